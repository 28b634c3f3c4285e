"""Segmented telescopes against HCIPy's, which has them from the observatories' drawings."""

import hcipy
import numpy as np
import pytest

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.segment_layouts import elt, gmt, keck


@pytest.mark.parametrize(
    ("layout", "make", "width_m", "may_turn"),
    [
        (gmt, lambda: hcipy.make_gmt_aperture(with_spiders=False), 26.0, False),
        (keck, lambda: hcipy.make_keck_aperture(with_spiders=False, gap_padding=1), 11.2, True),
        (elt, lambda: hcipy.make_elt_aperture(with_spiders=False), 40.4, True),
    ],
)
def test_mirrors_lie_where_hcipy_has_them(layout, make, width_m, may_turn):
    pixels, parts = 128, 4
    theirs = make()(hcipy.make_pupil_grid(pixels * parts, width_m)).shaped
    theirs = np.asarray(theirs, float).reshape(pixels, parts, pixels, parts).mean(axis=(1, 3))
    ours = layout().amplitude(Grid((pixels, pixels), width_m / pixels))
    if may_turn:  # a lattice of hexagons may stand on a side or on a corner
        ours = min((ours, ours.T), key=lambda one: abs(one - theirs).sum())
    # HCIPy has points, no areas: four in a row leave an eighth of a pixel of each rim.
    assert abs(ours - theirs).sum() / theirs.sum() < 0.03
    assert ours.sum() == pytest.approx(theirs.sum(), rel=4e-3)

"""Segmented telescopes that exist, or are built: where their mirrors are."""

import dataclasses
import math
from collections.abc import Callable, Iterator

import numpy as np

from nlcwfs.beam.pupil import Spiders
from nlcwfs.beam.segments import Segment, Segments
from nlcwfs.beam.settings import BeamSettings
from nlcwfs.errors import SettingsError


def sparse(*, spiders: Spiders | None = None) -> Segments:
    """Four discs of 2.4 m in 8 m, as in Guyon 2010, sec. 4.5.

    Examples:
        >>> [round(part.x_m, 2) for part in sparse().parts]
        [2.8, 0.0, -2.8, 0.0]
    """
    away_m = (8.0 - 2.4) / 2
    places = ((0, 1), (1, 0), (0, -1), (-1, 0))
    return Segments(tuple(Segment(y * away_m, x * away_m, 2.4) for y, x in places), spiders=spiders)


def gmt(*, spiders: Spiders | None = None) -> Segments:
    """Giant Magellan Telescope: seven mirrors of 8.4 m in 25.4 m, the outer six seen askew.

    Sizes of the GMT System Level Preliminary Design Review (GMT-REQ-03215, rev. F), as HCIPy has them: clear diameters
    8.293 and 8.350 m, the outer mirrors tilted by 13.522 degrees, a gap of 0.447 m to the middle one, which has a
    shadow of 3.495 m. Its truss is left out.

    Examples:
        >>> len(gmt().parts), round(gmt().parts[1].x_m, 2)
        (7, 8.65)
    """
    middle_m, outer_m, gap_m, squeeze = 8.365 - 0.072, 8.365 - 0.015, 0.359 + 0.088, math.cos(math.radians(13.522))
    away_m = middle_m / 2 + outer_m / 2 * squeeze + gap_m
    angles_rad = np.deg2rad(60.0 * np.arange(6))
    ring = [Segment(float(away_m * np.sin(a)), float(away_m * np.cos(a)), outer_m, squeeze=squeeze) for a in angles_rad]
    return Segments((Segment(0.0, 0.0, middle_m), *ring), obstruction_m=3.495, spiders=spiders)


def keck(*, spiders: Spiders | None = None) -> Segments:
    """Keck: three rings of hexagons of 0.9 m a side, 3 mm apart, a shadow of 2.65 m (Nelson et al. 1985).

    Examples:
        >>> len(keck().parts)
        36
    """
    width_m, gap_m = 0.9 * math.sqrt(3), 0.003
    places = [place for place in _hexagonal(width_m + gap_m, rings=3) if place != (0.0, 0.0)]
    return Segments(_hexagons(places, width_m), obstruction_m=2.65, spiders=spiders)


def elt(*, spiders: Spiders | None = None) -> Segments:
    """Extremely Large Telescope: 798 hexagons of 1.45 m from corner to corner, 4 mm apart, in 39 m.

    The inner hexagon of 9.41 m is left out, and so are the tips of the outer one (ESO's E-ELT Construction Proposal, as
    HCIPy has it).

    Examples:
        >>> len(elt().parts)
        798
    """
    width_m, gap_m, inner_m, outer_m = 1.45 * math.sqrt(3) / 2, 0.004, 9.4136, 39.14634
    normals_rad = np.deg2rad([30.0, 90.0, 150.0])  # of the outlines, which stand on a corner of the segments' lattice

    def across_m(place: tuple[float, float]) -> float:
        return float(np.max(np.abs(place[1] * np.cos(normals_rad) + place[0] * np.sin(normals_rad))))

    places = list(_hexagonal(width_m + gap_m, rings=17))
    kept = [p for p in places if across_m(p) > inner_m / 2 and _top_m(p) < 0.99 * outer_m / 2]
    return Segments(_hexagons(kept, width_m), spiders=spiders)


LAYOUTS: dict[str, Callable[..., Segments]] = {"sparse": sparse, "gmt": gmt, "keck": keck, "elt": elt}
"""By the name that the settings have for them."""


def segments_of(beam: BeamSettings) -> Segments | None:
    """The segments that the settings ask for; None for a telescope of one piece.

    Raises:
        SettingsError: If segments overlap or leave the telescope, or pistons are not one for each.

    Examples:
        >>> segments_of(BeamSettings()) is None
        True
        >>> from nlcwfs.beam.settings import SegmentsSettings
        >>> two = SegmentsSettings(layout="discs", centres_m=((0.0, -1.0), (0.0, 1.0)), widths_m=(3.0,))
        >>> segments_of(BeamSettings(segments=two))
        Traceback (most recent call last):
        ...
        nlcwfs.errors.SettingsError: beam.segments.centres_m: must keep segments apart; two overlap, got ...
    """
    chosen = beam.segments
    if chosen.layout == "none":
        return None
    spiders, shadow_m = vanes(beam), beam.obstruction_ratio * beam.diameter_m
    if chosen.layout in LAYOUTS:
        found = LAYOUTS[chosen.layout](spiders=spiders)
        found = dataclasses.replace(found, obstruction_m=max(found.obstruction_m, shadow_m))
    else:
        widths_m = chosen.widths_m * (len(chosen.centres_m) if len(chosen.widths_m) == 1 else 1)
        sides = 6 if chosen.layout == "hexagons" else 0
        parts = [
            Segment(y_m, x_m, width_m, sides=sides, angle_deg=chosen.angle_deg)
            for (y_m, x_m), width_m in zip(chosen.centres_m, widths_m, strict=True)
        ]
        found = Segments(tuple(parts), obstruction_m=shadow_m, spiders=spiders)
    found.check_inside(beam.diameter_m)
    if chosen.pistons_nm and len(chosen.pistons_nm) != len(found.parts):
        rule = f"must be one for each of {len(found.parts)} segments"
        raise SettingsError("beam.segments.pistons_nm", rule, f"{len(chosen.pistons_nm)}")
    return found


def vanes(beam: BeamSettings) -> Spiders | None:
    """The vanes of the settings, if there are any.

    Examples:
        >>> vanes(BeamSettings(spider_count=2, spider_width_m=0.2))
        Spiders(angles_deg=(0.0, 180.0), width_m=0.2)
    """
    if not beam.spider_count:
        return None
    return Spiders.evenly(beam.spider_count, width_m=beam.spider_width_m, first_angle_deg=beam.spider_angle_deg)


def _hexagonal(pitch_m: float, *, rings: int) -> Iterator[tuple[float, float]]:
    """Centres `(y, x)` of a hexagonal lattice, its rows along x."""
    for row in range(-rings, rings + 1):
        count = 2 * rings + 1 - abs(row)
        for column in range(count):
            yield row * pitch_m * math.sqrt(3) / 2, (column - (count - 1) / 2) * pitch_m


def _hexagons(places: list[tuple[float, float]], width_m: float) -> tuple[Segment, ...]:
    return tuple(Segment(y_m, x_m, width_m, sides=6) for y_m, x_m in places)


def _top_m(place: tuple[float, float]) -> float:
    """How far a centre is out along the directions of the lattice's corners."""
    angles_rad = np.deg2rad([0.0, 60.0, 120.0])
    return float(np.max(np.abs(place[1] * np.cos(angles_rad) + place[0] * np.sin(angles_rad))))

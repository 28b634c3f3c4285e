"""The modes that a wrapped phase is unwrapped with, for any pupil."""

import numpy as np
from jaxtyping import Float

from nlcwfs.beam.modes import ModalBasis, modal_basis
from nlcwfs.beam.pupil import inside
from nlcwfs.beam.segment_modes import segment_basis
from nlcwfs.estimation.sensor_geometry import SensorGeometry

CARRIED = 0.7
"""Modes for each pixel that is at least half lit, at most: pi / 4 is half a cycle per pixel, less the rim."""


def unwrapping_basis(geometry: SensorGeometry, pupil: Float[np.ndarray, "y x"], *, modes: int) -> ModalBasis:
    """As many modes as are wanted and as the pixels carry; on a pupil of segments as many inside each.

    Args:
        geometry: The sensor.
        pupil: Amplitude of the pupil on the pixels of its frames.
        modes: Wanted.

    Examples:
        >>> from nlcwfs.beam.grid import Grid
        >>> from nlcwfs.beam.pupil_shape import PupilShape
        >>> from nlcwfs.beam.segment_layouts import sparse
        >>> shape, frame = PupilShape(8.0, segments=sparse()), Grid((24, 24), 0.4)
        >>> unwrapping_basis(SensorGeometry(shape, frame, 0.65e-6, (3e6,)), shape.on(frame), modes=40).count
        43
    """
    frame, diameter_m = geometry.frame, geometry.pupil.diameter_m
    labels = geometry.pupil.labels(frame)
    if labels is None:
        count = max(1, min(modes, int(CARRIED * np.sum(inside(pupil)))))
        return modal_basis(pupil, frame, diameter_m=diameter_m, count=count)
    number = int(labels.max()) + 1
    carried = CARRIED * np.bincount(labels.ravel(), inside(pupil).ravel(), number).min()
    count = max(0, min(modes // number, int(carried)))
    return segment_basis(pupil, frame, labels, diameter_m=diameter_m, inside=count)

"""How few pixels, and how small a window: the error against both, beside the law of Guyon 2010, sec. 2.5."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from nlcwfs.beam.sampling import SamplingNeed, sampling_needed
from nlcwfs.beam.sampling_cost import SensedLight
from nlcwfs.simulation.design.loop_errors import LoopErrors, Planes, loop_errors
from nlcwfs.simulation.design.loop_residual import Loop, LoopResidual
from nlcwfs.simulation.design.plane_information import Pixels, PlaneInformation

PER_CYCLE = 2.75
"""Pixels across the pupil for each cycle of the mirror's cutoff that are proposed: 44 for 16, with which loops run
well. Information would do with fewer, the reconstructor does not (study 08)."""

TRIED = (1.0, 0.82, 0.68, 0.59, 0.5, 0.41)
"""Parts of that number that are tried: 44, 36, 30, 26, 22, 18."""

WINDOWS = (1.1, 1.45, 2.0, 2.9)
"""Windows that are told, in telescope diameters."""


@dataclass(frozen=True)
class Choice:
    """A detector, and what it is expected to leave.

    Attributes:
        pixels: Across the pupil and along the window.
        errors: What is left with them.
        caught: Share of the light that falls on the window.
    """

    pixels: Pixels
    errors: LoopErrors
    caught: float


def pixels_of(loop: Loop, part: float = 1.0) -> int:
    """Pixels across the pupil, even, for a part of the usual number.

    Examples:
        >>> from nlcwfs.config import Config
        >>> [pixels_of(Loop.of(Config(), 3e6), part) for part in TRIED]
        [44, 36, 30, 26, 22, 18]
    """
    return max(4, 2 * round(part * PER_CYCLE * loop.cutoff_cpa / 2))


def window_of(across: int, window: float) -> int:
    """Pixels along a window of so many telescope diameters, even.

    Examples:
        >>> window_of(44, 1.45), window_of(22, 1.45)
        (64, 32)
    """
    return 2 * math.ceil(round(across * window, 6) / 2)


def law_of(loop: Loop, planes: Planes) -> SamplingNeed:
    """What the sampling law asks for, see `beam.sampling.sampling_needed`."""
    light = SensedLight(loop.diameter_m, loop.wavelength_m, cycles_per_aperture=loop.cutoff_cpa)
    return sampling_needed(light, planes.distances_m)


def choices(
    residual: LoopResidual, planes: Planes, *, pixels: Sequence[Pixels], rate_hz: float, dark_share: float
) -> list[Choice]:
    """What detectors leave, for the first of the residual's wavefronts.

    Args:
        residual: The wavefronts that are met.
        planes: The planes.
        pixels: Detectors.
        rate_hz: Exposures in a second.
        dark_share: See `PlaneInformation`.

    Examples:
        >>> from nlcwfs.atmosphere.phase_screen import Turbulence
        >>> from nlcwfs.beam.pupil_shape import PupilShape
        >>> small = Loop(Turbulence(0.2), 1.0, 0.85e-6, 4.0, 10.0, 1.0, photons_per_s=1e6)
        >>> left = LoopResidual.build(small, PupilShape(1.0)).redrawn(rate_hz=500.0, draws=1, seed=0)
        >>> both = [Pixels(12, 18), Pixels(12, 36)]
        >>> usual, wide = choices(left, Planes.evenly(3e4), pixels=both, rate_hz=500.0, dark_share=0.0)
        >>> usual.caught < wide.caught, usual.errors.photon_m > wide.errors.photon_m
        (True, True)
    """
    told = []
    for one in pixels:
        information = PlaneInformation(residual.first(1), one, dark_share)
        errors = loop_errors(information, planes, rate_hz=rate_hz)
        caught = sum(
            share * information.caught(distance_m)
            for distance_m, share in zip(planes.distances_m, planes.shares, strict=True)
        )
        told.append(Choice(one, errors, caught))
    return told

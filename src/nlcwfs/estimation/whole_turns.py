"""Pixels that have slipped by a whole turn in a carried phase, and back."""

import numpy as np
from jaxtyping import Array, Float

from nlcwfs.beam.grid import Grid
from nlcwfs.estimation.angle import wrap
from nlcwfs.estimation.turbulence_filter import half_plane_frequencies, smoothed_phase

CUTOFF_CPA = 5.0
"""A slipped group of pixels is narrower, turbulence up to D / r0 = 25 seldom strays by pi beyond (study 01)."""

PASSES = 3
"""A pass brings back most pixels, so that the next sees a smooth phase near the others; beside groups two turns off it
takes three (17 nm instead of 39 in one of 8 screens at 2e6 photons), and a fourth changes nothing."""


def slip_filter(grid: Grid, *, diameter_m: float) -> Float[np.ndarray, "y fx"]:
    """Fourier factor that leaves the smooth part of a phase."""
    return 1 / (1 + (half_plane_frequencies(grid) * diameter_m / CUTOFF_CPA) ** 4)


def without_slips(phase_rad: Float[Array, "y x"], smooth: Float[Array, "y fx"]) -> Float[Array, "y x"]:
    """The phase with every pixel within half a turn of its smooth surroundings.

    Bright light leaves the filter inside the loop little to say; a pixel may then settle a whole turn off, where it
    explains the images just as well. At 2e6 photons that costs 31 instead of 17 nm, and a third of the screens.

    Args:
        phase_rad: Carried phase, not wrapped.
        smooth: See `slip_filter`.
    """
    for _ in range(PASSES):
        surroundings = smoothed_phase(phase_rad, smooth)
        phase_rad = surroundings + wrap(phase_rad - surroundings)
    return phase_rad

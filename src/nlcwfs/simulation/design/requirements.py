"""What a design is asked for, and whether physics allows it."""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from nlcwfs.errors import SettingsError
from nlcwfs.simulation.design.loop_errors import LoopErrors, best_of_rates, ideal_errors
from nlcwfs.simulation.design.loop_residual import LoopResidual

USUAL_LOSS = 2.8
"""Photons that the sensor needs over the quantum limit, window and pixels counted; for a first guess of the rate."""

LOCKED_RAD = 1.5
"""Rms at the wavelength of sensing beyond which no loop is expected to stay closed: loops of study 04 end at 1.2 to
1.8 rad with a star of magnitude 15, and are lost or stay open with 16."""


@dataclass(frozen=True)
class Wishes:
    """What is asked for; None is for the design to choose.

    Attributes:
        planes: How many planes, in symmetric pairs.
        window: Width of the detector's window, in telescope diameters.
        pixels: Across the pupil.
        rate_hz: Exposures in a second.
        rms_nm: What may be left at most.
        keep_planes: Take the planes of the settings.
        draws: Wavefronts over which the information is averaged.

    Raises:
        SettingsError: If a number breaks its rule.

    Examples:
        >>> Wishes(rms_nm=80.0).planes
        4
    """

    planes: int = 4
    window: float = 1.45
    pixels: int | None = None
    rate_hz: float | None = None
    rms_nm: float | None = None
    keep_planes: bool = False
    draws: int = 2

    def __post_init__(self) -> None:
        if self.planes not in (2, 4):
            raise SettingsError("--planes", "must be 2 or 4, in symmetric pairs", self.planes)
        if not 1 <= self.window <= 16:
            raise SettingsError("--window", "must be from 1 to 16 telescope diameters", self.window)
        if self.pixels is not None and not 4 <= self.pixels <= 1000:
            raise SettingsError("--pixels", "must be from 4 to 1000 across the pupil", self.pixels)
        if self.rate_hz is not None and not 0 < self.rate_hz <= 1e5:
            raise SettingsError("--rate", "must be greater than 0 and at most 100000 Hz", self.rate_hz)
        if self.rms_nm is not None and not (self.rms_nm > 0 and math.isfinite(self.rms_nm)):
            raise SettingsError("--rms-nm", "must be a positive length", self.rms_nm)


def first_rate_hz(residual: LoopResidual, wishes: Wishes) -> float:
    """The rate that is asked for, or about the best.

    Args:
        residual: Mirror, air and star.
        wishes: What is asked for.
    """
    if wishes.rate_hz is not None:
        return wishes.rate_hz
    return best_of_rates(lambda rate_hz: ideal_errors(residual, rate_hz=rate_hz, loss=USUAL_LOSS).total_m)


def check_possible(residual: LoopResidual, wishes: Wishes, *, rate_hz: float, images: int) -> None:
    """Refuse what no planes can make good, before anything long is computed.

    Args:
        residual: Mirror, air and star.
        wishes: What is asked for.
        rate_hz: Exposures in a second.
        images: Number of planes.

    Raises:
        SettingsError: If a requirement cannot be met; the message says by how much.

    Examples:
        >>> from nlcwfs.atmosphere.phase_screen import Turbulence
        >>> from nlcwfs.beam.pupil_shape import PupilShape
        >>> from nlcwfs.simulation.design.loop_residual import Loop
        >>> small = Loop(Turbulence(0.2), 1.0, 0.85e-6, 4.0, 10.0, 1.0, photons_per_s=1e6)
        >>> left = LoopResidual.build(small, PupilShape(1.0))
        >>> check_possible(left, Wishes(pixels=4), rate_hz=500.0, images=4)
        >>> check_possible(left, Wishes(pixels=4), rate_hz=500.0, images=2)
        Traceback (most recent call last):
        ...
        nlcwfs.errors.SettingsError: --pixels: must be at least 6 for the 42 modes of the mirror on 2 images, got 4
    """
    pixels = wishes.pixels
    if pixels is not None and images * np.pi / 4 * pixels**2 < residual.controlled:
        least = math.ceil(math.sqrt(residual.controlled * 4 / np.pi / images))
        rule = f"must be at least {least} for the {residual.controlled} modes of the mirror on {images} images"
        raise SettingsError("--pixels", rule, pixels)
    check_rms(residual, ideal_errors(residual, rate_hz=rate_hz), wishes)
    _check_locked(residual, wishes, rate_hz)


def _check_locked(residual: LoopResidual, wishes: Wishes, rate_hz: float) -> None:
    """Refuse a mirror that is too coarse, air that is too fast and a star that is too faint for any loop."""
    expected, most_m = ideal_errors(residual, rate_hz=rate_hz, loss=USUAL_LOSS), LOCKED_RAD * residual.loop.radian_m
    if expected.total_m <= most_m:
        return
    limit = f"{1e9 * most_m:.0f} nm ({LOCKED_RAD:g} rad) for a loop to stay closed"
    photons_per_s = residual.loop.photons_per_s

    def left_m(factor: float) -> float:
        brighter = dataclasses.replace(residual.loop, photons_per_s=photons_per_s * factor)
        bright = dataclasses.replace(residual, loop=brighter)
        return ideal_errors(bright, rate_hz=first_rate_hz(bright, wishes), loss=USUAL_LOSS).total_m

    low, enough = 1.0, 1e6
    if left_m(enough) > most_m:
        parts = f"mirror {1e9 * expected.fitting_m:.0f} nm, lag {1e9 * expected.lag_m:.0f} nm at {rate_hz:g} Hz"
        raise SettingsError("mirror.cutoff_cpa", f"mirror and rate must leave less than {limit}", parts)
    while enough > 1.05 * low:
        middle = math.sqrt(low * enough)
        low, enough = (low, middle) if left_m(middle) <= most_m else (middle, enough)
    rule = f"must be at least {photons_per_s * enough:.2g} (photo-electrons) to leave less than {limit}"
    raise SettingsError(
        "atmosphere.photons_per_s", rule, f"{photons_per_s:.2g}, which leave {1e9 * expected.total_m:.0f} nm"
    )


def check_rms(residual: LoopResidual, errors: LoopErrors, wishes: Wishes) -> None:
    """Refuse an rms that cannot be reached.

    Args:
        residual: Mirror, air and star.
        errors: What is expected.
        wishes: What is asked for.

    Raises:
        SettingsError: If more is expected to be left; the message says what limits.

    Examples:
        >>> from nlcwfs.atmosphere.phase_screen import Turbulence
        >>> from nlcwfs.beam.pupil_shape import PupilShape
        >>> from nlcwfs.simulation.design.loop_residual import Loop
        >>> small = Loop(Turbulence(0.2), 1.0, 0.85e-6, 4.0, 10.0, 1.0, photons_per_s=1e6)
        >>> left = LoopResidual.build(small, PupilShape(1.0))
        >>> check_rms(left, ideal_errors(left, rate_hz=500.0), Wishes(rms_nm=20.0))
        Traceback (most recent call last):
        ...
        nlcwfs.errors.SettingsError: --rms-nm: must be at least 28.4: the mirror cannot make ... leave 20), got 20.0
    """
    if wishes.rms_nm is None or errors.total_m * 1e9 <= wishes.rms_nm:
        return
    fitting_nm, total_nm = 1e9 * errors.fitting_m, 1e9 * errors.total_m
    if fitting_nm > wishes.rms_nm:
        needed = residual.loop.cutoff_cpa * (fitting_nm / wishes.rms_nm) ** (6 / 5)  # variance falls with f^(-5/3)
        rule = (
            f"must be at least {fitting_nm:.1f}: the mirror cannot make what is finer than"
            f" {residual.loop.cutoff_cpa:.3g} cycles per aperture ({needed:.3g} leave {wishes.rms_nm:g})"
        )
        raise SettingsError("--rms-nm", rule, wishes.rms_nm)
    what = "any sensor" if errors.photon_m <= errors.quantum_m * (1 + 1e-9) else "these planes"
    rule = (
        f"must be at least {total_nm:.1f}, what {what} of {residual.loop.photons_per_s:.3g} photons a second leaves at"
        f" {errors.rate_hz:g} Hz (mirror {fitting_nm:.0f}, lag {1e9 * errors.lag_m:.0f}, photons"
        f" {1e9 * errors.photon_m:.0f})"
    )
    raise SettingsError("--rms-nm", rule, wishes.rms_nm)

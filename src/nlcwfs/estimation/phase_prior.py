r"""What is known of the phase before its photons are: a variance for every wave of a periodic grid.

A power here is the variance of a coefficient of `rfft2`, in rad^2, where white noise of unit variance has 1 (see
`turbulence_filter.expected_power`), so that a phase with this prior is :math:`F^{-1} \sqrt{P}\, F x` for white x.
It is either the whole turbulence or what a closed loop leaves of it; what the frame before leaves open is told by
`frame_prediction`.

A periodic grid holds too little tilt, 12 % of Kolmogorov's variance on a window of 1.42 telescopes and 28 % on one
of 2.84; without tilt it holds 92 % and 98 %. So take the phase relative to a tilt that is known otherwise.
"""

import math
from dataclasses import dataclass

import numpy as np
import scipy.special
from jaxtyping import Float

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.errors import SettingsError
from nlcwfs.estimation.prior_settings import PriorSettings
from nlcwfs.estimation.turbulence_filter import expected_power, half_plane_frequencies


@dataclass(frozen=True)
class ClosedLoop:
    """What a mirror that follows the wind with a delay leaves of the turbulence.

    Attributes:
        cutoff_per_m: Finest wave that the mirror takes out.
        lag_s: From the middle of an exposure to the middle of its correction on the mirror.
        wind_m_per_s: Speed of the air; its direction is not known.
        noise: Power that measurement noise adds below the cutoff, see `noise_power`.
        beyond_share: Share of the turbulence that is expected beyond the cutoff.

    Raises:
        SettingsError: If the cutoff is not positive, or another number is negative.

    Examples:
        >>> loop = ClosedLoop(cutoff_per_m=2.0, lag_s=2e-3, wind_m_per_s=10.0)
        >>> loop.noise
        0.0
    """

    cutoff_per_m: float
    lag_s: float
    wind_m_per_s: float
    noise: float = 0.0
    beyond_share: float = 1.0

    def __post_init__(self) -> None:
        if not self.cutoff_per_m > 0:
            raise SettingsError("estimation.prior.cutoff_cpa", "must be positive", self.cutoff_per_m)
        names = {
            "lag_s": "lag_s",
            "wind_m_per_s": "wind_speed_m_per_s",
            "noise": "noise",
            "beyond_share": "beyond_share",
        }
        for name, key in names.items():
            if not getattr(self, name) >= 0:
                raise SettingsError(f"estimation.prior.{key}", "must not be negative", getattr(self, name))


def expected_air(settings: PriorSettings, *, seeing_arcsec: float, diameter_m: float) -> Turbulence:
    """The turbulence that a user expects.

    Args:
        settings: Fried's parameter, when known, and outer scale.
        seeing_arcsec: Seeing at 0.5 um; counts where the settings hold no Fried parameter.
        diameter_m: Of the telescope.

    Raises:
        SettingsError: If a length is not positive, or the outer scale is below the telescope's diameter.

    Examples:
        >>> round(expected_air(PriorSettings(), seeing_arcsec=0.6, diameter_m=8.0).fried_m, 3)
        0.168
        >>> expected_air(PriorSettings(outer_scale_m=2.0), seeing_arcsec=0.6, diameter_m=8.0)
        Traceback (most recent call last):
        ...
        nlcwfs.errors.SettingsError: estimation.prior.outer_scale_m: must be at least the telescope's diameter (8 m)...
    """
    outer_scale_m = math.inf if settings.outer_scale_m is None else settings.outer_scale_m
    if not outer_scale_m >= diameter_m:
        rule = f"must be at least the telescope's diameter ({diameter_m:g} m)"
        raise SettingsError("estimation.prior.outer_scale_m", rule, f"{outer_scale_m:g}")
    if settings.fried_m is not None:
        if not settings.fried_m > 0:  # only where the settings were made without being validated
            raise SettingsError("estimation.prior.fried_m", "must be a positive length", settings.fried_m)
        return Turbulence(settings.fried_m, outer_scale_m=outer_scale_m)
    if not seeing_arcsec > 0:
        raise SettingsError("estimation.seeing_arcsec", "must be a positive angle", seeing_arcsec)
    return Turbulence.from_seeing(seeing_arcsec=seeing_arcsec, outer_scale_m=outer_scale_m)


def prior_power(
    grid: Grid,
    settings: PriorSettings,
    air: Turbulence,
    *,
    wavelength_m: float,
    diameter_m: float,
    lit_pixels: float,
) -> Float[np.ndarray, "y fx"]:
    """The power that a user expects: of the whole turbulence, or of what a closed loop leaves.

    Args:
        grid: Pixels of the phase.
        settings: Without `cutoff_cpa` no loop is closed.
        air: See `expected_air`.
        wavelength_m: Wavelength at which the phase counts.
        diameter_m: Of the telescope, the unit of `cutoff_cpa`.
        lit_pixels: Light on the grid over that of a fully lit pixel.

    Raises:
        SettingsError: If the cutoff is not positive, or lag or wind are negative.

    Examples:
        >>> light = {"wavelength_m": 0.85e-6, "diameter_m": 8.0, "lit_pixels": 200.0}
        >>> grid, air = Grid((32, 32), 0.5), Turbulence.from_seeing(seeing_arcsec=0.6)
        >>> whole = prior_power(grid, PriorSettings(), air, **light)
        >>> left = prior_power(grid, PriorSettings(cutoff_cpa=6.0, lag_s=0.004, photons=1e4), air, **light)
        >>> bool(left[0, 1] < whole[0, 1]), bool(left[0, 16] == whole[0, 16])
        (True, True)
    """
    if settings.cutoff_cpa is None:
        return expected_power(grid, air, wavelength_m=wavelength_m, cutoff_per_m=None)
    noise = 0.0
    if settings.photons is not None:
        noise = noise_power(settings.photons, sensor_loss=settings.sensor_loss, lit_pixels=lit_pixels)
    loop = ClosedLoop(
        cutoff_per_m=settings.cutoff_cpa / diameter_m,
        lag_s=settings.lag_s,
        wind_m_per_s=settings.wind_speed_m_per_s,
        noise=noise,
        beyond_share=settings.beyond_share,
    )
    return closed_loop_power(grid, air, loop, wavelength_m=wavelength_m)


def closed_loop_power(
    grid: Grid, air: Turbulence, loop: ClosedLoop, *, wavelength_m: float
) -> Float[np.ndarray, "y fx"]:
    """Power of what a loop of gain one leaves: below its cutoff lag and noise, beyond it the turbulence.

    Examples:
        >>> air = Turbulence(fried_m=0.2)
        >>> prompt = ClosedLoop(cutoff_per_m=0.3, lag_s=0.0, wind_m_per_s=10.0)
        >>> power = closed_loop_power(Grid((8, 8), 0.5), air, prompt, wavelength_m=0.65e-6)
        >>> bool(power[0, 1] == 0), bool(power[0, 2] > 0)  # 0.25 and 0.5 cycles per metre
        (True, True)
    """
    frequency_per_m = half_plane_frequencies(grid)
    whole = expected_power(grid, air, wavelength_m=wavelength_m, cutoff_per_m=None)
    lagging = whole * lag_share(frequency_per_m, wind_m_per_s=loop.wind_m_per_s, lag_s=loop.lag_s) + loop.noise
    return np.where(frequency_per_m <= loop.cutoff_per_m, lagging, loop.beyond_share * whole)


def lag_share(
    frequency_per_m: Float[np.ndarray, "*shape"], *, wind_m_per_s: float, lag_s: float
) -> Float[np.ndarray, "*shape"]:
    r"""What a pure delay leaves of a wave that the wind carries, over its variance: 0 to 2.8.

    :math:`|1 - \exp(-2 \pi i f v \tau \cos\theta)|^2` averaged over the direction of the wind,
    :math:`2 (1 - J_0(2 \pi f v \tau))`. Above 1 the correction makes the wave worse.

    Examples:
        >>> lag_share(np.array([0.0, 1.0, 50.0]), wind_m_per_s=10.0, lag_s=0.002).round(3).tolist()
        [0.0, 0.008, 1.559]
    """
    angle = 2 * np.pi * frequency_per_m * wind_m_per_s * lag_s
    # Two terms of the series where 1 - J0 has lost its digits; the third is 2e-11 of them there.
    return np.where(angle < 0.01, angle**2 / 2 * (1 - angle**2 / 16), 2 * (1 - scipy.special.j0(angle)))


def noise_power(photons: float, *, sensor_loss: float, lit_pixels: float) -> float:
    """Power of white measurement noise that gives every mode of unit rms the variance `sensor_loss / (4 photons)`.

    A mode averages over all lit pixels, hence their number. The limit is that of Haffert et al. 2023.

    Args:
        photons: Of one exposure, whole sensor.
        sensor_loss: Photons that the sensor needs relative to the quantum limit.
        lit_pixels: Light on the grid over that of a fully lit pixel.

    Raises:
        SettingsError: If there are no photons, or the sensor is better than the quantum limit.

    Examples:
        >>> noise_power(1e4, sensor_loss=2.0, lit_pixels=1600.0)
        0.08
    """
    if not photons > 0:
        raise SettingsError("estimation.prior.photons", "must be positive", photons)
    if not sensor_loss >= 1:
        raise SettingsError("estimation.prior.sensor_loss", "must be at least 1, the quantum limit", sensor_loss)
    return sensor_loss * lit_pixels / (4 * photons)

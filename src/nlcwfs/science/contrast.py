r"""The halo that a fast loop leaves around a star: C2 of Guyon (2005, ApJ 629, 592), time lag and photon noise.

Behind an ideal coronagraph a ripple of the wavefront of amplitude h makes two speckles, each of
:math:`(\pi h / \lambda_i)^2` of the star's peak, at :math:`\theta = \lambda_i f`. A random phase of power spectrum W
[rad^2 m^2] makes the mean halo :math:`C(\theta) = W(\theta / \lambda_i) / A` with A the area of the telescope: the
power in one element of resolution. What is left out: scintillation, chromatic errors, aliasing, what the mirror cannot
make, and what the aperture's wings carry from one angle to another.
"""

import math
from typing import NamedTuple

import numpy as np
import scipy.optimize
from jaxtyping import Float

from nlcwfs.atmosphere.phase_screen import Turbulence

AZIMUTHS = 256
"""Directions over a quarter turn; the mean over them is that over all."""

FASTEST_HZ, SLOWEST_HZ = 1e6, 1e-1
"""Where the numerical search for the best rate ends."""


def ripple_contrast(amplitude_m: float, wavelength_m: float) -> float:
    r"""Contrast of each of the two speckles of a ripple, :math:`(\pi h / \lambda)^2`.

    Examples:
        >>> f"{ripple_contrast(5e-9, 1.6e-6):.2e}"
        '9.64e-05'
    """
    return (math.pi * amplitude_m / wavelength_m) ** 2


class Halo(NamedTuple):
    r"""Telescope, air, star and loop, as far as the halo depends on them.

    The loop is the plain one: what an exposure of length T has shown is taken out whole during the exposure that
    begins `latency_exposures` after its end. All contrasts are means over the azimuth, relative to the star's peak.

    Attributes:
        air: The turbulence.
        winds: Share of the turbulence and speed in m/s of each layer.
        diameter_m: Diameter of the telescope, in which cycles per aperture are counted.
        area_m2: Area of the telescope.
        sensing_m: Wavelength of the sensor.
        imaging_m: Wavelength of the image.
        photons_per_s: What the sensor gets of the star.
        latency_exposures: From the end of an exposure until its command is on the mirror, in exposures.

    Examples:
        >>> air, area_m2 = Turbulence.from_seeing(seeing_arcsec=0.6), math.pi * 16
        >>> halo = Halo(air, ((1.0, 10.0),), 8.0, area_m2, 0.7e-6, 1.6e-6, 7.8e7)
        >>> theta, q = np.array([2.0e-7]), np.array([760.9])
        >>> f"{halo.contrast(theta, 1000.0, q)[0]:.1e} at 1 kHz, best at {halo.best_rate_hz(theta, q)[0]:.0f} Hz"
        '5.3e-04 at 1 kHz, best at 635 Hz'
    """

    air: Turbulence
    winds: tuple[tuple[float, float], ...]
    diameter_m: float
    area_m2: float
    sensing_m: float
    imaging_m: float
    photons_per_s: float
    latency_exposures: float = 0.0

    def cycles_per_aperture(self, angle_rad: Float[np.ndarray, " angle"]) -> Float[np.ndarray, " angle"]:
        """Frequency of the waves whose speckles lie at an angle."""
        return np.asarray(angle_rad) * (self.diameter_m / self.imaging_m)

    def uncorrected(self, angle_rad: Float[np.ndarray, " angle"]) -> Float[np.ndarray, " angle"]:
        r"""The halo of the air itself, :math:`W(f) / A`."""
        opd_m2 = self.air.opd_spectrum(np.asarray(angle_rad) / self.imaging_m)
        return opd_m2 * (2 * np.pi / self.imaging_m) ** 2 / self.area_m2

    def lag(self, angle_rad: Float[np.ndarray, " angle"], rate_hz: float) -> Float[np.ndarray, " angle"]:
        r"""The halo of the time that passes from light to correction.

        The mirror holds the mean over an exposure T while the frozen air goes on. Of a wave of
        :math:`\nu = f \cdot v` cycles a second the power that is left, averaged over the exposure, is

        .. math:: 1 + s^2 - 2 s^2 \cos(2 \pi \nu T (1 + L)) , \quad s = \mathrm{sinc}(\nu T) , \; L \text{ the latency}

        of that in the air. For slow waves it is :math:`(2 \pi \nu T)^2 ((1 + L)^2 + 1/12)`: the lag from middle to
        middle, and a twelfth for the drift during the exposure.
        """
        frequency = np.asarray(angle_rad, float)[..., None] / self.imaging_m
        along = np.cos((np.arange(AZIMUTHS) + 0.5) * (np.pi / 2 / AZIMUTHS))
        left = 0.0
        for share, speed_m_per_s in self.winds:
            cycles = frequency * speed_m_per_s * along / rate_hz
            mean = np.sinc(cycles)
            passed = 2 * np.sin(np.pi * cycles * (1 + self.latency_exposures)) ** 2  # 1 - cos, digits kept
            left = left + share * np.mean((1 - mean) ** 2 + 2 * mean * (1 - mean) + 2 * mean**2 * passed, axis=-1)
        return self.uncorrected(angle_rad) * left

    def photon_noise(self, rate_hz: float, flux_factor: Float[np.ndarray, " angle"]) -> Float[np.ndarray, " angle"]:
        r"""The halo of photon noise, :math:`q / (4 F T)\,(\lambda_w / \lambda_i)^2`.

        A mode of unit rms gets the variance :math:`q / (4 F T)` rad^2 from F T photons. Orthonormal modes fill the
        plane of frequencies with A modes to the unit of area, so the power spectrum of the noise is that times A,
        and the halo its A-th part.
        """
        scale = (self.sensing_m / self.imaging_m) ** 2
        return np.asarray(flux_factor) * (scale * rate_hz / (4 * self.photons_per_s))

    def contrast(
        self, angle_rad: Float[np.ndarray, " angle"], rate_hz: float, flux_factor: Float[np.ndarray, " angle"]
    ) -> Float[np.ndarray, " angle"]:
        """C2: the halo of lag and photon noise.

        Args:
            angle_rad: Angle from the star.
            rate_hz: Exposures in a second.
            flux_factor: Of the sensor, at the frequency of each angle.
        """
        return self.lag(angle_rad, rate_hz) + self.photon_noise(rate_hz, flux_factor)

    def best_rate_hz(
        self, angle_rad: Float[np.ndarray, " angle"], flux_factor: Float[np.ndarray, " angle"]
    ) -> Float[np.ndarray, " angle"]:
        r"""Rate of the least halo where the lag is short: of :math:`a T^2 + b / T` at :math:`T = (b / 2 a)^{1/3}`.

        The least is :math:`3 (a b^2 / 4)^{1/3}`, two thirds of it photon noise. So the gain of a sensor over another,
        each at its best rate, is the ratio of their flux factors to the power 2/3, whatever air and star are.
        """
        return (self.photon_noise(1.0, flux_factor) / (2 * self._slow_lag(angle_rad))) ** (-1 / 3)

    def best_contrast(
        self, angle_rad: Float[np.ndarray, " angle"], flux_factor: Float[np.ndarray, " angle"]
    ) -> Float[np.ndarray, " angle"]:
        """The least halo where the lag is short, see `best_rate_hz`."""
        noise = self.photon_noise(1.0, flux_factor)
        return 3 * (self._slow_lag(angle_rad) * noise**2 / 4) ** (1 / 3)

    def searched_rate_hz(self, angle_rad: float, flux_factor: float) -> float:
        """Rate of the least halo, found by search in the whole formula: a check of `best_rate_hz`.

        Args:
            angle_rad: One angle.
            flux_factor: There.
        """
        found = scipy.optimize.minimize_scalar(
            lambda x: float(np.log(self.contrast(np.array([angle_rad]), math.exp(x), np.array([flux_factor]))[0])),
            bounds=(math.log(SLOWEST_HZ), math.log(FASTEST_HZ)),
            method="bounded",
            options={"xatol": 1e-6},
        )
        return math.exp(found.x)

    def _slow_lag(self, angle_rad: Float[np.ndarray, " angle"]) -> Float[np.ndarray, " angle"]:
        """Halo of a short lag over the square of the exposure, 1/s^2; the mean over azimuths halves the square wind."""
        waves_per_m = np.asarray(angle_rad) / self.imaging_m
        square = sum(share * speed_m_per_s**2 for share, speed_m_per_s in self.winds) / 2
        delay = (1 + self.latency_exposures) ** 2 + 1 / 12
        return self.uncorrected(angle_rad) * (2 * np.pi * waves_per_m) ** 2 * square * delay

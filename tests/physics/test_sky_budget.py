"""Closed forms of what the sky costs: against linear estimation with matrices, and power laws."""

import math

import numpy as np
import pytest

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.atmosphere.scintillation import amplitude_variance
from nlcwfs.config import load_config
from nlcwfs.simulation.colours import colours_of
from nlcwfs.simulation.sky_budget import SkyBudget

WAVE_M, DIAMETER_M, PIXEL_M, PLANES_M = 0.85e-6, 8.0, 8 / 44, np.array([-3.5e6, -2.5e6, 2.5e6, 3.5e6])
MAS = math.pi / 180 / 3600e3
T = np.linspace(-1, 1, 1001)
"""Across a disc of radius 1, whose strips are the root of 1 - T^2 high."""
BAND = ("beam.spectrum.shape=flat", "beam.spectrum.bandwidth_ratio=0.6", "beam.spectrum.wavelengths=5")
BENT = (
    *BAND,
    "curvature_sensor.lenses=ideal",
    "atmosphere.dispersion.zenith_deg=50",
    "atmosphere.dispersion.corrector=share",
)
BENT = (*BENT, "atmosphere.dispersion.remaining_share=0.05", "atmosphere.dispersion.direction_deg=0")


def budget(*settings: str, rms_nm: float = 300.0, photons: float = 2e5) -> SkyBudget:
    air = Turbulence.from_rms(opd_rms_m=rms_nm * 1e-9, diameter_m=DIAMETER_M)
    colours = colours_of(load_config(None, settings), air)
    return SkyBudget(air, colours, wavelength_m=WAVE_M, diameter_m=DIAMETER_M, pixel_m=PIXEL_M, photons=photons)


def kolmogorov_rad2(frequency: np.ndarray, rms_nm: float) -> np.ndarray:
    """Variance of a mode of rms 1 in the spectrum 0.0229 r0^(-5/3) f^(-11/3) (Noll 1976), piston taken out."""
    fried_m = DIAMETER_M * (1.0299 / (2 * np.pi * rms_nm * 1e-9 / WAVE_M) ** 2) ** 0.6
    x = np.pi * DIAMETER_M * frequency
    piston = np.array([(2 / np.pi * np.trapezoid(np.cos(one * T) * np.sqrt(1 - T**2), T)) ** 2 for one in x])
    return 0.0229 * fried_m ** (-5 / 3) * frequency ** (-11 / 3) * (1 - piston) / (np.pi / 4 * DIAMETER_M**2)


def error_with_matrices(frequency: float, variance: float, photons: float, left, *, knows: bool) -> float:
    """One complex ripple on four planes: gain by Bayes, then what it makes of the true signals; mean over azimuths."""
    ideal = 2 * np.sin(np.pi * WAVE_M * PLANES_M * frequency**2)
    noise = np.diag(np.full(4, 4 / photons))  # a quarter of the photons each: variance of a wave's contrast
    true = np.moveaxis(ideal[:, None] * left, 0, -1)
    believed = true if knows else np.broadcast_to(ideal.astype(complex), true.shape)
    covariance = variance * believed[:, :, None] * believed[:, None, :].conj() + noise
    gain = variance * np.einsum("ap,apq->aq", believed.conj(), np.linalg.inv(covariance))
    missed = np.abs(1 - np.sum(gain * true, axis=1)) ** 2 * variance
    return float(np.mean(missed + np.einsum("ap,pq,aq->a", gain, noise, gain.conj()).real))


def smeared_by_disc(frequency: float, size_mas: float) -> np.ndarray:
    """Strips of a disc: no Bessel function."""
    turns = np.pi * size_mas * MAS * np.abs(PLANES_M) * frequency
    strips = np.sqrt(1 - T**2)
    return np.array([[np.average(np.cos(one * T), weights=strips)] for one in turns])


def smeared_by_dispersion(frequency: float, angles_rad, shares) -> np.ndarray:
    """A sum over colours, for many directions of the ripple; the mean direction is a tilt and is counted apart."""
    along = np.cos(np.linspace(0, np.pi, 61)[:-1])
    centred = angles_rad - shares @ angles_rad
    return np.einsum(
        "c,cpa->pa", shares, np.exp(-2j * np.pi * frequency * np.multiply.outer(centred, np.outer(PLANES_M, along)))
    )


@pytest.mark.parametrize("knows", [False, True])
@pytest.mark.parametrize("effect", ["star", "dispersion"])
def test_smeared_ripples_cost_what_linear_estimation_says(effect, knows):
    star = "atmosphere.star.size_mas=20"
    found = budget(*((star,) if effect == "star" else BENT))
    frequency = np.geomspace(0.5 / DIAMETER_M, 1 / PIXEL_M, 1500)
    variance = kolmogorov_rad2(frequency, 300.0)
    colours_m, shares = np.array(found.colours.spectrum.wavelengths_m), np.array(found.colours.spectrum.shares)
    # Ideal lenses: a colour from aside is moved by its own z, as if it came from farther aside.
    angles_rad = np.array([x for _, x in found.colours.star.directions_rad or [(0, 0)]]) * WAVE_M / colours_m
    added = []
    for one, power in zip(frequency, variance, strict=True):
        smeared = smeared_by_disc(one, 20.0)
        if effect == "dispersion":
            smeared = smeared_by_dispersion(one, angles_rad, shares)
        point = error_with_matrices(one, power, 2e5, np.ones((4, 1)), knows=True)
        added.append(error_with_matrices(one, power, 2e5, smeared, knows=knows) - point)
    seen = np.sinc(frequency * PIXEL_M / np.sqrt(2)) ** 4
    density = np.array(added) * np.pi / 4 * DIAMETER_M**2 * 2 * np.pi * frequency * seen
    ripples_m = WAVE_M / (2 * np.pi) * np.sqrt(np.trapezoid(density, frequency))
    tilt_m = 0.0
    if effect == "dispersion" and not knows:
        tilt_m = abs(shares @ angles_rad) * DIAMETER_M / 4
        assert tilt_m == pytest.approx(found.tilt_m, rel=1e-9)
        assert tilt_m > 1e-9
    # Both integrate in steps over signals that alternate fast at the end.
    without_tilt_m = math.sqrt(found.smeared_m(knows=knows) ** 2 - tilt_m**2)
    assert without_tilt_m == pytest.approx(ripples_m, rel=0.01)


def test_a_tilt_of_one_milliarcsecond_is_ten_nanometres_of_eight_metres():
    """The rms of a tilt over a disc is its slope times D / 4; here of coordinates on pixels."""
    found = budget(*BENT)
    colours = found.colours
    scale = np.array(colours.spectrum.shares) * WAVE_M / np.array(colours.spectrum.wavelengths_m)
    mean_rad = scale @ np.array(colours.star.directions_rad)
    y_m, x_m = np.meshgrid(np.arange(-500, 500) + 0.5, np.arange(-500, 500) + 0.5, indexing="ij")
    lit = np.hypot(y_m, x_m) < 500
    tilt_m = (mean_rad[0] * y_m + mean_rad[1] * x_m)[lit] * DIAMETER_M / 1000
    assert found.tilt_m == pytest.approx(np.std(tilt_m), rel=1e-3)  # pixels of the rim


def test_slow_waves_of_the_amplitude_follow_their_power_law():
    """Where sin x = x: 0.0229 r0^(-5/3) 2 pi (pi lambda h)^2 f^(7/3) 3 / 7."""
    air = Turbulence.from_seeing(seeing_arcsec=0.6)
    layers = {"heights_m": (0.0, 8e3), "fractions": (0.25, 0.75), "wavelength_m": WAVE_M}
    slow = amplitude_variance(air, **layers, finest_per_m=1.0)
    power = 0.75 * 0.0229 * air.fried_at(WAVE_M) ** (-5 / 3) * 2 * np.pi * (np.pi * WAVE_M * 8e3) ** 2 * 3 / 7
    assert slow == pytest.approx(power, rel=1e-3)  # sin: 3e-4 less
    at_rest = budget().twinkling_m(air, (0.0, 8e3), (0.25, 0.75))
    seen = amplitude_variance(air, **layers, finest_per_m=22 / 8)
    assert at_rest == pytest.approx(WAVE_M / (2 * np.pi) * math.sqrt(seen / 4), rel=1e-9)


def test_nothing_is_lost_to_a_steady_point():
    found = budget()
    for knows in (True, False):  # rounding, under a root
        assert found.smeared_m(knows=knows) < 1e-14
    assert (found.tilt_m, found.dispersion_rad) == (0.0, 0.0)

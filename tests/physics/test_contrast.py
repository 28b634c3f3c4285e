"""The halo around a star: closed forms against published numbers, direct sums, and images of random phases."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.modes import modal_basis
from nlcwfs.beam.pupil import circular_pupil
from nlcwfs.constants import ARCSEC_RAD
from nlcwfs.errors import SettingsError
from nlcwfs.science.contrast import Halo, ripple_contrast
from nlcwfs.science.coronagraph import coronagraphic_image
from nlcwfs.science.flux_factor import FluxFactor, constant_flux_factor, shack_hartmann_flux_factor
from nlcwfs.science.long_exposure import LongExposure
from nlcwfs.science.point_spread_function import strehl_ratio

ANGLES_RAD = np.array([41.0, 83.0, 165.0, 330.0, 660.0]) * ARCSEC_RAD / 1000
CURVATURE = np.array([2.3, 2.1, 2.0, 2.0, 2.0])
"""Flux factors of the paper's sensor with a static aberration, measured by a prototype apart from this package."""


def paper(**changes) -> Halo:
    """Guyon 2010, Fig. 12."""
    air = Turbulence.from_seeing(seeing_arcsec=0.6)
    return Halo(air, ((1.0, 10.0),), 8.0, math.pi * 16, 0.7e-6, 1.6e-6, 7.8e7)._replace(**changes)


def lenslets(halo: Halo) -> np.ndarray:
    return shack_hartmann_flux_factor(halo.cycles_per_aperture(ANGLES_RAD), 50)


def test_the_halo_is_that_of_the_prototype():
    """Its numbers have two digits and came from other code: 5 %."""
    halo = paper()
    spots = halo.contrast(ANGLES_RAD, 1000.0, lenslets(halo))
    assert spots == pytest.approx([5.3e-4, 1.4e-4, 3.6e-5, 9.8e-6, 3.2e-6], rel=0.05)
    curvature = halo.contrast(ANGLES_RAD, 3000.0, CURVATURE)
    assert curvature == pytest.approx([1.1e-5, 5.9e-6, 4.3e-6, 3.9e-6, 3.7e-6], rel=0.05)


def test_best_against_best_gains_what_the_prototype_found():
    halo = paper()
    gain = halo.best_contrast(ANGLES_RAD, lenslets(halo)) / halo.best_contrast(ANGLES_RAD, CURVATURE)
    assert gain == pytest.approx([48, 20, 8.4, 3.5, 1.6], rel=0.05)  # two digits; asked: 10 %
    assert gain == pytest.approx((lenslets(halo) / CURVATURE) ** (2 / 3), rel=1e-12)


def test_the_best_rate_is_where_a_search_finds_it():
    """The closed form takes the lag as short; at 770 exposures a second and 16 cycles that is right to 0.3 %."""
    halo = paper(latency_exposures=0.5)
    for k, q in enumerate(lenslets(halo)):
        searched = halo.searched_rate_hz(float(ANGLES_RAD[k]), float(q))
        assert searched == pytest.approx(float(halo.best_rate_hz(ANGLES_RAD, lenslets(halo))[k]), rel=0.01)
        least = halo.contrast(ANGLES_RAD[k : k + 1], searched, np.array([q]))
        assert least == pytest.approx(halo.best_contrast(ANGLES_RAD, lenslets(halo))[k], rel=0.01)


@pytest.mark.parametrize(("latency", "rate_hz"), [(0.0, 100.0), (1.0, 150.0), (0.4, 40.0)])
def test_the_lag_is_that_of_a_wave_that_moves(latency, rate_hz):
    """A direct sum in time: a travelling wave, its mean over an exposure, and what is left during a later one."""
    frequency, speed = 1.3, 7.0  # cycles per metre and m/s: up to a fifth of a cycle and more in an exposure
    halo = paper(winds=((1.0, speed),), latency_exposures=latency)
    moments = (np.arange(400) + 0.5) / 400 / rate_hz
    left = []
    for turn in (np.arange(180) + 0.5) * np.pi / 180:
        rate = 2 * np.pi * frequency * speed * np.cos(turn)
        seen = np.mean(np.exp(1j * rate * moments))
        later = np.exp(1j * rate * (moments + (1 + latency) / rate_hz))
        left.append(np.mean(np.abs(later - seen) ** 2))
    angle_rad = np.array([frequency * halo.imaging_m])
    told = halo.lag(angle_rad, rate_hz) / halo.uncorrected(angle_rad)
    assert told == pytest.approx(np.mean(left), rel=1e-4)  # the sum over 400 moments


def test_layers_add_up():
    one, other = (paper(winds=((1.0, speed),)).lag(ANGLES_RAD, 500.0) for speed in (5.0, 20.0))
    both = paper(winds=((0.3, 5.0), (0.7, 20.0))).lag(ANGLES_RAD, 500.0)
    assert both == pytest.approx(0.3 * one + 0.7 * other, rel=1e-12)


def test_photon_noise_is_that_of_every_orthonormal_mode():
    """Random coefficients of variance q / 4N on 200 modes of a disc: their mean image between 2 and 5 lambda/D."""
    grid, count, draws = Grid((40, 44), pixel_m=0.22), 200, 60
    basis = modal_basis(circular_pupil(grid, diameter_m=8.0), grid, diameter_m=8.0, count=count)
    halo, q, rate_hz = paper(), 2.5, 2000.0
    rms_m = 0.7e-6 / (2 * np.pi) * math.sqrt(q / (4 * 7.8e7 / rate_hz))
    coefficients_m = rms_m * np.random.default_rng(3).standard_normal((draws, count))
    angles = Grid((33, 33), pixel_m=1.6e-6 / 8.0 / 2)
    exposure = LongExposure.init(
        circular_pupil(grid, diameter_m=8.0), wavelength_m=1.6e-6, pixel_m=0.22, angles=angles, coronagraph=True
    )
    for drawn_m in coefficients_m:
        exposure = exposure.add(np.tensordot(drawn_m, np.asarray(basis.modes, float), axes=1))
    place = np.hypot(angles.y_m, angles.x_m) * 8.0 / 1.6e-6
    seen = np.mean(np.asarray(exposure.image)[(place > 2) & (place < 5)])
    told = halo.photon_noise(rate_hz, np.array([q]))[0]
    assert seen == pytest.approx(told, rel=0.1)  # 66 speckles in 60 images: 1.6 %; what misses at the rim: 4 %


class TestFluxFactors:
    def test_lenslets_see_the_mean_slope_of_a_wave(self):
        """A direct sum: least-squares amplitude of a wave from the mean slopes of lenslets with ideal noise."""
        across, waves, photons = 20, 3.0, 1e6
        edges = np.arange(across + 1) / across
        slopes = []
        for phase in (0.3, 0.3 + np.pi / 2):  # sine and cosine share the information
            wave = np.sqrt(2) * np.sin(2 * np.pi * waves * edges + phase)  # unit rms
            slopes.append(np.diff(wave))  # rad of tilt over the width of a lenslet
        n = photons / across**2
        sigma2 = 12 / (4 * n)  # quantum limit of a ramp over a square, whose rms is 1/sqrt(12)
        information = np.mean([across * np.sum(one**2) for one in slopes]) / sigma2
        told = shack_hartmann_flux_factor(np.array([waves]), across)
        assert told == pytest.approx(4 * photons / information, rel=1e-9)

    def test_waves_too_fine_for_the_lenslets_are_not_seen(self):
        assert np.isinf(shack_hartmann_flux_factor(np.array([4.99, 5.0, 7.0]), 10)).tolist() == [False, True, True]

    def test_between_points_and_beside_a_blind_one(self):
        curve = FluxFactor("pyramid", np.array([1.0, 4.0, 8.0, 16.0]), np.array([8.0, 2.0, np.inf, 3.0]))
        assert curve.at(np.array([1.0, 2.0, 4.0])) == pytest.approx([8.0, 4.0, 2.0])
        assert np.isinf(curve.at(np.array([3.9, 4.1, 8.0, 15.9, 16.0]))).tolist() == [False, True, True, True, False]
        with pytest.raises(SettingsError, match=r"from 1 to 16 cycles per aperture, where pyramid is known, got 0\.9"):
            curve.at(np.array([2.0, 0.9]))

    def test_a_sensor_without_noise_makes_none(self):
        assert constant_flux_factor("none", 0.0).at(np.array([3.0])) == pytest.approx(0, abs=1e-200)


class TestCoronagraph:
    pupil_grid = Grid((90, 96), pixel_m=0.1)
    wavelength_m = 1.6e-6

    def pupil(self) -> np.ndarray:
        return circular_pupil(self.pupil_grid, diameter_m=8.0)

    def image(self, opd_m: np.ndarray, angles: Grid) -> np.ndarray:
        scale = {"wavelength_m": self.wavelength_m, "pixel_m": 0.1, "angles": angles}
        return np.asarray(coronagraphic_image(jnp.asarray(self.pupil()), jnp.asarray(opd_m), **scale))

    def test_a_ripple_of_5_nm_makes_two_speckles(self):
        """(pi h / lambda)^2 of the peak: 9.6e-5 at 1.6 um; asked: 2 %. Six waves along x, three along y."""
        grid, waves = self.pupil_grid, np.array([3.0, 6.0]) / 8.0
        opd_m = 5e-9 * np.cos(2 * np.pi * (waves[0] * grid.y_m + waves[1] * grid.x_m) + 0.7)
        angles = Grid((9, 17), pixel_m=self.wavelength_m / 8.0)
        image = self.image(opd_m, angles)
        for place in ((4 + 3, 8 + 6), (4 - 3, 8 - 6)):
            assert image[place] == pytest.approx(ripple_contrast(5e-9, self.wavelength_m), rel=0.02)
        assert image[4 + 3, 8 - 6] < 0.02 * image[4 + 3, 8 + 6]  # and none at the mirror image of the direction
        assert image[4, 8] < 1e-9 * image.max()

    def test_random_phases_make_the_halo_of_their_spectrum(self):
        """A white spectrum up to 1.5 cycles/m, 30 nm rms: C = W / A inside; 30 images of 300 speckles, so 2 %."""
        grid, draws, rms_m, edge = self.pupil_grid, 30, 30e-9, 1.5
        rng = np.random.default_rng(5)
        frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(192, 0.1), np.fft.fftfreq(180, 0.1)))
        inside = frequency < edge
        angles = Grid((49, 49), pixel_m=self.wavelength_m / 8.0 / 2)
        exposure = LongExposure.init(
            self.pupil(),
            wavelength_m=self.wavelength_m,
            pixel_m=0.1,
            angles=angles,
            dtype="float64",
            coronagraph=True,
        )
        for _ in range(draws):
            noise = np.fft.ifft2(np.fft.fft2(rng.standard_normal((180, 192))) * inside).real / np.sqrt(inside.mean())
            exposure = exposure.add(jnp.asarray(rms_m * noise[: grid.shape[0], : grid.shape[1]]))
        spectrum = (2 * np.pi * rms_m / self.wavelength_m) ** 2 / (np.pi * edge**2)
        place = np.hypot(angles.y_m, angles.x_m) / self.wavelength_m
        ring = (place > 0.5) & (place < 1.0)  # cycles/m, four and more from the edge of the spectrum and the axis
        seen = np.mean(np.asarray(exposure.image)[ring]) / float(exposure.strehl)
        assert seen == pytest.approx(spectrum / (np.pi * 16), rel=0.06)  # 3 sigma; the wings of its edge: 2 %

    def test_the_strehl_ratio_is_that_without_coronagraph(self):
        opd_m = 100e-9 * np.random.default_rng(2).standard_normal(self.pupil_grid.shape)
        exposure = LongExposure.init(
            self.pupil(), wavelength_m=self.wavelength_m, pixel_m=0.1, angles=Grid((3, 3), 1e-8), coronagraph=True
        ).add(opd_m)
        plain = strehl_ratio(jnp.asarray(self.pupil()), jnp.asarray(opd_m), wavelength_m=self.wavelength_m)
        assert float(exposure.strehl) == pytest.approx(float(plain), rel=1e-5)  # single precision
        assert float(exposure.image[1, 1]) < 1e-9

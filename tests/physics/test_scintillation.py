"""Air at altitude: the closed forms of weak scintillation, the sign of travel, energy, and where it is nothing."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import gamma

from nlcwfs.atmosphere.phase_screen import PhaseScreens, Turbulence
from nlcwfs.atmosphere.scintillation import scintillation_index
from nlcwfs.beam.air_at_pupil import HighAir
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.curvature_sensor.defocused_images import CurvatureSensor
from nlcwfs.errors import SettingsError

AIR = Turbulence(0.168, 0.5e-6)
COLOUR_M = 0.85e-6
HEIGHTS_M, SHARES = (0.0, 4e3, 12e3), (0.5, 0.2, 0.3)
# Cn^2 dh of the whole air: r0^(-5/3) = 0.423 k^2 Cn^2 dh (Fried 1966; Roddier 1981).
WHOLE_CN2 = AIR.fried_m ** (-5 / 3) / 0.423 / (2 * math.pi / 0.5e-6) ** 2


def moment(power: float) -> float:
    return WHOLE_CN2 * sum(share * height_m**power for height_m, share in zip(HEIGHTS_M, SHARES, strict=True))


def high_air(shape=(36, 29), pixel_m=0.05, colours_m=(COLOUR_M,), heights_m=HEIGHTS_M, shares=SHARES) -> HighAir:
    layers = {"heights_m": heights_m, "fractions": shares, "wavelengths_m": colours_m}
    return HighAir.build(AIR, **layers, grid=(shape, pixel_m), dtype="float64")


# ------------------------------------------------------------------------------------------------ closed forms


def test_the_index_of_a_point_is_rytovs():
    """19.12 lambda^(-7/6) int Cn2 h^(5/6) dh; Roddier's 19.12, 0.423 and Noll's 0.0229 have three digits: 1 %."""
    found = scintillation_index(AIR, HEIGHTS_M, SHARES, wavelength_m=COLOUR_M)
    assert found == pytest.approx(19.12 * COLOUR_M ** (-7 / 6) * moment(5 / 6), rel=0.01)
    # int u^(-8/3) sin^2(u^2) du = Gamma(-5/6) cos(5 pi / 12) 2^(5/6) / -4, from int t^(s-1) cos(t) dt.
    whole = -gamma(-5 / 6) * math.cos(5 * math.pi / 12) * 2 ** (5 / 6) / 4
    reach = sum(share * (math.pi * COLOUR_M * one) ** (5 / 6) for one, share in zip(HEIGHTS_M, SHARES, strict=True))
    exact = 4 * 0.0229 * 2 * math.pi * AIR.fried_at(COLOUR_M) ** (-5 / 3) * whole * reach
    assert found == pytest.approx(exact, rel=1e-4)  # 20 000 steps


@pytest.mark.parametrize("diameter_m", [4.0, 8.0, 16.0])
def test_the_index_of_a_telescope_falls_as_its_diameter_to_the_7_thirds(diameter_m):
    """17.34 D^(-7/3) int Cn2 h^2 dh, whatever the colour (Roddier 1981; Dravins 1997): for D far above 0.1 m."""
    found = scintillation_index(AIR, HEIGHTS_M, SHARES, wavelength_m=COLOUR_M, diameter_m=diameter_m)
    assert found == pytest.approx(17.34 * diameter_m ** (-7 / 3) * moment(2), rel=0.05)  # 4 % short at 4 m
    half = scintillation_index(AIR, HEIGHTS_M, SHARES, wavelength_m=COLOUR_M / 2, diameter_m=diameter_m)
    assert half == pytest.approx(found, rel=0.04)


def test_a_layer_at_the_telescope_does_not_twinkle():
    assert scintillation_index(AIR, (0.0,), (1.0,), wavelength_m=COLOUR_M) == 0


def test_drawn_amplitudes_have_the_index_of_the_grid_and_keep_the_mean_of_the_light():
    """The variance over the square of frequencies of the grid, summed here; log-normal: exp(4 var) - 1."""
    high, pixel_m, period = high_air(), 0.05, 72
    f = np.fft.fftfreq(period, pixel_m)
    f2 = f[:, None] ** 2 + f[None, :] ** 2
    f2[0, 0] = 1
    spectrum = 0.0229 * AIR.fried_at(COLOUR_M) ** (-5 / 3) * f2 ** (-11 / 6) / (period * pixel_m) ** 2
    spectrum[0, 0] = 0
    waves = zip(HEIGHTS_M, SHARES, strict=True)
    variance = sum(share * np.sum(spectrum * np.sin(np.pi * COLOUR_M * one * f2) ** 2) for one, share in waves)
    assert float(high.log_variance[0]) == pytest.approx(variance, rel=2e-3)  # the mean over a cell is not its centre
    keys = jax.random.split(jax.random.key(7), 400)
    light = np.asarray(jax.lax.map(lambda key: high.draw(key).factor[0] ** 2, keys, batch_size=50))
    # the light of a 1.8 m x 1.5 m telescope varies by 3 %: 0.15 % in the mean of 400, 4 sigma
    assert light.mean() == pytest.approx(1, abs=0.006)
    assert light.var() == pytest.approx(math.expm1(4 * variance), rel=0.02)  # 400 x ~300 speckles


def test_light_on_fine_cells_has_nearly_the_index_of_a_point():
    """Cells of 2 cm; what is finer than that has 1 % of it."""
    high = high_air(shape=(64, 64), pixel_m=0.02)
    point = scintillation_index(AIR, HEIGHTS_M, SHARES, wavelength_m=COLOUR_M)
    assert 0.93 * point < 4 * float(high.log_variance[0]) < point


# ---------------------------------------------------------------------------------- travel, against full Fresnel


def split_step(fine_m: np.ndarray, pixel_m: float, heights_m, shares) -> np.ndarray:
    """The field at the pupil, layer by layer from the top, by sums over frequencies."""
    rows, columns = (np.fft.fftfreq(count, pixel_m) for count in fine_m.shape[1:])
    f2 = rows[:, None] ** 2 + columns[None, :] ** 2
    field, from_m = np.ones(fine_m.shape[1:], complex), max(heights_m)
    for layer in np.argsort(heights_m)[::-1]:
        travelled = np.fft.fft2(field) * np.exp(-1j * np.pi * COLOUR_M * (from_m - heights_m[layer]) * f2)
        field = np.fft.ifft2(travelled)
        field *= np.exp(2j * np.pi / COLOUR_M * math.sqrt(shares[layer]) * fine_m[layer])
        from_m = heights_m[layer]
    return np.fft.ifft2(np.fft.fft2(field) * np.exp(-1j * np.pi * COLOUR_M * from_m * f2))


def test_faint_air_travels_as_light_does():
    """To first order in the phase; with 1e-3 of the air, what is left is of second order, 1e-3 of what is told."""
    high = high_air()
    fine_m = 1e-3 * np.asarray([high.screens.draw_fine(jax.random.key(seed)) for seed in range(3)])
    nothing = jnp.zeros((36, 29))
    found = high.at_pupil(jnp.asarray(fine_m), nothing)
    light = split_step(fine_m, 0.05, HEIGHTS_M, SHARES)[:36, :29]
    told = np.log(np.asarray(found.factor[0])) + float(high.log_variance[0])
    np.testing.assert_allclose(told, np.log(np.abs(light)), atol=0.01 * told.std())
    phase = np.angle(light * np.exp(-1j * np.angle(light.mean())))
    opd_m = np.asarray(found.opd_m)
    np.testing.assert_allclose(opd_m, (phase - phase.mean()) * COLOUR_M / 2 / np.pi, atol=0.005 * opd_m.std())
    assert told.std() > 1e-5


def test_light_gathers_where_the_path_is_long():
    """A lens is thick in its middle: travel downstream brightens the crest by 1 + 2 k a sin(pi lambda h f^2)."""
    height_m, crest_m, period = 3e3, 1e-9, 72
    high = high_air(heights_m=(height_m,), shares=(1.0,))
    y, x = np.meshgrid(np.arange(period), np.arange(period), indexing="ij")
    wave = np.cos(2 * np.pi * (5 * y + 2 * x) / period - 0.7)
    found = high.at_pupil(jnp.asarray(crest_m * wave[None]), jnp.zeros((36, 29)))
    turn = np.pi * COLOUR_M * height_m * (5**2 + 2**2) / (period * 0.05) ** 2
    light = np.asarray(found.factor[0]) ** 2 * math.exp(2 * float(high.log_variance[0]))
    swing = 2 * (2 * np.pi / COLOUR_M) * crest_m * math.sin(turn)
    np.testing.assert_allclose(light - 1, swing * wave[:36, :29], atol=swing**2)
    part = wave[:36, :29] - wave[:36, :29].mean()
    np.testing.assert_allclose(found.opd_m, crest_m * math.cos(turn) * part, atol=1e-14)


def test_each_colour_has_its_own_field():
    """The factor of a colour, with the reference's wavefront, is what the colour alone would have."""
    others = (0.75e-6, 0.95e-6)
    both = high_air(colours_m=(COLOUR_M, *others))
    fine_m = jnp.stack([both.screens.draw_fine(jax.random.key(seed)) for seed in range(3)])
    nothing = jnp.zeros((36, 29))
    found = both.at_pupil(fine_m, nothing)
    for number, colour_m in enumerate(others):
        alone = high_air(colours_m=(colour_m,)).at_pupil(fine_m, nothing)
        field = np.asarray(alone.factor[0]) * np.exp(2j * np.pi / colour_m * np.asarray(alone.opd_m))
        told = np.asarray(found.factor[number]) * np.exp(2j * np.pi / colour_m * np.asarray(found.opd_m))
        turned = np.vdot(told, field)
        np.testing.assert_allclose(told * turned / abs(turned), field, atol=1e-9)  # but for piston


def test_low_air_is_the_air_that_was():
    """At a height of 1 um the wavefront is that of a phase screen, of the same key, and the amplitude is 1."""
    found = high_air(heights_m=(1e-6,), shares=(1.0,)).draw(jax.random.key(5))
    screens = PhaseScreens.build(AIR, shape=(36, 29), pixel_m=0.05, dtype="float64")
    np.testing.assert_allclose(found.opd_m, screens.draw(jax.random.key(5)), atol=1e-15)
    np.testing.assert_allclose(found.factor, 1, atol=1e-8)


# -------------------------------------------------------------------------------------------------- the sensor


def test_the_factor_multiplies_the_field_in_every_colour():
    rng = np.random.default_rng(3)
    shape, colours_m, planes_m = (24, 18), (0.7e-6, 0.9e-6), (-2e5, 3e5)
    pupil = np.zeros(shape)
    pupil[5:17, 4:13] = rng.uniform(0.5, 1, (12, 9))
    opd_m = 1e-7 * rng.standard_normal(shape)
    factors = {
        "one map": rng.uniform(0.5, 1.5, (1, *shape)),
        "own maps": rng.uniform(0.5, 1.5, (2, *shape)) * np.exp(1j * rng.standard_normal((2, *shape))),
    }
    spectrum = Spectrum(colours_m, (0.4, 0.6))
    sensor = CurvatureSensor.build(
        pupil, Grid(shape, 0.2), distances_m=planes_m, spectrum=spectrum, flux_fractions=(0.3, 0.7), dtype="float64"
    )
    f2 = np.fft.fftfreq(24, 0.2)[:, None] ** 2 + np.fft.fftfreq(18, 0.2)[None, :] ** 2
    for factor in factors.values():
        wanted = np.zeros((2, *shape))
        for colour, (colour_m, share) in enumerate(zip(colours_m, (0.4, 0.6), strict=True)):
            near = pupil / np.linalg.norm(pupil) * np.exp(2j * np.pi / colour_m * opd_m) * factor[colour % len(factor)]
            for plane, (far_m, split) in enumerate(zip(planes_m, (0.3, 0.7), strict=True)):
                far = np.fft.ifft2(np.fft.fft2(near) * np.exp(-1j * np.pi * colour_m * far_m * f2))
                wanted[plane] += 500 * share * split * np.abs(far) ** 2
        found = sensor.images(jnp.asarray(opd_m), 500.0, factor=jnp.asarray(factor)).photons
        np.testing.assert_allclose(found, wanted, atol=1e-10)
    same = sensor.images(jnp.asarray(opd_m), 500.0, factor=jnp.ones((1, *shape))).photons
    np.testing.assert_allclose(same, sensor.images(jnp.asarray(opd_m), 500.0).photons, atol=1e-11)


# ------------------------------------------------------------------------------------------------ what is refused


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"heights_m": (1e3,)}, "must be one per layer, 2, got [1.0]"),
        ({"heights_m": (0.0, -1e3)}, "must be from 0 upward, finite, got [0.0, -1.0]"),
        ({"heights_m": (0.0, math.nan)}, "must be from 0 upward, finite, got [0.0, nan]"),
        (
            {"heights_m": (0.0, 90e3)},
            "must leave the scintillation weak, an index of at most 0.3 at 0.85 um, got [0.0, 90.0], 0.46",
        ),
        (
            {"heights_m": (0.0, 10e3), "grid": ((36, 29), 0.001)},
            "must be at most 4.78 on cells of 0.001 m: light that the finest wave sends aside by 4.25 m needs a "
            "screen of 8575 cells, 4096 are served, got 10.0",
        ),
    ],
)
def test_layers_that_cannot_be_served_are_refused(change, message):
    layers = {"fractions": (0.5, 0.5), "wavelengths_m": (COLOUR_M,), "grid": ((36, 29), 0.05)} | change
    with pytest.raises(SettingsError) as refusal:
        HighAir.build(AIR, **layers)
    assert str(refusal.value) == f"atmosphere.layer_heights_km: {message}"


def test_small_cells_get_a_wider_screen():
    """Of 1 cm: 10 km send the finest wave 0.43 m aside, 43 cells on either side of 36."""
    period = high_air(pixel_m=0.01, heights_m=(10e3,), shares=(1.0,)).transfer.shape[-1]
    assert 36 + 2 * 43 <= period <= 130

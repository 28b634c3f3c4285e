"""Images of many colours: against sums by NumPy, brute-force sums over directions, and the law of chromatic lenses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nlcwfs.atmosphere.phase_screen import PhaseScreens, Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil import circular_pupil
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.curvature_sensor.apparent_star import ApparentStar
from nlcwfs.curvature_sensor.chromatic_lenses import LensLaw
from nlcwfs.curvature_sensor.defocused_images import CurvatureSensor
from nlcwfs.errors import SettingsError

RAINBOW = Spectrum((0.68e-6, 0.85e-6, 1.02e-6), (0.2, 0.5, 0.3))
SMALL = Grid((32, 35), 0.3)
DISTANCES_M = (-3.5e6, 2.5e6)


def asymmetric_pupil() -> np.ndarray:
    rng = np.random.default_rng(5)
    return rng.uniform(0.2, 1, (20, 23)) * (rng.uniform(size=(20, 23)) > 0.2)


def rough_opd_m(seed: int, shape=SMALL.shape) -> np.ndarray:
    return np.random.default_rng(seed).normal(scale=200e-9, size=shape)


def images_of(opd_m, distances_m, spectrum, *, grid=SMALL, pupil=None, **options) -> np.ndarray:
    pupil = asymmetric_pupil() if pupil is None else pupil
    sensor = CurvatureSensor.build(pupil, grid, distances_m=distances_m, spectrum=spectrum, dtype="float64", **options)
    return np.asarray(sensor.images(jnp.asarray(opd_m), 1000.0).photons)


def field_by_numpy(opd_m, wavelength_m, *, grid=SMALL, pupil=None):
    pupil = np.pad(asymmetric_pupil(), 6) if pupil is None else pupil
    return pupil * np.sqrt(1000 / np.sum(pupil**2)) * np.exp(2j * np.pi * opd_m / wavelength_m)


def far_by_numpy(near, wavelength_m, distance_m, grid=SMALL):
    fy, fx = np.fft.fftfreq(grid.shape[0], grid.pixel_m)[:, None], np.fft.fftfreq(grid.shape[1], grid.pixel_m)
    return np.fft.ifft2(np.fft.fft2(near) * np.exp(-1j * np.pi * wavelength_m * distance_m * (fy**2 + fx**2)))


@pytest.mark.parametrize("by_colour", [False, True])
def test_a_frame_is_the_sum_over_its_colours(by_colour):
    opd_m = rough_opd_m(1)
    rows = np.array([[-3.5e6, 2.5e6], [-3.1e6, 2.9e6], [-2.2e6, 2.0e6]]) if by_colour else np.array([DISTANCES_M] * 3)
    found = images_of(opd_m, rows if by_colour else DISTANCES_M, RAINBOW, flux_fractions=(0.4, 0.6))
    expected = np.zeros_like(found)
    for wavelength_m, share, row in zip(RAINBOW.wavelengths_m, RAINBOW.shares, rows, strict=True):
        for plane, (distance_m, fraction) in enumerate(zip(row, (0.4, 0.6), strict=True)):
            far = far_by_numpy(field_by_numpy(opd_m, wavelength_m), wavelength_m, distance_m)
            expected[plane] += share * fraction * np.abs(far) ** 2
    np.testing.assert_allclose(found, expected, atol=1e-12 * expected.max())  # rounding of two FFTs


@pytest.mark.parametrize(("photons", "seed", "size_rad"), [(1.0, 3, 0.0), (3e6, 4, 2e-8)])
def test_no_photon_is_lost_between_colours(photons, seed, size_rad):
    star = ApparentStar(((1e-8, 0.0), (0.0, -2e-8), (3e-8, 1e-8)), size_rad=size_rad)
    options = {"distances_m": DISTANCES_M, "spectrum": RAINBOW, "dtype": "float64", "star": star}
    sensor = CurvatureSensor.build(asymmetric_pupil(), SMALL, **options)
    total = float(sensor.images(jnp.asarray(rough_opd_m(seed)), photons).photons.sum())
    assert total == pytest.approx(photons, rel=1e-12)  # rounding


# ---------------------------------------------------------------------------------------- chromatic lenses


@pytest.mark.parametrize("wavelength_m", [0.5e-6, 0.68e-6, 1.02e-6, 2.2e-6])
def test_behind_ideal_lenses_equal_phases_make_equal_images(wavelength_m):
    phase_rad = 2 * np.pi * rough_opd_m(2) / 0.85e-6
    law = LensLaw("ideal", 0.85e-6)
    reference, other = (
        images_of(
            phase_rad * colour_m / (2 * np.pi), law.distances_m(DISTANCES_M, (colour_m,)), Spectrum((colour_m,), (1.0,))
        )
        for colour_m in (0.85e-6, wavelength_m)
    )
    np.testing.assert_allclose(other, reference, atol=1e-12 * reference.max())  # rounding


def test_colours_that_share_their_images_share_their_fresnel_factors():
    colours = RAINBOW.wavelengths_m
    options = {"spectrum": RAINBOW, "dtype": "float64"}
    ideal = LensLaw("ideal", 0.85e-6).distances_m(DISTANCES_M, colours)
    assert len(CurvatureSensor.build(asymmetric_pupil(), SMALL, distances_m=ideal, **options).transfer) == 1
    assert len(CurvatureSensor.build(asymmetric_pupil(), SMALL, distances_m=DISTANCES_M, **options).transfer) == 3


def kolmogorov(rms_nm: float, grid: Grid, diameter_m: float, seed: int) -> np.ndarray:
    air = Turbulence.from_rms(opd_rms_m=rms_nm * 1e-9, diameter_m=diameter_m)
    screens = PhaseScreens.build(air, shape=grid.shape, pixel_m=grid.pixel_m)
    return np.asarray(screens.draw(jax.random.key(seed)), float)


@pytest.mark.parametrize(("kind", "least", "most"), [("ideal", 0.04, 0.12), ("achromatic", 0.19, 0.27)])
def test_equal_path_differences_make_images_that_differ_by_what_is_known(kind, least, most):
    """8 m, 100 nm rms, tilt included: 0.68 and 1.02 um differ from 0.85 um by 4 to 12 %, or by 19 to 27 %."""
    grid = Grid((160, 160), 0.125)
    pupil = circular_pupil(grid, diameter_m=8.0)
    law = LensLaw(kind, 0.85e-6)
    for seed in (1, 2):
        opd_m = kolmogorov(100.0, grid, 8.0, seed)
        opd_m = opd_m * 100e-9 / np.std(opd_m[pupil > 0.5])
        blue, middle, red = (
            images_of(
                opd_m,
                law.distances_m((-3.5e6, -2.5e6, 2.5e6, 3.5e6), (colour_m,)),
                Spectrum((colour_m,), (1.0,)),
                grid=grid,
                pupil=pupil,
            )
            for colour_m in (0.68e-6, 0.85e-6, 1.02e-6)
        )
        ends = [np.sqrt(np.sum((end - middle) ** 2) / np.sum(middle**2)) for end in (blue, red)]
        assert least < np.mean(ends) < most, ends


# --------------------------------------------------------------------------------- directions and source size


def tilt_m(grid: Grid, y_rad: float, x_rad: float) -> np.ndarray:
    return grid.y_m * y_rad + grid.x_m * x_rad


def smooth_spot() -> tuple[Grid, np.ndarray]:
    """A Gaussian pupil, off centre, whose light and spectrum end before the grid does; odd and even sides."""
    grid = Grid((96, 91), 0.25)
    return grid, np.exp(-((grid.y_m - 0.4) ** 2 + 1.3 * (grid.x_m + 0.3) ** 2) / 2.0**2)


def test_a_colour_from_aside_is_a_tilted_colour():
    grid, pupil = smooth_spot()
    opd_m = 40e-9 * np.sin(grid.y_m + 0.5 * grid.x_m)
    directions = ((4e-7, -2e-7), (0.0, 0.0), (-1e-7, 3e-7))
    found = images_of(opd_m, (-2.5e6, 3e6), RAINBOW, grid=grid, pupil=pupil, star=ApparentStar(directions))
    expected = np.zeros_like(found)
    for wavelength_m, share, angles in zip(RAINBOW.wavelengths_m, RAINBOW.shares, directions, strict=True):
        near = field_by_numpy(opd_m + tilt_m(grid, *angles), wavelength_m, grid=grid, pupil=pupil)
        for plane, distance_m in enumerate((-2.5e6, 3e6)):
            expected[plane] += share / 2 * np.abs(far_by_numpy(near, wavelength_m, distance_m, grid)) ** 2
    # Light and spectrum end at 1e-12 of their peaks before the grid does, also when they are moved.
    np.testing.assert_allclose(found, expected, atol=1e-9 * expected.max())


@pytest.mark.parametrize("profile", ["disc", "gaussian"])
@pytest.mark.parametrize("law", ["achromatic", "ideal"])
def test_a_star_of_some_size_is_the_sum_over_its_directions(profile, law):
    """A sum over two hundred directions, each a tilt of the wavefront."""
    grid, pupil = smooth_spot()
    opd_m = 250e-9 * np.sin(1.2 * grid.y_m + 0.5 * grid.x_m)
    size_rad = 3e-7
    colours = Spectrum((0.68e-6, 1.02e-6), (0.4, 0.6))
    rows = LensLaw(law, 0.85e-6).distances_m((-2.5e6, 3e6), colours.wavelengths_m)
    star = ApparentStar(size_rad=size_rad, profile=profile)
    found = images_of(opd_m, rows, colours, grid=grid, pupil=pupil, star=star)
    radii, weights = np.polynomial.legendre.leggauss(14)
    if profile == "disc":
        radius, weight = size_rad / 2 * np.sqrt((radii + 1) / 2), weights / 2  # equal areas
    else:
        radius = 2 * size_rad * (radii + 1) / 2
        weight = weights * radius * np.exp(-4 * np.log(2) * (radius / size_rad) ** 2)
        weight = weight / weight.sum()
    turns = 2 * np.pi * (np.arange(16) + 0.5) / 16
    expected = np.zeros_like(found)
    for one, share in zip(radius, weight, strict=True):
        for turn in turns:
            opd_from = opd_m + tilt_m(grid, one * np.sin(turn), one * np.cos(turn))
            for wavelength_m, flux, row in zip(colours.wavelengths_m, colours.shares, rows, strict=True):
                near = field_by_numpy(opd_from, wavelength_m, grid=grid, pupil=pupil)
                for plane, distance_m in enumerate(row):
                    light = np.abs(far_by_numpy(near, wavelength_m, distance_m, grid)) ** 2
                    expected[plane] += share / len(turns) * flux / 2 * light
    point = images_of(opd_m, rows, colours, grid=grid, pupil=pupil)
    assert np.abs(point - expected).max() > 0.01 * expected.max()  # there is something to smear
    np.testing.assert_allclose(found, expected, atol=1e-4 * expected.max())  # 224 directions, up to 4.7 sigma


def test_directions_and_rows_must_be_one_for_each_colour():
    with pytest.raises(SettingsError, match=r"^curvature_sensor\.star: must be one for each of 3 colours, got 1 dire"):
        images_of(rough_opd_m(1), DISTANCES_M, RAINBOW, star=ApparentStar(((1e-7, 0.0),)))
    with pytest.raises(SettingsError, match=r"^curvature_sensor\.distances_m: must have one row, or one for each of 3"):
        images_of(rough_opd_m(1), np.ones((2, 2)), RAINBOW)


def test_the_visibility_of_a_disc_is_that_of_the_textbook():
    """A disc's first zero is at 1.21967 / size (Born & Wolf, sec. 10.4.2); a Gaussian stays one."""
    grid, distance_m, size_rad = Grid((64, 64), 0.125), 3e6, 1.21967 / 3e6
    visibility = ApparentStar(size_rad=size_rad).visibility(grid, distance_m=distance_m)
    assert abs(visibility[8, 0]) < 1e-5  # f = 8 / 8 m: 1 / m
    assert visibility[4, 0] > 0.5 > 0 > visibility[10, 0]
    gaussian = ApparentStar(size_rad=size_rad, profile="gaussian").visibility(grid, distance_m=-distance_m)
    assert gaussian[8, 0] == pytest.approx(np.exp(-((np.pi * 1.21967) ** 2) / (4 * np.log(2))), rel=1e-9)


# ------------------------------------------------------------------------------------------------- budgets

WIDE = Grid((64, 63), 0.125)  # 8 m high, lit everywhere: waves come back on the other side as they would without a rim
RIPPLE_CPA, RIPPLE_M, PLANE_M = 16, 1e-9, 3.5e6


def amplitude_of_a_ripple(colours: Spectrum, star: ApparentStar, law: LensLaw) -> complex:
    """What a ripple of 16 cycles along y and 1 nm becomes in an image, over the mean light."""
    opd_m = RIPPLE_M * np.cos(2 * np.pi * RIPPLE_CPA * WIDE.y_m / 8.0) + 0 * WIDE.x_m
    rows = law.distances_m((PLANE_M,), colours.wavelengths_m)
    image = images_of(opd_m, rows, colours, grid=WIDE, pupil=np.ones(WIDE.shape), star=star)[0]
    wave = np.exp(-2j * np.pi * RIPPLE_CPA * WIDE.y_m / 8.0)
    return complex(2 * np.mean(image * wave) / np.mean(image))


def ripple_budget(colours: Spectrum, fades, law: LensLaw) -> complex:
    """Sum over colours of 2 k h sin(pi lambda z f^2), each with its factor (docs/colour.md)."""
    total = 0.0
    for (wavelength_m, share), fade in zip(zip(colours.wavelengths_m, colours.shares, strict=True), fades, strict=True):
        z_m = float(law.distances_m((PLANE_M,), (wavelength_m,))[0, 0])
        signal = np.sin(np.pi * wavelength_m * z_m * (RIPPLE_CPA / 8.0) ** 2)
        total += share * 2 * (2 * np.pi / wavelength_m) * RIPPLE_M * signal * fade(z_m * RIPPLE_CPA / 8.0)
    return total


@pytest.mark.parametrize("kind", ["achromatic", "ideal"])
def test_a_star_of_some_size_fades_a_ripple_by_its_visibility(kind):
    """A disc of 20 mas at z f = 7e6 cycles per radian: 2 J1(x) / x with x = pi size z f, about 0.48."""
    size_rad, law = 20e-3 * np.pi / 180 / 3600, LensLaw(kind, 0.85e-6)

    def disc(cycles_per_rad):
        x = np.linspace(-1, 1, 20001)[1:-1]  # the strips of a disc, summed: no Bessel function
        return np.average(np.cos(np.pi * size_rad * cycles_per_rad * x), weights=np.sqrt(1 - x**2))

    found = amplitude_of_a_ripple(RAINBOW, ApparentStar(size_rad=size_rad), law)
    expected = ripple_budget(RAINBOW, [disc] * 3, law)
    point = ripple_budget(RAINBOW, [lambda cycles_per_rad: 1.0] * 3, law)
    assert abs(expected) < 0.7 * abs(point)
    # Second order in the ripple's phase of 0.01 rad: 1e-4; its square is at twice the frequency.
    assert found == pytest.approx(expected, rel=1e-3)


def test_colours_from_aside_add_their_ripples_with_their_phases():
    """What dispersion leaves: each colour's wave is turned by 2 pi z f theta."""
    law, angles_rad = LensLaw("ideal", 0.85e-6), (2e-8, 0.0, -1.5e-8)

    def turned(angle_rad):
        return lambda cycles_per_rad: np.exp(-2j * np.pi * angle_rad * cycles_per_rad)

    star = ApparentStar(
        tuple((angle_rad, 3e-8) for angle_rad in angles_rad)
    )  # x moves nothing: the ripple runs along y
    found = amplitude_of_a_ripple(RAINBOW, star, law)
    expected = ripple_budget(RAINBOW, [turned(angle_rad) for angle_rad in angles_rad], law)
    assert found == pytest.approx(expected, rel=1e-3)
    assert abs(expected.imag) > 0.1 * abs(expected)  # a sign of z or theta would show


def test_the_fading_by_dispersion_is_that_of_the_variance_of_the_tilt():
    """For small tilts exp(-2 (pi z f)^2 variance), the budget of docs/colour.md."""
    law, angles_rad = LensLaw("ideal", 0.85e-6), np.array([1e-8, 0.0, -0.8e-8])
    phases = Spectrum((0.85e-6, 0.8500001e-6, 0.8499999e-6), RAINBOW.shares)  # one colour, three directions
    star = ApparentStar(tuple((angle_rad, 0.0) for angle_rad in angles_rad))
    left = abs(amplitude_of_a_ripple(phases, star, law)) / abs(amplitude_of_a_ripple(phases, ApparentStar(), law))
    shares = np.array(RAINBOW.shares)
    variance = shares @ angles_rad**2 - (shares @ angles_rad) ** 2
    assert left == pytest.approx(
        np.exp(-2 * (np.pi * PLANE_M * RIPPLE_CPA / 8.0) ** 2 * variance), rel=2e-3
    )  # 4th order
    assert left < 0.98

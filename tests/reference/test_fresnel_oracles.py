"""Our light against HCIPy's and AOtools': other people's code, other conventions, the same physics."""

import aotools
import hcipy
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from aotools.opticalpropagation import angularSpectrum
from aotools.turbulence.slopecovariance import structure_function_vk

from nlcwfs.atmosphere.phase_screen import PhaseScreens, Turbulence
from nlcwfs.beam.field import pupil_field
from nlcwfs.beam.fraunhofer import propagate_fraunhofer
from nlcwfs.beam.fresnel import propagate_fresnel
from nlcwfs.beam.grid import Grid

WAVELENGTH_M = 0.85e-6
DIAMETER_M = 8.0
WAVENUMBER_PER_M = 2 * np.pi / WAVELENGTH_M


@pytest.fixture(scope="module", autouse=True)
def _scipy_transforms():
    """HCIPy's other transforms need libraries of their own."""
    before = hcipy.Configuration().fourier.fft.method
    hcipy.Configuration().fourier.fft.method = ["scipy"]
    yield
    hcipy.Configuration().fourier.fft.method = before


def aberrated_telescope(shape, pixel_m, *, seed) -> np.ndarray:
    """An obstructed 8 m telescope with a vane on one side and 100 nm rms of HCIPy's Zernikes 2 to 21."""
    grid = hcipy_grid(shape, pixel_m)
    aperture = hcipy.evaluate_supersampled(hcipy.make_obstructed_circular_aperture(DIAMETER_M, 0.2), grid, 4)
    aperture = aperture * ~((abs(grid.y + 0.3 * grid.x) < 0.15) & (grid.x > 0))
    zernikes = hcipy.make_zernike_basis(20, DIAMETER_M, grid, 2, radial_cutoff=False)
    opd = sum(c * mode for c, mode in zip(np.random.default_rng(seed).normal(size=20), zernikes, strict=True))
    opd = opd * (aperture > 0)
    opd_m = np.asarray(opd).reshape(shape) * 100e-9 / opd[aperture > 0.5].std()
    pupil = np.asarray(aperture).reshape(shape)
    photons = float(np.sum(pupil**2))  # unit amplitude where the pupil is open
    return np.asarray(pupil_field(pupil, jnp.asarray(opd_m), wavelength_m=WAVELENGTH_M, photons=photons))


def hcipy_grid(shape, pixel_m):
    return hcipy.make_uniform_grid((shape[1], shape[0]), (shape[1] * pixel_m, shape[0] * pixel_m))


def travel(field: np.ndarray, distance_m: float, pixel_m: float) -> np.ndarray:
    return np.asarray(
        propagate_fresnel(jnp.asarray(field), distance_m=distance_m, wavelength_m=WAVELENGTH_M, pixel_m=pixel_m)
    )


def without_carrier(field: np.ndarray, like: np.ndarray) -> np.ndarray:
    """The field with one constant phase that matches the other: exp(ikz) has no digits left in float64."""
    overlap = np.vdot(field, like)
    return field * overlap / abs(overlap)


def padded(field: np.ndarray) -> np.ndarray:
    return np.pad(field, [(n // 2, n // 2) for n in field.shape])


def unpadded(field: np.ndarray) -> np.ndarray:
    rows, columns = (n // 4 for n in field.shape)
    return field[rows:-rows, columns:-columns]


# ------------------------------------------------------------------------------------------------ Fresnel


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(
    # Short: HCIPy multiplies the spectrum. Long: it convolves with exp(ikr^2/2z), well sampled near
    # pixel^2 = lambda z / width, so that the two come by different ways.
    ("distance_km", "shape", "pixel_m"),
    [(300, (96, 128), 0.1), (2500, (112, 112), 0.0974), (3500, (112, 112), 0.1152)],
)
def test_fresnel_is_hcipys(distance_km, shape, pixel_m, sign, seed):
    near = aberrated_telescope(shape, pixel_m, seed=seed)
    distance_m = sign * distance_km * 1e3
    light = hcipy.Wavefront(hcipy.Field(near.ravel(), hcipy_grid(shape, pixel_m)), WAVELENGTH_M)
    propagator = hcipy.FresnelPropagator(light.grid, distance_m, num_oversampling=1)  # it pads twice by itself
    theirs = np.asarray(propagator(light).electric_field).reshape(shape)
    ours = unpadded(travel(padded(near), distance_m, pixel_m))
    # Amplitudes of order 1. Short: rounding. Long: the kernel's sampling misses its ideal by 2e-4 of itself.
    np.testing.assert_allclose(ours, without_carrier(theirs, ours), atol=1e-12 if distance_km == 300 else 1e-4)


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("distance_km", [300, -300, 2500, -2500, 3500, -3500])
def test_fresnel_is_aotools_angular_spectrum(distance_km, seed):
    near = padded(aberrated_telescope((96, 96), 0.11, seed=seed))
    theirs = angularSpectrum(near, WAVELENGTH_M, 0.11, 0.11, distance_km * 1e3)  # no carrier there either
    np.testing.assert_allclose(travel(near, distance_km * 1e3, 0.11), theirs, atol=1e-12)  # rounding


# --------------------------------------------------------------------------------------------- Fraunhofer


def bent(field: np.ndarray, distance_m: float, pixel_m: float) -> np.ndarray:
    """The field times exp(i k r^2 / 2z)."""
    y_m, x_m = ((np.arange(n) - (n - 1) / 2) * pixel_m for n in field.shape)
    square = y_m[:, None] ** 2 + x_m[None, :] ** 2
    return field * np.exp(0.5j * WAVENUMBER_PER_M * square / distance_m)


def test_fraunhofer_is_hcipys():
    shape, wide, pixel_m, focal_m = (60, 75), (31, 24), 0.14, 2.5e6
    near = bent(aberrated_telescope(shape, pixel_m, seed=3), -4e6, pixel_m)
    far_grid = hcipy_grid(wide, 0.09)
    light = hcipy.Wavefront(hcipy.Field(near.ravel(), hcipy_grid(shape, pixel_m)), WAVELENGTH_M)
    theirs = hcipy.FraunhoferPropagator(light.grid, far_grid, focal_length=focal_m)(light)
    theirs = np.asarray(theirs.electric_field).reshape(wide)
    angles = Grid(wide, 0.09 / focal_m)
    ours = propagate_fraunhofer(jnp.asarray(near), wavelength_m=WAVELENGTH_M, pixel_m=pixel_m, angles=angles)
    # HCIPy gives amplitude per metre with Goodman's factor 1 / i; ours is per pixel and without it.
    np.testing.assert_allclose(ours, 1j * theirs * 0.09 / pixel_m, atol=1e-12)


@pytest.mark.parametrize("distance_m", [2.5e6, -2.5e6])
def test_fresnel_is_the_fraunhofer_image_of_the_bent_pupil(distance_m):
    # With pixel^2 = lambda |z| / n, n even, both are the same sum for any field, hard edges included.
    size = 168
    pixel_m = np.sqrt(WAVELENGTH_M * abs(distance_m) / size)
    near = aberrated_telescope((size, size), pixel_m, seed=4)
    far = travel(near, distance_m, pixel_m)

    grid = hcipy_grid((size, size), pixel_m)
    light = hcipy.Wavefront(hcipy.Field(bent(near, distance_m, pixel_m).ravel(), grid), WAVELENGTH_M)
    theirs = hcipy.FraunhoferPropagator(grid, grid, focal_length=abs(distance_m))(light)
    theirs = np.asarray(theirs.electric_field).reshape(size, size)
    angles = Grid((size, size), pixel_m / abs(distance_m))
    ours = propagate_fraunhofer(
        jnp.asarray(bent(near, distance_m, pixel_m)),
        wavelength_m=WAVELENGTH_M,
        pixel_m=pixel_m,
        angles=angles,
    )
    for image in (theirs, -1j * np.asarray(ours)):
        # exp(i k r^2 / 2z) / (i lambda z) times the transform at x / z: for z < 0 turned by half a turn.
        turned = image if distance_m > 0 else -image[::-1, ::-1]
        np.testing.assert_allclose(far, bent(turned, distance_m, pixel_m), atol=1e-11)  # phases of 100 rad


# --------------------------------------------------------------------------------------------- turbulence


@pytest.mark.parametrize("outer_scale_m", [4.0, 25.0])
def test_screens_follow_aotools_von_karman_structure_function(outer_scale_m):
    air = Turbulence(0.5, 0.5e-6, outer_scale_m)
    screens = PhaseScreens.build(air, shape=(32, 40), pixel_m=0.25, dtype="float32")
    keys = jax.random.split(jax.random.key(21), 600)
    opd_m = np.asarray(jax.jit(lambda keys: jax.lax.map(screens.draw, keys, batch_size=50))(keys), float)
    phase = opd_m * 2 * np.pi / 0.5e-6
    for steps in (6, 12, 24):
        for difference in (phase[:, steps:] - phase[:, :-steps], phase[:, :, steps:] - phase[:, :, :-steps]):
            sample = np.mean(difference**2, axis=(1, 2))
            expected = structure_function_vk(0.25 * steps, 0.5, outer_scale_m)
            error = 5 * sample.std() / np.sqrt(sample.size)  # 5 sigma of 600 independent screens
            # 3 % more: cells of the low frequencies, and what lies above the last frequency of a pixel.
            np.testing.assert_allclose(sample.mean(), expected, atol=error + 0.03 * expected)
            assert error < 0.2 * expected


@pytest.mark.parametrize("seeing_arcsec", [0.4, 1.3])
def test_seeing_is_that_of_aotools(seeing_arcsec):
    expected = aotools.seeing_to_r0(seeing_arcsec, 0.5e-6)
    # AOtools rounds 0.976 to 0.98.
    np.testing.assert_allclose(Turbulence.from_seeing(seeing_arcsec=seeing_arcsec).fried_m, expected, rtol=0.006)

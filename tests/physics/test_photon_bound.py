"""What the light allows: the information of the images, and the bound made of it."""

import functools

import defocused_light
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.modes import ModalBasis, modal_basis
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.config import load_config
from nlcwfs.curvature_sensor.defocused_images import CurvatureSensor
from nlcwfs.estimation.photon_bound import fisher_information, photon_bound
from nlcwfs.simulation.exposure import ExposureSimulator
from nlcwfs.studies import case_bound as bounds

WAVELENGTH_M = defocused_light.WAVELENGTH_M
RADIAN_M = WAVELENGTH_M / (2 * np.pi)
QUANTUM = 4 / RADIAN_M**2  # per photon: 1 / (2 sqrt N) rad for a mode of unit rms (Haffert et al. 2023)

few = settings(max_examples=8, deadline=None)  # each traces anew: 0.3 s
seeds = st.integers(0, 2**32 - 1)

SHAPE = (15, 18)
DISTANCES_M = (-0.9e6, 0.4e6, 1.3e6)
SHARES = (0.5, 0.2, 0.3)


def sensor(pupil, pixel_m, distances_m=DISTANCES_M, shares=SHARES) -> CurvatureSensor:
    grid, colour = Grid(pupil.shape, pixel_m), Spectrum.monochromatic(WAVELENGTH_M)
    options = {"distances_m": distances_m, "flux_fractions": shares, "dtype": "float64"}
    return CurvatureSensor.build(pupil, grid, spectrum=colour, **options)


def information(optics: CurvatureSensor, opd_m, modes, photons=1.0, read_variance=0.0) -> np.ndarray:
    return fisher_information(
        lambda opd_m: optics.images(opd_m, photons).photons,
        jnp.asarray(opd_m),
        jnp.asarray(modes),
        read_variance=read_variance,
    )


def random_light(seed: int, count: int, strength_rad: float = 1.5):
    """A pupil of no symmetry, a wavefront, and modes that are orthonormal on its light."""
    rng = np.random.default_rng(seed)
    pupil = rng.uniform(0.2, 1, SHAPE) * (rng.uniform(size=SHAPE) > 0.3)
    root = (pupil / np.sqrt(np.sum(pupil**2))).ravel()
    columns = np.column_stack([root, rng.normal(size=(root.size, count)) * root[:, None]])  # piston in front
    columns = np.linalg.qr(columns)[0][:, 1:]
    modes = np.divide(columns, root[:, None], out=np.zeros_like(columns), where=root[:, None] > 0)
    return pupil, strength_rad * RADIAN_M * rng.normal(size=SHAPE), modes.T.reshape(count, *SHAPE)


# ------------------------------------------------------------------------------------ Fisher information


@pytest.mark.parametrize("read_variance", [0.0, 3.0])
def test_the_information_is_that_of_finite_differences_of_another_model(read_variance):
    pupil, opd_m, modes = random_light(1, 4)
    photons, step_m = 700.0, 1e-11

    def counts(opd_m):
        return photons * defocused_light.images(pupil, opd_m, pixel_m=0.5, distances_m=DISTANCES_M, shares=SHARES)

    slopes = np.array([(counts(opd_m + step_m * one) - counts(opd_m - step_m * one)) / (2 * step_m) for one in modes])
    expected = np.einsum("apyx,bpyx,pyx->ab", slopes, slopes, 1 / (counts(opd_m) + read_variance))
    found = information(sensor(pupil, 0.5), opd_m, modes, photons, read_variance)
    # A step of 1e-4 rad: its square for the differences, and 1e-16 / 1e-4 for their rounding.
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-7 * expected.max())


@few
@given(seed=seeds, read_variance=st.floats(0, 5))
def test_counts_that_are_linear_have_the_textbook_information(seed, read_variance):
    rng = np.random.default_rng(seed)
    base, response = rng.uniform(5, 9, (2, 3, 4)), rng.uniform(-0.1, 0.1, (2, 3, 4, 2, 3))
    opd_m, modes = rng.normal(size=(2, 3)), rng.normal(size=(4, 2, 3))

    def counts(opd_m):
        return jnp.asarray(base) + jnp.tensordot(jnp.asarray(response), opd_m, axes=2)

    mean = base + np.tensordot(response, opd_m, axes=2)
    along = np.tensordot(modes, response, axes=((1, 2), (3, 4))).reshape(4, -1)
    expected = along @ np.diag(1 / (mean.ravel() + read_variance)) @ along.T
    found = fisher_information(counts, jnp.asarray(opd_m), jnp.asarray(modes), read_variance=read_variance)
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)


def test_a_dark_pixel_says_nothing_and_breaks_nothing():
    def counts(opd_m):
        return jnp.stack([10 + 3 * opd_m, 0 * opd_m, 1e-9 * opd_m])[:, 0][None]

    found = fisher_information(counts, jnp.zeros((1, 1)), jnp.ones((1, 1, 1)))
    np.testing.assert_allclose(found, [[0.9]], rtol=1e-12)


def test_planes_add_their_information_by_their_light():
    pupil, opd_m, modes = random_light(2, 5)
    alone = [information(sensor(pupil, 0.5, (z,), (1.0,)), opd_m, modes) for z in DISTANCES_M]
    expected = sum(share * each for share, each in zip(SHARES, alone, strict=True))
    np.testing.assert_allclose(information(sensor(pupil, 0.5), opd_m, modes), expected, rtol=1e-9, atol=1e-9 * QUANTUM)
    assert np.ptp([each[0, 0] for each in alone]) > 0.01 * QUANTUM  # else the shares would not be seen


@few
@given(seed=seeds, strength_rad=st.floats(0, 10))
def test_no_wavefront_and_no_mode_tell_more_than_the_quantum_limit(seed, strength_rad):
    """Every direction, so every mixture of modes: the largest eigenvalue is at most 4 per photon and rad^2."""
    pupil, opd_m, modes = random_light(seed, 3, strength_rad)
    values = np.linalg.eigvalsh(information(sensor(pupil, 0.5), opd_m, modes))
    assert values[-1] <= QUANTUM * (1 + 1e-9)
    assert values[0] > 0


def test_a_modulation_that_turns_into_intensity_reaches_the_quantum_limit():
    """Talbot: a quarter turn of the wave's Fresnel phase makes a small ripple of phase one of intensity."""
    size, pixel_m, cycles = 24, 0.5, 3
    frequency = cycles / (size * pixel_m)
    talbot_m = 0.5 / (WAVELENGTH_M * frequency**2)
    ripple = np.sqrt(2) * np.cos(2 * np.pi * frequency * pixel_m * np.arange(size)) * np.ones((size, 1))
    for distance_m, share in ((talbot_m, 1.0), (-talbot_m, 1.0), (talbot_m / 3, 0.25), (2 * talbot_m, 0.0)):
        optics = sensor(np.ones((size, size)), pixel_m, (distance_m,), (1.0,))
        found = information(optics, np.zeros((size, size)), ripple[None])[0, 0]
        assert found == pytest.approx(share * QUANTUM, abs=1e-9 * QUANTUM)  # 4 sin^2(pi lambda z f^2)


# ------------------------------------------------------------------------------------------ speckled light


@functools.cache
def speckled() -> tuple[np.ndarray, ModalBasis]:
    """Information of one photon at D / r0 = 8, light and modes on the same 24 pixels across."""
    grid = Grid((72, 72), 8.0 / 24)
    pupil = np.asarray(PupilShape(8.0).on(grid))
    basis = modal_basis(pupil, grid, diameter_m=8.0, count=120)
    rng = np.random.default_rng(4)
    coefficients = rng.normal(size=120) * np.sqrt(np.asarray(basis.kolmogorov_rad2) * 8.0 ** (5 / 3))
    opd_m = RADIAN_M * np.tensordot(coefficients, np.asarray(basis.modes), axes=1)
    optics = sensor(pupil, grid.pixel_m, defocused_light.DISTANCES_M, (0.25,) * 4)
    return information(optics, opd_m, np.asarray(basis.modes)), basis


def test_speckles_show_the_phase_to_half():
    """Only the part of a change that is in phase with the speckle is seen: 2, when the light is all speckles."""
    per_photon, basis = speckled()
    share = np.diag(per_photon) / QUANTUM
    fine = np.asarray(basis.cycles_per_aperture) > 3  # slower ones move light that is no speckle yet
    assert fine.sum() > 60
    assert np.all((share[fine] > 0.25) & (share[fine] < 0.75))
    light = {"telescope_over_fried": 8.0, "photons": 2e4, "wavelength_m": WAVELENGTH_M}
    loss = photon_bound(2e4 * per_photon, basis, **light).sensor_loss
    assert loss == pytest.approx(1 / np.median(share))
    assert 1.9 < loss < 2.4


# ---------------------------------------------------------------------------------------------- the bound


@functools.cache
def modes_of_a_sector(count: int) -> ModalBasis:
    """Modes on a pupil of no symmetry, on pixels that are not square in number."""
    grid = Grid((19, 22), 0.42)
    pupil = np.array(PupilShape(diameter_m=7.5, obstruction_ratio=0.3).on(grid))
    pupil[:6, :9] = 0
    return modal_basis(pupil, grid, diameter_m=7.5, count=count)


def bound(information, basis, *, over_fried=8.2, photons=2e4):
    return photon_bound(information, basis, telescope_over_fried=over_fried, photons=photons, wavelength_m=WAVELENGTH_M)


@pytest.mark.parametrize("over_fried", [0.5, 8.2, 25.0])
def test_without_information_the_error_is_the_turbulence(over_fried):
    grid = Grid((48, 48), 8.0 / 45)
    basis = modal_basis(np.asarray(PupilShape(8.0).on(grid)), grid, diameter_m=8.0, count=30)
    assert basis.kolmogorov_total_rad2 == pytest.approx(1.0299, rel=0.01)  # Noll 1976, Table IV; r0 has three digits
    blind = bound(np.zeros((30, 30)), basis, over_fried=over_fried)
    assert blind.bayesian_m / RADIAN_M == pytest.approx(np.sqrt(1.0299 * over_fried ** (5 / 3)), rel=0.005)
    assert blind.sensor_loss == np.inf


def test_the_whole_turbulence_is_that_of_all_pairs_of_pixels():
    """A direct double sum of the structure function 6.88 r^(5/3)."""
    basis = modes_of_a_sector(5)
    rows, columns = np.nonzero(basis.weights)
    weights = basis.weights[rows, columns]
    apart = np.hypot(rows[:, None] - rows, columns[:, None] - columns) * 0.42 / 7.5
    expected = weights @ (6.8839 * apart ** (5 / 3)) @ weights / 2
    assert basis.kolmogorov_total_rad2 == pytest.approx(expected, rel=2e-3)  # modes squeeze x by one in a thousand


def information_below_the_limit(seed: int, count: int, photons: float) -> np.ndarray:
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(count, count)))[0]
    return turn @ np.diag(rng.uniform(0, 1, count)) @ turn.T * QUANTUM * photons


@few
@given(seed=seeds, log_photons=st.floats(1, 6), over_fried=st.floats(1, 25))
def test_more_photons_help_and_no_sensor_beats_the_quantum_limit(seed, log_photons, over_fried):
    basis, photons = modes_of_a_sector(40), 10**log_photons
    found = information_below_the_limit(seed, 40, photons)
    few_photons = bound(found, basis, over_fried=over_fried, photons=photons)
    many = bound(3 * found, basis, over_fried=over_fried, photons=3 * photons)
    blind = bound(0 * found, basis, over_fried=over_fried, photons=photons)
    assert many.bayesian_m < few_photons.bayesian_m < blind.bayesian_m
    assert many.quantum_m < few_photons.quantum_m <= few_photons.bayesian_m
    assert few_photons.sensor_loss == pytest.approx(many.sensor_loss)
    assert few_photons.sensor_loss == pytest.approx(QUANTUM * photons / np.median(np.diag(found)))


def test_a_sensor_that_loses_nothing_is_the_quantum_limit():
    basis, photons, strength = modes_of_a_sector(40), 2e4, 8.2 ** (5 / 3)
    ideal = bound(QUANTUM * photons * np.eye(40), basis)
    prior = np.asarray(basis.kolmogorov_rad2) * strength
    beyond = basis.kolmogorov_total_rad2 * strength - prior.sum()
    expected_rad = np.sqrt(np.sum(prior / (1 + 4 * photons * prior)) + beyond)
    assert ideal.quantum_m / RADIAN_M == pytest.approx(expected_rad, rel=1e-12)
    assert ideal.bayesian_m / RADIAN_M == pytest.approx(expected_rad, rel=1e-12)
    assert ideal.sensor_loss == pytest.approx(1)
    one = bound(QUANTUM * photons * np.eye(1), basis.first(1), over_fried=1e4)  # a tilt and no prior to speak of
    seen_rad = (one.quantum_m / RADIAN_M) ** 2 - 1e4 ** (5 / 3) * (basis.kolmogorov_total_rad2 - prior[0] / strength)
    assert seen_rad == pytest.approx(1 / (4 * photons), rel=0.05)  # twelve digits below the rest


def test_the_best_linear_estimate_reaches_the_bound():
    """Monte Carlo: coefficients of turbulence seen through noise, the posterior mean, what is left of them."""
    basis, rng = modes_of_a_sector(12), np.random.default_rng(6)
    variance = np.asarray(basis.kolmogorov_rad2) * 8.2 ** (5 / 3) * RADIAN_M**2
    response = rng.normal(size=(30, 12)) / RADIAN_M * 3
    response[:, 1] = response[:, 0] + 0.1 * response[:, 1]  # two modes that look nearly the same
    truth_m = rng.normal(size=(12, 4000)) * np.sqrt(variance)[:, None]
    seen = response @ truth_m + rng.normal(size=(30, 4000))
    # The estimate by the covariance of what is seen, and not by the information.
    spread = response * variance @ response.T + np.eye(30)
    left = truth_m - (variance[:, None] * response.T) @ np.linalg.solve(spread, seen)
    beyond = basis.kolmogorov_total_rad2 * 8.2 ** (5 / 3) * RADIAN_M**2 - variance.sum()
    squares = np.sum(left**2, axis=0)
    found = bound(response.T @ response, basis).bayesian_m ** 2 - beyond
    assert found == pytest.approx(squares.mean(), abs=5 * squares.std() / np.sqrt(4000))


# --------------------------------------------------------------------------------------- the bound of a case


@pytest.fixture(scope="module")
def small_case():
    """Twelve pixels across and 30 modes, with the light of the bound."""
    camera = ["detector.pixels_across_pupil=12", "detector.window_pixels=16"]
    config = load_config(None, [*camera, "atmosphere.opd_rms_nm=300", "beam.wavelength_um=0.65", "precision=double"])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bounds, "MODES", 30)
        patch.setattr(bounds, "SCREENS", 1)
        return config, bounds.light_information(config)


def test_the_bound_of_a_case_knows_pixels_and_window(small_case):
    """NumPy: two cells to a pixel, sums over the pixels of the window, one photon in all."""
    config, light = small_case
    finer = config.model_copy(update={"simulation": config.simulation.model_copy(update={"light_oversampling": 2})})
    simulator = ExposureSimulator.build(finer)
    truth_m = np.asarray(simulator.expose(bounds.frame_key(seed=0, frame=0)).opd_m)
    pupil, margin = np.asarray(simulator.sensor.pupil), (simulator.light.shape[0] - light.basis.modes.shape[1]) // 2
    step_m, distances_m = 1e-11, [1e3 * distance_km for distance_km in config.curvature_sensor.distances_km]

    def counts(opd_m):
        fine = defocused_light.images(pupil, opd_m, pixel_m=8.0 / 24, distances_m=distances_m)
        pixels = fine.reshape(4, fine.shape[1] // 2, 2, -1, 2).sum(axis=(2, 4))
        edge = (pixels.shape[1] - 16) // 2
        return pixels[:, edge : edge + 16, edge : edge + 16]

    modes = [np.pad(np.asarray(light.basis.modes[index]), margin) for index in (0, 7, 29)]
    slopes = [(counts(truth_m + step_m * one) - counts(truth_m - step_m * one)) / (2 * step_m) for one in modes]
    expected = np.einsum("apyx,bpyx,pyx->ab", slopes, slopes, 1 / counts(truth_m))
    found = light.per_photon[0][np.ix_((0, 7, 29), (0, 7, 29))]
    np.testing.assert_allclose(found, expected, atol=1e-5 * QUANTUM)  # modes are single precision
    assert np.linalg.eigvalsh(light.per_photon[0])[-1] < QUANTUM


def test_the_columns_of_a_case_are_the_bound_in_nanometres(small_case):
    config, light = small_case
    found = bounds.case_bound(config, light)
    over_fried = (300e-9 / RADIAN_M) ** (6 / 5) / 1.0299 ** (3 / 5)
    expected = photon_bound(
        config.atmosphere.photons * light.per_photon[0],
        light.basis,
        telescope_over_fried=over_fried,
        photons=config.atmosphere.photons,
        wavelength_m=WAVELENGTH_M,
    )
    assert found["bound_nm"] == pytest.approx(1e9 * expected.bayesian_m, rel=1e-3)
    assert found["quantum_nm"] == pytest.approx(1e9 * expected.quantum_m, rel=1e-3)
    assert 2 < found["sensor_loss"] < 6  # pixels of 0.67 m blur the speckles of far planes

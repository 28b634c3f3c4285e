"""Kalman's filter of the curvature sensor, made for the air that a loop has seen."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.beam.modes import DIM, ModalBasis, modal_basis
from nlcwfs.config import Config
from nlcwfs.estimation.flow_filter import FlowFilter, Still, modal_information
from nlcwfs.estimation.maximum_a_posteriori import MaximumAPosteriori
from nlcwfs.estimation.moving_modes import Step
from nlcwfs.estimation.resolution_level import Measurement
from nlcwfs.estimation.sensor_model import PlaneScale
from nlcwfs.feedback.controller import Telemetry
from nlcwfs.simulation.closed_loop.air import MovingAir, learnt_air, prior_air
from nlcwfs.simulation.closed_loop.carried import CarriedCurvature
from nlcwfs.simulation.closed_loop.light import LoopLight
from nlcwfs.simulation.closed_loop.measurement import FollowedCurvature

BEYOND = 1.25
"""Modes that are filtered for each that the mirror makes: what is a little finer is carried to it as well."""

AT_LEAST = 800
"""... and not less than these, where the cells carry them: what the light shows and the filter does not hold is taken
for something else. With 200 Zernikes on the mirror 500 modes lost every star, 800 keep one of magnitude 14 at the
floor."""

CELLS = 4
"""Lit cells for each mode, at least."""

STILL_M, STILL_S, STILL_MODES = 50e-9, 2.0, 200
"""What a telescope shows that does not move with the wind: rms, how long it lasts, and in how many modes."""

DRAW = 20101
"""Seed of the air beyond the mirror's modes at which the light is linearised."""


def carried_curvature(
    followed: FollowedCurvature, config: Config, light: LoopLight, telemetry: Telemetry | None
) -> CarriedCurvature | None:
    """The sensor with a filter for the wind that a closed loop has seen; None if no wind is clear.

    Args:
        followed: Has measured until now.
        config: The settings.
        light: Mirror and pupil.
        telemetry: What was recorded; None where the wind is told.

    Raises:
        SettingsError: If the wind is told and the turbulence is not.
    """
    solver = followed.reconstructor.solver
    basis = filtered_basis(solver, light.mirror.count)
    air = learnt_air(config, basis, solver.level.grid, mirror_modes(followed, light, basis), telemetry)
    if air is None:
        return None
    residual_m = np.zeros(basis.count)
    if telemetry is not None:
        residual_m = air.shapes @ np.asarray(telemetry.measured_m[-1], float)
    made = settled_filter(solver, air, residual_m, photons=light.still.photons, interval_s=1 / config.loop.rate_hz)
    return CarriedCurvature(
        followed=followed,
        filter=made,
        seen=jnp.asarray(air.commands, made.modes.dtype),
        ahead=jnp.asarray(air.commands @ air.ahead, made.modes.dtype),
        mirror=light.mirror,
        wind=air.wind,
        strength=(prior_air(config).fried_m / air.turbulence.fried_m) ** (5 / 3),
        starts_closed=config.loop.start == "closed",
    )


def filtered_basis(solver: MaximumAPosteriori, commands: int) -> ModalBasis:
    """The modes of the air that are filtered, on the cells of the model.

    Args:
        solver: The sensor.
        commands: How many modes the mirror has.
    """
    level = solver.level
    amplitude = np.sqrt(np.asarray(level.light, float))
    count = min(max(AT_LEAST, round(BEYOND * commands)), int(np.sum(amplitude > DIM)) // CELLS)
    return modal_basis(amplitude, level.grid, diameter_m=solver.geometry.pupil.diameter_m, count=count)


def mirror_modes(followed: FollowedCurvature, light: LoopLight, basis: ModalBasis) -> Float[np.ndarray, "mode command"]:
    """The modes of each command, as the model sees the mirror."""
    mirror = light.mirror

    @jax.jit
    def modes_of(command_m: Float[Array, " command"]) -> Float[Array, " mode"]:
        return basis.project(followed.on_model(mirror.opd_m(command_m)))

    small_m = 1e-7  # within any stroke
    unit = small_m * np.eye(mirror.count, dtype=np.float32)
    return np.stack([np.asarray(modes_of(one), float) for one in unit], axis=1) / small_m


def settled_filter(
    solver: MaximumAPosteriori,
    air: MovingAir,
    residual_m: Float[np.ndarray, " mode"],
    *,
    photons: float,
    interval_s: float,
) -> FlowFilter:
    """Kalman's filter for a wind.

    Args:
        solver: The sensor.
        air: Its modes.
        residual_m: What the mirror leaves of it, in the modes; finer air is drawn.
        photons: Of an exposure.
        interval_s: From exposure to exposure.
    """
    radian_m = solver.geometry.wavelength_m / (2 * np.pi)
    drawn_m = np.linalg.cholesky(air.now_m2) @ np.random.default_rng(DRAW).standard_normal(air.basis.count)
    finer_m = drawn_m - air.shapes @ (air.commands @ drawn_m)
    step = Step(air.step.again, air.step.new / radian_m**2)
    seen = seen_information(solver, air.basis, (residual_m + finer_m) / radian_m, photons=photons)
    still = Still(expected_still(air) / radian_m**2, float(np.exp(-interval_s / STILL_S)))
    return FlowFilter.build(solver, air.basis, step, still, seen, beyond_rad2=air.beyond_m2 / radian_m**2)


def expected_still(air: MovingAir) -> Float[np.ndarray, " still"]:
    """Variance in m^2 of the modes that stay: as of turbulence, with a rms of `STILL_M` in all."""
    shape = np.asarray(air.basis.kolmogorov_rad2)[: min(STILL_MODES, air.shapes.shape[1])]
    return STILL_M**2 * shape / np.sum(shape)


def seen_information(
    solver: MaximumAPosteriori, basis: ModalBasis, modes_rad: Float[np.ndarray, " mode"], *, photons: float
) -> Float[np.ndarray, "mode mode"]:
    """Fisher information of an exposure about the modes, 1/rad^2.

    Args:
        solver: The sensor.
        basis: The modes.
        modes_rad: At this wavefront.
        photons: Of the whole exposure.
    """
    level, dtype = solver.level, solver.power.dtype
    none = jnp.zeros((len(solver.geometry.distances_m), *level.measured_shape), dtype)
    measured = Measurement(none, jnp.ones(none.shape, bool), jnp.zeros((), dtype))
    counts = jnp.asarray(level.optics.flux_fractions, dtype)[:, None, None] * photons
    known_rad = solver.known_rad(jnp.zeros(2, dtype))
    prior = solver.prior(solver.power, solver.tilt_rms_rad)
    problem = solver.problem(measured, known_rad, PlaneScale(counts, 0 * counts), prior)
    phase_rad = known_rad + basis.combine(jnp.asarray(modes_rad, dtype))
    return modal_information(problem, phase_rad, basis)

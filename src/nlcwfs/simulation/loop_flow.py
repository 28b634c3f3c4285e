"""What a loop has recorded tells the wind; with it Kalman's filter of the curvature sensor is made."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.beam.modes import DIM, ModalBasis, modal_basis
from nlcwfs.config import Config
from nlcwfs.estimation.flow_filter import FlowFilter, modal_information
from nlcwfs.estimation.maximum_a_posteriori import MaximumAPosteriori
from nlcwfs.estimation.moving_modes import Step
from nlcwfs.estimation.phase_prior import expected_air
from nlcwfs.estimation.resolution_level import Measurement
from nlcwfs.estimation.sensor_model import PlaneScale
from nlcwfs.estimation.wind import Wind, found_wind
from nlcwfs.feedback.controller import Telemetry
from nlcwfs.simulation.loop_air import MovingAir, measured_air, moving_air
from nlcwfs.simulation.loop_carried import CarriedCurvature
from nlcwfs.simulation.loop_light import LoopLight
from nlcwfs.simulation.loop_measurement import FollowedCurvature

BEYOND = 1.25
"""Modes that are filtered for each that the mirror makes: what is a little finer is carried to it as well."""

AT_LEAST = 500
"""... and not less than these, where the cells carry them."""

CELLS = 4
"""Lit cells for each mode, at least."""

DRAW = 20101
"""Seed of the air beyond the mirror's modes at which the light is linearised."""


def carried_curvature(
    followed: FollowedCurvature, config: Config, light: LoopLight, telemetry: Telemetry
) -> CarriedCurvature | None:
    """The sensor with a filter for the wind that a closed loop has seen; None if no wind is clear.

    Args:
        followed: Has measured until now.
        config: The settings.
        light: Mirror and pupil.
        telemetry: What was recorded.
    """
    solver = followed.reconstructor.solver
    grid, diameter_m = solver.level.grid, solver.geometry.pupil.diameter_m
    basis = filtered_basis(solver, light.mirror.count)
    shapes = mirror_modes(followed, light, basis)
    modes_m = telemetry.open_loop_m @ shapes.T
    rate_hz = light.sequence.rate_hz
    wind = _told_wind(config) or _seen_wind(basis, modes_m, pixel_m=grid.pixel_m, interval_s=1 / rate_hz)
    if wind is None:
        return None
    moving = moving_air(
        basis,
        _air(config, basis, modes_m, seen=light.mirror.count),
        wind,
        shapes,
        pixel_m=grid.pixel_m,
        diameter_m=diameter_m,
        interval_s=1 / rate_hz,
        latency_frames=config.feedback.latency_frames,
    )
    residual_m = shapes @ np.asarray(telemetry.measured_m[-1], float)
    flow = settled_filter(solver, moving, residual_m, photons=light.still.photons)
    return CarriedCurvature(
        followed=followed,
        flow=flow,
        seen=jnp.asarray(moving.commands, flow.modes.dtype),
        ahead=jnp.asarray(moving.commands @ moving.ahead, flow.modes.dtype),
        mirror=light.mirror,
        wind=wind,
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

    unit = np.eye(mirror.count, dtype=np.float32)
    stroke_m = 1e-7  # within any stroke
    return np.stack([np.asarray(modes_of(one * stroke_m), float) for one in unit], axis=1) / stroke_m


def settled_filter(
    solver: MaximumAPosteriori, moving: MovingAir, residual_m: Float[np.ndarray, " mode"], *, photons: float
) -> FlowFilter:
    """Kalman's filter for a wind.

    Args:
        solver: The sensor.
        moving: The air.
        residual_m: What the mirror leaves of it, in its own modes; finer air is drawn.
        photons: Of an exposure.
    """
    basis, radian_m = moving.basis, solver.geometry.wavelength_m / (2 * np.pi)
    drawn_m = np.linalg.cholesky(moving.now_m2) @ np.random.default_rng(DRAW).standard_normal(basis.count)
    finer_m = drawn_m - moving.shapes @ (moving.commands @ drawn_m)
    step = Step(moving.step.again, moving.step.new / radian_m**2)
    # modes are metres a metre, or radians a radian
    seen = seen_information(solver, basis, (residual_m + finer_m) / radian_m, photons=photons)
    return FlowFilter.build(solver, basis, step, seen, beyond_rad2=moving.beyond_m2 / radian_m**2)


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
    planes = len(solver.geometry.distances_m)
    none = jnp.zeros((planes, *level.measured_shape), dtype)
    measured = Measurement(none, jnp.ones(none.shape, bool), jnp.zeros((), dtype))
    shares = jnp.asarray(level.optics.flux_fractions, dtype)[:, None, None] * photons
    one = jnp.ones((), dtype)
    known_rad = solver.known_rad(jnp.zeros(2, dtype))
    prior = solver.prior(solver.power, solver.tilt_rms_rad)
    task = solver.task(measured, known_rad, PlaneScale(shares, 0 * shares), prior, one)
    phase_rad = known_rad + basis.combine(jnp.asarray(modes_rad, dtype))
    return modal_information(task.problem, phase_rad, basis)


def _told_wind(config: Config) -> Wind | None:
    """The wind that the settings tell, speed and direction."""
    prior = config.estimation.prior
    if prior.wind_direction_deg is None:
        return None
    angle = np.deg2rad(prior.wind_direction_deg)
    return Wind(float(prior.wind_speed_m_per_s * np.sin(angle)), float(prior.wind_speed_m_per_s * np.cos(angle)), 1.0)


def _seen_wind(
    basis: ModalBasis, modes_m: Float[np.ndarray, "frame mode"], *, pixel_m: float, interval_s: float
) -> Wind | None:
    """The wind in the modes of a loop."""
    lit = np.asarray(basis.weights) > 0
    rows, columns = (slice(np.flatnonzero(line)[0], np.flatnonzero(line)[-1] + 1) for line in (lit.any(1), lit.any(0)))
    inner = np.asarray(basis.modes, np.float32)[:, rows, columns]
    opd_m = np.tensordot(modes_m.astype(np.float32), inner, axes=1)
    return found_wind(opd_m, lit[rows, columns], pixel_m=pixel_m, interval_s=interval_s)


def _air(config: Config, basis: ModalBasis, modes_m: Float[np.ndarray, "frame mode"], *, seen: int) -> Turbulence:
    """The turbulence that is told, or that the modes show."""
    settings, diameter_m = config.estimation, config.beam.diameter_m
    if settings.seeing_arcsec is None and settings.prior.fried_m is None:
        far_m = settings.prior.outer_scale_m or np.inf
        return measured_air(basis, modes_m, seen=seen, diameter_m=diameter_m, outer_scale_m=far_m)
    told = settings.seeing_arcsec or 1.0  # not looked at where Fried's parameter is told
    return expected_air(settings.prior, seeing_arcsec=told, diameter_m=diameter_m)

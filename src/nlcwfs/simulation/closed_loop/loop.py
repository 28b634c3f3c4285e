"""The closed loop: a step for every exposure, a line for every stage of the light."""

from functools import cached_property
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.modes import ModalBasis, modal_basis
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.config import Config
from nlcwfs.errors import SettingsError
from nlcwfs.estimation.outcome import Outcome
from nlcwfs.feedback.controller import Controller, Telemetry
from nlcwfs.feedback.state import FeedbackState
from nlcwfs.science.long_exposure import LongExposure
from nlcwfs.science.rms_groups import rms_groups
from nlcwfs.simulation.closed_loop.faults import bump_rms_m, bump_shape, damaged, fault_in
from nlcwfs.simulation.closed_loop.flow import carried_curvature
from nlcwfs.simulation.closed_loop.lenslets import FollowedSpots
from nlcwfs.simulation.closed_loop.light import LoopLight
from nlcwfs.simulation.closed_loop.measurement import FollowedCurvature
from nlcwfs.simulation.closed_loop.sensor import LoopSensor, build_sensor, wind_is_told
from nlcwfs.simulation.closed_loop.sight import Sight
from nlcwfs.simulation.closed_loop.spots_air import carried_spots
from nlcwfs.simulation.exposure import Exposure

GROUPS = ("tip_tilt", "low", "middle", "high", "beyond")
"""Groups of modes in the order of `Record.group_nm2`: tilt, below 4 cycles per aperture, 4 to 12, above, the rest."""


class LoopState(NamedTuple):
    """What is carried from exposure to exposure.

    Attributes:
        frame: Number of the next exposure.
        control: The controller's, the mirror included.
        memory: The reconstructor's.
        image: The star's image since the loop settled.
        closed_at: Frame at which the loop closed; -1 before.
        before: The exposure that arrived last, where a detector is to send it twice; else None.
    """

    frame: int
    control: FeedbackState
    memory: Any
    image: LongExposure
    closed_at: int
    before: Exposure | None


class Record(NamedTuple):
    """What is recorded of an exposure.

    Attributes:
        rms_nm: Residual, mean over the moments of the exposure.
        group_nm2: Squares of the residual by groups of modes, see `GROUPS`; of the mean over detector pixels.
        sight: What was measured; None of an exposure that did not arrive.
        command_m: Mean command that was on the mirror.
    """

    rms_nm: float
    group_nm2: Float[np.ndarray, "5"]
    sight: Sight | None
    command_m: Float[np.ndarray, " mode"]


class Loop:
    """A loop, ready to run.

    Attributes:
        config: The settings.
        light: Air, mirror, optics, detector and star.
        measurement: Sensor and reconstructor.
        controller: From measurements to commands.
        basis: Modes on the detector's pixels, for the groups.
        reference_m: Modes that are left on the sensor.
    """

    def __init__(self, config: Config, *, light: LoopLight, measurement: LoopSensor, controller: Controller) -> None:
        self.config, self.light, self.measurement, self.controller = config, light, measurement, controller
        self.basis = pixel_basis(light)
        self.reference_m = light.mirror.fitted(light.reference_m)
        self._science_m = light.still.on_pixels(light.still.on_light(light.reference_m))
        self._groups = jax.jit(self._group_squares)

    @classmethod
    def build(cls, config: Config, pupil: PupilShape | None = None) -> "Loop":
        """Prepare everything.

        Args:
            config: The settings.
            pupil: Its shape, as for `ExposureSimulator.build`.

        Raises:
            SettingsError: If settings contradict each other.
            SamplingError: If the pupil does not fit in the window, or the mirror's shapes are too fine.
        """
        most = config.loop.substeps * config.loop.rate_hz
        blur_m = max(config.atmosphere.wind_speeds_m_per_s) / most
        if blur_m > config.beam.diameter_m / 4:
            rule = "must be higher, or loop.substeps: the air moves more than a quarter of the telescope in a moment"
            raise SettingsError("loop.rate_hz", rule, f"{config.loop.rate_hz:g}")
        light = LoopLight.build(config, pupil)
        controller = Controller.build(config.feedback, light.mirror.count, config.loop.rate_hz)
        return cls(config, light=light, measurement=build_sensor(config, light), controller=controller)

    def init(self) -> LoopState:
        """Before the first exposure: the mirror flat, or with the shape of the air."""
        control = self.controller.init()
        if self.config.loop.start == "closed":
            command_m = self.light.mirror.fitted(self.light.air_m(0)) - self.reference_m
            for _ in range(control.line.commands_m.shape[0]):
                control = control.push(command_m)
        image = self.light.star_image(self.config.loop.science_wavelength_um * 1e-6)
        return LoopState(0, control, None, image, -1, None)

    def step(self, state: LoopState) -> tuple[LoopState, Record]:
        """One exposure: air, mirror, light, detector, wavefront, command."""
        light, settings, line = self.light, self.config.loop, state.control.line
        fault = fault_in(settings, state.frame)
        bump_m = bump_rms_m(settings, state.frame) * self._bump
        corrected = light.expose(jnp.asarray(state.frame, jnp.int32), line, state.image, bump_m)
        arrived = damaged(fault, corrected.exposure, state.before)
        if arrived is None:
            sight = None
            command_m, memory = self.measurement.skip(state.memory)
        else:
            sight, memory = self._measured(arrived, line.mean_m, state.memory)
            sight = sight._replace(residual_m=sight.residual_m - self.reference_m)
            command_m = sight.command_m
        control = self._commanded(state.control, sight, command_m)
        closed_at = state.closed_at
        if closed_at < 0 and sight is not None and sight.closed:
            closed_at = state.frame
        image = corrected.image
        if closed_at < 0 or state.frame <= closed_at + settings.settle_s * settings.rate_hz:
            image = state.image  # nothing counts before the loop has settled
        record = Record(
            rms_nm=1e9 * float(jnp.sqrt(corrected.square_m2)),
            group_nm2=1e18 * np.asarray(self._groups(corrected.exposure.truth_m), float),
            sight=sight,
            command_m=np.asarray(line.mean_m),
        )
        before = corrected.exposure if settings.fault == "doubled-frames" else None  # else too large to keep
        return LoopState(state.frame + 1, control, memory, image, closed_at, before), record

    def _commanded(self, control: FeedbackState, sight: Sight | None, command_m: Array | None) -> FeedbackState:
        """The next command on its way: that of a sensor that looks ahead, or the controller's."""
        if command_m is not None:
            return control.push(command_m - self.reference_m)
        if sight is None or sight.outcome in (Outcome.NO_LIGHT, Outcome.NOT_FINITE):
            return self.controller.skip(control)[0]
        return self.controller.step(control, sight.residual_m)[0]

    @property
    def learns(self) -> bool:
        """Whether there is anything to learn: a filter whose wind is told works from the start."""
        return self.config.feedback.controller != "integrator" and not wind_is_told(self.config)

    def learn(self, telemetry: Telemetry) -> None:
        """Gains, predictions or the wind, from what was recorded; a loop without a clear wind goes on as it was.

        Args:
            telemetry: What was recorded since the loop has closed.
        """
        if self.config.feedback.controller != "kalman":
            self.controller = self.controller.learn(telemetry)
        elif isinstance(self.measurement, FollowedCurvature):
            filtered = carried_curvature(self.measurement, self.config, self.light, telemetry)
            self.measurement = filtered or self.measurement
        elif isinstance(self.measurement, FollowedSpots):
            self.measurement = carried_spots(self.measurement, self.config, self.light, telemetry) or self.measurement

    @cached_property
    def _bump(self) -> Float[Array, "lit_y lit_x"]:
        """Of unit rms; made once, for the mirror and the pupil of a loop stay what they are."""
        return bump_shape(self.light)

    def _measured(self, arrived: Exposure, command_m: Float[Array, " mode"], memory: Any) -> tuple[Sight, Any]:
        electrons = arrived.frames.electrons - self.light.still.detector.background_electrons
        usable = jnp.isfinite(electrons)
        clean = eqx.tree_at(lambda one: one.frames.electrons, arrived, jnp.where(usable, electrons, 0))
        return self.measurement.measure(clean, usable, self.light.mirror.opd_m(command_m), memory)

    def _group_squares(self, truth_m: Float[Array, "y x"]) -> Float[Array, "5"]:
        groups = rms_groups(jnp.nan_to_num(truth_m - self._science_m), self.basis)
        return jnp.stack([getattr(groups, f"{name}_m") for name in GROUPS]) ** 2


def pixel_basis(light: LoopLight) -> ModalBasis:
    """Karhunen-Loeve modes on the detector's pixels, as many as the mirror has, or as the pixels carry."""
    still = light.still
    frame: Grid = still.frame
    pupil = still.shape.on(frame)
    lit = int(np.sum(pupil > 0.5))
    count = min(light.mirror.count, int(0.45 * lit))
    return modal_basis(pupil, frame, diameter_m=still.shape.diameter_m, count=count)

"""What a sensor and its reconstructor make of an exposure in a loop: coefficients of the mirror's modes."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

from nlcwfs.beam.modes import modal_basis
from nlcwfs.config import Config
from nlcwfs.estimation.map_verdict import UNEXPLAINED
from nlcwfs.estimation.method import Reconstructor, build_reconstructor
from nlcwfs.estimation.outcome import Outcome
from nlcwfs.estimation.second_look import SecondLook
from nlcwfs.estimation.sequence_memory import Memory
from nlcwfs.estimation.sequence_reconstructor import SequenceReconstructor
from nlcwfs.estimation.settings import EstimationSettings
from nlcwfs.estimation.wavefront_estimate import WavefrontEstimate
from nlcwfs.simulation.closed_loop.light import LoopLight
from nlcwfs.simulation.closed_loop.model_cells import ModelCells
from nlcwfs.simulation.closed_loop.sight import Cautious, PixelModes, Sight
from nlcwfs.simulation.exposure import Exposure
from nlcwfs.simulation.known_sensor import geometry_of

DOUBTS = 2
"""Frames in a row that are not explained before what was followed is given up."""

SURE = 2
"""Frames in a row that must be believed, each on its own, before they are followed."""

TELLING = 3
"""Planes from which on light that is explained shows that a wavefront is right, even if the search did not agree with
itself: two planes are explained as well (unexplained 0.05 to 0.15) by wavefronts that are 500 nm off."""

PATIENT = {"healings": 8, "healing_iterations": 15, "agreement": 0.4}
"""At least so patient is the search while a loop is open, at D / r0 of 25 and more: with the defaults for single frames
3 of 8 loops closed with islands that cost 50 nm and more, or not within 24 frames; so all closed within 12."""


class FollowedState(NamedTuple):
    """Memory of a loop that is followed.

    Attributes:
        memory: What is expected; None while the loop is not closed.
        doubts: Frames in a row that were not explained.
        since: Frames since the last second look.
        sure: Frames in a row that were believed on their own.
    """

    memory: Memory | None
    doubts: int
    since: int
    sure: int


class FollowedCurvature(eqx.Module):
    """The curvature sensor with the most likely wavefront, followed from frame to frame.

    While the loop is open each frame is reconstructed on its own, for the whole turbulence: air and mirror together
    are Kolmogorov's, not the residual. Once a wavefront is believed the next are followed with a fixed number of FFTs.
    """

    reconstructor: SequenceReconstructor
    second: SecondLook
    pixels: PixelModes
    cautious: Cautious
    on_model: ModelCells
    read_variance: float = eqx.field(static=True)
    look_again_every: int = eqx.field(static=True)

    @classmethod
    def build(cls, config: Config, light: LoopLight) -> "FollowedCurvature":
        """Prepare the reconstructor of a configuration.

        Raises:
            SettingsError: If settings contradict each other.
        """
        still, geometry = light.still, geometry_of(config, light.still)
        settings = with_wind_of_air(config)
        own = settings.map
        patient = {
            "healings": max(own.healings, PATIENT["healings"]),
            "healing_iterations": max(own.healing_iterations, PATIENT["healing_iterations"]),
            "agreement": min(own.agreement, PATIENT["agreement"]),
        }
        settings = settings.model_copy(update={"map": own.model_copy(update=patient)})
        rate_hz = light.sequence.rate_hz
        sequence = SequenceReconstructor.build(geometry, settings, interval_s=1 / rate_hz, photons=still.photons)
        level = sequence.solver.level
        return cls(
            reconstructor=sequence,
            second=SecondLook.build(sequence),
            pixels=PixelModes.build(light),
            cautious=Cautious.build(config, np.asarray(light.mirror.cycles_per_aperture)),
            on_model=ModelCells.build(light, np.asarray(level.light) > 0, oversampling=level.oversampling),
            read_variance=still.detector.variance_without_light,
            look_again_every=config.loop.look_again_every,
        )

    @eqx.filter_jit
    def _looked(
        self, how: Callable, counts: Array, usable: Array, mirror_m: Array, memory: tuple[Memory, ...]
    ) -> tuple[WavefrontEstimate, Memory, Float[Array, " mode"]]:
        """One of the ways of the reconstructor to look at a frame; the first needs no memory."""
        known_m, noise = -self.on_model(mirror_m), self.read_variance
        estimate, after = how(self.reconstructor, counts, usable, *memory, read_variance=noise, known_m=known_m)
        return estimate, after, self.pixels(estimate.opd_m)

    def _without_islands(
        self, counts: Array, usable: Array, mirror_m: Array, memory: Memory, residual_m: Array
    ) -> tuple[int, Memory, Float[Array, " mode"], int]:
        """How many islands a second look at the frame brings back, memory and residual then, and its FFTs."""
        known_m, noise = -self.on_model(mirror_m), self.read_variance
        looked = self.second.look(counts, usable, memory, read_variance=noise, known_m=known_m)
        if looked.turned:
            residual_m = residual_m + self._change_m(looked.change_rad)
        return looked.turned, looked.memory, residual_m, looked.ffts

    @eqx.filter_jit
    def _change_m(self, change_rad: Float[Array, "Y X"]) -> Float[Array, " mode"]:
        """What a change of the phase on the model's grid is in modes."""
        solver = self.reconstructor.solver
        return self.pixels(solver.on_frame(change_rad) * (solver.geometry.wavelength_m / (2 * np.pi)))

    def measure(
        self,
        exposure: Exposure,
        usable: Bool[Array, "plane y x"],
        mirror_m: Float[Array, "lit_y lit_x"],
        memory: FollowedState | None,
    ) -> tuple[Sight, FollowedState]:
        """What an exposure shows; see `LoopSensor`."""
        state = memory or FollowedState(None, 0, 0, 0)
        counts = exposure.frames.electrons
        if state.memory is None or state.sure < SURE:
            estimate, begun, residual_m = self._looked(SequenceReconstructor.start, counts, usable, mirror_m, ())
            outcome, ffts = Outcome(int(estimate.outcome_code)), int(estimate.ffts)
            if len(counts) >= TELLING and outcome not in (Outcome.NO_LIGHT, Outcome.NOT_FINITE):
                turned, begun, residual_m, more = self._without_islands(counts, usable, mirror_m, begun, residual_m)
                ffts += more
                if not turned and float(estimate.unexplained) < UNEXPLAINED and not outcome.succeeded:
                    outcome = Outcome.BUDGET_SPENT  # healing went astray, but nothing more likely was found
            sure = state.sure + 1 if outcome.succeeded else 0
            after = FollowedState(begun if outcome.succeeded else None, 0, 0, sure)
            return self._sight(estimate, residual_m, outcome, ffts, closed=sure >= SURE), after
        seen = counts, usable, mirror_m
        estimate, followed, residual_m = self._looked(SequenceReconstructor.follow, *seen, (state.memory,))
        outcome, ffts = Outcome(int(estimate.outcome_code)), int(estimate.ffts)
        doubts, since = 0 if outcome.succeeded else state.doubts + 1, state.since + 1
        if outcome.succeeded and self.look_again_every and since >= self.look_again_every:
            _, followed, residual_m, more = self._without_islands(*seen, followed, residual_m)
            ffts, since = ffts + more, 0
        if outcome in (Outcome.NO_LIGHT, Outcome.NOT_FINITE):
            followed = self.reconstructor.skip(state.memory)
        lost = doubts >= DOUBTS
        sight = self._sight(estimate, residual_m, outcome, ffts, closed=True)
        return sight, FollowedState(None if lost else followed, doubts, since, 0 if lost else state.sure)

    def skip(self, memory: FollowedState | None) -> tuple[None, FollowedState | None]:
        """An exposure later; see `LoopSensor`."""
        if memory is None or memory.memory is None:
            return None, memory
        return None, memory._replace(memory=self.reconstructor.skip(memory.memory))

    def _sight(
        self, estimate: WavefrontEstimate, residual_m: Array, outcome: Outcome, ffts: int, *, closed: bool
    ) -> Sight:
        part_m = self.cautious.part(residual_m, outcome)
        return Sight(part_m, outcome, float(estimate.predicted_error_m), ffts, closed)


def with_wind_of_air(config: Config) -> EstimationSettings:
    """The settings of the estimation, with the speed of the wind where the user has not told another.

    Examples:
        >>> from nlcwfs.config import load_config
        >>> with_wind_of_air(load_config(None, ["atmosphere.wind_speeds_m_per_s=[7]"])).prior.wind_speed_m_per_s
        7.0
    """
    settings = config.estimation
    if settings.prior.wind_speed_m_per_s != type(settings.prior)().wind_speed_m_per_s:
        return settings
    prior = settings.prior.model_copy(update={"wind_speed_m_per_s": max(config.atmosphere.wind_speeds_m_per_s)})
    return settings.model_copy(update={"prior": prior})


class SingleFrames(eqx.Module):
    """The curvature sensor with any method, every frame on its own."""

    reconstructor: Reconstructor
    pixels: PixelModes
    cautious: Cautious
    read_variance: float = eqx.field(static=True)

    @classmethod
    def build(cls, config: Config, light: LoopLight) -> "SingleFrames":
        """Prepare the reconstructor of a configuration.

        Raises:
            SettingsError: If settings contradict each other.
        """
        geometry, settings, basis = geometry_of(config, light.still), config.estimation, None
        if settings.method == "gerchberg-saxton" and settings.unwrapping == "slopes":
            pupil = geometry.pupil.on(geometry.frame)
            basis = modal_basis(pupil, geometry.frame, diameter_m=geometry.pupil.diameter_m, count=settings.modes)
        return cls(
            reconstructor=build_reconstructor(geometry, settings, basis=basis),
            pixels=PixelModes.build(light),
            cautious=Cautious.build(config, np.asarray(light.mirror.cycles_per_aperture)),
            read_variance=light.still.detector.variance_without_light,
        )

    @eqx.filter_jit
    def _estimated(self, counts: Array, usable: Array) -> tuple[WavefrontEstimate, Float[Array, " mode"]]:
        estimate = self.reconstructor.estimate(counts, usable, read_variance=self.read_variance)
        return estimate, self.pixels(estimate.opd_m)

    def measure(
        self, exposure: Exposure, usable: Bool[Array, "plane y x"], mirror_m: Float[Array, "lit_y lit_x"], memory: None
    ) -> tuple[Sight, None]:
        """What an exposure shows; see `LoopSensor`."""
        estimate, residual_m = self._estimated(exposure.frames.electrons, usable)
        outcome = Outcome(int(estimate.outcome_code))
        part_m = self.cautious.part(residual_m, outcome)
        return Sight(part_m, outcome, float(estimate.predicted_error_m), int(estimate.ffts), outcome.succeeded), None

    def skip(self, memory: None) -> tuple[None, None]:
        """Every frame is on its own; see `LoopSensor`."""
        return None, memory


class IdealMeasurement(eqx.Module):
    """Sees the mean residual of an exposure without noise: what lag and the mirror alone leave."""

    light: LoopLight

    def measure(
        self, exposure: Exposure, usable: Bool[Array, "plane y x"], mirror_m: Float[Array, "lit_y lit_x"], memory: None
    ) -> tuple[Sight, None]:
        """What an exposure shows; see `LoopSensor`."""
        margins = [(a - b) // 2 for a, b in zip(exposure.opd_m.shape, mirror_m.shape, strict=True)]
        inner = tuple(slice(m, m + size) for m, size in zip(margins, mirror_m.shape, strict=True))
        residual_m = self.light.mirror.fitted(exposure.opd_m[inner])
        return Sight(residual_m, Outcome.CONVERGED, 0.0, 0, True), None

    def skip(self, memory: None) -> tuple[None, None]:
        """Nothing is remembered; see `LoopSensor`."""
        return None, memory

"""Frames in a row: what the last ones showed is expected of the next, so that a few FFTs a frame are enough."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nlcwfs.errors import SettingsError
from nlcwfs.estimation import gauss_newton as gn
from nlcwfs.estimation.expected_amplitude import refuse_estimated
from nlcwfs.estimation.fit_quality import unexplained_share
from nlcwfs.estimation.followed_air import ExpectedAir, FollowedAir
from nlcwfs.estimation.map_solution import Found, Task
from nlcwfs.estimation.map_verdict import UNEXPLAINED
from nlcwfs.estimation.maximum_a_posteriori import MaximumAPosteriori
from nlcwfs.estimation.outcome import Outcome
from nlcwfs.estimation.reconstructor import SENSOR_LOSS
from nlcwfs.estimation.resolution_level import cropped
from nlcwfs.estimation.sensor_geometry import SensorGeometry
from nlcwfs.estimation.sensor_model import PlaneScale
from nlcwfs.estimation.sequence_budget import fixed_ffts, inner_steps
from nlcwfs.estimation.sequence_memory import Memory, plane_counts
from nlcwfs.estimation.settings import EstimationSettings
from nlcwfs.estimation.tilt import mean_slope, tilt_phase
from nlcwfs.estimation.turbulence_filter import half_plane_frequencies
from nlcwfs.estimation.wave_sensitivity import roughness, seen_share
from nlcwfs.estimation.wavefront_estimate import WavefrontEstimate
from nlcwfs.estimation.whitened_phase import Unknown

TILT_CYCLES = 1.0
"""A tilt is seen as well as a wave of so many cycles per aperture: the rim of the pupil moves."""


class SequenceReconstructor(eqx.Module):
    """Reconstructs frames that follow each other, with a fixed number of FFTs for each after the first.

    The first frame is reconstructed as if alone. From then on the prior of a frame is what the wind leaves of the last
    estimate (`frame_prediction`), and a few Gauss-Newton steps from there are enough. In a closed loop the mirror's
    shape is told as a known wavefront: what is followed is the whole turbulence, whose prior is known.

    Attributes:
        solver: Reconstructs single frames.
        air: How the phase goes on.
        inner: Conjugate gradients of each step.

    Examples:
        >>> from nlcwfs.beam.grid import Grid
        >>> from nlcwfs.beam.pupil_shape import PupilShape
        >>> geometry = SensorGeometry(PupilShape(8.0), Grid((32, 32), 0.36), 0.65e-6, (-3.5e6, -2.5e6, 2.5e6, 3.5e6))
        >>> sequence = SequenceReconstructor.build(geometry, EstimationSettings(modes=100), interval_s=0.004)
        >>> sequence.inner, sequence.ffts
        ((2, 2, 1), 97)
    """

    solver: MaximumAPosteriori
    air: FollowedAir
    inner: tuple[int, ...] = eqx.field(static=True)
    interval_s: float = eqx.field(static=True)

    @classmethod
    def build(
        cls,
        geometry: SensorGeometry,
        settings: EstimationSettings,
        *,
        interval_s: float,
        photons: float = 1e4,
        dtype: str = "float32",
    ) -> "SequenceReconstructor":
        """Prepare for frames at equal intervals.

        Args:
            geometry: The sensor.
            settings: Options; the wind is that of `settings.prior`.
            interval_s: Time from frame to frame.
            photons: About how many a frame has: with many, old frames are forgotten sooner.
            dtype: Precision.

        Raises:
            SettingsError: If an option contradicts another, the interval is not positive, or the budget too small.
            SamplingError: If the pupil does not fit on the frames.
        """
        if not interval_s > 0 or not photons > 0:
            raise SettingsError("interval_s and photons", "must be positive", (interval_s, photons))
        if geometry.pupil.is_segmented:
            rule = "must be one piece to be followed from frame to frame; frames on their own may have segments"
            raise SettingsError("pupil", rule, "segments")
        refuse_estimated(settings, because="frames that follow each other: only frames on their own twinkle")
        planes, options, prior = len(geometry.distances_m), settings.map, settings.prior
        inner = inner_steps(
            planes,
            budget=options.ffts_per_frame,
            steps=options.sequence_steps,
            oversampling=options.oversampling,
        )
        solver = MaximumAPosteriori.build(geometry, settings, dtype=dtype)
        information = 4 * photons / (SENSOR_LOSS * float(jnp.sum(solver.level.light)))
        whole = ExpectedAir(
            solver.power,
            solver.tilt_rms_rad,
            solver.level.grid,
            diameter_m=geometry.pupil.diameter_m,
            wavelength_m=geometry.wavelength_m,
        )
        air = FollowedAir.build(whole, prior, interval_s=interval_s, information=information)
        return cls(solver=solver, air=air, inner=inner, interval_s=interval_s)

    @property
    def ffts(self) -> int:
        """FFTs of every frame after the first."""
        level = self.solver.level
        planes, colours = level.optics.transfer.shape[1], level.colour_count
        return fixed_ffts(planes, inner=self.inner, oversampling=level.oversampling, colours=colours)

    def start(
        self,
        counts: Float[Array, "plane y x"],
        usable: Bool[Array, "plane y x"],
        *,
        read_variance: float | Float[Array, ""] = 0.0,
        known_m: Float[Array, "Y X"] | None = None,
    ) -> tuple[WavefrontEstimate, Memory]:
        """The wavefront of a first frame, and what it tells of the next; arguments as for `follow`."""
        solver, grid = self.solver, self.solver.level.grid
        near = solver.capture.measurement(counts, usable, read_variance)
        if known_m is None:
            found = solver.found(near)
            return solver.account(found), self._begun(found)
        # The tilt of the mirror goes to the tilt of the air, which no periodic window can hold.
        slope = mean_slope(known_m, solver.level.light, grid).astype(solver.power.dtype)
        rest_rad = self.phase_of(known_m) - tilt_phase(slope, grid, solver.geometry.wavelength_m)
        found = solver.found(near, mirror_rad=-rest_rad)
        memory = self._begun(found)
        return solver.account(found), dataclasses.replace(memory, slope=memory.slope - slope)

    def _begun(self, found: Found) -> Memory:
        """What a frame on its own tells of the next."""
        solver, task, strength = self.solver, found.task, found.strength
        total = plane_counts(task.measured)
        scale = PlaneScale(task.scale.counts / total, task.scale.background)
        unseen = self.air.unseen(strength, found.slope, scale)
        return self.air.seen(unseen, task.problem, found.search.best.unknown, jnp.sum(solver.level.light))

    def phase_of(self, opd_m: Float[Array, "y x"]) -> Float[Array, "y x"]:
        """Phase of a wavefront at the wavelength of sensing."""
        return opd_m.astype(self.solver.power.dtype) * (2 * np.pi / self.solver.geometry.wavelength_m)

    def follow(
        self,
        counts: Float[Array, "plane y x"],
        usable: Bool[Array, "plane y x"],
        memory: Memory,
        *,
        read_variance: float | Float[Array, ""] = 0.0,
        known_m: Float[Array, "Y X"] | None = None,
    ) -> tuple[WavefrontEstimate, Memory]:
        """The wavefront of the next frame, in a fixed number of FFTs, and what it tells of the one after.

        Args:
            counts: Photo-electrons on the frames' pixels, background subtracted.
            usable: False for pixels to ignore.
            memory: What the frame before has told.
            read_variance: Variance of a pixel without light, electrons squared.
            known_m: Wavefront on the model's grid that is added to what is followed: minus the shape of a mirror.

        Returns:
            The wavefront that the sensor saw, `known_m` included, and the memory of what is followed, without it.
        """
        solver = self.solver
        level = solver.level
        expected = self.skip(memory)
        measured = solver.capture.measurement(counts, usable, read_variance).padded(level.measured_shape)
        known_rad = solver.known_rad(memory.slope) + expected.phase_rad
        if known_m is not None:
            known_rad = known_rad + self.phase_of(known_m)
        prior = self.air.prior(expected)
        total = plane_counts(measured)
        scale = PlaneScale(memory.scale.counts * total, memory.scale.background)
        task = solver.task(measured, known_rad, scale, prior, memory.strength)
        shown = self._shown(roughness(known_rad, level) + memory.surprise_rad2)
        task = task._replace(problem=task.problem._replace(shown=shown))
        unknown = prior.nothing()
        for inner in self.inner:
            direction, _ = gn.direction_of_step(task.problem, inner, unknown)
            unknown = gn.plus(unknown, direction, 1.0)
        after = self.air.seen(expected, task.problem, unknown, jnp.sum(level.light))
        surprise_rad2 = roughness(after.phase_rad - expected.phase_rad, level)
        return self._account(task, unknown, after), dataclasses.replace(after, surprise_rad2=surprise_rad2)

    def skip(self, memory: Memory) -> Memory:
        """What is expected one interval later; call it for every frame that is missing."""
        return self.air.expected(memory)

    def _shown(self, rough_rad2: Float[Array, " lag"]) -> Unknown:
        """Share of the information that waves and tilt get from a wavefront of this roughness."""
        level, geometry = self.solver.level, self.solver.geometry
        sensor = {
            "pixel_m": level.grid.pixel_m,
            "distances_m": geometry.distances_m,
            "fractions": level.optics.flux_fractions,
            "wavelength_m": geometry.wavelength_m,
        }
        waves = seen_share(half_plane_frequencies(level.grid), rough_rad2, **sensor)
        tilt = seen_share(np.full(2, TILT_CYCLES / geometry.pupil.diameter_m), rough_rad2, **sensor)
        return Unknown(waves, tilt)

    def _account(self, task: Task, unknown: Unknown, after: Memory) -> WavefrontEstimate:
        """Wavefront, expected error and verdict of a frame that was followed."""
        solver, problem = self.solver, task.problem
        geometry = solver.geometry
        metres = geometry.wavelength_m / (2 * np.pi)
        whole_rad = problem.known_rad + problem.prior.phase_rad(unknown)
        model = problem.expected(whole_rad)
        light = solver.on_frame(solver.level.light)
        opd_m = solver.on_frame(whole_rad) * metres - solver.on_frame(solver.level.optics.static_opd_m)
        opd_m = opd_m - jnp.sum(light * opd_m) / jnp.sum(light)
        unexplained = unexplained_share(task.measured, model, solver.band)
        code = jnp.where(unexplained > UNEXPLAINED, Outcome.NOT_EXPLAINED, Outcome.BUDGET_SPENT)
        dark = jnp.any(jnp.sum(jnp.where(task.measured.usable, problem.counts, 0), axis=(1, 2)) <= 0)
        code = jnp.where(dark, Outcome.NO_LIGHT, code)
        code = jnp.where(jnp.all(jnp.isfinite(opd_m)), code, Outcome.NOT_FINITE).astype(jnp.int32)
        left = self.air.left_rad2(after) + task.beyond
        residual = jnp.where(task.measured.usable, problem.counts - model, 0)
        return WavefrontEstimate(
            opd_m=opd_m,
            predicted_error_m=jnp.sqrt(left) * metres,
            unexplained=unexplained,
            residual=jnp.stack([cropped(plane, geometry.frame.shape) for plane in residual]),
            iterations=jnp.asarray(solver.settings.map.sequence_steps, jnp.int32),
            ffts=jnp.asarray(self.ffts, jnp.int32),
            outcome_code=code,
            strength=after.strength,
        )

"""The non-linear pyramid in the loop: from the first exposure on the most likely wavefront is followed.

The matrix of the linear pyramid gives the first guess, tells from how uneven the light is whether the loop has closed,
and works where the most likely wavefront does not explain the light.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nlcwfs.beam.grid import Grid
from nlcwfs.config import Config
from nlcwfs.errors import SettingsError
from nlcwfs.estimation.followed_air import ExpectedAir, FollowedAir
from nlcwfs.estimation.ladder import window_shape
from nlcwfs.estimation.outcome import Outcome
from nlcwfs.estimation.phase_prior import expected_air
from nlcwfs.estimation.reconstructor import SENSOR_LOSS
from nlcwfs.estimation.resolution_level import pixel_means
from nlcwfs.estimation.sequence_memory import Memory
from nlcwfs.estimation.solved_pyramid import Solved, SolvedPyramid
from nlcwfs.estimation.turbulence_filter import expected_power
from nlcwfs.mirror.mirror import Mirror
from nlcwfs.simulation.closed_loop.light import LoopLight
from nlcwfs.simulation.closed_loop.measurement import with_wind_of_air
from nlcwfs.simulation.closed_loop.model_cells import ModelCells
from nlcwfs.simulation.closed_loop.pyramid_light import PyramidOptics, pyramid_on
from nlcwfs.simulation.closed_loop.pyramid_sensor import FollowedPyramid, PyramidState
from nlcwfs.simulation.closed_loop.sight import PixelModes, Sight
from nlcwfs.simulation.exposure import Exposure, seeing_arcsec, wavelength_m
from nlcwfs.simulation.known_sensor import geometry_of
from nlcwfs.simulation.static_aberration import lit_part

EXPLAINED = 1.5
"""Misfit per pixel above which a wavefront is not believed."""

DOUBTS = 2
"""Frames in a row that are not believed before the matrix works again."""


class SolvedState(NamedTuple):
    """Memory of a loop whose pyramid is solved.

    Attributes:
        matrix: Of the linear reconstructor.
        followed: Of the other; None where it fails.
        doubts: Frames in a row that were not explained.
    """

    matrix: PyramidState | None
    followed: Memory | None
    doubts: int


class SearchingPyramid(eqx.Module):
    """All pixels of four pupil images, and the most likely wavefront behind them.

    Attributes:
        matrix: Begins, judges, and works when the other fails.
        solver: Follows.
        pixels: From a wavefront on the detector's pixels of the curvature sensor to commands.
        on_model: From the mirror's shape to the model.
        mirror: The mirror.
        frame: Those pixels.
    """

    matrix: FollowedPyramid
    solver: SolvedPyramid
    pixels: PixelModes
    on_model: ModelCells
    mirror: Mirror
    frame: Grid = eqx.field(static=True)

    @classmethod
    def build(cls, config: Config, light: LoopLight, optics: PyramidOptics) -> "SearchingPyramid":
        """Make the matrix and the model.

        Raises:
            SettingsError: If settings contradict each other.
            SamplingError: If the model's cells are too wide for the prism.
        """
        still, settings = light.still, with_wind_of_air(config)
        if settings.prior.wind_direction_deg is not None:  # see docs: the loop goes astray
            rule = "must be left out with pyramid.reconstructor = map"
            raise SettingsError("estimation.prior.wind_direction_deg", rule, settings.prior.wind_direction_deg)
        oversampling, wave_m, diameter_m = settings.map.oversampling, wavelength_m(config), still.shape.diameter_m
        grid = Grid(window_shape(geometry_of(config, still), 1, settings.map.window), still.frame.pixel_m)
        grid = grid.finer(oversampling)
        pupil = still.shape.on(grid)
        lit, weights = pupil > 0, pupil**2 / np.max(pupil**2)
        across = pupil[lit_part(pupil)].shape
        told = settings.seeing_arcsec or seeing_arcsec(still.air)
        air = expected_air(settings.prior, seeing_arcsec=told, diameter_m=diameter_m)
        power = expected_power(grid, air, wavelength_m=wave_m, cutoff_per_m=None)
        dtype = str(light.weights.dtype)
        whole = ExpectedAir(
            jnp.asarray(power, dtype),
            jnp.asarray(air.tilt_rms_rad(wave_m, diameter_m=diameter_m), dtype),
            grid,
            diameter_m=diameter_m,
            wavelength_m=wave_m,
        )
        information = 4 * still.photons / (SENSOR_LOSS * float(np.sum(weights)))
        followed = FollowedAir.build(whole, settings.prior, interval_s=1 / config.loop.rate_hz, information=information)
        prism = pyramid_on(config, still, Grid((across[0], across[1]), grid.pixel_m))
        return cls(
            matrix=FollowedPyramid.build(config, light, optics),
            solver=SolvedPyramid(prism, followed, jnp.asarray(weights, dtype), settings.map.dark_share),
            pixels=PixelModes.build(light),
            on_model=ModelCells.build(light, lit, oversampling=oversampling),
            mirror=light.mirror,
            frame=still.frame,
        )

    def measure(
        self,
        exposure: Exposure,
        usable: Bool[Array, "image v u"],
        mirror_m: Float[Array, "lit_y lit_x"],
        memory: SolvedState | None,
    ) -> tuple[Sight, SolvedState]:
        """What an exposure shows; see `LoopSensor`."""
        state = memory or SolvedState(None, None, 0)
        sight, matrix = self.matrix.measure(exposure, usable, mirror_m, state.matrix)
        if sight.outcome is Outcome.NO_LIGHT:
            return sight, self._skipped(state)
        seen = exposure.frames.electrons, usable, mirror_m
        if state.followed is None:
            solved, residual_m, left_m = self._started(*seen, self.mirror.opd_m(sight.residual_m))
        else:
            solved, residual_m, left_m = self._followed(*seen, state.followed)
        explained = float(solved.chi2) < EXPLAINED
        doubts = 0 if explained else state.doubts + 1
        if doubts >= DOUBTS or (state.followed is None and not explained):
            return sight, SolvedState(matrix, None, 0)
        outcome = Outcome.CONVERGED if explained else Outcome.NOT_EXPLAINED
        return Sight(residual_m, outcome, float(left_m), 0, sight.closed), SolvedState(matrix, solved.memory, doubts)

    def skip(self, memory: SolvedState | None) -> tuple[None, SolvedState | None]:
        """An exposure later; see `LoopSensor`."""
        return None, memory and self._skipped(memory)

    def _skipped(self, state: SolvedState) -> SolvedState:
        if state.followed is None:
            return state
        return state._replace(followed=self.solver.air.expected(state.followed))

    @eqx.filter_jit
    def _started(self, counts: Array, usable: Array, mirror_m: Array, residual_m: Array) -> tuple[Solved, Array, Array]:
        known_rad, noise = -self._phase(mirror_m), self.matrix.read_variance
        guess_rad = self._phase(residual_m)
        solved = self.solver.start(counts, usable, guess_rad, known_rad=known_rad, read_variance=noise)
        return solved, *self._account(solved)

    @eqx.filter_jit
    def _followed(self, counts: Array, usable: Array, mirror_m: Array, memory: Memory) -> tuple[Solved, Array, Array]:
        known_rad, noise = -self._phase(mirror_m), self.matrix.read_variance
        solved = self.solver.follow(counts, usable, memory, known_rad=known_rad, read_variance=noise)
        return solved, *self._account(solved)

    def _phase(self, opd_m: Float[Array, "lit_y lit_x"]) -> Float[Array, "Y X"]:
        return self.on_model(opd_m) * (2 * np.pi / self.solver.air.whole.wavelength_m)

    def _account(self, solved: Solved) -> tuple[Float[Array, " mode"], Float[Array, ""]]:
        """Commands of the residual, and the error that is expected of it."""
        air = self.solver.air.whole
        metres = air.wavelength_m / (2 * np.pi)
        factor = round(self.frame.pixel_m / air.grid.pixel_m)
        pixels = pixel_means(solved.residual_rad, factor, self.frame.shape)
        return self.pixels(pixels * metres), jnp.sqrt(self.solver.air.left_rad2(solved.memory)) * metres

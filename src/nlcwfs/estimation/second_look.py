"""A second look at a frame that was followed: islands that came in over the rim a whole turn off are brought back.

The images hardly show such an island: only its rim, two or three cells wide, disagrees with them. Some iterations of
Gerchberg-Saxton on the field tear the phase there (`turn_islands`), the cheapest cut through the torn phase names
regions that may be turned (`turned_regions`), and each is asked of the light itself: is the wavefront with it brought
back more likely?
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
from jaxtyping import Array, Bool, Float

from nlcwfs.estimation.angle import wrap
from nlcwfs.estimation.map_solution import Solution, Task, solved
from nlcwfs.estimation.maximum_a_posteriori import START_NOISE
from nlcwfs.estimation.resolution_level import LIT
from nlcwfs.estimation.sequence_memory import Memory
from nlcwfs.estimation.sequence_reconstructor import SequenceReconstructor
from nlcwfs.estimation.tilt import tilt_phase
from nlcwfs.estimation.turn_islands import tearing_ffts, torn_phase
from nlcwfs.estimation.turned_regions import TurnedRegion, turned_regions

TEARING = 15
"""Iterations that tear: fewer leave the rims whole, more bring only noise."""

TEARING_GAIN = 1.0
"""Length of their steps. Gerchberg and Saxton's own: with twice that, noise hides every third island."""

EASES = (0.9, 0.75)
"""See `turned_regions`. Of 12 islands in loops the first names 10 and nothing else, the second 11 and as many that are
none; 1 names 7."""

MOST = 6
"""Regions that are asked about in one look."""

EVIDENCE = 5.0
"""By how much the likelihood times the prior must rise, in nats. Of 50 looks at a loop, islands gave 33 to 240."""

REACH = 8
"""Cells beyond the rim of the pupil that move with a region: the smooth phase goes on there."""

BLUR = 1.0
"""Width of the soft rim of a moved region, cells."""


AROUND = 4
"""Cells around a region in which the light of the frame sets the phase, so that the rim is mended, too."""


class Looked(NamedTuple):
    """What a second look has found.

    Attributes:
        memory: With the islands brought back.
        change_rad: What was added to the phase, on the model's grid.
        turned: How many regions were brought back.
        ffts: FFTs of one plane.
    """

    memory: Memory
    change_rad: Float[Array, "Y X"]
    turned: int
    ffts: int


class SecondLook(eqx.Module):
    """Looks for islands in what is followed, between frames and without haste.

    Attributes:
        sequence: Follows the frames.
        lit: Cells with light.
        nearest: For each cell the nearest one with light (rows, columns), and whether it is within `REACH`.
    """

    sequence: SequenceReconstructor
    lit: np.ndarray
    nearest: tuple[np.ndarray, np.ndarray, np.ndarray]

    @classmethod
    def build(cls, sequence: SequenceReconstructor) -> "SecondLook":
        """Prepare for the frames of one sensor."""
        lit = np.asarray(sequence.solver.level.light) > LIT
        away, nearest = scipy.ndimage.distance_transform_edt(~lit, return_indices=True)  # pyright: ignore
        return cls(sequence, lit, (nearest[0], nearest[1], away <= REACH))

    def look(
        self,
        counts: Float[Array, "plane y x"],
        usable: Bool[Array, "plane y x"],
        memory: Memory,
        *,
        read_variance: float | Float[Array, ""] = 0.0,
        known_m: Float[Array, "Y X"] | None = None,
    ) -> Looked:
        """Look once more at a frame.

        Args:
            counts: Photo-electrons on the frames' pixels, background subtracted.
            usable: False for pixels to ignore.
            memory: What following that very frame has told.
            read_variance: Variance of a pixel without light, electrons squared.
            known_m: As it was told when the frame was followed.
        """
        seen = counts, usable, read_variance, known_m
        ffts = tearing_ffts(counts.shape[0], TEARING, moments=self.sequence.solver.level.moment_count)
        regions = self._regions(np.asarray(self._torn(*seen, memory), float))
        change_rad, turned = jnp.zeros_like(memory.phase_rad), 0
        if not regions:
            return Looked(memory, change_rad, turned, ffts)
        best = self._solved(*seen, memory, change_rad)
        moved_rad = np.zeros(self.lit.shape)
        ffts += int(best[1].ffts)
        for region in regions:
            tried_rad = moved_rad + self._move_rad(region)
            found = self._solved(*seen, memory, jnp.asarray(tried_rad, change_rad.dtype))
            ffts += int(found[1].ffts)
            if float(found[1].cost) < float(best[1].cost) - EVIDENCE:
                best, moved_rad, turned = found, tried_rad, turned + 1
        if turned:
            # Elsewhere what is followed knows more than this one frame.
            around = jnp.asarray(_around(moved_rad), change_rad.dtype)
            change_rad = around * (best[0] - memory.phase_rad)
        after = eqx.tree_at(lambda one: one.phase_rad, memory, memory.phase_rad + change_rad)
        return Looked(after, change_rad, turned, ffts)

    def _regions(self, rough_rad: np.ndarray) -> list[TurnedRegion]:
        """Regions of the rough phase that may be turned, none twice."""
        found: list[TurnedRegion] = []
        for ease in EASES:
            for region in turned_regions(rough_rad, self.lit, ease=ease):
                shared = [np.sum(region.cells & one.cells) / np.sum(region.cells | one.cells) for one in found]
                if not any(share > 0.5 for share in shared):
                    found.append(region)
        return found[:MOST]

    def _move_rad(self, region: TurnedRegion) -> np.ndarray:
        """A turn in the region and some way beyond the pupil's rim, with a soft edge."""
        rows, columns, near = self.nearest
        return 2 * np.pi * region.turns * scipy.ndimage.gaussian_filter(region.cells[rows, columns] * near * 1.0, BLUR)

    def _task(
        self, counts: Array, usable: Array, read_variance: Array | float, known_m: Array | None, memory: Memory
    ) -> Task:
        """The frame, with nothing but turbulence expected."""
        solver, strength = self.sequence.solver, memory.strength
        measured = solver.capture.measurement(counts, usable, read_variance).padded(solver.level.measured_shape)
        known_rad = solver.known_rad(memory.slope)
        if known_m is not None:
            known_rad = known_rad + self.sequence.phase_of(known_m)
        scale = solver.plane_scale(measured, known_rad + memory.phase_rad)
        prior = solver.prior(solver.power * strength, solver.tilt_rms_rad * jnp.sqrt(strength))
        return solver.task(measured, known_rad, scale, prior, strength)

    @eqx.filter_jit
    def _torn(
        self, counts: Array, usable: Array, read_variance: Array | float, known_m: Array | None, memory: Memory
    ) -> Float[Array, "Y X"]:
        """The turbulence with what the field shows beside it, torn where that is a turn."""
        solver = self.sequence.solver
        task = self._task(counts, usable, read_variance, known_m, memory)
        smooth_rad = task.problem.known_rad + memory.phase_rad
        torn_rad = torn_phase(task.level, task.measured, task.scale, smooth_rad, iterations=TEARING, gain=TEARING_GAIN)
        air_rad = memory.phase_rad + tilt_phase(memory.slope, solver.level.grid, solver.geometry.wavelength_m)
        return air_rad + wrap(torn_rad - smooth_rad)

    @eqx.filter_jit
    def _solved(
        self,
        counts: Array,
        usable: Array,
        read_variance: Array | float,
        known_m: Array | None,
        memory: Memory,
        move_rad: Array,
    ) -> tuple[Array, Solution]:
        """The most likely phase near a moved one."""
        task, none = self._task(counts, usable, read_variance, known_m, memory), jnp.asarray(0, jnp.int32)
        noise = START_NOISE / task.problem.information
        start = task.prior.start(memory.phase_rad + move_rad, noise_variance=noise)
        solution = solved(task, self.sequence.solver.settings.map, start, (none, none))
        return task.problem.prior.phase_rad(solution.unknown), solution


def _around(moved_rad: np.ndarray) -> np.ndarray:
    """1 where the phase was moved and somewhat around, softly 0 beyond."""
    near = np.asarray(scipy.ndimage.distance_transform_edt(abs(moved_rad) < np.pi)) <= AROUND
    return scipy.ndimage.gaussian_filter(near.astype(float), BLUR)

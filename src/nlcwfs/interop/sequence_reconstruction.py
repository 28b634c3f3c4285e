"""Frames of one file that follow each other in time: each starts from what the last one showed."""

import dataclasses
import time
from collections.abc import Iterable, Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from nlcwfs.errors import SettingsError
from nlcwfs.estimation.sequence_memory import Memory
from nlcwfs.estimation.sequence_reconstructor import SequenceReconstructor
from nlcwfs.estimation.settings import EstimationSettings
from nlcwfs.estimation.wavefront_estimate import WavefrontEstimate
from nlcwfs.interop.frame_times import FrameTimes
from nlcwfs.interop.frames_file import FramesFile
from nlcwfs.interop.frames_reconstruction import FramesReconstructor
from nlcwfs.interop.frames_sensor import sensor_geometry
from nlcwfs.interop.wavefront_file import FrameWavefront

FORGOTTEN = 1000
"""After so many intervals without a frame the next one is reconstructed alone, as if it were the first."""

FOLLOWED = "done: it follows frame"
"""How the sentence of a frame begins that is believed as a follower."""

PREDICTION_FFTS = 2
"""FFTs of the model's grid for every interval without a frame."""


class SequenceRun(eqx.Module):
    """Reconstructs the frames of a sequence in the order of time.

    The first frame is reconstructed alone, the others follow the last one in a fixed number of FFTs. A frame that is
    not believed when it follows is reconstructed alone at once, and what it cost is the sum of both. A frame that
    cannot be used, and an interval without a frame, let the prediction grow older by one interval.

    Attributes:
        single: Accounts for each frame.
        solver: The method.
        times: When the frames were taken.

    Examples:
        >>> frames = FramesFile(
        ...     electrons=np.full((2, 2, 20, 20), 9.0), masked=np.zeros((2, 2, 20, 20), bool), has_frame_axis=True,
        ...     pixel_m=0.5, wavelength_m=0.65e-6, diameter_m=8.0, distances_m=(-3e6, 3e6), rate_hz=500.0,
        ... )
        >>> run = SequenceRun.build(frames, EstimationSettings(modes=40), FrameTimes(0.002, (0, 1)))
        >>> run.solver.ffts <= 100
        True
    """

    single: FramesReconstructor
    solver: SequenceReconstructor
    times: FrameTimes = eqx.field(static=True)

    @classmethod
    def build(
        cls, frames: FramesFile, settings: EstimationSettings, times: FrameTimes, *, dtype: str = "float32"
    ) -> "SequenceRun":
        """Prepare everything that the frames of a sequence share.

        Args:
            frames: The file.
            settings: Options of the method `map`.
            times: When the frames were taken.
            dtype: Precision.

        Raises:
            SettingsError: If the method is another one, or an option contradicts another.
            SamplingError: If the pixels cannot carry the pupil.
        """
        if settings.method != "map":
            raise SettingsError("--sequence", "must come with --method map", settings.method)
        usable = [number for number in range(len(frames.electrons)) if number not in frames.frame_problems]
        photons = max(float(np.median(frames.photo_electrons()[usable].sum(axis=(1, 2, 3)))), 1.0)
        lights = {"wavelengths": settings.map.wavelengths, "moments": settings.map.membrane_moments}
        geometry = sensor_geometry(frames, **lights)
        solver = SequenceReconstructor.build(
            geometry, settings, interval_s=times.interval_s, photons=photons, dtype=dtype
        )
        single = FramesReconstructor.around(frames, settings, solver.solver, dtype=dtype)
        return cls(single=single, solver=solver, times=times)

    def compile(self) -> float:
        """Compile everything ahead of the first frame; returns the seconds that it took."""
        started = time.perf_counter()
        frame = self.single.inputs(0)
        _, memory = _start(self.solver, *frame)
        jax.block_until_ready(_follow(self.solver, *frame, memory, jnp.asarray(0))[0].opd_m)
        return time.perf_counter() - started

    def each(self, numbers: Iterable[int]) -> Iterator[tuple[int, FrameWavefront]]:
        """Frames in the order of time, with their numbers; the first of them is reconstructed alone."""
        memory, last = None, 0
        for number in numbers:
            started = time.perf_counter()
            estimate, memory, sentence = self._next(number, memory, last)
            seconds = time.perf_counter() - started
            last = number
            found = self.single.account(number, estimate, seconds=seconds)
            yield number, dataclasses.replace(found, sentence=sentence)

    def _next(self, number: int, memory: Memory | None, last: int) -> tuple[WavefrontEstimate, Memory | None, str]:
        """A frame after the last one: estimate, memory and a sentence."""
        spent, note, frame = 0, "", self.single.inputs(number)
        missing = self.times.missing(number, last) if memory is not None else 0
        if memory is not None and missing <= FORGOTTEN:
            estimate, after = jax.block_until_ready(_follow(self.solver, *frame, memory, jnp.asarray(missing)))
            spent = int(estimate.ffts) + PREDICTION_FFTS * missing
            if estimate.outcome.succeeded:
                return _counted(estimate, spent), after, f"{FOLLOWED} {last}"
            note = f" (alone: as a follower of frame {last} it was not believed)"
        estimate, after = jax.block_until_ready(_start(self.solver, *frame))
        believed = estimate.outcome.succeeded
        total = _counted(estimate, int(estimate.ffts) + spent)
        return total, after if believed else None, f"{estimate.outcome.sentence}{note}"


def _counted(estimate: WavefrontEstimate, ffts: int) -> WavefrontEstimate:
    return dataclasses.replace(estimate, ffts=jnp.asarray(ffts, jnp.int32))


@eqx.filter_jit
def _start(
    solver: SequenceReconstructor, counts: Array, usable: Array, read_variance: Array
) -> tuple[WavefrontEstimate, Memory]:
    return solver.start(counts, usable, read_variance=read_variance)


@eqx.filter_jit
def _follow(
    solver: SequenceReconstructor,
    counts: Array,
    usable: Array,
    read_variance: Array,
    memory: Memory,
    missing: Int[Array, ""],
) -> tuple[WavefrontEstimate, Memory]:
    older = jax.lax.fori_loop(0, missing, lambda _, known: solver.skip(known), memory)
    return solver.follow(counts, usable, older, read_variance=read_variance)

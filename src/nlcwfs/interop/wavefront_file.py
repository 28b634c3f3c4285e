"""The wavefront of one frame, and of a file of frames of which some may be missing."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from nlcwfs.errors import SettingsError
from nlcwfs.interop.frames_file import FramesFile

NOT_RUN = "not run"
"""Outcome of a frame that was not reached, for instance because the user interrupted."""

BAD_FRAME = "bad frame"
"""Outcome of a frame that cannot be used; its sentence says why."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameWavefront:
    """What was found in one frame.

    Attributes:
        opd_m: The wavefront, NaN outside the pupil.
        rms_nm: Its rms over the pupil.
        outcome: One or two words, 'converged' for a success.
        iterations: How many steps it took.
        ffts: How many fast Fourier transforms.
        predicted_error_nm: Predicted 1-sigma error of the wavefront; NaN when unknown.
        runtime_s: Time of the computation.
        coefficient_m: The wavefront's modes; none when the method has no modes.
        sigma_m: Their 1-sigma errors.
        error_nm: rms of (found - true), piston removed; None when the truth is not known.
        quantum_limit_nm: Error that no sensor could beat with this light; None when the method tells none.
        photon_loss: Photons that the sensor needs relative to that limit; None when the method tells none.
        wrong_turn: Probability that a segment is whole wavelengths off; None where nothing tells.
        residual: Data - model in electrons.
        amplitude: Of the light over that of the telescope, NaN outside the pupil; None where it was taken as known.
        sentence: What the outcome means here.
    """

    opd_m: Float[np.ndarray, "y x"]
    rms_nm: float
    outcome: str
    iterations: int
    ffts: int
    predicted_error_nm: float
    runtime_s: float
    coefficient_m: Float[np.ndarray, " mode"]
    sigma_m: Float[np.ndarray, " mode"]
    error_nm: float | None = None
    quantum_limit_nm: float | None = None
    photon_loss: float | None = None
    wrong_turn: float | None = None
    residual: Float[np.ndarray, "plane y x"] | None = None
    amplitude: Float[np.ndarray, "y x"] | None = None
    sentence: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class WavefrontFile:
    """The wavefronts of a file of frames; frames without a result are NaN.

    Attributes:
        opd_m: The wavefronts on the pixels of an input plane, NaN outside the pupil.
        has_frame_axis: Whether the input has a frame axis; without it there is one frame here.
        pixel_m: Width of a pixel at the scale of the telescope.
        method: How the wavefront was found.
        outcomes: One or two words per frame; `NOT_RUN` for those that were not reached.
        sentences: What the outcomes mean.
        noll: Noll index of every mode.
        residual: Data - model in electrons; None when not kept.
        amplitude: Of the light over that of the telescope, NaN outside the pupil; None where it was taken as known.
        source: The file the frames came from.
        source_digest: First digits of the SHA-256 of that file.
    """

    opd_m: Float[np.ndarray, "frame y x"]
    has_frame_axis: bool
    pixel_m: float
    wavelength_m: float
    diameter_m: float
    method: str
    outcomes: tuple[str, ...]
    sentences: tuple[str, ...]
    rms_nm: Float[np.ndarray, " frame"]
    iterations: Int[np.ndarray, " frame"]
    ffts: Int[np.ndarray, " frame"]
    predicted_error_nm: Float[np.ndarray, " frame"]
    runtime_s: Float[np.ndarray, " frame"]
    noll: Int[np.ndarray, " mode"]
    coefficient_m: Float[np.ndarray, "frame mode"]
    sigma_m: Float[np.ndarray, "frame mode"]
    error_nm: Float[np.ndarray, " frame"] | None = None
    quantum_limit_nm: Float[np.ndarray, " frame"] | None = None
    photon_loss: Float[np.ndarray, " frame"] | None = None
    wrong_turn: Float[np.ndarray, " frame"] | None = None
    residual: Float[np.ndarray, "frame plane y x"] | None = None
    amplitude: Float[np.ndarray, "frame y x"] | None = None
    source: str = ""
    source_digest: str = ""

    @classmethod
    def from_frames(
        cls,
        done: Mapping[int, FrameWavefront],
        frames: FramesFile,
        *,
        method: str,
        noll: Sequence[int] | Int[np.ndarray, " mode"],
    ) -> "WavefrontFile":
        """Put together what is done so far, in whatever order it was done.

        Frames that are not done are NaN; their outcome is `BAD_FRAME` where `frames` says that they cannot be
        used, else `NOT_RUN`.

        Args:
            done: Results by number of the frame, from 0; may be empty.
            frames: Where they come from.

        Raises:
            SettingsError: If a result does not fit the frames or the modes.

        Examples:
            >>> frames = FramesFile(
            ...     electrons=np.ones((2, 1, 8, 9)), masked=np.zeros((2, 1, 8, 9), bool), has_frame_axis=True,
            ...     pixel_m=1.0, wavelength_m=0.65e-6, diameter_m=8.0, distances_m=(2.5e6,),
            ... )
            >>> started = WavefrontFile.from_frames({}, frames, method="gerchberg-saxton", noll=[])
            >>> started.outcomes, started.opd_m.shape
            (('not run', 'not run'), (2, 8, 9))
        """
        shape = frames.electrons.shape
        modes = np.asarray(noll, dtype=np.int64)
        for number, frame in done.items():
            _check_fits(number, frame, shape, len(modes))

        def column(name: str, missing: Any) -> Any:
            return _column(done, name, missing, shape[0])

        problems = frames.frame_problems
        gaps = {number: BAD_FRAME if number in problems else NOT_RUN for number in range(shape[0])}
        outcomes = gaps | {number: frame.outcome for number, frame in done.items()}
        sentences = {n: problems.get(n, "") for n in gaps} | {n: frame.sentence for n, frame in done.items()}
        no_modes = np.full(len(modes), np.nan)

        def known(name: str, missing: Any = np.nan) -> Any:
            told = any(getattr(frame, name) is not None for frame in done.values())
            return column(name, missing) if told else None

        return cls(
            opd_m=column("opd_m", np.full(shape[2:], np.nan)),
            has_frame_axis=frames.has_frame_axis,
            pixel_m=frames.pixel_m,
            wavelength_m=frames.wavelength_m,
            diameter_m=frames.diameter_m,
            method=method,
            outcomes=tuple(outcomes[number] for number in gaps),
            sentences=tuple(sentences[number] for number in gaps),
            rms_nm=column("rms_nm", np.nan),
            iterations=column("iterations", 0),
            ffts=column("ffts", 0),
            predicted_error_nm=column("predicted_error_nm", np.nan),
            runtime_s=column("runtime_s", np.nan),
            noll=modes,
            coefficient_m=column("coefficient_m", no_modes),
            sigma_m=column("sigma_m", no_modes),
            error_nm=column("error_nm", np.nan) if frames.truth_m is not None else known("error_nm"),
            **{name: known(name) for name in ("quantum_limit_nm", "photon_loss", "wrong_turn")},
            residual=known("residual", np.full(shape[1:], np.nan)),
            amplitude=known("amplitude", np.full(shape[2:], np.nan)),
            source=frames.source,
            source_digest=frames.source_digest,
        )

    @property
    def ran(self) -> Bool[np.ndarray, " frame"]:
        """Which frames have a result, good or not."""
        return np.array([outcome not in (NOT_RUN, BAD_FRAME) for outcome in self.outcomes])

    def finished(self) -> dict[int, FrameWavefront]:
        """The frames that have a result, by number: what an interrupted run need not do again."""
        return {int(number): self._frame(int(number)) for number in np.flatnonzero(self.ran)}

    def _frame(self, number: int) -> FrameWavefront:
        def told(values: Float[np.ndarray, " frame"] | None) -> float | None:
            return None if values is None or np.isnan(values[number]) else float(values[number])

        return FrameWavefront(
            opd_m=self.opd_m[number],
            rms_nm=float(self.rms_nm[number]),
            outcome=self.outcomes[number],
            iterations=int(self.iterations[number]),
            ffts=int(self.ffts[number]),
            predicted_error_nm=float(self.predicted_error_nm[number]),
            runtime_s=float(self.runtime_s[number]),
            coefficient_m=self.coefficient_m[number],
            sigma_m=self.sigma_m[number],
            error_nm=told(self.error_nm),
            quantum_limit_nm=told(self.quantum_limit_nm),
            photon_loss=told(self.photon_loss),
            wrong_turn=told(self.wrong_turn),
            residual=None if self.residual is None else self.residual[number],
            amplitude=None if self.amplitude is None else self.amplitude[number],
            sentence=self.sentences[number],
        )


def _column(done: Mapping[int, FrameWavefront], name: str, missing: Any, count: int) -> Any:
    values = [getattr(done[number], name) if number in done else None for number in range(count)]
    return np.array([missing if value is None else value for value in values])


def _check_fits(number: int, frame: FrameWavefront, shape: tuple[int, ...], mode_count: int) -> None:
    where = f"wavefront.frames[{number}]"
    if not 0 <= number < shape[0]:
        raise SettingsError(where, f"must be one of the {shape[0]} frames, counted from 0", number)
    if frame.opd_m.shape != shape[2:]:
        raise SettingsError(f"{where}.opd_m", f"must have the pixels of the frames, {shape[2:]}", frame.opd_m.shape)
    if frame.coefficient_m.shape != (mode_count,) or frame.sigma_m.shape != (mode_count,):
        raise SettingsError(f"{where}.coefficient_m", f"must be one per mode, {mode_count}", frame.coefficient_m.shape)
    if frame.residual is not None and frame.residual.shape != shape[1:]:
        raise SettingsError(f"{where}.residual", f"must have the planes of a frame, {shape[1:]}", frame.residual.shape)

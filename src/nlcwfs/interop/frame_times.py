"""When the frames of a sequence were taken: at equal intervals, of which some may have passed without a frame."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nlcwfs.interop.fits_keywords import file_error
from nlcwfs.interop.frames_file import FramesFile

IRREGULAR = 0.01
"""A frame may come earlier or later than a whole number of intervals by this share of one."""


@dataclass(frozen=True)
class FrameTimes:
    """The clock of a sequence.

    Attributes:
        interval_s: From one frame to the next where none is missing.
        steps: Number of intervals from the first frame to each.

    Examples:
        >>> FrameTimes(0.002, (0, 1, 4)).missing(2)
        2
    """

    interval_s: float
    steps: tuple[int, ...]

    def missing(self, number: int, after: int | None = None) -> int:
        """Intervals without a frame before this one.

        Args:
            number: The frame.
            after: The last one that was used; the one before when left out.
        """
        return self.steps[number] - self.steps[number - 1 if after is None else after] - 1


def frame_times(frames: FramesFile, path: str | Path) -> FrameTimes:
    """When the frames were taken, from `RATE` and `TIME` of their file; frames without `TIME` miss no interval.

    Args:
        frames: The frames, in the order of time.
        path: Their file, for messages.

    Raises:
        FileFormatError: If there is one frame only, neither RATE nor TIME, or if times are no whole intervals.

    Examples:
        >>> frames = FramesFile(
        ...     electrons=np.ones((3, 1, 4, 4)), masked=np.zeros((3, 1, 4, 4), bool), has_frame_axis=True,
        ...     pixel_m=2.0, wavelength_m=0.65e-6, diameter_m=8.0, distances_m=(2.5e6,),
        ...     rate_hz=500.0, times_s=np.array([7.0, 7.002, 7.006]),
        ... )
        >>> frame_times(frames, "f.fits").steps
        (0, 1, 3)
    """
    count = len(frames.electrons)
    if count < 2:
        raise file_error(path, "PRIMARY", "must hold at least 2 frames for --sequence", "1")
    if frames.times_s is None:
        if frames.rate_hz is None:
            rule = "is required for --sequence, in hertz, or an HDU TIME with the seconds of every frame"
            raise file_error(path, "RATE", rule, "no such keyword")
        return FrameTimes(1 / frames.rate_hz, tuple(range(count)))
    apart_s = np.diff(frames.times_s)
    told_s = float(apart_s.min()) if frames.rate_hz is None else 1 / frames.rate_hz
    steps = np.maximum(np.round(apart_s / told_s), 1)
    interval_s = float(np.sum(apart_s) / np.sum(steps))  # a rate that is rounded must not add up over long gaps
    if abs(interval_s / told_s - 1) > IRREGULAR:
        interval_s = told_s
    late = apart_s / interval_s - steps
    worst = int(np.argmax(np.abs(late)))
    if abs(late[worst]) > IRREGULAR:
        rule = f"must be whole multiples of {_clock(frames)} apart, within 1 % of it"
        raise file_error(path, "TIME", rule, f"{apart_s[worst]:.5g} s between frames {worst} and {worst + 1}")
    return FrameTimes(interval_s, (0, *(int(step) for step in np.cumsum(steps))))


def _clock(frames: FramesFile) -> str:
    return "the shortest interval" if frames.rate_hz is None else f"1/RATE = {1 / frames.rate_hz:.5g} s"

"""The wind, from wavefronts that follow each other: how far has the air moved when it is most like itself?

The peak of the correlation of the slopes of two wavefronts, as in the profilers of Wang, Schoeck & Chanan (2008, Appl.
Opt. 47, 1880): frozen air keeps its height while it moves off, whatever does not move stays at zero.
"""

from typing import NamedTuple

import numpy as np
import scipy.fft
from jaxtyping import Bool, Float

APART_CELLS = 4.0
"""Farther than this the peak of what moves is apart from where it started."""

OVERLAP = 0.4
"""Share of the pupil that two wavefronts must have in common."""

CLEAR = 0.25
"""Correlation from which on a wind is believed."""

KEPT = 0.6
"""A later peak counts that has this share of the first one's height: air boils, or other layers move elsewhere."""

NEAR_CELLS = 3
"""Around where the wind has been found to lead, a later peak is looked for."""


class Wind(NamedTuple):
    """The air's motion.

    Attributes:
        y_m_per_s: Speed towards +y.
        x_m_per_s: Towards +x.
        correlation: Of slopes, after the longest interval that was used.
    """

    y_m_per_s: float
    x_m_per_s: float
    correlation: float


def found_wind(
    opd_m: Float[np.ndarray, "frame y x"], lit: Bool[np.ndarray, "y x"], *, pixel_m: float, interval_s: float
) -> Wind | None:
    """The wind that carries most of the air; None if none is clear.

    Args:
        opd_m: Wavefronts of the air, equally spaced in time; half a second and more tells air from a bad mirror.
        lit: Cells that hold light.
        pixel_m: Width of a cell.
        interval_s: From one wavefront to the next.

    Examples:
        >>> rng = np.random.default_rng(1)
        >>> air = scipy.fft.irfft2(scipy.fft.rfft2(rng.standard_normal((64, 128))) / (1 + np.arange(65)))
        >>> frames = np.stack([air[10:42, 60 - step : 92 - step] for step in range(40)])
        >>> wind = found_wind(frames, np.ones((32, 32), bool), pixel_m=0.1, interval_s=0.02)
        >>> round(wind.y_m_per_s, 1), round(wind.x_m_per_s, 1)
        (0.0, 5.0)
    """
    moving = np.where(lit, opd_m - opd_m.mean(0), 0.0)
    correlations = _Correlations.of(moving, lit)
    best: Wind | None = None
    frames, height = 1, 0.0
    while frames <= len(opd_m) // 2:
        second = frames * interval_s / pixel_m  # cells per metre per second
        near = None if best is None else (best.y_m_per_s * second, best.x_m_per_s * second)
        peak = correlations.peak(frames, near)
        if peak is None or peak[2] < max(CLEAR, KEPT * height):
            if best is not None:
                break
        elif best is not None or np.hypot(*peak[:2]) > APART_CELLS or 2 * frames > len(opd_m) // 2:
            height = max(height, peak[2])
            best = Wind(float(peak[0] / second), float(peak[1] / second), float(peak[2]))
        frames *= 2
    return best


class _Correlations(NamedTuple):
    """Spectra of the slopes, from which the correlation at any distance comes."""

    spectra: np.ndarray
    overlap: np.ndarray
    variance: float

    @classmethod
    def of(cls, opd_m: np.ndarray, lit: np.ndarray) -> "_Correlations":
        """Slopes between neighbours that are both lit."""
        both = np.stack([lit & np.roll(lit, -1, axis) for axis in (0, 1)])
        both[0, -1], both[1, :, -1] = False, False
        slopes = np.stack([np.roll(opd_m, -1, axis + 1) - opd_m for axis in (0, 1)], axis=1) * both
        slopes -= slopes.sum((2, 3), keepdims=True) / both.sum((1, 2))[:, None, None] * both  # a tilt is no feature
        shape = 2 * lit.shape[0], 2 * lit.shape[1]
        spectra = np.asarray(scipy.fft.rfft2(slopes.astype(np.float32), s=shape))
        light = np.asarray(scipy.fft.rfft2(both.astype(float), s=shape))
        overlap = np.asarray(scipy.fft.irfft2(np.abs(light) ** 2, s=shape)).sum(0)
        return cls(spectra, overlap, float(np.mean(slopes**2) * both[0].size * 2 / both.sum()))

    def peak(self, frames: int, near: tuple[float, float] | None) -> tuple[float, float, float] | None:
        """Where (y, x, in cells) wavefronts so many frames apart are most alike, and how much."""
        pairs = self.spectra[frames:] * np.conj(self.spectra[:-frames])
        alike = np.asarray(scipy.fft.irfft2(pairs.mean(0).sum(0), s=self.overlap.shape))
        share = self.overlap / self.overlap[0, 0]
        alike = np.where(share > OVERLAP, alike / (np.maximum(self.overlap, 1) * self.variance), -1.0)
        if near is not None:
            rows, columns = (np.abs(_apart(place, size)) for place, size in zip(near, alike.shape, strict=True))
            around = (rows[:, None] <= NEAR_CELLS) & (columns[None, :] <= NEAR_CELLS)
            if share[around].min() <= OVERLAP:
                return None  # the peak may lie where too little is left of the pupil
            alike = np.where(around, alike, -1.0)
        row, column = np.unravel_index(int(np.argmax(alike)), alike.shape)
        if alike[row, column] <= 0:
            return None
        place = row + _vertex(alike[:, column], int(row)), column + _vertex(alike[row], int(column))
        wrapped = [(one + size / 2) % size - size / 2 for one, size in zip(place, alike.shape, strict=True)]
        return wrapped[0], wrapped[1], float(alike[row, column])


def _apart(place: float, size: int) -> np.ndarray:
    """Distance of each cell of a correlation from a place, along one axis that repeats itself."""
    return (np.arange(size) - place + size / 2) % size - size / 2


def _vertex(values: np.ndarray, at: int) -> float:
    """Where a parabola through a peak and its neighbours is highest, relative to the peak."""
    before, here, after = values[at - 1], values[at], values[(at + 1) % values.size]
    bend = before - 2 * here + after
    return 0.0 if min(before, after) < 0 or bend >= 0 else float((before - after) / (2 * bend))

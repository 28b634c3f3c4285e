"""Modes of a pupil made of segments: pistons of the segments, then tip, tilt and finer waves inside each."""

import numpy as np
from jaxtyping import Float, Int

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.modes import DIM, ModalBasis, _covariance_kernel, _kolmogorov_total, modal_basis
from nlcwfs.beam.pupil import light_weights
from nlcwfs.errors import SettingsError

PISTON_CYCLES = 0.5
"""Cycles per segment of a piston, for the order of modes: slower than any wave inside."""


def segment_basis(
    pupil: Float[np.ndarray, "y x"],
    grid: Grid,
    labels: Int[np.ndarray, "y x"],
    *,
    diameter_m: float,
    inside: int = 2,
) -> ModalBasis:
    """Orthonormal modes with the piston, tip and tilt of each segment.

    First the pistons, one fewer than segments, for the piston of the whole pupil is no mode: each raises one segment
    and lowers all before it. Then for each segment its ramps along x and y and the standing waves of a disc around it,
    orthonormalised on its own light; modes of different segments share no pixel. All have unit rms over the pupil.

    Args:
        pupil: Amplitude.
        grid: Its pixels.
        labels: Segment of each pixel.
        diameter_m: Of the telescope: unit of `cycles_per_aperture`, and of D / r0.
        inside: Modes inside each segment: 2 are its ramps.

    Raises:
        SettingsError: If `inside` is negative, or there is no light on a segment.
        SamplingError: If the pixels of a segment cannot carry so many modes.

    Examples:
        >>> from nlcwfs.beam.segments import Segment, Segments
        >>> two = Segments((Segment(0.0, -2.0, 3.0), Segment(0.0, 2.0, 3.0)))
        >>> grid = Grid((16, 32), 0.25)
        >>> basis = segment_basis(two.amplitude(grid), grid, two.labels(grid), diameter_m=8.0)
        >>> step_m = 30e-9 * two.labels(grid)
        >>> basis.count, [round(abs(float(one)) * 1e9, 3) for one in basis.project(step_m)]
        (5, [15.0, 0.0, 0.0, 0.0, 0.0])
    """
    if inside < 0:
        raise SettingsError("modes.inside", "must be at least 0", inside)
    pupil, names = np.where(pupil < DIM, 0, pupil), np.unique(labels)
    weights = light_weights(pupil)
    shares = np.array([weights[labels == name].sum() for name in names])
    if shares.min() <= 0:
        raise SettingsError("segments", "must each let some light through", f"none on {names[np.argmin(shares)]}")
    pixel = grid.pixel_m / diameter_m
    modes = [_pistons(labels, names, shares, weights)]
    cycles, kolmogorov = [], []
    kernel = _covariance_kernel(weights.shape, pixel)
    kolmogorov.append(np.array([_variance(mode, weights, kernel) for mode in modes[0]]))
    widths_m = np.sqrt(4 / np.pi * np.array([pupil[labels == name].sum() for name in names])) * grid.pixel_m
    cycles.append(PISTON_CYCLES * diameter_m / widths_m[1:])
    raw = 1.0
    for name, share, width_m in zip(names, shares, widths_m, strict=True) if inside else ():
        own = np.where(labels == name, pupil, 0)
        made = modal_basis(own, grid, diameter_m=float(width_m), count=inside, kind="disc-harmonics")
        modes.append(np.asarray(made.modes) / np.sqrt(share))
        cycles.append(np.asarray(made.cycles_per_aperture) * diameter_m / width_m)
        kolmogorov.append(np.asarray(made.kolmogorov_rad2) * share * (width_m / diameter_m) ** (5 / 3))
        raw = max(raw, made.raw_condition)
    total = _kolmogorov_total(weights, pixel)
    return ModalBasis(
        np.concatenate(modes), weights, np.concatenate(cycles), np.concatenate(kolmogorov), total, raw, 1.0
    )


def _pistons(labels: np.ndarray, names: np.ndarray, shares: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Each raises a segment and lowers all before it, so that they are orthogonal and without a mean."""
    modes = np.zeros((len(names) - 1, *labels.shape))
    before = np.cumsum(shares)
    for number in range(1, len(names)):
        low, high = before[number - 1], shares[number]
        height = 1 / np.sqrt(high + high**2 / low)
        modes[number - 1][np.isin(labels, names[:number])] = -height * high / low
        modes[number - 1][labels == names[number]] = height
    return np.where(weights > 0, modes, 0)


def _variance(mode: np.ndarray, weights: np.ndarray, kernel: np.ndarray) -> float:
    """Of its coefficient in turbulence of D / r0 = 1: -1/2 sum w m(r) D(r - r') w' m'(r')."""
    ny, nx = mode.shape
    spectrum = np.fft.rfft2(weights * mode, s=(2 * ny, 2 * nx)) * kernel
    return float(np.sum(weights * mode * np.fft.irfft2(spectrum, s=(2 * ny, 2 * nx))[:ny, :nx]))

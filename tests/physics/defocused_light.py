"""Starlight for the tests of reconstruction, in NumPy alone: no line of it is shared with the code under test.

The light runs on pixels three times finer than the detector's and on a window twice as wide as the frames.
"""

import numpy as np
import scipy.fft
import scipy.ndimage

DIAMETER_M = 8.0
PIXEL_M = DIAMETER_M / 45
WAVELENGTH_M = 0.65e-6
DISTANCES_M = (-3.5e6, -2.5e6, 2.5e6, 3.5e6)
FINER = 3


def centres(count: int, pixel_m: float) -> np.ndarray:
    return (np.arange(count) - (count - 1) / 2) * pixel_m


def disc(shape: tuple[int, int], pixel_m: float) -> np.ndarray:
    """The telescope; a pixel on the rim has the fraction of 9 x 9 points that are lit."""
    parts = 9
    y_m, x_m = (centres(n * parts, pixel_m / parts) for n in shape)
    fine = y_m[:, None] ** 2 + x_m**2 < (DIAMETER_M / 2) ** 2
    return fine.reshape(shape[0], parts, shape[1], parts).mean(axis=(1, 3))


def images(pupil, opd_m, *, pixel_m, distances_m=DISTANCES_M, shares=None) -> np.ndarray:
    """Shares of the photons on every pixel and plane; they sum to 1. z > 0 is downstream."""
    fy, fx = (np.fft.fftfreq(n, pixel_m) for n in pupil.shape)
    squared = fy[:, None] ** 2 + fx**2
    field = pupil / np.sqrt(np.sum(pupil**2)) * np.exp(2j * np.pi / WAVELENGTH_M * opd_m)
    spectrum = scipy.fft.fft2(field)
    shares = np.full(len(distances_m), 1 / len(distances_m)) if shares is None else shares
    return np.array(
        [
            share * abs(scipy.fft.ifft2(spectrum * np.exp(-1j * np.pi * WAVELENGTH_M * z * squared))) ** 2
            for z, share in zip(distances_m, shares, strict=True)
        ]
    )


def on_detector(fine_images: np.ndarray, window: tuple[int, int]) -> np.ndarray:
    """Sums over the pixels of a window in the middle."""
    planes, rows, columns = fine_images.shape
    pixels = fine_images.reshape(planes, rows // FINER, FINER, columns // FINER, FINER).sum(axis=(2, 4))
    top, left = ((have - want) / 2 for have, want in zip(pixels.shape[1:], window, strict=True))
    if top % 1 or left % 1:
        raise ValueError("the window must have the parity of the grid of the light")
    return pixels[:, int(top) : int(top) + window[0], int(left) : int(left) + window[1]]


def error_nm(estimate_m: np.ndarray, truth_m: np.ndarray) -> float:
    """Rms over the pupil, piston removed, on the fine grid of the truth: what the pixels cannot show counts."""
    fine_m = PIXEL_M / FINER
    rows, columns = (
        centres(fine, fine_m) / PIXEL_M + (pixels - 1) / 2
        for fine, pixels in zip(truth_m.shape, estimate_m.shape, strict=True)
    )
    points = np.meshgrid(rows, columns, indexing="ij")
    on_fine = scipy.ndimage.map_coordinates(np.asarray(estimate_m, float), points, order=3, mode="nearest")
    lit = disc(truth_m.shape, fine_m) > 0.5
    return float(np.std((on_fine - truth_m)[lit]) * 1e9)

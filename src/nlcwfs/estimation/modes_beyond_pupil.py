"""Modes of turbulence where no light shows them: how a wavefront most likely goes on beyond the pupil."""

import numpy as np
from jaxtyping import Float

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.modes import ModalBasis
from nlcwfs.constants import KOLMOGOROV_STRUCTURE


def modes_beyond_pupil(basis: ModalBasis, grid: Grid, *, diameter_m: float) -> Float[np.ndarray, "mode y x"]:
    r"""The Karhunen-Loeve modes on all pixels: on the pupil as they are, beyond it as turbulence goes on.

    The mean of Kolmogorov's turbulence at a point, given the coefficients on the pupil, is
    :math:`\sum c_k\, \mathrm{cov}(\phi(r), c_k) / \mathrm{var}(c_k)` (they are Gaussian and independent); with
    :math:`\mathrm{cov}(\phi(r), c_k) = -\frac12 \sum w' D(|r - r'|)\, m_k(r')` up to piston. On the pupil this is the
    equation that defines the modes, so they go on without a step.

    Args:
        basis: Karhunen-Loeve modes on the grid.
        grid: Their pixels.
        diameter_m: The diameter that the variances of the basis refer to.

    Examples:
        >>> from nlcwfs.beam.modes import modal_basis
        >>> from nlcwfs.beam.pupil import circular_pupil
        >>> grid = Grid((16, 20), pixel_m=0.6)
        >>> basis = modal_basis(circular_pupil(grid, diameter_m=8.0), grid, diameter_m=8.0, count=2)
        >>> tilts = modes_beyond_pupil(basis, grid, diameter_m=8.0)
        >>> bool(np.all(np.ptp(tilts, axis=(1, 2)) > np.ptp(basis.modes, axis=(1, 2))))  # they go on rising
        True
    """
    ny, nx = grid.shape
    y, x = (2 * n * np.fft.fftfreq(2 * n) * grid.pixel_m / diameter_m for n in (ny, nx))
    kernel = np.fft.rfft2(-KOLMOGOROV_STRUCTURE / 2 * np.hypot(y[:, None], x[None, :]) ** (5 / 3))
    weights = np.asarray(basis.weights)
    whole = np.empty(basis.modes.shape)
    for number, mode in enumerate(np.asarray(basis.modes)):  # one at a time: memory
        spectrum = np.fft.rfft2(weights * mode, s=(2 * ny, 2 * nx)) * kernel
        covariance = np.fft.irfft2(spectrum, s=(2 * ny, 2 * nx))[:ny, :nx]
        beyond = (covariance - np.sum(weights * covariance)) / basis.kolmogorov_rad2[number]
        whole[number] = np.where(weights > 0, mode, beyond)
    return whole

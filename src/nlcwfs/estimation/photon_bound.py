"""How well any method could do: Fisher information of the images, and what it allows."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.beam.modes import ModalBasis

DARK = 1e-6
"""Pixels with less than this share of the mean photons carry no information."""


def fisher_information(
    photons: Callable[[Float[Array, "y x"]], Float[Array, "plane v u"]],
    opd_m: Float[Array, "y x"],
    modes: Float[Array, "mode y x"],
    *,
    read_variance: float = 0.0,
) -> Float[np.ndarray, "mode mode"]:
    r"""Fisher information of the coefficients of modes, at a given wavefront.

    :math:`F_{ab} = \sum \partial_a \mu\, \partial_b \mu / (\mu + \sigma^2)` for counts of mean :math:`\mu` with
    photon noise and read noise; derivatives are exact (forward differentiation).

    Args:
        photons: Mean counts on the detector for a wavefront.
        opd_m: The wavefront.
        modes: Unit changes of the wavefront, on the same pixels as `opd_m`.
        read_variance: Variance of a pixel without light, electrons squared.

    Returns:
        Information in 1/m^2 for coefficients in metres.

    Examples:
        A pixel that sees `10 + 3 c` counts informs with 9 / 10 about c.

        >>> import jax.numpy as jnp
        >>> counts = lambda opd: (10 + 3 * opd).reshape(1, 1, 1)
        >>> found = fisher_information(counts, jnp.zeros((1, 1)), jnp.ones((1, 1, 1)))
        >>> round(float(found[0, 0]), 6)
        0.9
    """
    mean, along = jax.linearize(photons, opd_m)
    sigma = jnp.sqrt(mean + read_variance)
    seen = mean + read_variance > DARK * jnp.mean(mean)

    def signal(mode: Float[Array, "y x"]) -> Float[Array, " pixel"]:
        return jnp.where(seen, along(mode.astype(opd_m.dtype)) / jnp.where(seen, sigma, 1), 0).reshape(-1)

    signals = np.asarray(jax.jit(lambda m: jax.lax.map(signal, m))(modes), float)
    return signals @ signals.T


class PhotonBound(NamedTuple):
    """What the light of one wavefront allows.

    Attributes:
        bayesian_m: Rms error of the best estimator that knows the light and the statistics of turbulence.
        quantum_m: The same for a sensor that loses nothing, `variance = 1 / (4 N)` rad^2 for each mode.
        sensor_loss: Photons this sensor needs relative to the quantum limit, median over the modes.
    """

    bayesian_m: float
    quantum_m: float
    sensor_loss: float


def photon_bound(
    information: Float[np.ndarray, "mode mode"],
    basis: ModalBasis,
    *,
    telescope_over_fried: float,
    photons: float,
    wavelength_m: float,
) -> PhotonBound:
    r"""Bayesian Cramer-Rao bound of the wavefront's rms error, piston excluded, tilt included.

    :math:`\mathrm{tr}(F + C^{-1})^{-1}` over the modes, C their Kolmogorov variances (van Trees 1968, sec. 2.4),
    plus the whole variance of the turbulence on these pixels beyond the modes. The quantum limit is Haffert et
    al. 2023.

    Args:
        information: See `fisher_information`.
        basis: The modes: Karhunen-Loeve, whose turbulent coefficients are independent.
        telescope_over_fried: D / r0 at the wavelength.
        photons: Photons of the exposure.
        wavelength_m: Wavelength of sensing.

    Examples:
        >>> from nlcwfs.beam.grid import Grid
        >>> from nlcwfs.beam.modes import modal_basis
        >>> from nlcwfs.beam.pupil import circular_pupil
        >>> grid = Grid((32, 32), pixel_m=0.3)
        >>> basis = modal_basis(circular_pupil(grid, diameter_m=8.0), grid, diameter_m=8.0, count=20)
        >>> light = {"telescope_over_fried": 8.0, "photons": 1e4, "wavelength_m": 0.65e-6}
        >>> blind = photon_bound(np.zeros((20, 20)), basis, **light)  # nothing seen: the turbulence itself
        >>> noll_rad = (1.0299 * 8.0 ** (5 / 3)) ** 0.5
        >>> bool(abs(blind.bayesian_m / 0.65e-6 * 2 * np.pi / noll_rad - 1) < 0.01)
        True
    """
    radian = wavelength_m / (2 * np.pi)
    strength = telescope_over_fried ** (5 / 3) * radian**2
    variance = np.asarray(basis.kolmogorov_rad2, float) * strength
    beyond = max(basis.kolmogorov_total_rad2 * strength - variance.sum(), 0.0)
    posterior = np.linalg.inv(information + np.diag(1 / variance))
    ideal = 4 * photons / radian**2
    quantum = np.sum(variance / (1 + ideal * variance))
    seen = np.median(np.diag(information))
    return PhotonBound(
        bayesian_m=float(np.sqrt(np.trace(posterior) + beyond)),
        quantum_m=float(np.sqrt(quantum + beyond)),
        sensor_loss=float(ideal / seen) if seen > 0 else float("inf"),
    )

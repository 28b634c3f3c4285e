"""From the slopes of a Shack-Hartmann sensor to the coefficients of modes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float

from nlcwfs.comparison_sensors.shack_hartmann import ShackHartmann
from nlcwfs.errors import SettingsError
from nlcwfs.estimation.spot_centroids import Slopes, SpotFilter


class ModalReconstructor(eqx.Module):
    """One matrix from slopes to modes.

    Attributes:
        matrix: Metres of each mode per radian of each slope; a spot's slope along y comes before that along x.

    Examples:
        >>> from nlcwfs.estimation.spot_centroids import Slopes
        >>> both = ModalReconstructor(jnp.array([[0.5, 0.0, 0.5, 0.0]]))
        >>> float(both.coefficients_m(Slopes(jnp.ones((2, 2)), jnp.ones(2)))[0])
        1.0
    """

    matrix: Float[Array, "mode slope"]

    def coefficients_m(self, slopes: Slopes) -> Float[Array, " mode"]:
        """Coefficients of the modes; a slope without weight counts as zero."""
        return self.matrix @ (slopes.slope * slopes.weight[:, None]).ravel()


def average_gradients(sensor: ShackHartmann) -> Float[np.ndarray, "axis spot y x"]:
    """What each cell's path adds to the mean slope of its subaperture: the geometry alone.

    The mean over the light of the differences between neighbouring cells, those in the dark left out. It is what a
    centre of gravity of all the light measures, for any wavefront (Ehrenfest's theorem); light lost beyond the field
    and filters that look at the core of the spot measure something else, see `diffractive_response`.

    Returns:
        Slope along y and along x, in radians per metre of path of the cell.

    Examples:
        >>> from nlcwfs.beam.grid import Grid
        >>> from nlcwfs.beam.spectrum import Spectrum
        >>> from nlcwfs.comparison_sensors.settings import ShackHartmannSettings
        >>> grid, settings = Grid((24, 24), 0.1), ShackHartmannSettings(subapertures=2)
        >>> sensor = ShackHartmann.build(
        ...     np.ones((24, 24)), grid, diameter_m=2.4, spectrum=Spectrum.monochromatic(1e-6), settings=settings
        ... )
        >>> ramp = np.broadcast_to(grid.x_m, (24, 24))
        >>> response(sensor, average_gradients(sensor), ramp[None]).round(6)[:2, 0]
        array([0., 1.])
    """
    amplitude = np.asarray(sensor.amplitude, float)
    found = []
    for axis in (1, 2):
        pairs = np.take(amplitude, range(1, amplitude.shape[axis]), axis) * np.take(
            amplitude, range(amplitude.shape[axis] - 1), axis
        )
        pairs /= pairs.sum(axis=(1, 2), keepdims=True) * sensor.cell_m
        before = [(1, 0) if one == axis else (0, 0) for one in range(3)]
        after = [(0, 1) if one == axis else (0, 0) for one in range(3)]
        found.append(np.pad(pairs, before) - np.pad(pairs, after))
    return np.array(found)


def diffractive_response(
    sensor: ShackHartmann, spots: SpotFilter, opd_m: Float[Array, "Y X"]
) -> Float[np.ndarray, "axis spot y x"]:
    """What a small change of each cell's path does to the slopes as they are measured: optics, field and filter.

    The derivative at a given wavefront. A cell acts on its own subaperture alone, so that one adjoint run for each
    axis gives what pushing and pulling every mode through the sensor would give, a thousand times sooner.

    Args:
        spots: How the slopes are measured; a threshold has no derivative worth having, use the same without.
        opd_m: Where to take the derivative: flat, or what the loop leaves.

    Returns:
        Slope along y and along x, in radians per metre of path of the cell.

    Examples:
        >>> from nlcwfs.beam.grid import Grid
        >>> from nlcwfs.beam.spectrum import Spectrum
        >>> from nlcwfs.comparison_sensors.settings import ShackHartmannSettings
        >>> from nlcwfs.estimation.spot_centroids import matched_filter
        >>> from nlcwfs.estimation.spot_model import SpotModel
        >>> grid, settings = Grid((24, 24), 0.1), ShackHartmannSettings(subapertures=2)
        >>> sensor = ShackHartmann.build(
        ...     np.ones((24, 24)), grid, diameter_m=2.4, spectrum=Spectrum.monochromatic(1e-6), settings=settings
        ... )
        >>> spots = matched_filter(SpotModel.of_sensor(sensor))
        >>> ramp = np.broadcast_to(grid.x_m, (24, 24))
        >>> kernel = diffractive_response(sensor, spots, jnp.zeros((24, 24)))
        >>> bool(abs(response(sensor, kernel, ramp[None])[1, 0] - 1) < 0.01)
        True
    """

    def summed(parts_m: Float[Array, "spot y x"], axis: int) -> Float[Array, ""]:
        images = sensor.images_of_parts(parts_m, 1.0)
        return jnp.sum(spots.measure(images.photons).slope[:, axis])

    parts_m = sensor.subaperture_maps(opd_m.astype(sensor.amplitude.dtype))
    derivative = jax.jit(jax.grad(summed), static_argnums=1)
    return np.stack([np.asarray(derivative(parts_m, axis)) for axis in (0, 1)])


def response(
    sensor: ShackHartmann, kernels: Float[np.ndarray, "axis spot y x"], modes: Float[np.ndarray, "mode Y X"]
) -> Float[np.ndarray, "slope mode"]:
    """The interaction matrix: slopes in radians per metre of each mode.

    Args:
        kernels: From `average_gradients` or `diffractive_response`.
        modes: Maps on the cells of the light; a few hundred at a time, their columns stack.

    Examples:
        See `average_gradients`.
    """
    row, column = np.asarray(sensor.places).T
    cells, across = kernels.shape[3], sensor.subapertures * kernels.shape[3]
    top, left = ((size - across) // 2 for size in modes.shape[1:])
    sides = (sensor.subapertures, cells)
    lattice = modes[:, top : top + across, left : left + across].reshape(-1, *sides, *sides)
    parts = lattice[:, row, :, column, :].reshape(row.size, len(modes), cells**2)
    weights = kernels.transpose(1, 0, 2, 3).reshape(row.size, 2, cells**2)
    return (weights @ parts.swapaxes(1, 2)).reshape(2 * row.size, len(modes))


def minimum_variance(
    interaction: Float[np.ndarray, "slope mode"],
    *,
    prior_m2: Float[np.ndarray, " mode"],
    noise_rad2: Float[np.ndarray, " slope"],
    keep: int | None = None,
) -> ModalReconstructor:
    r"""The reconstructor with the least mean square error: :math:`(G^T N^{-1} G + C^{-1})^{-1} G^T N^{-1}`.

    Modes are scaled by their prior before anything is inverted: a ridge on unscaled modes would take most from the
    tilt, whose slopes are the weakest and whose turbulence is the strongest.

    Args:
        interaction: From `response`.
        prior_m2: Variance of every mode; Kolmogorov's, or what a closed loop leaves of it.
        noise_rad2: Variance of every slope from photon and read noise; infinite for one that is not to be used.
        keep: Give only the first modes. Those behind are estimated all the same and then dropped, so that they do not
            alias onto the first.

    Raises:
        SettingsError: If a variance is not positive, or sizes disagree.

    Examples:
        >>> found = minimum_variance(np.eye(2), prior_m2=np.ones(2), noise_rad2=np.array([1.0, np.inf]))
        >>> found.matrix.round(6).tolist()
        [[0.5, 0.0], [0.0, 0.0]]
    """
    slopes, modes = interaction.shape
    for name, variance, size in (("prior_m2", prior_m2, modes), ("noise_rad2", noise_rad2, slopes)):
        if np.shape(variance) != (size,) or not np.all(np.asarray(variance) > 0):
            raise SettingsError(f"minimum_variance.{name}", f"must be {size} positive variances", np.shape(variance))
    amplitude_m = np.sqrt(prior_m2)
    scaled = interaction * (amplitude_m[None, :] / np.sqrt(noise_rad2)[:, None])
    fisher = scaled.T @ scaled
    fisher[np.diag_indices(modes)] += 1
    matrix = scipy.linalg.solve(fisher, scaled.T, assume_a="pos")
    matrix *= amplitude_m[:, None] / np.sqrt(noise_rad2)[None, :]
    return ModalReconstructor(jnp.asarray(matrix[:keep]))


def truncated_inverse(
    interaction: Float[np.ndarray, "slope mode"], *, least_singular: float = 0.02, keep: int | None = None
) -> ModalReconstructor:
    """The pseudo-inverse of the interaction matrix as it stands, without its weakest singular values.

    For modes of unit rms; they are not scaled. It knows neither noise nor turbulence: what is kept is believed fully.

    Args:
        interaction: From `response`.
        least_singular: Smallest singular value that is kept, over the largest.
        keep: Give only the first modes.

    Raises:
        SettingsError: If the share is not between 0 and 1.

    Examples:
        >>> truncated_inverse(np.diag([2.0, 1e-6])).matrix.tolist()
        [[0.5, 0.0], [0.0, 0.0]]
    """
    if not 0 < least_singular < 1:
        raise SettingsError("truncated_inverse.least_singular", "must be between 0 and 1", least_singular)
    return ModalReconstructor(jnp.asarray(np.linalg.pinv(interaction, rcond=least_singular)[:keep]))

"""The tilt of a wavefront from the positions of its defocused images."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def centroid_tilt(
    counts: Float[Array, "plane y x"],
    usable: Float[Array, "plane y x"],
    distances_m: Float[np.ndarray, " plane"],
    *,
    pixel_m: float,
) -> Float[Array, "2"]:
    """Mean slope of the wavefront along y and x, by least squares over the planes.

    The centroid of an image at distance z moves by slope * z from where it lies at z = 0, because light travels
    straight (Ehrenfest's theorem for the paraxial wave: exact for any wavefront if the whole image is seen).
    The common position of all planes is fitted too when the planes allow, so that a shifted detector does no harm.

    Args:
        counts: Photo-electrons, background subtracted.
        usable: 1 where a pixel counts, 0 where it is masked or outside the detector.
        distances_m: Signed distance of each plane.
        pixel_m: Width of a pixel.

    Returns:
        Slope (y, x) in metres of path per metre of pupil.

    Examples:
        Two images, one pixel apart along x, 2000 km apart along the beam.

        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> counts = jnp.zeros((2, 4, 4)).at[0, 2, 1].set(5.0).at[1, 2, 2].set(5.0)
        >>> slope = centroid_tilt(counts, jnp.ones_like(counts), np.array([-1e6, 1e6]), pixel_m=0.1)
        >>> [round(float(s) * 1e9) for s in slope]
        [0, 50]
    """
    light = counts * usable
    total = jnp.sum(light, axis=(1, 2))
    total = jnp.where(total > 0, total, 1)
    y_m, x_m = _positions(counts.shape[1], pixel_m), _positions(counts.shape[2], pixel_m)
    centroid_m = jnp.stack(
        [
            jnp.einsum("pyx,y->p", light, jnp.asarray(y_m, counts.dtype)) / total,
            jnp.einsum("pyx,x->p", light, jnp.asarray(x_m, counts.dtype)) / total,
        ]
    )
    return centroid_m @ jnp.asarray(_slope_weights(distances_m), counts.dtype)


def _positions(count: int, pixel_m: float) -> Float[np.ndarray, " n"]:
    return (np.arange(count) - (count - 1) / 2) * pixel_m


def _slope_weights(distances_m: Float[np.ndarray, " plane"]) -> Float[np.ndarray, " plane"]:
    """Weights that turn centroids into a slope: a straight line through them, with or without an offset."""
    centred = distances_m - distances_m.mean()
    lever = centred if np.ptp(distances_m) > 0.1 * np.abs(distances_m).max() else distances_m
    return lever / np.sum(lever**2)

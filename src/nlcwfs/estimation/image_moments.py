"""Where the light of every plane lies, and how wide it is spread."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from nlcwfs.beam.grid import Grid
from nlcwfs.estimation.resolution_level import Measurement


def image_moments(
    counts: Float[Array, "plane y x"], usable: Bool[Array, "plane y x"], grid: Grid
) -> tuple[Float[Array, "plane 2"], Float[Array, "plane 3"]]:
    r"""First and second central moments of the light of every plane.

    They follow the wavefront by laws that hold however strong it is, where the images themselves are not linear in it.
    With the ray direction :math:`\theta = \nabla \mathrm{opd}` and means over the light of the pupil, a paraxial image
    at distance z has its centroid at :math:`\langle x\rangle + z \langle\theta_x\rangle`, and the part of its second
    central moments that is linear in z is :math:`z\,(\mathrm{cov}(a, \theta_b) + \mathrm{cov}(\theta_a, b))`: twice
    :math:`\mathrm{cov}(x, \theta_x)` for xx (Teague 1983, JOSA 73, 1434; exact if the whole image is seen).

    Args:
        counts: Photo-electrons, background subtracted.
        usable: False for pixels to ignore; they count as the mean of their usable neighbours.
        grid: The pixels.

    Returns:
        The centroids (y, x) in metres, and the second central moments (yy, yx, xx) in square metres; zeros for a
        plane without light.

    Examples:
        Light on two pixels, 1 m to either side of the middle along x.

        >>> import jax.numpy as jnp
        >>> counts = jnp.array([[[5.0, 0.0, 5.0]]])
        >>> centroid_m, second_m2 = image_moments(counts, jnp.ones((1, 1, 3), bool), Grid((1, 3), 1.0))
        >>> centroid_m.tolist(), second_m2.tolist()
        ([[0.0, 0.0]], [[0.0, 0.0, 1.0]])
    """
    light = Measurement(counts, usable, jnp.zeros((), counts.dtype)).binned(1).counts
    total = jnp.sum(light, axis=(1, 2), keepdims=True)
    share = jnp.where(total > 0, light / jnp.where(total > 0, total, 1), 0)
    y_m, x_m = (jnp.asarray(axis.ravel(), counts.dtype) for axis in (grid.y_m, grid.x_m))
    along_y, along_x = jnp.sum(share, axis=2), jnp.sum(share, axis=1)
    centroid_m = jnp.stack([along_y @ y_m, along_x @ x_m], axis=1)
    # About the centroid and not about zero: the difference of two large moments would lose the digits of float32.
    y_m, x_m = y_m[None] - centroid_m[:, :1], x_m[None] - centroid_m[:, 1:]
    second_m2 = [
        jnp.sum(along_y * y_m**2, axis=1),
        jnp.einsum("pyx,py,px->p", share, y_m, x_m),
        jnp.sum(along_x * x_m**2, axis=1),
    ]
    lit = total[:, 0] > 0
    return centroid_m, jnp.where(lit, jnp.stack(second_m2, axis=1), 0)

"""The multiplication register of an EMCCD: every electron becomes many, and not always as many."""

import jax
from jaxtyping import Array, Float, PRNGKeyArray


def multiply_electrons(
    key: PRNGKeyArray, electrons: Float[Array, "*shape"], *, em_gain: float
) -> Float[Array, "*shape"]:
    """Send electrons through a register of many stages with a small chance of multiplication in each.

    One electron leaves as a geometric number of mean G and variance G (G - 1), the law of a pure birth
    process. The sum over n electrons is drawn as `(G - 1) Gamma(n G / (G - 1))`, which has the same mean and
    variance for every G; at high gain it is `G Gamma(n)` of Hirsch et al. 2013, PLoS ONE 8, e53671.

    Args:
        key: Random key, used once.
        electrons: Numbers of electrons that enter.
        em_gain: Mean multiplication G, at least 1; 1 returns the input unchanged.

    Returns:
        Electrons that leave the register; none where none entered.

    Examples:
        >>> import jax.numpy as jnp
        >>> out = multiply_electrons(jax.random.key(1), jnp.full(10000, 50.0), em_gain=300.0)
        >>> round(float(out.mean()) / 300.0)
        50
    """
    if em_gain == 1:
        return electrons
    spread = em_gain - 1
    return spread * jax.random.gamma(key, electrons * (em_gain / spread), dtype=electrons.dtype)


def excess_noise_factor(em_gain: float) -> float:
    r"""Factor F by which multiplication enlarges the rms of the photon noise.

    :math:`F^2 = 2 - 1/G` for many stages (Robbins and Hadwen 2003, IEEE Trans. Electron Devices 50, 1227): 1
    without multiplication, sqrt 2 at high gain.

    Args:
        em_gain: Mean multiplication G, at least 1.

    Examples:
        >>> excess_noise_factor(1.0)
        1.0
        >>> round(excess_noise_factor(1000.0), 3)
        1.414
    """
    return (2 - 1 / em_gain) ** 0.5

"""The analogue-to-digital converter: electrons at the amplifier become numbers, and back."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def electrons_to_adu(
    electrons: Float[Array, "*shape"], *, gain_electrons_per_adu: float, bias_adu: float, bits: int
) -> Float[Array, "*shape"]:
    """Convert electrons at the amplifier into the codes of the converter.

    Args:
        electrons: Electrons behind the multiplication register, noise included; may be negative.
        gain_electrons_per_adu: Electrons per step.
        bias_adu: Reading without electrons.
        bits: Number of bits; 0 neither rounds nor limits.

    Returns:
        Whole numbers from 0 to 2^bits - 1, as floats of the input's dtype.

    Examples:
        >>> electrons = jnp.array([-1000.0, 0.0, 2.6, 1000.0])
        >>> electrons_to_adu(electrons, gain_electrons_per_adu=2.0, bias_adu=10.0, bits=8)
        Array([  0.,  10.,  11., 255.], dtype=...)
    """
    adu = electrons / gain_electrons_per_adu + bias_adu
    if bits == 0:
        return adu
    return jnp.clip(jnp.round(adu), 0, highest_code(bits))


def adu_to_electrons(
    adu: Float[Array, "*shape"], *, gain_electrons_per_adu: float, bias_adu: float
) -> Float[Array, "*shape"]:
    """Convert readings back into electrons at the amplifier; undoes `electrons_to_adu` to half a step.

    Args:
        adu: Readings.
        gain_electrons_per_adu: Electrons per step.
        bias_adu: Reading without electrons.

    Returns:
        Electrons behind the multiplication register.

    Examples:
        >>> adu_to_electrons(jnp.array([10.0, 11.0]), gain_electrons_per_adu=2.0, bias_adu=10.0)
        Array([0., 2.], dtype=...)
    """
    return (adu - bias_adu) * gain_electrons_per_adu


def at_full_scale(adu: Float[Array, "*shape"], *, bits: int) -> Bool[Array, "*shape"]:
    """Tell which readings stand at the highest code, so that the truth may lie above.

    Args:
        adu: Readings.
        bits: Number of bits; 0 has no highest code.

    Examples:
        >>> at_full_scale(jnp.array([254.0, 255.0]), bits=8)
        Array([False,  True], dtype=bool)
    """
    if bits == 0:
        return jnp.zeros(adu.shape, bool)
    return adu >= highest_code(bits)


def highest_code(bits: int) -> float:
    """The highest reading of a converter."""
    return float(2**bits - 1)

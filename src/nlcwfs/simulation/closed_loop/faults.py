"""What may go wrong in a loop: frames that are damaged, missing or old, and a bump in the wavefront."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.simulation.closed_loop.light import LoopLight
from nlcwfs.simulation.closed_loop.settings import LoopSettings
from nlcwfs.simulation.exposure import Exposure


def fault_in(settings: LoopSettings, frame: int) -> str:
    """The fault of a frame, or `none`.

    Examples:
        >>> settings = LoopSettings(rate_hz=100, fault="lost-frames", fault_at_s=0.1, fault_s=0.02)
        >>> [fault_in(settings, frame) for frame in (9, 10, 11, 12)]
        ['none', 'lost-frames', 'lost-frames', 'none']
    """
    first = round(settings.fault_at_s * settings.rate_hz)
    last = first + max(1, round(settings.fault_s * settings.rate_hz))
    return settings.fault if first <= frame < last else "none"


def bump_rms_m(settings: LoopSettings, frame: int) -> float:
    """Rms of the bump in a frame; it stays once it has begun.

    Examples:
        >>> settings = LoopSettings(rate_hz=100, fault="bump", fault_at_s=0.1, bump_nm=300)
        >>> [round(1e9 * bump_rms_m(settings, frame)) for frame in (9, 10, 99)]
        [0, 300, 300]
    """
    begun = settings.fault == "bump" and frame >= round(settings.fault_at_s * settings.rate_hz)
    return settings.bump_nm * 1e-9 if begun else 0.0


def bump_shape(light: LoopLight) -> Float[Array, "lit_y lit_x"]:
    """The bump of unit rms: another piece of turbulence that the mirror can hold."""
    falls = np.maximum(np.asarray(light.mirror.cycles_per_aperture), 0.5) ** (-11 / 6)  # Kolmogorov's amplitudes
    noise = jax.random.normal(jax.random.key(7), (light.mirror.count,), light.weights.dtype)
    shape_m = light.mirror.opd_m(noise * jnp.asarray(falls * 1e-9, noise.dtype))
    return shape_m / jnp.sqrt(jnp.sum(light.weights * shape_m**2))


def damaged(fault: str, exposure: Exposure, before: Exposure | None) -> Exposure | None:
    """What arrives of an exposure; nothing when it is lost. A dead plane of four is a dead quarter of the spots."""
    electrons = exposure.frames.electrons
    if fault == "lost-frames":
        return None
    if fault == "doubled-frames" and before is not None:
        return before
    if fault == "nan-frames":
        electrons = jnp.full_like(electrons, np.nan)
    if fault == "dead-plane":
        electrons = electrons.at[: max(1, len(electrons) // 4)].set(0)
    return eqx.tree_at(lambda one: one.frames.electrons, exposure, electrons)

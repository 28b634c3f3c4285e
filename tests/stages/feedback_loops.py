"""Loops around a controller, for the tests of feedback."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.signal import lfilter


def closed_loop(controller, air_m: np.ndarray, noise_m: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Mean residuals `[exposure, mode]` and commands of a loop whose mirror does what it is told."""
    noise_m = np.zeros_like(air_m) if noise_m is None else noise_m

    def expose(state, moment):
        residual_m = moment[0] - state.line.mean_m
        state, command_m = controller.step(state, residual_m + moment[1])
        return state, (residual_m, command_m)

    _, recorded = eqx.filter_jit(lambda air, noise: jax.lax.scan(expose, controller.init(), (air, noise)))(
        jnp.asarray(air_m), jnp.asarray(noise_m)
    )
    return np.asarray(recorded[0]), np.asarray(recorded[1])


def first_order(rng, *, correlation: float, frames: int, modes: int) -> np.ndarray:
    """A stationary AR(1) process of variance 1, `[frame, mode]`."""
    new = np.sqrt(1 - correlation**2) * rng.normal(size=(frames, modes))
    new[0] /= np.sqrt(1 - correlation**2)
    return lfilter([1.0], [1.0, -correlation], new, axis=0)


def first_order_spectrum(frequency: np.ndarray, *, correlation: float) -> np.ndarray:
    """Its two-sided spectrum per cycle per frame."""
    return (1 - correlation**2) / abs(1 - correlation * np.exp(-2j * np.pi * frequency)) ** 2

r"""Moving air at altitude, as it is at the pupil: a wavefront and an amplitude that the wind carries along together.

Travel commutes with a wind: the pattern that a frozen layer leaves at the pupil is frozen, too, and moves as the layer
does. So the travel of `beam.air_at_pupil` is computed once for each layer, over its whole period.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.atmosphere.frozen_flow import FrozenFlow, MovingLayer
from nlcwfs.beam.fresnel import fresnel_transfer


class Twinkling(eqx.Module):
    r"""The amplitude that layers at altitude leave at the pupil, to first order (Rytov).

    Attributes:
        log_amplitude: Layers whose "path" is the logarithm of the amplitude, :math:`\chi`.
        variance: Of the logarithm, over the whole air.
    """

    log_amplitude: FrozenFlow
    variance: Float[Array, ""]

    def amplitude(self, time_s: float | Float[Array, ""]) -> Float[Array, "y x"]:
        """What multiplies the field at a moment; the mean of its square over much air is 1."""
        return jnp.exp(self.log_amplitude.opd_m(time_s) - self.variance)


def at_pupil(
    flow: FrozenFlow, *, heights_m: Sequence[float], wavelength_m: float, pixel_m: float
) -> tuple[FrozenFlow, Twinkling]:
    r"""The wavefront at the pupil that a flow at altitude leaves, and the amplitude.

    Of each layer's fine structure :math:`F` at the height h it is the part that travels as
    :math:`\cos(\pi \lambda h f^2) F`, and :math:`\chi = k \sin(\pi \lambda h f^2) F`. Waves longer than the period
    carry no amplitude.

    Args:
        flow: The air of every layer where it is.
        heights_m: Height of each layer.
        wavelength_m: Of the light.
        pixel_m: Width of a pixel of the flow.

    Examples:
        >>> import jax
        >>> from nlcwfs.atmosphere.frozen_flow import WindLayer
        >>> from nlcwfs.atmosphere.phase_screen import PhaseScreens, Turbulence
        >>> screens = PhaseScreens.build(Turbulence(0.17), shape=(32, 32), pixel_m=0.05, period=256)
        >>> flow = FrozenFlow.build(screens, [WindLayer()], jax.random.key(1))
        >>> moved, twinkling = at_pupil(flow, heights_m=(10e3,), wavelength_m=0.85e-6, pixel_m=0.05)
        >>> twinkling.amplitude(0.01).shape, moved.opd_m(0.01).shape
        ((32, 32), (32, 32))
    """
    wavefronts, amplitudes, variance = [], [], jnp.zeros((), flow.layers[0].fine_m.dtype)
    for layer, height_m in zip(flow.layers, heights_m, strict=True):
        rows, columns = layer.fine_m.shape
        travel = {"distance_m": height_m, "wavelength_m": wavelength_m, "pixel_m": pixel_m}
        factor = jnp.asarray(
            fresnel_transfer((rows, columns), **travel), np.result_type(layer.fine_m.dtype, np.complex64)
        )
        complex_m = jnp.fft.ifft2(factor * jnp.fft.fft2(layer.fine_m.astype(factor.dtype)))
        # i k times this is log-amplitude + i phase, as in `HighAir`
        log_amplitude = -2 * np.pi / wavelength_m * complex_m.imag
        wavefronts.append(_with(layer, complex_m.real))
        amplitudes.append(_with(layer, log_amplitude, low=0))
        variance += jnp.mean(log_amplitude**2)
    return (
        FrozenFlow(tuple(wavefronts), flow.unrepeated_s),
        Twinkling(FrozenFlow(tuple(amplitudes), flow.unrepeated_s), variance),
    )


def _with(layer: MovingLayer, fine: Float[Array, "Y X"], *, low: int = 1) -> MovingLayer:
    """A layer of other fine structure, with its long waves or without."""
    return eqx.tree_at(lambda one: (one.fine_m, one.low_m), layer, (fine, low * layer.low_m))

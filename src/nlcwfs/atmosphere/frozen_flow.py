"""Moving air: layers of frozen turbulence that the wind carries across the telescope."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int, PRNGKeyArray

from nlcwfs.atmosphere.phase_screen import PhaseScreens
from nlcwfs.errors import SettingsError

FINEST = 0.8
"""Highest frequency of the air, along x and along y, over that at which the grid samples twice a period."""

TAPS = 32
KAISER_BETA = 10.0
"""Pixels and window of the interpolation: 32 and 10 move every wave up to `FINEST` with an error below 2.1e-5 of it."""

MOST_CROSSINGS = 256
"""Crossings of the period that are looked at; by then any wind but a calm has met its own air again."""

Velocity = tuple[float, float]
"""Along y and along x."""


@dataclass(frozen=True)
class WindLayer:
    """A layer of air and how it moves.

    Attributes:
        fraction: Its share of the turbulence, of `r0^(-5/3)`.
        speed_m_per_s: Speed of the wind.
        direction_deg: Where the air goes to: 0 is towards +x, 90 towards +y.

    Examples:
        >>> WindLayer(speed_m_per_s=10.0, direction_deg=30.0).velocity_m_per_s
        (4.999..., 8.660...)
    """

    fraction: float = 1.0
    speed_m_per_s: float = 10.0
    direction_deg: float = 0.0

    @property
    def velocity_m_per_s(self) -> Velocity:
        """Speed towards +y and towards +x; a wind along an axis has exactly no part across it."""
        turn = math.radians(self.direction_deg)
        sine, cosine = (0.0 if abs(part) < 1e-12 else part for part in (math.sin(turn), math.cos(turn)))
        return self.speed_m_per_s * sine, self.speed_m_per_s * cosine


class MovingLayer(eqx.Module):
    r"""One layer of frozen air, :math:`\mathrm{opd}(x, t) = \mathrm{opd}(x - v t, 0)`.

    The fine structure is periodic and lies on pixels; between them it is interpolated by a sinc under Kaiser's window,
    which is exact for what the air holds of frequencies. The longer waves, see `PhaseScreens`, have no common period,
    and each turns its phase as it moves.

    Attributes:
        fine_m: The fine structure over its whole period.
        low_m: Coefficients of the long waves.
        low_y: Each long wave along y, less 1: what is left is a slope, not metres of piston.
        low_x: The same along x.
        low_rad_per_s: How fast each wave turns.
        pixels_per_s: Velocity towards +y and +x.
    """

    fine_m: Float[Array, "Y X"]
    low_m: Complex[Array, " wave"]
    low_y: Complex[Array, "wave y"]
    low_x: Complex[Array, "wave x"]
    low_rad_per_s: Float[Array, " wave"]
    pixels_per_s: Float[Array, "2"]

    @classmethod
    def build(cls, screens: PhaseScreens, layer: WindLayer, key: PRNGKeyArray) -> "MovingLayer":
        """Draw the air of a layer.

        Args:
            screens: Statistics of the whole air, and the grid.
            layer: Share and wind.
            key: Random key of this layer.
        """
        key_fine, key_low = jax.random.split(key)
        dtype, velocity = screens.amplitude_m.dtype, np.array(layer.velocity_m_per_s)
        reached = np.abs(np.fft.fftfreq(screens.amplitude_m.shape[0])) <= FINEST / 2
        kept = jnp.asarray(reached[:, None] & reached[None, :])
        limited = eqx.tree_at(lambda one: one.amplitude_m, screens, jnp.where(kept, screens.amplitude_m, 0))
        share = math.sqrt(layer.fraction)
        frequency = np.array(screens.low_frequency_per_m)
        low = []
        for axis, waves in enumerate((screens.low_waves_y, screens.low_waves_x)):
            count = waves.shape[1]
            position_m = (np.arange(count) - (count - 1) / 2) * screens.pixel_m
            low.append(jnp.asarray(np.expm1(2j * np.pi * frequency[:, axis, None] * position_m), waves.dtype))
        return cls(
            fine_m=share * limited.draw_fine(key_fine),
            low_m=share * screens.draw_low(key_low),
            low_y=low[0],
            low_x=low[1],
            low_rad_per_s=jnp.asarray(-2 * np.pi * frequency @ velocity, dtype),
            pixels_per_s=jnp.asarray(velocity / screens.pixel_m, dtype),
        )

    def opd_m(self, time_s: float | Float[Array, ""]) -> Float[Array, "y x"]:
        """What the layer adds to the path at a moment."""
        start = -self.pixels_per_s * jnp.asarray(time_s, self.fine_m.dtype)
        whole = jnp.floor(start)
        first, rest = whole.astype(int), start - whole
        rows, columns = self.low_y.shape[1], self.low_x.shape[1]
        near = self._reached(self._reached(self.fine_m, first[0], rows, axis=0), first[1], columns, axis=1)
        fine = _matrix(rest[0], rows) @ near @ _matrix(rest[1], columns).T
        return fine + self._low(time_s)

    def _reached(
        self, fine_m: Float[Array, "Y X"], first: Int[Array, ""], count: int, *, axis: int
    ) -> Float[Array, "near_y near_x"]:
        """The pixels along an axis that an interpolation from `first` on touches."""
        index = first - (TAPS // 2 - 1) + jnp.arange(count + TAPS - 1)
        return jnp.take(fine_m, index % fine_m.shape[axis], axis=axis)

    def _low(self, time_s: float | Float[Array, ""]) -> Float[Array, "y x"]:
        """The long waves, less their sum in the middle of the grid at time 0."""
        angle = self.low_rad_per_s * time_s
        turned = self.low_m * jax.lax.complex(jnp.cos(angle), jnp.sin(angle))
        # exp(i angle) - 1, without losing the digits of a small angle
        moved = self.low_m * jax.lax.complex(-2 * jnp.sin(angle / 2) ** 2, jnp.sin(angle))
        at_y, at_x = turned[:, None] * self.low_y, turned[:, None] * self.low_x
        # the real part of at_y.T @ low_x: a product of real matrices is four times faster
        both = jnp.concatenate([at_y.real, -at_y.imag]).T @ jnp.concatenate([self.low_x.real, self.low_x.imag])
        return both + at_y.real.sum(0)[:, None] + at_x.real.sum(0)[None, :] + moved.real.sum()


class FrozenFlow(eqx.Module):
    """Turbulence in any number of layers, each frozen and carried by its own wind (Taylor's hypothesis).

    The same key gives the same air, however long it is watched.

    Attributes:
        layers: The layers.
        unrepeated_s: How long it can be watched before it shows air again that it has shown.

    Examples:
        >>> import jax
        >>> from nlcwfs.atmosphere.phase_screen import PhaseScreens, Turbulence
        >>> screens = PhaseScreens.build(Turbulence(0.2), shape=(32, 32), pixel_m=0.25, period=384)
        >>> flow = FrozenFlow.build(screens, [WindLayer(0.7, 10.0), WindLayer(0.3, 25.0, 90.0)], jax.random.key(1))
        >>> flow.opd_m(0.002).shape, round(flow.unrepeated_s, 2)
        ((32, 32), 3.21)
    """

    layers: tuple[MovingLayer, ...]
    unrepeated_s: float = eqx.field(static=True)

    @classmethod
    def build(
        cls, screens: PhaseScreens, layers: Sequence[WindLayer], key: PRNGKeyArray, *, duration_s: float = 0.0
    ) -> "FrozenFlow":
        """Draw the air of every layer.

        Args:
            screens: Statistics of the whole air, and the grid. The longer its period, the longer the air is new.
            layers: Shares and winds; the shares are those of `screens`.
            key: Random key of the air.
            duration_s: How long it will be watched.

        Raises:
            SettingsError: If the air would repeat within that time, or if there is no layer.
        """
        if not layers:
            raise SettingsError("layers", "must be at least one", "none")
        shape = screens.low_waves_y.shape[1], screens.low_waves_x.shape[1]
        period = screens.amplitude_m.shape[0]
        longest_s = unrepeated_s(layers, shape=shape, pixel_m=screens.pixel_m, period=period)
        if not duration_s <= longest_s:
            rule = f"must be at most {longest_s:.4g} s, after which this air repeats itself"
            raise SettingsError("duration_s", rule, f"{duration_s:g} s")
        keys = [jax.random.fold_in(key, number) for number in range(len(layers))]
        drawn = [MovingLayer.build(screens, layer, one) for layer, one in zip(layers, keys, strict=True)]
        return cls(layers=tuple(drawn), unrepeated_s=longest_s)

    def opd_m(self, time_s: float | Float[Array, ""]) -> Float[Array, "y x"]:
        """Optical path difference at a moment, on the grid of the screens; its zero is the same at all times.

        Args:
            time_s: From 0 to `unrepeated_s`; later air has been seen before.
        """
        with jax.default_matmul_precision("highest"):  # the short numbers of a GPU would cost nanometres
            return sum((layer.opd_m(time_s) for layer in self.layers[1:]), self.layers[0].opd_m(time_s))


def unrepeated_s(layers: Sequence[WindLayer], *, shape: tuple[int, int], pixel_m: float, period: int) -> float:
    """How long no layer shows a piece of fine structure twice; infinite for a calm.

    The air is a pattern with a period along x and along y. It shows again when the window, with what the
    interpolation needs around it, has moved by whole periods to within its own width. A wind across the axes drifts
    past its own track and stays new for longer.

    Args:
        layers: How each layer moves.
        shape: Pixels of the window along y and x.
        pixel_m: Width of a pixel.
        period: Pixels after which the fine structure repeats.

    Examples:
        >>> grid = {"shape": (32, 32), "pixel_m": 0.25, "period": 384}
        >>> along, across = WindLayer(direction_deg=90.0), WindLayer(direction_deg=75.0)
        >>> round(unrepeated_s([along], **grid), 2), round(unrepeated_s([across], **grid), 2)
        (8.03, 31.01)
    """
    window = [count + TAPS - 1 for count in shape]
    moments = [math.inf]
    for layer in layers:
        (begin_y, end_y), (begin_x, end_x) = (
            _near_whole_periods(speed_m_per_s / pixel_m, period, width)
            for speed_m_per_s, width in zip(layer.velocity_m_per_s, window, strict=True)
        )
        begin = np.maximum(begin_y[:, None], begin_x[None, :])
        met = begin < np.minimum(end_y[:, None], end_x[None, :])
        met[0, 0] = False  # where it started
        moments += begin[met].tolist()
    return min(moments)


def _near_whole_periods(
    pixels_per_s: float, period: int, width: int
) -> tuple[Float[np.ndarray, " crossing"], Float[np.ndarray, " crossing"]]:
    """When the way along an axis is within a width of 0, 1, 2... periods: from and until, in seconds."""
    crossing = np.arange(MOST_CROSSINGS) * period
    speed = abs(pixels_per_s)
    if speed == 0:
        return np.where(crossing == 0, 0.0, np.inf), np.full(MOST_CROSSINGS, np.inf)
    return np.maximum(crossing - width, 0) / speed, (crossing + width) / speed


def _matrix(rest: Float[Array, ""], count: int) -> Float[Array, "count near"]:
    """Interpolates `count` values at `rest` of a pixel behind the middle of their neighbours."""
    distance = rest - (jnp.arange(TAPS) - (TAPS // 2 - 1)).astype(rest.dtype)
    root = jnp.sqrt(jnp.maximum(1 - (distance / (TAPS / 2)) ** 2, 0))
    weight = jnp.sinc(distance) * jnp.i0(KAISER_BETA * root) / np.i0(KAISER_BETA).astype(rest.dtype)
    offset = np.arange(count + TAPS - 1)[None, :] - np.arange(count)[:, None]
    inside = (offset >= 0) & (offset < TAPS)
    return jnp.where(inside, weight[np.clip(offset, 0, TAPS - 1)], 0)

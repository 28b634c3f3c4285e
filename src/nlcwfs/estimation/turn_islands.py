"""Islands of the phase that lie a whole turn off, and how they are brought back.

A smooth phase that was found coarse to fine may be right but for islands one turn too high or low: inside them and
outside the light is right, and only their rims, two or three pixels wide, disagree with the images. No small change
of a smooth phase removes a rim. The field can: Gerchberg-Saxton, which knows no prior and may tear the phase, lets
the light flow together across the rim within some iterations; unwrapping the field then shows the phase without the
island. At D / r0 = 25 nearly all first solutions hold such islands, at 15 one in three (study 02).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from nlcwfs.estimation.amplitude_constraint import LARGEST_FACTOR
from nlcwfs.estimation.angle import angle
from nlcwfs.estimation.gerchberg_saxton import pupil_light
from nlcwfs.estimation.resolution_level import Level, Measurement
from nlcwfs.estimation.sensor_model import PlaneScale

FAINT = 1.0
"""Least counts added to that variance: at less than a photon a pixel noise would tear everything."""

FLOOR = 0.3
"""Share of the mean count of a lit pixel in the variance of a step, so that dark pixels do not rule it."""

LONGER, MORE = 2.0, 3
"""Behind a membrane that moves, each of the fields answers only a part of what an image misses: steps are so many times
longer, and there are so many more. Without, 110 nm of islands take five healings (2500 and 3500 km, 8 moments); so
two, and with twice the length alone four."""


def torn_phase(
    level: Level,
    measured: Measurement,
    scale: PlaneScale,
    phase_rad: Float[Array, "y x"],
    *,
    iterations: int,
    gain: float,
) -> Float[Array, "y x"]:
    """Wrapped phase after some iterations of serial Gerchberg-Saxton on the field, without any smoothing.

    Args:
        level: The sensor.
        measured: The counts.
        scale: Counts of each plane.
        phase_rad: Where to start, everything included.
        iterations: Passes over all planes, see `tearing_ffts`. Behind a membrane that moves a plane, the fields of all
            moments get the same factor, and come back together; then there are `MORE`.
        gain: Length of a step; 1 is Gerchberg and Saxton's. `LONGER` behind a membrane.
    """
    floor = jnp.maximum(FLOOR * scale.counts * level.oversampling**2 / jnp.sum(level.light), FAINT)
    counts = jnp.where(measured.usable, measured.counts, 0)

    moving = level.optics if level.moving is None else level.moving
    if level.moving is not None:
        iterations, gain = MORE * iterations, LONGER * gain
    shares = jnp.asarray(moving.spectrum.shares, level.modulus.dtype)[:, None, None]

    def through(phase_rad: Float[Array, "y x"], plane: tuple) -> tuple[Float[Array, "y x"], None]:
        transfer, seen, usable, gain_counts, background, noise = plane
        far = jnp.fft.ifft2(jnp.fft.fft2(pupil_light(level, phase_rad))[None] * transfer)
        light = jnp.sum(shares * (far.real**2 + far.imag**2), axis=0)
        model = gain_counts * level.on_pixels(light[None])[0] + background
        variance = (jnp.maximum(seen, 0) + model) / 2 + noise + measured.read_variance
        factor = 1 + gain * jnp.where(usable, seen - model, 0) / (2 * variance)
        factor = level.on_cells(jnp.clip(factor, 0, LARGEST_FACTOR)[None]).astype(far.dtype)
        back = jnp.sum(jnp.fft.fft2(far * factor) * (shares.astype(far.dtype) * jnp.conj(transfer)), axis=0)
        return angle(jnp.fft.ifft2(back)), None

    planes = (jnp.swapaxes(moving.transfer, 0, 1), counts, measured.usable, scale.counts, scale.background, floor)
    # From one side of the pupil to the other: neighbours in the list would pull the same way.
    order = jnp.asarray(_alternating(counts.shape[0]))
    planes = jax.tree.map(lambda part: part[order], planes)

    def one(phase_rad: Float[Array, "y x"], _: None) -> tuple[Float[Array, "y x"], None]:
        return jax.lax.scan(through, phase_rad, planes)[0], None

    return jax.lax.scan(one, phase_rad, None, length=iterations)[0]


def tearing_ffts(planes: int, iterations: int, *, moments: int = 1) -> int:
    """FFTs of `torn_phase`.

    Examples:
        >>> tearing_ffts(4, 10), tearing_ffts(4, 10, moments=8)
        (160, 2160)
    """
    return (2 + 2 * moments) * planes * iterations * (MORE if moments > 1 else 1)


def _alternating(count: int) -> list[int]:
    """First, last, second, last but one ..."""
    return [i // 2 if i % 2 == 0 else count - 1 - i // 2 for i in range(count)]

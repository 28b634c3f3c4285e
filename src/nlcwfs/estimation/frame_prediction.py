"""What one frame says about the next: the wind carries the phase on, and new air comes in.

This is Kalman's filter (1960, J. Basic Eng. 82, 35), diagonal in Fourier space: each wave is followed on its own, so
that the prediction of a frame costs two FFTs and no matrix. It is exact where the phase is seen on the whole periodic
grid and forgets as the correlation says. For a stream that is `lasting_correlation`. The rim of a pupil couples waves,
and air that comes in over it has not been seen: `unseen_share` puts that right on average. Powers are those of
`phase_prior`.
"""

import math
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Array, Complex, Float

from nlcwfs.beam.grid import Grid
from nlcwfs.estimation.turbulence_filter import half_plane_frequencies

REMEMBERED = 2.0
"""Frames over which a filter needs the wave to stay itself, over the inverse of its gain. Measured: with 2 the error is
within 2 % of the best that a filter of this kind can do, and told within 9 %; with 1 it is 8 % larger and told 15 %
too small (260 to 2000 Hz, 300 to 11500 photons a frame, three layers)."""


def posterior_power(
    power: Float[Array, "y fx"], information: float | Float[Array, ""] | Float[Array, "y fx"]
) -> Float[Array, "y fx"]:
    """What a frame leaves open of each wave: `P / (1 + P i)`, with i its information per pixel in 1/rad^2.

    Inside the pupil `i` is the inverse of `noise_power`. No information leaves the prior.

    Examples:
        >>> posterior_power(jnp.full((2, 2), 4.0), 0.75).tolist()
        [[1.0, 1.0], [1.0, 1.0]]
    """
    return power / (1 + power * information)


def wind_correlation(grid: Grid, *, wind_m_per_s: float, interval_s: float) -> Float[np.ndarray, "y fx"]:
    r"""How much of each wave the next frame shows again, for wind of unknown direction: :math:`J_0(2 \pi f v t) \ge 0`.

    Where :math:`J_0` is negative, nothing is taken over.

    Examples:
        >>> again = wind_correlation(Grid((8, 8), 0.5), wind_m_per_s=10.0, interval_s=0.05)
        >>> again[0].round(2).tolist()
        [1.0, 0.85, 0.47, 0.03, 0.0]
    """
    angle = 2 * np.pi * half_plane_frequencies(grid) * wind_m_per_s * interval_s
    return np.maximum(scipy.special.j0(angle), 0)


def lasting_correlation(
    grid: Grid,
    power: Float[np.ndarray, "y fx"],
    *,
    information: float | Float[np.ndarray, "y fx"],
    wind_m_per_s: float,
    interval_s: float,
) -> Float[np.ndarray, "y fx"]:
    r"""How much of each wave is seen again, per frame over the frames that the filter remembers: what a stream needs.

    Frozen flow does not forget the same share each frame: a wave keeps turning the same way, and what is new after ten
    frames is a hundred times what is new after one. `wind_correlation` is right from one frame to the next, but a
    filter that believes it for good remembers too long: at 1 kHz and 3000 photons its errors are 1.1 to 2.3 times what
    it says, and twice what they need be. So this takes :math:`J_0(2 \pi f v n t)^{1/n}`, with n the frames that the
    settled filter remembers; found by iteration.

    Args:
        grid: Pixels of the phase.
        power: Of the whole turbulence.
        information: Of a frame, per pixel, see `posterior_power`.
        wind_m_per_s: Speed of the wind, direction unknown.
        interval_s: Time to the next frame.

    Examples:
        >>> from nlcwfs.atmosphere.phase_screen import Turbulence
        >>> from nlcwfs.estimation.turbulence_filter import expected_power
        >>> grid, air = Grid((16, 16), 0.5), Turbulence.from_seeing(seeing_arcsec=0.6)
        >>> power = expected_power(grid, air, wavelength_m=0.85e-6, cutoff_per_m=None)
        >>> wind = {"wind_m_per_s": 10.0, "interval_s": 0.001}
        >>> once = wind_correlation(grid, **wind)[0, 4]
        >>> lasting = lasting_correlation(grid, power, information=10.0, **wind)[0, 4]
        >>> round(float(1 - once), 5), round(float(1 - lasting), 5)
        (0.00025, 0.00135)
    """
    angle = 2 * np.pi * half_plane_frequencies(grid) * wind_m_per_s * interval_s
    frames, again = np.ones_like(angle), np.ones_like(angle)
    for _ in range(80):
        # Beyond 2.2 rad, before the first zero of J0, the wave is lost to the filter all the same.
        lasting = scipy.special.j0(np.minimum(angle * frames, 2.2)) ** (1 / frames)
        again = np.minimum(lasting, np.maximum(scipy.special.j0(angle), 0))
        new = (1 - again**2) * power
        half = (1 - again**2 - new * information) / 2
        signal = np.sqrt(half**2 + new * information) - half  # settled power times information
        gain = np.maximum(signal / (1 + signal), 1e-5)
        frames = np.sqrt(frames * np.maximum(REMEMBERED / gain, 1))
    return again


def wind_carriage(
    grid: Grid, layers: Sequence[tuple[float, float, float]], *, interval_s: float
) -> Complex[np.ndarray, "y fx"]:
    r"""What the next frame shows of each wave, for layers of known wind: :math:`\sum w \exp(-2 \pi i f \cdot v t)`.

    One layer moves as a whole, with factors of modulus 1; several smear each other's fine waves. The wave of half a
    cycle per pixel has no sign on the grid and keeps a cosine. What layers smear is right from one frame to the next; a
    stream follows several layers no better than by `lasting_correlation`, for the reason given there.

    Args:
        grid: Pixels of the phase, periodic.
        layers: Share of the turbulence, speed towards +y, speed towards +x in m/s; the shares sum to 1.
        interval_s: Time to the next frame.

    Examples:
        >>> row = np.arange(8.0)[None, :]
        >>> moved = np.fft.rfft2(row) * wind_carriage(Grid((1, 8), 0.5), [(1.0, 0.0, 100.0)], interval_s=0.01)
        >>> abs(np.fft.irfft2(moved, s=(1, 8)).round(9)).tolist()  # two pixels towards +x
        [[6.0, 7.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0]]
    """
    rows, columns = grid.shape
    along_x = np.fft.rfftfreq(columns, grid.pixel_m)
    total = np.zeros((rows, along_x.size), complex)
    for share, towards_y, towards_x in layers:
        turn_y = _ramp(grid.fy_per_m[:, 0], towards_y * interval_s, grid.pixel_m)
        turn_x = _ramp(along_x, towards_x * interval_s, grid.pixel_m)
        total += share * turn_y[:, None] * turn_x[None, :]
    return total


def unseen_share(*, diameter_m: float, wind_m_per_s: float, interval_s: float) -> float:
    """Share of a round telescope over which the wind has brought air that the last frame did not see.

    What is not in the overlap of two shifted discs. Times the root of one less this share, a correlation counts it
    as new.

    Examples:
        >>> round(unseen_share(diameter_m=8.0, wind_m_per_s=10.0, interval_s=0.01), 4)
        0.0159
    """
    moved = min(wind_m_per_s * interval_s / diameter_m, 1.0)
    return 1 - 2 / math.pi * (math.acos(moved) - moved * math.sqrt(1 - moved**2))


def predicted_mean_and_power(
    previous_rad: Float[Array, "y x"],
    left_open: Float[Array, "y fx"],
    power: Float[Array, "y fx"],
    correlation: Float[Array, "y fx"] | Complex[Array, "y fx"],
) -> tuple[Float[Array, "y x"], Float[Array, "y fx"]]:
    """What the last frame says about the next: Kalman's prediction, wave by wave, two FFTs.

    The mean is `a * previous`, its power `|a|^2 R + (1 - |a|^2) P`: what was left open, and what is new.

    Args:
        previous_rad: Estimate of the last frame.
        left_open: Its error R, see `posterior_power`.
        power: Of the whole turbulence, P.
        correlation: What is seen again, a; see `wind_correlation` and `wind_carriage`.

    Examples:
        >>> again, power = jnp.full((4, 3), 0.6), jnp.full((4, 3), 2.0)
        >>> mean_rad, wider = predicted_mean_and_power(jnp.ones((4, 4)), 0 * power, power, again)
        >>> round(float(mean_rad[0, 0]), 6), round(float(wider[0, 0]), 6)
        (0.6, 1.28)
    """
    spectrum = jnp.fft.rfft2(previous_rad)
    mean_rad = jnp.fft.irfft2(spectrum * correlation.astype(spectrum.dtype), s=previous_rad.shape)
    again = jnp.abs(correlation) ** 2
    return mean_rad.astype(previous_rad.dtype), again * left_open + (1 - again) * power


def settled_power(
    power: Float[Array, "y fx"],
    correlation: Float[Array, "y fx"] | Complex[Array, "y fx"],
    information: float | Float[Array, ""] | Float[Array, "y fx"],
) -> Float[Array, "y fx"]:
    r"""The prediction's power after many frames, so that nothing but the mean need be carried along.

    The positive root p of Riccati's equation :math:`p = |a|^2 p / (1 + p i) + (1 - |a|^2) P`.

    Examples:
        >>> again, power = jnp.full((2, 2), 0.99), jnp.full((2, 2), 2.0)
        >>> settled = settled_power(power, again, 5.0)
        >>> _, after = predicted_mean_and_power(jnp.ones((2, 2)), posterior_power(settled, 5.0), power, again)
        >>> bool(jnp.allclose(after, settled))
        True
    """
    again = jnp.abs(correlation) ** 2
    new = (1 - again) * power
    half = (1 - again - new * information) / 2
    root = jnp.sqrt(half**2 + information * new)
    # Two forms of the same root; each keeps its digits where the other loses them.
    few = new / jnp.where(half > 0, half + root, 1)
    many = (root - half) / jnp.where(information > 0, information, 1)
    return jnp.where(information > 0, jnp.where(half > 0, few, many), power)


def _ramp(frequency_per_m: Float[np.ndarray, " wave"], moved_m: float, pixel_m: float) -> np.ndarray:
    """Turn of each wave along one axis when the air moves."""
    turn = np.exp(-2j * np.pi * frequency_per_m * moved_m)
    highest = np.isclose(np.abs(frequency_per_m), 0.5 / pixel_m, rtol=1e-9)
    return np.where(highest, np.real(turn), turn)

r"""The best gain of an integrator for every mode, from what the mode did.

Air is slow and noise is fast, so that each mode has a gain at which their sum in the residual is least (Gendron & Lena
1994, A&A 291, 337): :math:`J(g) = \int |E_g|^2 (S_y - \sigma^2) + |N_g|^2 \sigma^2`, with :math:`S_y` the temporal
spectrum of the measured open loop, :math:`\sigma^2` the noise, and the transfer functions of `loop_transfer`. A mirror
that never acts before it has measured has :math:`\int |N_g|^2 - |E_g|^2 = -1` whatever its gain, so that
:math:`J = \int |E_g|^2 S_y - \sigma^2`: the best gain is that at which least is measured in the closed loop, and white
noise need not be known to find it. It is read from the end of the spectrum to tell what is left.
"""

from dataclasses import dataclass

import numpy as np
import scipy.signal
from jaxtyping import Float

from nlcwfs.errors import SettingsError
from nlcwfs.feedback.loop_transfer import IntegratorLoop

LEAST_FRAMES = 64
"""Fewer hold too few periods of what an integrator corrects."""

LONGEST_SEGMENT = 4096
"""Frames of one spectrum, at most. Slower waves are corrected by any gain, or are a static aberration."""

FLOOR = 0.75
"""The noise is read above this share of the highest frequency. What the air holds there counts as noise too."""

TRIED = 400
"""Gains, equal steps apart in the logarithm, and a parabola through the best three."""

SMALLEST_GAIN = 1e-3

MARGIN = 0.7
"""Largest gain, over the limit of stability: a mirror that is 1.4 times as strong as is known does not shake itself.
Frozen Kolmogorov air would take more where there is hardly noise, and leave 2 % less at a latency of one frame."""


@dataclass(frozen=True)
class ModalGains:
    """What is best for each mode.

    Attributes:
        gain: Of the integrator.
        measured_m2: Variance of what will be measured in closed loop, noise included.
        noise_m2: Variance of the noise of one measurement, or what the air has that is as fast.
    """

    gain: Float[np.ndarray, " mode"]
    measured_m2: Float[np.ndarray, " mode"]
    noise_m2: Float[np.ndarray, " mode"]

    @property
    def residual_m2(self) -> Float[np.ndarray, " mode"]:
        """Variance that is left, of means over exposures; as uncertain as the noise, and so perhaps negative."""
        return self.measured_m2 - self.noise_m2


def temporal_spectrum(
    series_m: Float[np.ndarray, "frame mode"],
) -> tuple[Float[np.ndarray, " frequency"], Float[np.ndarray, "frequency mode"]]:
    """One-sided power spectrum per cycle per frame, whose sum over frequencies times their step is the variance.

    Welch's (1967) mean over half-overlapping segments under Hann's window, which hold at least four periods of the
    slowest wave together. The mean of a segment is taken out.

    Examples:
        >>> frequency, power = temporal_spectrum(np.random.default_rng(1).normal(size=(4096, 1)))
        >>> frequency.size, bool(abs(power.mean() - 2) < 0.1)
        (512, True)
    """
    segment = min(LONGEST_SEGMENT, len(series_m) // 4)
    frequency, power = scipy.signal.welch(np.asarray(series_m, float), nperseg=segment, axis=0)
    return frequency[1:], power[1:]


def noise_floor_m2(series_m: Float[np.ndarray, "frame mode"]) -> Float[np.ndarray, " mode"]:
    """Variance of white noise that would make the fast end of the spectrum.

    Examples:
        >>> noise = np.random.default_rng(1).normal(size=(4096, 1))
        >>> slow = np.sin(np.arange(4096.0)[:, None] / 40)
        >>> bool(abs(noise_floor_m2(slow + noise)[0] - 1) < 0.1)
        True
    """
    frequency, power = temporal_spectrum(series_m)
    return power[frequency >= 0.5 * FLOOR].mean(0) / 2


def optimal_gains(open_loop_m: Float[np.ndarray, "frame mode"], *, loop: IntegratorLoop) -> ModalGains:
    """The gain of each mode that leaves the least variance, up to `MARGIN` of what is stable.

    Args:
        open_loop_m: What was measured of each mode, or in a closed loop that plus the mirror's mean shape.
        loop: The integrator that the gains are for.

    Raises:
        SettingsError: If there are too few frames.

    Examples:
        >>> rng = np.random.default_rng(1)
        >>> walk, noise = rng.normal(size=(2, 4000, 2))
        >>> seen = np.cumsum(walk, 0) * [1.0, 0.03] + noise  # a mode of much air, and one of much noise
        >>> optimal_gains(seen, loop=IntegratorLoop()).gain.round(1).tolist()
        [0.6, 0.0]
    """
    if len(open_loop_m) < LEAST_FRAMES:
        raise SettingsError("open_loop_m", f"must be at least {LEAST_FRAMES} frames", len(open_loop_m))
    frequency, power = temporal_spectrum(open_loop_m)
    logarithm = np.linspace(np.log(SMALLEST_GAIN), np.log(MARGIN * loop.largest_stable_gain()), TRIED)
    left = abs(loop.rejection_transfer(frequency[:, None], np.exp(logarithm)[None, :])) ** 2
    measured = (frequency[1] - frequency[0]) * power.T @ left
    best = np.clip(measured.argmin(1), 1, TRIED - 2)
    below, at, above = (np.take_along_axis(measured, best[:, None] + side, 1)[:, 0] for side in (-1, 0, 1))
    bend = below - 2 * at + above
    shift = np.clip(np.where(bend > 0, (below - above) / (2 * np.where(bend > 0, bend, 1)), 0), -1, 1)
    gain = np.exp(logarithm[best] + shift * (logarithm[1] - logarithm[0]))
    return ModalGains(gain=gain, measured_m2=at, noise_m2=noise_floor_m2(open_loop_m))

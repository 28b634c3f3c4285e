r"""What a loop makes of each temporal frequency: of the air, and of the noise.

In means over exposures, with :math:`z = \exp(2 \pi i f)` and `f` in cycles per frame: the mirror is
:math:`M = (1 - s) z^{-d} + s z^{-d-1}` for a latency of :math:`d + s` frames, a controller makes commands
:math:`u = H y` of air and noise, and the residual is :math:`(1 - M H)\,a - M H\,\mathrm{noise}`.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float

UNSTABLE = 8.0
"""A gain that no latency bears; the largest that one does is 4, after a latency of a quarter of an exposure."""


def mirror_transfer(
    frequency_per_frame: Float[np.ndarray, "..."], *, latency_frames: float
) -> Complex[np.ndarray, "..."]:
    """Mean shape of the mirror over an exposure, over the command for that exposure.

    Examples:
        >>> abs(mirror_transfer(np.array([0.0, 0.5]), latency_frames=1.5)).round(9).tolist()
        [1.0, 0.0]
    """
    back = np.exp(-2j * np.pi * frequency_per_frame)
    whole, part = divmod(latency_frames, 1)
    return back**whole * (1 - part + part * back)


@dataclass(frozen=True)
class IntegratorLoop:
    """A loop closed by an integrator, but for its gain.

    Attributes:
        latency_frames: See `DelayLine`.
        leak: Share of the command kept from frame to frame.
        pseudo_open_loop: Whether the mirror's known shape is added to what is measured.

    Examples:
        >>> loop = IntegratorLoop(latency_frames=0.0)
        >>> abs(loop.rejection_transfer(np.array([0.0, 0.5]), 0.5)).round(3).tolist()  # overshoots the fastest wave
        [0.0, 1.333]
    """

    latency_frames: float = 0.0
    leak: float = 1.0
    pseudo_open_loop: bool = False

    def noise_transfer(
        self, frequency_per_frame: Float[np.ndarray, "..."], gain: float | Float[np.ndarray, "..."]
    ) -> Complex[np.ndarray, "..."]:
        """Shape of the mirror over the noise of what is measured; arrays of gains broadcast."""
        mirror = mirror_transfer(frequency_per_frame, latency_frames=self.latency_frames)
        seen = 1 if self.pseudo_open_loop else mirror
        return mirror * gain / (np.exp(2j * np.pi * frequency_per_frame) - self.leak + gain * seen)

    def rejection_transfer(
        self, frequency_per_frame: Float[np.ndarray, "..."], gain: float | Float[np.ndarray, "..."]
    ) -> Complex[np.ndarray, "..."]:
        """Residual over air."""
        return 1 - self.noise_transfer(frequency_per_frame, gain)

    def largest_stable_gain(self) -> float:
        r"""The gain below which the loop forgets a bump.

        By halving: every root of :math:`z^{d+1} (z - l) + g ((1 - s) z + s)` has to be within the unit circle. For a
        whole latency d without leak the limit is :math:`2 \sin(\pi / (4 d + 2))` (Levin & May 1976, Theor. Popul.
        Biol. 9, 178). A latency below half an exposure bears more than none: what is measured then is part of two
        commands. With pseudo-open-loop the limit is 1 + leak, whatever the latency.
        """
        if self.pseudo_open_loop:
            return 1 + self.leak
        whole, part = divmod(self.latency_frames, 1)
        stable, unstable = 0.0, UNSTABLE
        for _ in range(50):
            gain = (stable + unstable) / 2
            ways = np.zeros(int(whole) + 3)
            ways[:2] = 1, -self.leak
            ways[-2:] += gain * (1 - part), gain * part
            stable, unstable = (gain, unstable) if np.max(np.abs(np.roots(ways))) < 1 else (stable, gain)
        return stable

"""The modes that a linear sensor of a loop drives, and what is known of them beforehand."""

import math
from typing import NamedTuple

import numpy as np
import scipy.special
from jaxtyping import Float

from nlcwfs.beam.modes import KOLMOGOROV_SPECTRUM
from nlcwfs.config import Config
from nlcwfs.errors import SettingsError
from nlcwfs.mirror.mirror import Mirror
from nlcwfs.mirror.settings import MirrorSettings
from nlcwfs.simulation.closed_loop.light import LoopLight
from nlcwfs.simulation.exposure import wavelength_m


class DrivenModes(NamedTuple):
    """Karhunen-Loeve modes, the mirror's own or such as it makes, the driven ones first.

    Attributes:
        modes: Their shapes on the lit part of the light.
        driven: How many are driven.
        open_m2: Variance of each mode in the air.
        moved_m2: How much it changes from an exposure to the next, of those that are driven.
        to_command: From the driven modes to the mirror's own; None when they are its first.
        count: How many modes the mirror has.
    """

    modes: Mirror
    driven: int
    open_m2: Float[np.ndarray, " mode"]
    moved_m2: Float[np.ndarray, " driven"]
    to_command: Float[np.ndarray, "command driven"] | None
    count: int

    @classmethod
    def build(cls, config: Config, light: LoopLight, *, cutoff_cpa: float, setting: str) -> "DrivenModes":
        """The modes up to a frequency, of air whose strength and wind are known.

        Args:
            config: The settings.
            light: Air, pupil and mirror.
            cutoff_cpa: Highest frequency that is driven, cycles per aperture.
            setting: Where that comes from.

        Raises:
            SettingsError: If no mode is slow enough to be driven.
        """
        own = light.mirror
        modes = own if config.mirror.kind == "karhunen-loeve" else _ideal_modes(config, light, cutoff_cpa)
        cycles = np.asarray(modes.cycles_per_aperture, float)
        driven = int(np.sum(cycles <= cutoff_cpa))
        if not driven:
            raise SettingsError(setting, f"must be at least {cycles[0]:.2f}, the tilt's", cutoff_cpa)
        open_m2 = KOLMOGOROV_SPECTRUM * cycles ** (-11 / 3) * 4 / math.pi * strength_m2(config, light)
        return cls(
            modes=modes,
            driven=driven,
            open_m2=open_m2,
            moved_m2=open_m2[:driven] * moved_share(config, cycles[:driven]),
            to_command=None
            if modes is own
            else np.asarray(own.fit, float) @ np.asarray(modes.shapes, float)[:driven].T,
            count=own.count,
        )

    def commands(self, matrix: Float[np.ndarray, "driven signal"]) -> Float[np.ndarray, "command signal"]:
        """A reconstructor of the driven modes as one of the mirror's own; modes that are not driven rest."""
        if self.to_command is not None:
            return self.to_command @ matrix
        return np.pad(matrix, [(0, self.count - len(matrix)), (0, 0)])


def strength_m2(config: Config, light: LoopLight) -> float:
    """(D / r0)^(5/3) at the wavelength of sensing, in square metres of path: the unit of variances of this air."""
    still = light.still
    ratio = still.shape.diameter_m / still.air.fried_at(wavelength_m(config))
    return ratio ** (5 / 3) * (wavelength_m(config) / (2 * math.pi)) ** 2


def moved_share(config: Config, cycles: Float[np.ndarray, " mode"]) -> Float[np.ndarray, " mode"]:
    """Share of its variance by which a mode changes from an exposure to the next: wind from any side.

    A wave that wind turns by the angle a has the correlation cos a with itself, on the mean over its directions J0(a);
    it moves by twice what is missing to 1.

    Examples:
        >>> from nlcwfs.config import load_config
        >>> moved_share(load_config(None, ["loop.rate_hz=100"]), np.array([1.0])).round(5)  # a = 0.0785
        array([0.00308])
    """
    sky = config.atmosphere
    turn = 2 * np.pi * cycles / config.beam.diameter_m / config.loop.rate_hz
    layers = zip(sky.layer_fractions, sky.wind_speeds_m_per_s, strict=True)
    moved = [share * 2 * (1 - scipy.special.j0(turn * speed)) for share, speed in layers]
    return np.sum(moved, axis=0)


def _ideal_modes(config: Config, light: LoopLight, cutoff_cpa: float) -> Mirror:
    """Karhunen-Loeve modes up to what is driven and a little beyond, for a mirror of another kind."""
    still = light.still
    fastest = float(np.max(light.mirror.cycles_per_aperture))
    settings = MirrorSettings(kind="karhunen-loeve", cutoff_cpa=min(cutoff_cpa, fastest))
    pupil = still.shape.on(light.part)
    dtype = str(light.weights.dtype)
    return Mirror.build(settings, pupil, light.part, diameter_m=still.shape.diameter_m, dtype=dtype)

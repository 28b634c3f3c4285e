"""Error bars of a maximum a posteriori wavefront."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.modes import modal_basis
from nlcwfs.estimation.error_bars import ErrorBars, ModesInBands, error_bars
from nlcwfs.estimation.map_solution import Task
from nlcwfs.estimation.resolution_level import Level
from nlcwfs.estimation.sensor_geometry import SensorGeometry
from nlcwfs.estimation.sensor_model import mean_counts
from nlcwfs.estimation.settings import EstimationSettings

SEED = 2010
"""Of the random signs of the probes: the same frame always gets the same error bars."""

NOLL = 1.0299
"""Variance of Kolmogorov's phase over a disc, piston excluded, over (D / r0)^(5/3), rad^2 (Noll 1976)."""


CARRIED = 0.5
"""Modes told over lit pixels: the fastest have 0.8 of a half cycle per pixel."""

UNSEEN = 2.0
"""The light is known only as far as the phase is: an error of s rad^2 makes the variance 1 + 2 s times larger than the
information at the estimate says. Measured with 0.02 to 0.14 rad^2."""

UNSEEN_SLOW = 4.0
"""The same for the slowest modes: what is wrong with the speckles of fine waves passes for slow ones."""

UNSEEN_HALF_CPA = 8.0
"""... half as much for a mode of so many cycles per aperture. Both were measured on 60 screens each at D / r0 of 8.2
(2e3, 2e4, 2e5 photons) and 15, other screens than those of study 02, which judges them."""


class MapError(eqx.Module):
    """Tells how far a wavefront may be off.

    Attributes:
        level: The sensor on the grid of the model.
        modes: Modes whose errors are told, on the measured pixels of the model's window.
        strength_one: (D / r0)^(5/3) for turbulence of strength 1.
        averaged: Share of each mode's variance that the mean over detector pixels keeps.
        unseen: Growth of each mode's variance with the error of the phase, over rad^2.
    """

    level: Level
    modes: ModesInBands
    strength_one: Float[Array, ""]
    averaged: Float[Array, " mode"]
    unseen: Float[Array, " mode"]

    @classmethod
    def build(
        cls, geometry: SensorGeometry, settings: EstimationSettings, level: Level, air: Turbulence, *, dtype: str
    ) -> "MapError":
        """Modes of the pupil on the measured pixels.

        Args:
            geometry: The sensor.
            settings: Number of modes.
            level: The sensor on the grid of the model.
            air: Turbulence of strength 1.
            dtype: Precision.
        """
        diameter_m, wavelength_m = geometry.pupil.diameter_m, geometry.wavelength_m
        window = Grid(level.measured_shape, geometry.frame.pixel_m)
        pupil = geometry.pupil.on(window)
        count = max(1, min(settings.modes, int(CARRIED * np.sum(pupil**2))))
        basis = modal_basis(pupil, window, diameter_m=diameter_m, count=count)
        cycles = np.asarray(basis.cycles_per_aperture, float)
        return cls(
            level=level,
            modes=ModesInBands.build(basis, dtype=dtype),
            strength_one=jnp.asarray((diameter_m / air.fried_at(wavelength_m)) ** (5 / 3), dtype),
            averaged=jnp.asarray(kept_by_pixels(cycles * window.pixel_m / diameter_m), dtype),
            unseen=jnp.asarray(UNSEEN_SLOW / (1 + (cycles / UNSEEN_HALF_CPA) ** 2), dtype),
        )

    def bars(
        self,
        task: Task,
        phase_rad: Float[Array, "y x"],
        strength: Float[Array, ""],
        log_amplitude: Float[Array, "y x"] | None = None,
    ) -> ErrorBars:
        """Error of every mode of the wavefront's mean over pixels; the phase is on the model's grid, and whole.

        Of an amplitude that is estimated too it takes no account: what one takes from the other is not counted.
        """
        problem, level, expected = task.problem, self.level, task.problem.expected
        if log_amplitude is not None:
            expected = partial(mean_counts, task.level.twinkling(log_amplitude), task.scale)
        model, along = jax.linearize(expected, phase_rad)
        bars = error_bars(
            lambda pixels: along(level.on_cells(pixels[None])[0]),
            jnp.where(problem.usable, model + problem.dark, jnp.inf),
            self.modes,
            strength=self.strength_one * strength,
            photons=jnp.maximum(jnp.sum(problem.counts), 1),
            key=jax.random.key(SEED),
        )
        grown = self.averaged * (1 + self.unseen * bars.wavefront_rad**2)
        root = jnp.sqrt(grown[: self.modes.slow])
        changed = grown * bars.mode_rad2, root[:, None] * bars.slow_rad2 * root[None]
        return eqx.tree_at(lambda told: (told.mode_rad2, told.slow_rad2), bars, changed)

    def told_rad(self, bars: ErrorBars, strength: Float[Array, ""], believed: Bool[Array, ""]) -> Float[Array, ""]:
        """Expected rms error of the wavefront; the error bars count the turbulence finer than the modes.

        A wavefront that is not believed tells no more than the turbulence did before: of the strength that the
        frame shows, or of what is usual where that is more.
        """
        square = bars.wavefront_rad**2
        known = jnp.sqrt(square * (1 + UNSEEN * square))
        unknown = jnp.sqrt(NOLL * self.strength_one * jnp.maximum(strength, 1))
        return jnp.where(believed, known, unknown)


def kept_by_pixels(cycles_per_pixel: Float[np.ndarray, " mode"]) -> Float[np.ndarray, " mode"]:
    """Share of the variance of waves, of any direction, that the mean over square pixels keeps.

    Examples:
        >>> kept_by_pixels(np.array([0.0, 0.1, 0.5])).round(2).tolist()
        [1.0, 0.97, 0.41]
    """
    angle = (np.arange(32) + 0.5) * (np.pi / 2 / 32)
    along = np.sinc(cycles_per_pixel[:, None] * np.cos(angle)) * np.sinc(cycles_per_pixel[:, None] * np.sin(angle))
    return np.mean(along**2, axis=1)

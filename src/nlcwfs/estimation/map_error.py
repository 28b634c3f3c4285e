"""Error bars of a maximum a posteriori wavefront."""

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
from nlcwfs.estimation.settings import EstimationSettings

SEED = 2010
"""Of the random signs of the probes: the same frame always gets the same error bars."""

NOLL = 1.0299
"""Variance of Kolmogorov's phase over a disc, piston excluded, over (D / r0)^(5/3), rad^2 (Noll 1976)."""


CARRIED = 0.5
"""Modes told over lit pixels: the fastest have 0.8 of a half cycle per pixel."""

UNSEEN = 2.0
"""The light is known only as far as the phase is: an error of s rad^2 makes the variances 1 + 2 s times larger than the
information at the estimate says. Measured with 0.03 to 0.12 rad^2 (study 02)."""


class MapError(eqx.Module):
    """Tells how far a wavefront may be off.

    Attributes:
        level: The sensor on the grid of the model.
        modes: Modes whose errors are told, on the measured pixels of the model's window.
        strength_one: (D / r0)^(5/3) for turbulence of strength 1.
    """

    level: Level
    modes: ModesInBands
    strength_one: Float[Array, ""]

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
        return cls(
            level=level,
            modes=ModesInBands.build(basis, dtype=dtype),
            strength_one=jnp.asarray((diameter_m / air.fried_at(wavelength_m)) ** (5 / 3), dtype),
        )

    def bars(self, task: Task, phase_rad: Float[Array, "y x"], strength: Float[Array, ""]) -> ErrorBars:
        """Error of every mode at a wavefront, on the model's grid with everything included."""
        problem, level = task.problem, self.level
        model, along = jax.linearize(problem.expected, phase_rad)
        return error_bars(
            lambda pixels: along(level.on_cells(pixels[None])[0]),
            jnp.where(problem.usable, model + problem.dark, jnp.inf),
            self.modes,
            strength=self.strength_one * strength,
            photons=jnp.maximum(jnp.sum(problem.counts), 1),
            key=jax.random.key(SEED),
        )

    def told_rad(self, bars: ErrorBars, strength: Float[Array, ""], believed: Bool[Array, ""]) -> Float[Array, ""]:
        """Expected rms error of the wavefront; the error bars count the turbulence finer than the modes.

        A wavefront that is not believed tells no more than the turbulence did before: of the strength that the
        frame shows, or of what is usual where that is more.
        """
        square = bars.wavefront_rad**2
        known = jnp.sqrt(square * (1 + UNSEEN * square))
        unknown = jnp.sqrt(NOLL * self.strength_one * jnp.maximum(strength, 1))
        return jnp.where(believed, known, unknown)

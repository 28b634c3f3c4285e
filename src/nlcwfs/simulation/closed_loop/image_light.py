"""The mean images of a loop's curvature sensor as a function of the wavefront, which a linear reconstructor derives."""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.fft
import scipy.special
from jaxtyping import Array, Float, Int

from nlcwfs.beam.grid import Grid
from nlcwfs.config import Config
from nlcwfs.curvature_sensor.defocused_images import CurvatureSensor
from nlcwfs.detector.pixels import integrate_on_pixels
from nlcwfs.estimation.resolution_level import sum_blocks
from nlcwfs.estimation.speckle_blur import blurred, unmodelled_structure
from nlcwfs.estimation.turbulence_filter import half_plane_frequencies
from nlcwfs.simulation.closed_loop.light import LoopLight
from nlcwfs.simulation.closed_loop.loop_waves import LoopWaves
from nlcwfs.simulation.exposure import distances_m, wavelength_m
from nlcwfs.simulation.known_sensor import geometry_of

AT_LEAST = 64
"""Cells of the model across the pupil, if the light's cells can be put together so. With 32 the rim alone adds 0.28 to
a chi-square of 1 (2 m, 16 pixels), with 64 0.06."""


class ImageLight(eqx.Module):
    """From a wavefront on the lit cells of a loop's light to the mean photons on the detector's pixels.

    The model is coarser than the light that makes the exposures, like that of any reconstructor here.

    Attributes:
        sensor: On the cells of the model.
        coherence: What is left of every wave of the images in the mean over random wavefronts; 1 for a known one.
        rows: Row of every lit cell of the light ...
        columns: ... and its column, on a grid that the model's cells divide.
        weights: Light of every lit cell.
        shape: Cells of that grid.
        coarser: Cells of the light along one of the model.
        factor: Cells of the model along a pixel.
        window: Pixels.
    """

    sensor: CurvatureSensor
    coherence: Float[Array, "plane y fx"]
    rows: Int[np.ndarray, " lit"]
    columns: Int[np.ndarray, " lit"]
    weights: Float[Array, " lit"]
    shape: tuple[int, int] = eqx.field(static=True)
    coarser: int = eqx.field(static=True)
    factor: int = eqx.field(static=True)
    window: tuple[int, int] = eqx.field(static=True)

    @classmethod
    def build(cls, config: Config, light: LoopLight) -> "ImageLight":
        """The model of a loop's sensor.

        Raises:
            SettingsError: If settings contradict each other.
        """
        still, lit = light.still, np.asarray(light.weights) > 0
        across = still.shape.diameter_m / still.light.pixel_m
        parts = (part for part in range(still.factor, 1, -1) if still.factor % part == 0)
        coarser = next((part for part in parts if across / part >= AT_LEAST * (1 - 1e-9)), 1)
        size = math.ceil(still.light.shape[0] / coarser)
        while (size * coarser - lit.shape[0]) % 2 or size != scipy.fft.next_fast_len(size):
            size += 1
        grid = Grid((size, size), still.light.pixel_m * coarser)
        sensor = geometry_of(config, still).model(grid, dtype=str(light.weights.dtype))
        rows, columns = np.nonzero(lit)
        corner = [(size * coarser - part) // 2 for part in lit.shape]
        return cls(
            sensor=sensor,
            coherence=jnp.ones((sensor.transfer.shape[1], size, size // 2 + 1), light.weights.dtype),
            rows=rows + corner[0],
            columns=columns + corner[1],
            weights=light.weights[lit],
            shape=(size * coarser, size * coarser),
            coarser=coarser,
            factor=still.factor // coarser,
            window=(still.window[0], still.window[1]),
        )

    def __call__(self, values_m: Float[Array, " lit"]) -> Float[Array, "plane v u"]:
        """Photons of every pixel, of one that the whole sensor gets."""
        both = jnp.stack([self.weights * values_m, self.weights])
        cells = jnp.zeros((2, *self.shape), both.dtype).at[:, self.rows, self.columns].set(both)
        summed = sum_blocks(cells, self.coarser)
        opd_m = jnp.where(summed[1] > 0, summed[0] / jnp.where(summed[1] > 0, summed[1], 1), 0)
        images = blurred(self.sensor.images(opd_m, 1.0).photons, self.coherence)
        return integrate_on_pixels(images, factor=self.factor, window=self.window)

    def amid(
        self, config: Config, light: LoopLight, waves: LoopWaves, driven_m2: Float[np.ndarray, " driven"]
    ) -> "ImageLight":
        r"""The same, in the mean over the wavefronts that are left of the air.

        Waves of frequency f in an image at z come from pairs of points :math:`\lambda z f` apart and fade by
        :math:`\exp(-D(\lambda z f)/2)`, D the structure function of the random part of the phase: exact for Gaussian
        phases that are alike everywhere. The mean derivative fades alike.

        Args:
            config: The settings.
            light: Air and pupil.
            waves: Its modes.
            driven_m2: Variance of what is left of the driven ones; those beyond are the air's.
        """
        size = self.coherence.shape[1]
        grid = Grid((size, size), self.sensor.pixel_m)
        frequency, wave_m = half_plane_frequencies(grid), wavelength_m(config)
        apart_m = [wave_m * abs(z_m) * frequency for z_m in distances_m(config)]
        table_m = np.linspace(0, float(np.max(apart_m)), 600)
        structure = residual_structure(table_m, light, waves, driven_m2)
        coherence = np.stack([np.exp(-np.interp(apart, table_m, structure) / 2) for apart in apart_m])
        return eqx.tree_at(lambda one: one.coherence, self, jnp.asarray(coherence, self.coherence.dtype))


def residual_structure(
    separation_m: Float[np.ndarray, " separation"],
    light: LoopLight,
    waves: LoopWaves,
    driven_m2: Float[np.ndarray, " driven"],
) -> Float[np.ndarray, " separation"]:
    """Structure function of what a loop leaves, rad^2: driven modes from any side, and all of the air beyond.

    Args:
        separation_m: Between two points.
        light: Air and pupil.
        waves: Modes of the loop.
        driven_m2: Variance that is left of the driven ones.
    """
    wave_m = light.still.wavelength_m
    cycles_per_m = waves.cycles[: waves.driven] / light.still.shape.diameter_m
    apart = 1 - scipy.special.j0(2 * np.pi * cycles_per_m * separation_m[:, None])
    driven = 2 * apart @ driven_m2 * (2 * np.pi / wave_m) ** 2
    finest = float(np.max(cycles_per_m))
    return driven + unmodelled_structure(separation_m, light.still.air, wavelength_m=wave_m, cutoff_per_m=finest)

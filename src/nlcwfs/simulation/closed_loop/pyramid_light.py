"""The light of a pyramid sensor in a loop: the loop's own cells, and the pixels of four pupil images."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.comparison_sensors.pyramid import Pyramid
from nlcwfs.config import Config
from nlcwfs.errors import SettingsError
from nlcwfs.simulation.exposure import Exposure, ExposureSimulator, wavelength_m


class PyramidOptics(eqx.Module):
    """A prism behind the same air and the same mirror as the curvature sensor, on the same cells.

    Attributes:
        still: Grid, pupil, photons and camera.
        sensor: The prism, on the part of the grid that holds the pupil.
    """

    still: ExposureSimulator
    sensor: Pyramid

    @classmethod
    def build(cls, config: Config, still: ExposureSimulator, part: Grid) -> "PyramidOptics":
        """Put the prism into the focus.

        Args:
            config: The settings.
            still: Grid, pupil, photons and camera of the loop.
            part: The part of the grid of the light that holds the pupil.

        Raises:
            SettingsError: If the pixels are finer than the cells of the light.
            SamplingError: If the cells are too wide for the modulation.
        """
        across = still.shape.diameter_m / part.pixel_m
        if config.pyramid.pixels > across * (1 + 1e-9):
            rule = f"must be at most {across:g}, the cells of the light across the telescope"
            raise SettingsError("pyramid.pixels", rule, config.pyramid.pixels)
        return cls(still=still, sensor=pyramid_on(config, still, part))

    def images(self, opd_m: Float[Array, "lit_y lit_x"], photons: float) -> Float[Array, "image v u"]:
        """The pupil images of one moment, see `LoopOptics`; every moment has its whole circle."""
        return self.sensor.images(opd_m, photons).photons

    def read(self, opd_m: Float[Array, "Y X"], images: Float[Array, "image v u"], key: PRNGKeyArray) -> Exposure:
        """What the detector reads of the sum, see `LoopOptics`."""
        missed = 1 - jnp.sum(images) / self.still.photons
        return Exposure(
            opd_m=opd_m,
            photons=images,
            frames=self.still.detector.read(images, key),
            truth_m=self.still.on_pixels(opd_m),
            lost=jnp.broadcast_to(missed, images.shape[:1]),
        )


def pyramid_on(config: Config, still: ExposureSimulator, cells: Grid) -> Pyramid:
    """The prism of a configuration on any cells."""
    return Pyramid.build(
        still.shape.on(cells),
        cells,
        diameter_m=still.shape.diameter_m,
        spectrum=Spectrum.monochromatic(wavelength_m(config)),
        settings=config.pyramid,
        dtype=str(still.weights.dtype),
    )

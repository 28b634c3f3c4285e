"""How light becomes counts in a loop, the same few words for every sensor."""

from typing import Protocol, runtime_checkable

import equinox as eqx
from jaxtyping import Array, Float, PRNGKeyArray

from nlcwfs.simulation.exposure import Exposure, ExposureSimulator


@runtime_checkable
class LoopOptics(Protocol):
    """The optics and the detector of a sensor, lit by what the mirror leaves of the air.

    Images are whatever the sensor's light falls on; their sum over the moments of an exposure is read once.
    """

    def images(self, opd_m: Float[Array, "lit_y lit_x"], photons: float) -> Float[Array, "image v u"]:
        """Photons of one moment.

        Args:
            opd_m: Wavefront on the part of the light's grid that holds the pupil, without piston.
            photons: Photons of the whole sensor in this moment.
        """
        ...

    def read(self, opd_m: Float[Array, "Y X"], images: Float[Array, "image v u"], key: PRNGKeyArray) -> Exposure:
        """Let the detector read what the moments have summed up.

        Args:
            opd_m: Mean wavefront on the whole grid of the light; it only goes into the record.
            images: Sum of `images`.
            key: Random key of the detector's noise.
        """
        ...


class CurvatureOptics(eqx.Module):
    """The defocused pupil images, on the grid of the light until they are read."""

    still: ExposureSimulator

    def images(
        self, opd_m: Float[Array, "lit_y lit_x"], photons: float, *, factor: Float[Array, "1 Y X"] | None = None
    ) -> Float[Array, "image v u"]:
        """Photons of one moment, see `LoopOptics`; and `CurvatureSensor.images` for the factor."""
        return self.still.sensor.images(self.still.on_light(opd_m), photons, factor=factor).photons

    def read(self, opd_m: Float[Array, "Y X"], images: Float[Array, "image v u"], key: PRNGKeyArray) -> Exposure:
        """What the detector reads of the sum, see `LoopOptics`."""
        return self.still.read(opd_m, images, key)

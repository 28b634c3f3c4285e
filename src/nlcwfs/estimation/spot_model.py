"""What the spots of a Shack-Hartmann sensor look like and how they move: known from the optics, or learnt in a loop."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.comparison_sensors.shack_hartmann import ShackHartmann
from nlcwfs.errors import SettingsError

CALIBRATION_STEP = 0.02
"""Tilt of a calibration in lambda / d: its third-order error is 1e-3 of the response."""


class SpotModel(eqx.Module):
    """What spots look like and how they move: to build and to calibrate filters with.

    Attributes:
        mean: Photons expected on every pixel; a single spot stands for all.
        along_y: Change of `mean` per radian of slope along y.
        along_x: The same along x.
        pixel_rad: Width of a pixel.
    """

    mean: Float[Array, "spot v u"]
    along_y: Float[Array, "spot v u"]
    along_x: Float[Array, "spot v u"]
    pixel_rad: float = eqx.field(static=True)

    @classmethod
    def of_sensor(cls, sensor: ShackHartmann, *, photons: float = 1.0) -> "SpotModel":
        """The spots of a flat wavefront and how they answer to a small tilt, from the optics themselves.

        Args:
            photons: Photons of the whole pupil in an exposure.

        Raises:
            SettingsError: If there are no photons.
        """
        if not photons > 0:
            raise SettingsError("photons", "must be positive", photons)
        across = sensor.subapertures * sensor.amplitude.shape[1]
        ramp_m = jnp.asarray((np.arange(across) - (across - 1) / 2) * sensor.cell_m, sensor.amplitude.dtype)
        wavelength_m = float(np.dot(sensor.spectrum.wavelengths_m, sensor.spectrum.shares))
        step = CALIBRATION_STEP * wavelength_m / sensor.subaperture_m
        flat_m = jnp.zeros((across, across), ramp_m.dtype)
        moved = []
        for slope_m in (flat_m + step * ramp_m[:, None], flat_m + step * ramp_m[None, :]):
            there, back = sensor.images(slope_m, photons).photons, sensor.images(-slope_m, photons).photons
            moved.append((there - back) / (2 * step))
        mean = sensor.images(flat_m, photons).photons
        return cls(mean, moved[0], moved[1], sensor.pixel_rad)

    @classmethod
    def of_mean(cls, mean: Float[Array, "spot v u"], *, pixel_rad: float) -> "SpotModel":
        """Spots as they were seen, and how they would move as they are.

        The slope of the light is a difference over five pixels, right to a percent for eight pixels per lambda / d;
        beyond the edge there is no light.
        """

        def slope_along(axis: int) -> Float[Array, "spot v u"]:
            margins = [(0, 0), (2, 2) if axis == 1 else (0, 0), (2, 2) if axis == 2 else (0, 0)]
            wide = jnp.pad(mean, margins)
            size = mean.shape[axis]
            part = [jax.lax.slice_in_dim(wide, first, first + size, axis=axis) for first in range(5)]
            return -(part[0] - 8 * part[1] + 8 * part[3] - part[4]) / (12 * pixel_rad)

        return cls(mean, slope_along(1), slope_along(2), pixel_rad)


class MeanSpot(eqx.Module):
    """The running mean of what all spots look like, centred on the optical axis.

    Mirrored copies of the mean enter with it, so that it learns the shape and not the place: a filter made from it
    stays anchored to the reference and a loop that uses it does not drift.

    Attributes:
        shape: Share of a spot's light on every pixel.
        memory: Weight of what was known in each update.

    Examples:
        >>> spot = MeanSpot(jnp.ones((1, 4, 4)) / 16, memory=0.5)
        >>> frame = jnp.zeros((3, 4, 4)).at[:, 1, 1].set(7.0)
        >>> [round(float(share), 3) for share in spot.updated(frame).shape[0, 1]]
        [0.031, 0.156, 0.156, 0.031]
    """

    shape: Float[Array, "1 v u"]
    memory: float = eqx.field(static=True)

    def updated(self, electrons: Float[Array, "spot v u"]) -> "MeanSpot":
        """Take in one exposure; one without light changes nothing."""
        seen = jnp.sum(electrons, axis=0)
        seen = seen + seen[::-1]
        seen = jnp.maximum(seen + seen[:, ::-1], 0)
        total = jnp.sum(seen)
        mixed = self.memory * self.shape + (1 - self.memory) * (seen / jnp.where(total > 0, total, 1))[None]
        return MeanSpot(jnp.where(total > 0, mixed, self.shape), self.memory)

    def model(self, *, pixel_rad: float) -> SpotModel:
        """The spot and how it moves, for a filter that serves all subapertures."""
        return SpotModel.of_mean(self.shape, pixel_rad=pixel_rad)

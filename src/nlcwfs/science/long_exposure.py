"""The image of a star while the wavefront changes: the mean of its instantaneous images."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from nlcwfs.beam.grid import Grid
from nlcwfs.science.coronagraph import coronagraphic_image
from nlcwfs.science.point_spread_function import point_spread_function, strehl_ratio


class LongExposure(eqx.Module):
    """Adds up images at one wavelength; begun by `LongExposure.init`.

    The sum is kept in the precision it began with: each image is rounded at 6e-8 of the sum in single precision,
    so ten thousand are right to 6e-4 at worst.

    Attributes:
        pupil: Amplitude from 0 to 1.
        image_sum: Sum of the images so far, each in units of the peak without aberration.
        strehl_sum: Sum of their intensities on the axis.
        exposures: How many there are.
        wavelength_m: Wavelength of the image; need not be that of the sensor.
        pixel_m: Width of a pixel at the pupil.
        angles: Directions on the sky; its `pixel_m` is read as radians per pixel.
        coronagraph: Whether an ideal coronagraph stands before the camera; the Strehl ratio is that without it.
    """

    pupil: Float[Array, "y x"]
    image_sum: Float[Array, "v u"]
    strehl_sum: Float[Array, ""]
    exposures: Int[Array, ""]
    wavelength_m: float = eqx.field(static=True)
    pixel_m: float = eqx.field(static=True)
    angles: Grid = eqx.field(static=True)
    coronagraph: bool = eqx.field(static=True, default=False)

    @classmethod
    def init(
        cls,
        pupil: Float[np.ndarray, "y x"] | Float[Array, "y x"],
        *,
        wavelength_m: float,
        pixel_m: float,
        angles: Grid,
        dtype: str = "float32",
        coronagraph: bool = False,
    ) -> "LongExposure":
        """Begin with no image at all.

        Args:
            pupil: Amplitude from 0 to 1.
            wavelength_m: Wavelength of the image.
            pixel_m: Width of a pixel at the pupil.
            angles: Directions on the sky; its `pixel_m` is read as radians per pixel.
            dtype: Precision of the sums.
            coronagraph: Whether an ideal coronagraph stands before the camera.

        Examples:
            >>> exposure = LongExposure.init(
            ...     np.ones((8, 8)), wavelength_m=1e-6, pixel_m=1.0, angles=Grid((3, 3), 1e-8)
            ... )
            >>> for piston_m in (0.0, 1e-7):
            ...     exposure = exposure.add(jnp.full((8, 8), piston_m))
            >>> int(exposure.exposures), round(float(exposure.strehl), 5), round(float(exposure.image.max()), 5)
            (2, 1.0, 1.0)
        """
        return cls(
            pupil=jnp.asarray(pupil, dtype),
            image_sum=jnp.zeros(angles.shape, dtype),
            strehl_sum=jnp.zeros((), dtype),
            exposures=jnp.zeros((), jnp.int32),
            wavelength_m=wavelength_m,
            pixel_m=pixel_m,
            angles=angles,
            coronagraph=coronagraph,
        )

    def add(self, opd_m: Float[Array | np.ndarray, "y x"]) -> "LongExposure":
        """The same with one more image, of a residual wavefront; all count alike."""
        opd_m = jnp.asarray(opd_m, self.image_sum.dtype)
        imaged = coronagraphic_image if self.coronagraph else point_spread_function
        image = imaged(self.pupil, opd_m, wavelength_m=self.wavelength_m, pixel_m=self.pixel_m, angles=self.angles)
        strehl = strehl_ratio(self.pupil, opd_m, wavelength_m=self.wavelength_m)
        return LongExposure(
            self.pupil,
            self.image_sum + image,
            self.strehl_sum + strehl,
            self.exposures + 1,
            self.wavelength_m,
            self.pixel_m,
            self.angles,
            self.coronagraph,
        )

    @property
    def image(self) -> Float[Array, "v u"]:
        """The long exposure, in units of the peak without aberration; NaN before the first image."""
        return self.image_sum / self.exposures.astype(self.image_sum.dtype)

    @property
    def strehl(self) -> Float[Array, ""]:
        """Mean intensity on the axis over that of a perfect telescope: a tilt that stays lowers it as jitter does."""
        return self.strehl_sum / self.exposures.astype(self.strehl_sum.dtype)

    @property
    def total(self) -> Float[Array, ""]:
        r"""Sum of the image over all directions, those outside its window included.

        By Parseval :math:`\lambda^2 \sum A^2 / (\sum A)^2`, over the areas of a pixel at the pupil and on the sky;
        without aberration as with.
        """
        pixels = self.pixel_m * self.angles.pixel_m / self.wavelength_m
        return jnp.sum(self.pupil**2) / (jnp.sum(self.pupil) * pixels) ** 2

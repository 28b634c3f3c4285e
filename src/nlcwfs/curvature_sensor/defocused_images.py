"""The forward model: from a wavefront to images of the pupil out of focus."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from nlcwfs.beam.field import pupil_field
from nlcwfs.beam.fresnel import fresnel_transfer
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.errors import SettingsError


class Planes(eqx.Module):
    """Light on the defocused planes.

    Attributes:
        photons: Photons per grid pixel and exposure, for each plane.
        pixel_m: Width of a grid pixel at the scale of the telescope.
    """

    photons: Float[Array, "plane y x"]
    pixel_m: float = eqx.field(static=True)


class CurvatureSensor(eqx.Module):
    """Images of the pupil at signed distances from it.

    The distances and shares are those of the optics; the grid is the caller's: fine and wide for the light that
    makes test images, coarse for the model inside a reconstructor.

    Attributes:
        pupil: Amplitude of the pupil, 0 to 1.
        transfer: Fresnel factor of each colour and plane.
        flux_fractions: Share of the light of each plane.
        static_opd_m: Known aberration in the arm of the sensor, added to the incoming wavefront.
        spectrum: Colours of the light.
        pixel_m: Width of a grid pixel.

    Examples:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> from nlcwfs.beam.grid import Grid
        >>> from nlcwfs.beam.spectrum import Spectrum
        >>> sensor = CurvatureSensor.build(
        ...     np.ones((16, 16)),
        ...     Grid((32, 32), pixel_m=0.5),
        ...     distances_m=(-2.5e6, 2.5e6),
        ...     spectrum=Spectrum.monochromatic(0.85e-6),
        ... )
        >>> planes = sensor.images(jnp.zeros((32, 32)), photons=1000.0)
        >>> planes.photons.shape, round(float(planes.photons.sum()))
        ((2, 32, 32), 1000)
    """

    pupil: Float[Array, "y x"]
    transfer: Complex[Array, "colour plane y x"]
    flux_fractions: Float[Array, " plane"]
    static_opd_m: Float[Array, "y x"]
    spectrum: Spectrum = eqx.field(static=True)
    pixel_m: float = eqx.field(static=True)

    @classmethod
    def build(
        cls,
        pupil: Float[np.ndarray, "py px"],
        grid: Grid,
        *,
        distances_m: Sequence[float],
        spectrum: Spectrum,
        flux_fractions: Sequence[float] | None = None,
        static_opd_m: Float[np.ndarray, "py px"] | None = None,
        dtype: str = "float32",
    ) -> "CurvatureSensor":
        """Precompute the travel to every plane.

        Args:
            pupil: Amplitude, 0 to 1, on the grid's pixels; a smaller map is centred in the grid.
            grid: Where the light is computed; wide enough that nothing leaves it, see `beam.sampling`.
            distances_m: Signed distance of each plane from the pupil, positive downstream.
            spectrum: Colours of the light.
            flux_fractions: Share of each plane, sum 1; equal shares when left out.
            static_opd_m: Known aberration in the arm of the sensor, same pixels as the pupil.
            dtype: Precision of the light.

        Raises:
            SettingsError: If the planes, the shares or the pupil contradict each other or the grid.
        """
        distances = tuple(float(distance) for distance in distances_m)
        if not distances or not np.all(np.isfinite(distances)):
            raise SettingsError("curvature_sensor.distances_m", "must be finite, at least one", distances)
        fractions = np.full(len(distances), 1 / len(distances)) if flux_fractions is None else flux_fractions
        fractions = np.asarray(fractions, float)
        shared = fractions.shape == (len(distances),) and fractions.min() > 0 and abs(fractions.sum() - 1) <= 1e-6
        if not shared:  # NaN included
            raise SettingsError("curvature_sensor.flux_fractions", "must be one per plane, positive, sum 1", fractions)
        if not np.all(np.isfinite(pupil)):
            bad = np.size(pupil) - np.isfinite(pupil).sum()
            raise SettingsError("pupil", "must be finite", f"{bad} pixels that are not")
        if not np.any(pupil):
            raise SettingsError("pupil", "must let some light through", "zeros everywhere")
        static = np.zeros_like(pupil, float) if static_opd_m is None else static_opd_m
        transfer = [
            [
                fresnel_transfer(grid.shape, distance_m=distance, wavelength_m=colour, pixel_m=grid.pixel_m)
                for distance in distances
            ]
            for colour in spectrum.wavelengths_m
        ]
        return cls(
            pupil=jnp.asarray(centred_in(pupil, grid.shape), dtype),
            transfer=jnp.asarray(np.array(transfer), np.result_type(dtype, np.complex64)),
            flux_fractions=jnp.asarray(fractions, dtype),
            static_opd_m=jnp.asarray(centred_in(static, grid.shape), dtype),
            spectrum=spectrum,
            pixel_m=grid.pixel_m,
        )

    def images(self, opd_m: Float[Array, "y x"], photons: float | Float[Array, ""]) -> Planes:
        """The photons on every plane.

        Args:
            opd_m: Wavefront at the pupil, positive for a longer path; what lies outside the pupil does not count.
            photons: Photons of the whole sensor in one exposure.

        Returns:
            Photons per pixel; over all planes they sum to `photons`.
        """
        opd_m = opd_m.astype(self.static_opd_m.dtype) + self.static_opd_m
        total = jnp.zeros(self.transfer.shape[1:], opd_m.dtype)
        for colour, (wavelength_m, share) in enumerate(
            zip(self.spectrum.wavelengths_m, self.spectrum.shares, strict=True)
        ):
            near = pupil_field(self.pupil, opd_m, wavelength_m=wavelength_m, photons=share * photons)
            far = jnp.fft.ifft2(jnp.fft.fft2(near)[None] * self.transfer[colour])
            total = total + self.flux_fractions[:, None, None] * (far.real**2 + far.imag**2)
        return Planes(total, self.pixel_m)


def centred_in(array: Float[np.ndarray, "py px"], shape: tuple[int, int]) -> Float[np.ndarray, "y x"]:
    """The array with zeros around it, its centre on the centre of the new shape.

    Raises:
        SettingsError: If it does not fit, or if its centre cannot fall on the new centre (odd against even).
    """
    inner = np.shape(array)
    margins = [outer - size for outer, size in zip(shape, inner, strict=True)]
    if min(margins) < 0 or any(margin % 2 for margin in margins):
        raise SettingsError("grid.shape", f"must exceed the pupil's {inner} by an even number of pixels", tuple(shape))
    return np.pad(np.asarray(array, float), [(margin // 2, margin // 2) for margin in margins])

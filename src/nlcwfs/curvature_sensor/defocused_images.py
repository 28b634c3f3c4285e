"""The forward model: from a wavefront to images of the pupil out of focus."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Shaped

from nlcwfs.beam.field import pupil_field
from nlcwfs.beam.fresnel import fresnel_transfer
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.curvature_sensor.apparent_star import POINT, ApparentStar
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
        transfer: Fresnel factor of each colour and plane; one for all colours where they share it.
        visibility: What the size of the star leaves of each frequency of an image, by colour or for all; None for a
            point.
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
    visibility: Float[Array, "size plane y fx"] | None
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
        distances_m: Sequence[float] | Float[np.ndarray, "colour plane"],
        spectrum: Spectrum,
        flux_fractions: Sequence[float] | None = None,
        static_opd_m: Float[np.ndarray, "py px"] | None = None,
        star: ApparentStar = POINT,
        dtype: str = "float32",
    ) -> "CurvatureSensor":
        """Precompute the travel to every plane.

        Args:
            pupil: Amplitude, 0 to 1, on the grid's pixels; a smaller map is centred in the grid.
            grid: Where the light is computed; wide enough that nothing leaves it, see `beam.sampling`.
            distances_m: Signed distance of each plane from the pupil, positive downstream; a row for each colour where
                lenses are chromatic, see `curvature_sensor.chromatic_lenses`.
            spectrum: Colours of the light.
            flux_fractions: Share of each plane, sum 1; equal shares when left out.
            static_opd_m: Known aberration in the arm of the sensor, same pixels as the pupil.
            star: Where each colour comes from, and how large the star is.
            dtype: Precision of the light.

        Raises:
            SettingsError: If the planes, the shares or the pupil contradict each other or the grid.
        """
        distances = _by_colour(distances_m, spectrum)
        planes = distances.shape[1]
        fractions = np.full(planes, 1 / planes) if flux_fractions is None else flux_fractions
        fractions = np.asarray(fractions, float)
        shared = fractions.shape == (planes,) and fractions.min() > 0 and abs(fractions.sum() - 1) <= 1e-6
        if not shared:  # NaN included
            raise SettingsError("curvature_sensor.flux_fractions", "must be one per plane, positive, sum 1", fractions)
        if not np.all(np.isfinite(pupil)):
            bad = np.size(pupil) - np.isfinite(pupil).sum()
            raise SettingsError("pupil", "must be finite", f"{bad} pixels that are not")
        if not np.any(pupil):
            raise SettingsError("pupil", "must let some light through", "zeros everywhere")
        static = np.zeros_like(pupil, float) if static_opd_m is None else static_opd_m
        return cls(
            pupil=jnp.asarray(centred_in(pupil, grid.shape), dtype),
            transfer=jnp.asarray(_transfer(grid, distances, spectrum, star=star, dtype=dtype)),
            visibility=None if star.size_rad == 0 else jnp.asarray(_visibility(grid, distances, star), dtype),
            flux_fractions=jnp.asarray(fractions, dtype),
            static_opd_m=jnp.asarray(centred_in(static, grid.shape), dtype),
            spectrum=spectrum,
            pixel_m=grid.pixel_m,
        )

    def images(
        self,
        opd_m: Float[Array, "y x"],
        photons: float | Float[Array, ""],
        *,
        factor: Shaped[Array, "seen y x"] | None = None,
    ) -> Planes:
        """The photons on every plane.

        Args:
            opd_m: Wavefront at the pupil, positive for a longer path; what lies outside the pupil does not count.
            photons: Photons of the whole sensor in one exposure.
            factor: What multiplies the field at the pupil, an amplitude or a complex number: one map for all colours,
                or one for each. See `beam.air_at_pupil`.

        Returns:
            Photons per pixel; over all planes they sum to `photons`, but for what the factor takes or adds.
        """
        opd_m = opd_m.astype(self.static_opd_m.dtype) + self.static_opd_m
        kind, smear = self.transfer.dtype, self.visibility
        own_smear = smear if smear is not None and len(smear) > 1 else None  # else the sum is smeared, once

        common = None if factor is None or len(factor) > 1 else factor[0]

        def light_of(wavelength_m, share, transfer, visibility, own_factor) -> Array:
            near = pupil_field(self.pupil, opd_m, wavelength_m=wavelength_m, photons=share * photons)
            changed = common if own_factor is None else own_factor
            near = near if changed is None else near * changed.astype(kind)
            far = jnp.fft.ifft2(jnp.fft.fft2(near)[None] * (self.transfer[0] if transfer is None else transfer))
            light = self.flux_fractions[:, None, None] * (far.real**2 + far.imag**2)
            return light if visibility is None else jnp.fft.rfft2(light) * visibility.astype(kind)

        wavelengths_m, shares = self.spectrum.wavelengths_m, self.spectrum.shares
        if len(shares) == 1:
            total = light_of(wavelengths_m[0], shares[0], None, None, None)
        else:
            own_transfer = self.transfer if len(self.transfer) > 1 else None
            own_factor = factor if common is None else None
            colours = (jnp.asarray(wavelengths_m, opd_m.dtype), jnp.asarray(shares, opd_m.dtype))
            shape, dtype = (self.transfer.shape, opd_m.dtype) if own_smear is None else (own_smear.shape, kind)
            dark, colours = jnp.zeros(shape[1:], dtype), (*colours, own_transfer, own_smear, own_factor)
            total = jax.lax.scan(lambda sums, one: (sums + light_of(*one), None), dark, colours)[0]
        if smear is not None:
            waves = total if own_smear is not None else jnp.fft.rfft2(total) * smear[0].astype(kind)
            total = jnp.fft.irfft2(waves, s=opd_m.shape).astype(opd_m.dtype)
        return Planes(total, self.pixel_m)


def _by_colour(
    distances_m: Sequence[float] | Float[np.ndarray, "colour plane"], spectrum: Spectrum
) -> Float[np.ndarray, "colour plane"]:
    """The distances of every colour, checked."""
    distances = np.asarray(distances_m, float)
    if not distances.size or distances.ndim > 2 or not np.all(np.isfinite(distances)):
        shown = tuple(map(float, distances)) if distances.ndim == 1 else distances.tolist()
        raise SettingsError("curvature_sensor.distances_m", "must be finite, at least one", shown)
    colours = len(spectrum.wavelengths_m)
    if distances.ndim == 2 and len(distances) != colours:
        rule = f"must have one row, or one for each of {colours} colours"
        raise SettingsError("curvature_sensor.distances_m", rule, len(distances))
    return np.broadcast_to(distances, (colours, distances.shape[-1]))


def _transfer(
    grid: Grid, distances: Float[np.ndarray, "colour plane"], spectrum: Spectrum, *, star: ApparentStar, dtype: str
) -> Complex[np.ndarray, "shared plane y x"]:
    """Fresnel factors; one for all colours if wavelength times distance and the direction are the same."""
    colours = np.array(spectrum.wavelengths_m)
    reach = colours[:, None] * distances
    if star.is_bent and len(star.directions_rad) != len(colours):
        rule = f"must be one for each of {len(colours)} colours"
        raise SettingsError("curvature_sensor.star", rule, f"{len(star.directions_rad)} directions")
    alike = not star.is_bent and bool(np.all(np.abs(reach - reach[0]) <= 1e-15 * np.abs(reach[0])))
    shared = colours[:1] if alike else colours
    kind = np.result_type(dtype, np.complex64)  # cast one by one: 37 colours of Table 1 are 1.2 GB
    factors = np.empty((len(shared), distances.shape[1], *grid.shape), kind)
    for number, plane in np.ndindex(factors.shape[:2]):
        scale = {"wavelength_m": float(shared[number]), "pixel_m": grid.pixel_m}
        distance_m = float(distances[number, plane])
        factor = fresnel_transfer(grid.shape, distance_m=distance_m, **scale)
        bent = star.shift(grid, distance_m=distance_m, colour=number) if star.is_bent else 1.0
        factors[number, plane] = factor * bent
    return factors


def _visibility(
    grid: Grid, distances: Float[np.ndarray, "colour plane"], star: ApparentStar
) -> Float[np.ndarray, "size plane y fx"]:
    """What is left of the frequencies of the images; one for all colours if their planes are the same."""
    rows = distances[:1] if np.all(distances == distances[0]) else distances
    return np.array([[star.visibility(grid, distance_m=float(z_m)) for z_m in row] for row in rows])


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

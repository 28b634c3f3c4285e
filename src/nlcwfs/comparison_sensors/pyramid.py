"""The pyramid sensor: a prism with its tip in the focus makes four images of the pupil."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil import light_weights
from nlcwfs.beam.real_products import even_and_odd, intensity_behind_even
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.comparison_sensors.settings import PyramidSettings
from nlcwfs.errors import SamplingError, SettingsError


class PupilImages(eqx.Module):
    """Light on the four images of the pupil.

    Attributes:
        photons: Photons per detector pixel and exposure. Image 0 lies at -y -x, 1 at -y +x, 2 at +y -x, 3 at +y +x.
        pixel_m: Width of a pixel at the scale of the telescope.
    """

    photons: Float[Array, "4 v u"]
    pixel_m: float = eqx.field(static=True)


class Pyramid(eqx.Module):
    r"""A pyramid in the focus, fixed, or with the star circling over its tip.

    A facet sends the light of its quadrant of the focus to an image of its own: light that comes from +x (a path that
    grows towards +x) brightens the images at +x, 1 and 3. The mask of the prism is
    :math:`\exp(-2 \pi i a (|f_x| + |f_y|))`, a product of one factor along x and one along y, so that the field on
    the detector is two matrix products, :math:`H_y E H_x^T`, with the wave optics of a roof in each,

    .. math:: H(u, x) = p \int_{-1/2p}^{1/2p} e^{2 \pi i f (u - x) - 2 \pi i a |f|}\,df ,

    p the width of a cell and 2a the distance between images. The integral is in closed form: as a pair of FFTs whose
    padding is infinite, edges of facets between all samples. Light of one facet that is diffracted into the image of
    another is there, and interferes. Only what is read is computed: four squares around the images, as regions of a
    camera; the frame between them is dark. What misses them is told by `fraction_missed`: of a flat wavefront about a
    tenth behind a fixed pyramid, a hundredth with 3 lambda/D of modulation (8 pixels around 44; thrice as much with 2).

    Attributes:
        amplitude: Amplitude of the pupil; the squares sum to 1.
        to_rows: Roof along y, from cells to samples of the images, for even and odd light, see `beam.real_products`.
        to_columns: The same along x.
        circle_rad: Directions of the star, along y and x.
        y_m: Position of every row of cells.
        x_m: Position of every column.
        spectrum: Colours of the light.
        pixel_m: Width of a detector pixel at the scale of the telescope.
        samples: Samples of the light along a detector pixel.

    Examples:
        >>> from nlcwfs.beam.pupil_shape import PupilShape
        >>> grid = Grid((64, 64), pixel_m=0.125)
        >>> sensor = Pyramid.build(
        ...     PupilShape(8.0).on(grid),
        ...     grid,
        ...     diameter_m=8.0,
        ...     spectrum=Spectrum.monochromatic(0.85e-6),
        ...     settings=PyramidSettings(pixels=16, margin_pixels=2),
        ... )
        >>> tilted = sensor.images(jnp.asarray(2e-8 * grid.x_m * np.ones((64, 1))), photons=1000.0)
        >>> tilted.photons.shape, tilted.photons.sum((1, 2)).round().tolist()
        ((4, 20, 20), [235.0, 255.0, 235.0, 255.0])
    """

    amplitude: Float[Array, "y x"]
    to_rows: Complex[Array, "parity half_v half_y"]
    to_columns: Complex[Array, "parity half_u half_x"]
    circle_rad: Float[Array, "point 2"]
    y_m: Float[Array, "y 1"]
    x_m: Float[Array, "1 x"]
    spectrum: Spectrum = eqx.field(static=True)
    pixel_m: float = eqx.field(static=True)
    samples: int = eqx.field(static=True)

    @classmethod
    def build(
        cls,
        pupil: Float[np.ndarray, "y x"],
        grid: Grid,
        *,
        diameter_m: float,
        spectrum: Spectrum,
        settings: PyramidSettings,
        dtype: str = "float32",
    ) -> "Pyramid":
        """Make the prism and the way to the pixels.

        Args:
            pupil: Amplitude, 0 to 1, on the grid.
            grid: Cells of the light; no padding is needed.
            diameter_m: Width of the telescope, the measure of pixels and separation.
            spectrum: Colours of the light; the modulation is counted at their mean wavelength.
            settings: Modulation, pixels and images.
            dtype: Precision of the light.

        Raises:
            SamplingError: If the cells are wider than the pixels, or too wide for the modulation.
        """
        mean_m = float(np.dot(spectrum.wavelengths_m, spectrum.shares))
        pixel_m = diameter_m / settings.pixels
        samples = math.ceil(pixel_m / grid.pixel_m - 1e-9)
        if grid.pixel_m > pixel_m * (1 + 1e-9):
            rule = f"must be at most that of a detector pixel, {pixel_m:.4g} m"
            raise SamplingError("pyramid.grid.pixel_m", rule, grid.pixel_m)
        radius_rad = settings.modulation_lambda_over_d * mean_m / diameter_m
        if radius_rad > min(spectrum.wavelengths_m) / (4 * grid.pixel_m):
            rule = f"must be at most {diameter_m / (4 * grid.pixel_m):.3g} on cells of {grid.pixel_m:.4g} m"
            raise SamplingError("pyramid.modulation_lambda_over_d", rule, settings.modulation_lambda_over_d)
        points = settings.modulation_points if radius_rad > 0 else 1
        angle = 2 * np.pi * (np.arange(points) + 0.5) / points
        shift_m = settings.separation * diameter_m / 2
        around = Grid((1, settings.read_across * samples), pixel_m / samples).x_m.ravel()
        u_m = np.concatenate([around - shift_m, around + shift_m])
        to_rows, to_columns = (
            even_and_odd(roof(u_m, x_m.ravel(), shift_m=shift_m, cell_m=grid.pixel_m)) for x_m in (grid.y_m, grid.x_m)
        )
        share = math.sqrt(pixel_m / samples / grid.pixel_m)
        light = np.result_type(dtype, np.complex64)
        return cls(
            amplitude=jnp.asarray(np.sqrt(light_weights(pupil)), dtype),
            to_rows=jnp.asarray(share * to_rows, light),
            to_columns=jnp.asarray(share * to_columns, light),
            circle_rad=jnp.asarray(radius_rad * np.stack([np.sin(angle), np.cos(angle)], axis=1), dtype),
            y_m=jnp.asarray(grid.y_m, dtype),
            x_m=jnp.asarray(grid.x_m, dtype),
            spectrum=spectrum,
            pixel_m=pixel_m,
            samples=samples,
        )

    def images(self, opd_m: Float[Array, "y x"], photons: float | Float[Array, ""]) -> PupilImages:
        """The photons on every pixel of the four images.

        Args:
            opd_m: Wavefront at the pupil on the cells of the light, positive for a longer path.
            photons: Photons of the whole pupil in one exposure.

        Returns:
            Photons per pixel. They sum to all photons less those that miss the pixels, see `fraction_missed`.
        """
        opd_m = opd_m.astype(self.amplitude.dtype)

        def add(total: Array, direction_rad: Array) -> tuple[Array, None]:
            return total + self._from(opd_m + direction_rad[0] * self.y_m + direction_rad[1] * self.x_m), None

        none = jnp.zeros(self._samples, opd_m.dtype)
        total = jax.lax.scan(add, none, self.circle_rad)[0] * (photons / len(self.circle_rad))
        rows, columns = (size // 2 // self.samples for size in total.shape)
        parts = total.reshape(2, rows, self.samples, 2, columns, self.samples).sum((2, 5))
        return PupilImages(parts.swapaxes(1, 2).reshape(4, rows, columns), self.pixel_m)

    def fraction_missed(self, images: PupilImages, photons: float) -> Float[Array, ""]:
        """Share of the light that falls on no pixel: diffracted at the edges of the facets, or bent too far.

        Args:
            images: Images without noise.
            photons: Photons of the whole pupil in the exposure.

        Raises:
            SettingsError: If there are no photons.
        """
        if not photons > 0:
            raise SettingsError("photons", "must be positive", photons)
        return 1 - jnp.sum(images.photons) / photons

    @property
    def _samples(self) -> tuple[int, int]:
        return 2 * self.to_rows.shape[1], 2 * self.to_columns.shape[1]

    def _from(self, opd_m: Float[Array, "y x"]) -> Float[Array, "v u"]:
        """Share of the light on each sample, of one direction of the star."""
        total = jnp.zeros(self._samples, opd_m.dtype)
        for wavelength_m, share in zip(self.spectrum.wavelengths_m, self.spectrum.shares, strict=True):
            phase = opd_m * (2 * math.pi / wavelength_m)
            field = jnp.stack([self.amplitude * jnp.cos(phase), self.amplitude * jnp.sin(phase)])
            total = total + share * intensity_behind_even(field, self.to_rows, self.to_columns)
        return total


def roof(
    u_m: Float[np.ndarray, " sample"], x_m: Float[np.ndarray, " cell"], *, shift_m: float, cell_m: float
) -> Complex[np.ndarray, "sample cell"]:
    r"""What a roof in the focus does along one axis, from cells to samples of two images.

    :math:`p \int_0^{1/2p} [e^{2 \pi i f (u - x - a)} + e^{-2 \pi i f (u - x + a)}]\,df`, light from the positive side
    to the image at +a, the other to -a; all waves that the cells of width p carry.

    Args:
        u_m: Where the light is wanted.
        x_m: Centres of the cells.
        shift_m: Half the distance between the images, a.
        cell_m: Width of a cell, p.

    Examples:
        Light is not lost: half of it goes either way, and from a cell in the middle spreads like the inverse distance.

        >>> u_m = np.arange(-20000, 20000) + 0.5
        >>> seen = abs(roof(u_m, np.array([0.5]), shift_m=100.0, cell_m=1.0)[:, 0]) ** 2
        >>> round(float(seen.sum()), 3), round(float(seen[u_m > 0].sum()), 3)
        (1.0, 0.5)
    """
    between_m = u_m[:, None] - x_m[None, :]
    return 0.5 * (_half_band((between_m - shift_m) / cell_m) + _half_band(-(between_m + shift_m) / cell_m))


def _half_band(cells: Float[np.ndarray, "sample cell"]) -> Complex[np.ndarray, "sample cell"]:
    """Mean of exp(2 pi i f cells) over f from 0 to a half."""
    return np.exp(0.5j * np.pi * cells) * np.sinc(cells / 2)

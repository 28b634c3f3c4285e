"""The Shack-Hartmann sensor: lenslets cut the pupil into subapertures, and each makes an image of the star."""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil import light_weights
from nlcwfs.beam.real_products import intensity_behind
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.comparison_sensors.settings import ShackHartmannSettings
from nlcwfs.errors import SamplingError, SettingsError

CELLS_PER_FRIED = 3
"""Cells of the light within r0: within a cell the turbulence then varies by 0.4 rad rms."""

CELLS_ACROSS = 120
"""Fewest cells across the pupil: its rim is then right to a percent of a subaperture's light for D/d up to 20."""

CELLS_PER_FIELD = 1.5
"""Fewest cells of a subaperture, over its field in lambda / d: the discrete transform repeats after as many lambda / d
as there are cells, and half of the field stays between the field and its repetition."""

FINEST_PIXEL = 0.125
"""Widest sample of an image, in lambda / d; wider pixels are sums. A sample stands for its area to 1 % of the peak."""


class Spots(eqx.Module):
    """Images behind the lenslets that serve.

    Attributes:
        photons: Photons per detector pixel and exposure; `v` is along y, `u` along x, the optical axis in the middle.
        pixel_rad: Width of a pixel on the sky.
    """

    photons: Float[Array, "spot v u"]
    pixel_rad: float = eqx.field(static=True)


class ShackHartmann(eqx.Module):
    r"""Diffractive lenslets on a square lattice, light through each apart from its neighbours'.

    A subaperture's image is the squared Fourier transform of its part of the field (matrix products, Soummer et al.
    2007), times the :math:`\mathrm{sinc}^2` of a cell: the field is uniform over a cell, so that an unaberrated square
    lenslet has exactly the :math:`\mathrm{sinc}^2` of its width, wings included. Light outside the field of view is
    stopped, as by the mask of an instrument: 5 % for a perfect spot and 8 lambda/d. Interference between neighbours,
    which such a stop removes, is not there.

    Attributes:
        amplitude: Amplitude in every subaperture that serves; the squares sum to the share of the pupil's light.
        to_sky: Fourier matrix of each colour from the cells to the samples of an image, along either axis.
        places: Row and column in the lattice of every subaperture that serves, row 0 at the smallest y.
        spectrum: Colours of the light.
        cell_m: Width of a cell of the light.
        pixel_rad: Width of a detector pixel on the sky.
        samples: Samples of an image along a detector pixel.
        subapertures: Subapertures across the telescope, D/d.

    Examples:
        >>> import jax.numpy as jnp
        >>> from nlcwfs.beam.pupil_shape import PupilShape
        >>> settings = ShackHartmannSettings(subapertures=10)
        >>> grid = lenslet_grid(settings, diameter_m=8.0, fried_m=0.32)
        >>> sensor = ShackHartmann.build(
        ...     PupilShape(8.0).on(grid),
        ...     grid,
        ...     diameter_m=8.0,
        ...     spectrum=Spectrum.monochromatic(0.85e-6),
        ...     settings=settings,
        ... )
        >>> spots = sensor.images(jnp.zeros(grid.shape), photons=1000.0)
        >>> spots.photons.shape, round(sensor.light_share, 2), round(float(spots.photons.sum()))
        ((76, 64, 64), 0.94, 895)
    """

    amplitude: Float[Array, "spot y x"]
    to_sky: Complex[Array, "colour sample cell"]
    places: Int[np.ndarray | Array, "spot 2"]
    spectrum: Spectrum = eqx.field(static=True)
    cell_m: float = eqx.field(static=True)
    pixel_rad: float = eqx.field(static=True)
    samples: int = eqx.field(static=True)
    subapertures: int = eqx.field(static=True)

    @classmethod
    def build(
        cls,
        pupil: Float[np.ndarray, "Y X"],
        grid: Grid,
        *,
        diameter_m: float,
        spectrum: Spectrum,
        settings: ShackHartmannSettings,
        dtype: str = "float32",
    ) -> "ShackHartmann":
        """Lay the lattice on the pupil.

        Args:
            pupil: Amplitude, 0 to 1, on the grid.
            grid: Cells of the light, a whole number of them in a subaperture, see `lenslet_grid`; it may reach beyond
                the telescope by the same number of cells on each side.
            diameter_m: Width of the lattice.
            spectrum: Colours of the light; the field of view is counted at their mean wavelength.
            dtype: Precision of the light.

        Raises:
            SamplingError: If the lattice does not fit on the cells, or they are too coarse for the field of view.
            SettingsError: If no subaperture gets enough light.
        """
        cells = _cells_of_subaperture(grid, diameter_m, settings)
        light = light_weights(pupil)
        root = cut_into_subapertures(np.sqrt(light), settings.subapertures, cells)
        brightness = cut_into_subapertures(np.asarray(pupil, float) ** 2, settings.subapertures, cells).mean((2, 3))
        active = brightness >= settings.least_light
        if not active.any():
            rule = f"must leave a subaperture that serves; the brightest gets {brightness.max():.2f}"
            raise SettingsError("shack_hartmann.least_light", rule, settings.least_light)
        lenslet_m = cells * grid.pixel_m
        mean_m = float(np.dot(spectrum.wavelengths_m, spectrum.shares))
        pixel_rad = settings.field_lambda_over_d * mean_m / lenslet_m / settings.pixels
        samples = math.ceil(settings.field_lambda_over_d / settings.pixels / FINEST_PIXEL - 1e-9)
        angles = Grid((1, settings.pixels * samples), pixel_rad / samples)
        inside = Grid((1, cells), grid.pixel_m)
        to_sky = [_fourier_matrix(angles, inside, wavelength_m) for wavelength_m in spectrum.wavelengths_m]
        return cls(
            amplitude=jnp.asarray(root[active], dtype),
            to_sky=jnp.asarray(np.array(to_sky), np.result_type(dtype, np.complex64)),
            places=np.argwhere(active),
            spectrum=spectrum,
            cell_m=grid.pixel_m,
            pixel_rad=pixel_rad,
            samples=samples,
            subapertures=settings.subapertures,
        )

    @property
    def count(self) -> int:
        """Number of subapertures that serve."""
        return self.amplitude.shape[0]

    @property
    def light_share(self) -> float:
        """Share of the pupil's light that falls on subapertures that serve."""
        return float(jnp.sum(self.amplitude**2))

    @property
    def subaperture_m(self) -> float:
        """Width of a subaperture, d."""
        return self.amplitude.shape[1] * self.cell_m

    @property
    def active(self) -> Bool[np.ndarray, "row column"]:
        """Which squares of the lattice serve, row 0 at the smallest y."""
        lattice = np.zeros((self.subapertures, self.subapertures), bool)
        lattice[tuple(np.asarray(self.places).T)] = True
        return lattice

    def subaperture_maps(self, opd_m: Float[Array, "Y X"]) -> Float[Array, "spot y x"]:
        """A map on the cells of the light, cut into the subapertures that serve."""
        parts = cut_into_subapertures(opd_m, self.subapertures, self.amplitude.shape[1])
        return jnp.asarray(parts)[self.places[:, 0], self.places[:, 1]]

    def images(self, opd_m: Float[Array, "Y X"], photons: float | Float[Array, ""]) -> Spots:
        """The photons on every pixel.

        Args:
            opd_m: Wavefront at the pupil on the cells of the light, positive for a longer path.
            photons: Photons of the whole pupil in one exposure.

        Returns:
            Photons per pixel. They sum to the photons on the subapertures that serve, less the light outside their
            fields of view, see `fraction_outside_field`.
        """
        return self.images_of_parts(self.subaperture_maps(opd_m.astype(self.amplitude.dtype)), photons)

    def images_of_parts(self, parts_m: Float[Array, "spot y x"], photons: float | Float[Array, ""]) -> Spots:
        """The same from a wavefront that is cut already, see `subaperture_maps`."""
        total = jnp.zeros((), self.amplitude.dtype)
        for to_sky, wavelength_m, share in zip(
            self.to_sky, self.spectrum.wavelengths_m, self.spectrum.shares, strict=True
        ):
            phase = parts_m * (2 * math.pi / wavelength_m)
            field = jnp.asarray(share, phase.dtype) ** 0.5 * self.amplitude
            field = jnp.stack([field * jnp.cos(phase), field * jnp.sin(phase)])
            total = total + intensity_behind(field, to_sky, to_sky)
        pixels = total.shape[1] // self.samples
        on_pixels = total.reshape(self.count, pixels, self.samples, pixels, self.samples).sum((2, 4))
        return Spots(photons * on_pixels, self.pixel_rad)

    def fraction_outside_field(self, spots: Spots, photons: float) -> Float[Array, " spot"]:
        """Share of each subaperture's light that its field of view stops.

        Args:
            spots: Images without noise.
            photons: Photons of the whole pupil in the exposure.

        Raises:
            SettingsError: If there are no photons.
        """
        if not photons > 0:
            raise SettingsError("photons", "must be positive", photons)
        return 1 - jnp.sum(spots.photons, (1, 2)) / (photons * jnp.sum(self.amplitude**2, (1, 2)))


def lenslet_grid(settings: ShackHartmannSettings, *, diameter_m: float, fried_m: float) -> Grid:
    """Cells of the light that carry this sensor through this air, a whole number of them in a subaperture.

    At least 3 cells in r0, 120 across the telescope, and 1.5 times as many in a subaperture as its field has
    lambda / d, so that no light folds from one side of the field to the other.

    Args:
        diameter_m: Diameter of the telescope.
        fried_m: Fried's parameter at the wavelength of the sensor.

    Raises:
        SettingsError: If a long exposure of the air's spot does not fit twice into the field, or a length is not
            positive.

    Examples:
        >>> lenslet_grid(ShackHartmannSettings(subapertures=36), diameter_m=8.0, fried_m=0.317).shape
        (432, 432)
    """
    for name, length_m in (("diameter_m", diameter_m), ("fried_m", fried_m)):
        if not 0 < length_m < math.inf:
            raise SettingsError(f"lenslet_grid.{name}", "must be a positive length", length_m)
    lenslet_m = diameter_m / settings.subapertures
    width = math.hypot(1, lenslet_m / fried_m)  # of the long exposure in lambda / d: diffraction and seeing
    if settings.field_lambda_over_d < 2 * width:
        rule = f"must be at least {2 * width:.1f}, twice the spot of this air behind {lenslet_m:.2f} m"
        raise SettingsError("shack_hartmann.field_lambda_over_d", rule, settings.field_lambda_over_d)
    cells = max(
        CELLS_PER_FRIED * lenslet_m / fried_m,
        CELLS_ACROSS / settings.subapertures,
        CELLS_PER_FIELD * settings.field_lambda_over_d,
    )
    across = math.ceil(cells - 1e-9) * settings.subapertures
    return Grid((across, across), diameter_m / across)


def cut_into_subapertures(
    cells_map: Float[Array | np.ndarray, "Y X"], subapertures: int, cells: int
) -> Float[Array | np.ndarray, "row column y x"]:
    """The middle of a map as a lattice of squares.

    Examples:
        >>> cut_into_subapertures(np.arange(36.0).reshape(6, 6), 2, 2)[0, 1]
        array([[ 9., 10.],
               [15., 16.]])
    """
    across = subapertures * cells
    top, left = ((size - across) // 2 for size in cells_map.shape)
    middle = cells_map[top : top + across, left : left + across]
    return middle.reshape(subapertures, cells, subapertures, cells).swapaxes(1, 2)


def _cells_of_subaperture(grid: Grid, diameter_m: float, settings: ShackHartmannSettings) -> int:
    """How many cells a subaperture has; raises if the lattice does not fit."""
    cells = diameter_m / settings.subapertures / grid.pixel_m
    whole = round(cells)
    if whole < 1 or abs(cells - whole) > 1e-6 * cells:
        rule = f"must cut {diameter_m:g} m into whole cells of {grid.pixel_m:.4g} m; a subaperture has {cells:.3f}"
        raise SamplingError("shack_hartmann.subapertures", rule, settings.subapertures)
    margins = [size - whole * settings.subapertures for size in grid.shape]
    if min(margins) < 0 or any(margin % 2 for margin in margins):
        rule = f"must exceed the lattice of {whole * settings.subapertures} cells by an even number"
        raise SamplingError("grid.shape", rule, tuple(grid.shape))
    if whole < CELLS_PER_FIELD * settings.field_lambda_over_d - 1e-9:
        rule = f"must leave {CELLS_PER_FIELD:g} times {settings.field_lambda_over_d:g} cells in a subaperture"
        raise SamplingError("grid.pixel_m", rule, f"{whole} cells of {grid.pixel_m:.4g} m")
    return whole


def _fourier_matrix(angles: Grid, cells: Grid, wavelength_m: float) -> Complex[np.ndarray, "sample cell"]:
    """Fourier transform along one axis, times the sinc of a uniform cell; keeps the light's total."""
    turn = np.exp(-2j * np.pi / wavelength_m * angles.x_m.T * cells.x_m)
    envelope = np.sinc(cells.pixel_m * angles.x_m.T / wavelength_m)
    return math.sqrt(cells.pixel_m * angles.pixel_m / wavelength_m) * envelope * turn

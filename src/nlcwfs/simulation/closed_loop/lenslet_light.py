"""The light of a Shack-Hartmann sensor in a loop: the loop's own wavefront, carried to the cells of the lenslets."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.comparison_sensors.shack_hartmann import ShackHartmann, lenslet_grid
from nlcwfs.config import Config
from nlcwfs.detector.read import Frames
from nlcwfs.detector.settings import DetectorSettings
from nlcwfs.detector.sparse_photons import room_for_photons, sample_sparse_photons
from nlcwfs.simulation.exposure import Exposure, ExposureSimulator, wavelength_m

EXACT = jax.lax.Precision.HIGHEST
"""Accelerators round the factors of a product to 11 bits unless told otherwise."""


class LensletOptics(eqx.Module):
    """Lenslets behind the same air and the same mirror as the curvature sensor's.

    The wavefront stays on the loop's grid of light, where it is scored. It is continued beyond the rim as it is there,
    and interpolated onto the lenslets' cells, which must be finer (see `lenslet_grid`). Turbulence finer than the
    loop's cells is in no sensor's light; what the interpolation itself changes is told in `docs/closed-loop`.

    Attributes:
        still: Grid, pupil, photons and camera.
        sensor: The lenslets.
        along_y: Interpolation from rows of the lit part to rows of the lenslets' cells.
        along_x: The same of columns.
        nearest: Row and column of the nearest lit cell.
        room: Most photons of an exposure when nothing but photons makes noise, else 0.
    """

    still: ExposureSimulator
    sensor: ShackHartmann
    along_y: Float[Array, "fine_y lit_y"]
    along_x: Float[Array, "fine_x lit_x"]
    nearest: tuple[np.ndarray | Array, np.ndarray | Array]
    room: int = eqx.field(static=True)

    @classmethod
    def build(cls, config: Config, still: ExposureSimulator, lit: Bool[np.ndarray, "lit_y lit_x"]) -> "LensletOptics":
        """Lay the lenslets on the pupil.

        Args:
            config: The settings.
            still: Grid, pupil, photons and camera of the loop.
            lit: Where light is on the part of the grid that holds the pupil.

        Raises:
            SettingsError: If settings contradict each other.
            SamplingError: If the cells are too coarse for the field of view.
        """
        settings, diameter_m = config.shack_hartmann, config.beam.diameter_m
        fried_m = still.air.fried_at(wavelength_m(config))
        grid = lenslet_grid(settings, diameter_m=diameter_m, fried_m=fried_m)
        if grid.pixel_m > still.light.pixel_m:  # never coarser than the loop's own light
            cells = math.ceil(diameter_m / settings.subapertures / still.light.pixel_m) * settings.subapertures
            grid = Grid((cells, cells), diameter_m / cells)
        dtype = str(still.weights.dtype)
        sensor = ShackHartmann.build(
            still.shape.on(grid),
            grid,
            diameter_m=diameter_m,
            spectrum=Spectrum.monochromatic(wavelength_m(config)),
            settings=settings,
            dtype=dtype,
        )
        rows, columns = lit.shape
        points = grid.y_m.ravel() / still.light.pixel_m
        nearest = scipy.ndimage.distance_transform_edt(~lit, return_distances=False, return_indices=True)
        electrons = still.photons * config.detector.quantum_efficiency
        return cls(
            still=still,
            sensor=sensor,
            along_y=jnp.asarray(keys_cubic(points + (rows - 1) / 2, rows), dtype),
            along_x=jnp.asarray(keys_cubic(points + (columns - 1) / 2, columns), dtype),
            nearest=(np.asarray(nearest)[0], np.asarray(nearest)[1]),
            room=room_for_photons(electrons) if only_photons(config.detector) else 0,
        )

    def on_cells(self, opd_m: Float[Array, "lit_y lit_x"]) -> Float[Array, "fine_y fine_x"]:
        """A wavefront of the loop on the lenslets' cells."""
        whole_m = opd_m[self.nearest[0], self.nearest[1]]
        rows = jnp.matmul(self.along_y, whole_m, precision=EXACT)
        return jnp.matmul(rows, self.along_x.T, precision=EXACT)

    def images(self, opd_m: Float[Array, "lit_y lit_x"], photons: float) -> Float[Array, "image v u"]:
        """The spots of one moment, see `LoopOptics`."""
        return self.sensor.images(self.on_cells(opd_m), photons).photons

    def read(self, opd_m: Float[Array, "Y X"], images: Float[Array, "image v u"], key: PRNGKeyArray) -> Exposure:
        """What the detector reads of the sum, see `LoopOptics`."""
        detector = self.still.detector
        if self.room:
            electrons = sample_sparse_photons(key, detector.expected_electrons(images), room=self.room)
            frames = Frames(electrons=electrons, saturated=jnp.zeros(images.shape, bool))
        else:
            frames = detector.read(images, key)
        arrived = self.still.photons * jnp.sum(self.sensor.amplitude**2, (1, 2))
        lost = 1 - jnp.sum(images, (1, 2)) / arrived
        return Exposure(opd_m=opd_m, photons=images, frames=frames, truth_m=self.still.on_pixels(opd_m), lost=lost)


def only_photons(settings: DetectorSettings) -> bool:
    """Whether a camera has no noise but that of the photons, and no limits.

    Examples:
        >>> only_photons(DetectorSettings()), only_photons(DetectorSettings(read_noise_electrons=0.5))
        (True, False)
    """
    dark = settings.dark_electrons == settings.background_photons == settings.read_noise_electrons == 0
    return dark and settings.em_gain == 1 and not settings.bits and math.isinf(settings.full_well_electrons)


def keys_cubic(points: Float[np.ndarray, " point"], count: int) -> Float[np.ndarray, "point cell"]:
    """Interpolation between cells, local and right to third order (Keys 1981, IEEE Trans. ASSP 29, 1153).

    Beyond the first and the last cell it goes on as there.

    Args:
        points: Where to interpolate, in cells from the first.
        count: Number of cells.

    Examples:
        >>> keys_cubic(np.array([1.5, 2.0]), 4).tolist()
        [[-0.0625, 0.5625, 0.5625, -0.0625], [0.0, 0.0, 1.0, 0.0]]
    """
    x = np.abs(np.clip(points, 0, count - 1)[:, None] - np.arange(-2, count + 2)[None, :])
    near, far = 1.5 * x**3 - 2.5 * x**2 + 1, -0.5 * x**3 + 2.5 * x**2 - 4 * x + 2
    wide = np.where(x < 1, near, np.where(x < 2, far, 0.0))
    inner = wide[:, 2:-2]
    inner[:, 0] += wide[:, :2].sum(axis=1)
    inner[:, -1] += wide[:, -2:].sum(axis=1)
    return inner

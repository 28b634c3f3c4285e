"""What a reconstructor must know of the sensor whose frames it gets."""

from dataclasses import dataclass, field, replace

import numpy as np
import scipy.ndimage
from jaxtyping import Float

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.light_band import LightBand
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.beam.spectrum import Spectrum
from nlcwfs.curvature_sensor.apparent_star import POINT, ApparentStar
from nlcwfs.curvature_sensor.chromatic_lenses import LensLaw
from nlcwfs.curvature_sensor.defocused_images import CurvatureSensor
from nlcwfs.curvature_sensor.membrane import Motion, membrane_moments, moving_light


@dataclass(frozen=True)
class SensorGeometry:
    """Pupil, planes and pixels of a real sensor.

    Attributes:
        pupil: The telescope.
        frame: Pixels of one plane's frame, at the scale of the telescope.
        wavelength_m: Wavelength of sensing, or of a model of one colour.
        distances_m: Signed distance of each plane from the pupil, positive downstream.
        flux_fractions: Share of the light of each plane; equal when left out.
        static_opd_m: Known aberration in the arm of the sensor, on the frame's pixels ...
        static_grid: ... or on these, which may be finer.
        spectrum: Wavelengths that stand for a band of light in a model of many colours; None where one is enough.
        colour_distances_m: Where each plane is in each of them; at `distances_m` in all when left out.
        star: Where each of them comes from, and how large the star is.
        motion: Of a membrane that moves the planes; the distances are the mean ones.
        moments: By which the model follows it, if it is a sine; 1 lets the planes rest.
        dead_share: Of the membrane's half period, in which nothing is integrated.
    """

    pupil: PupilShape
    frame: Grid
    wavelength_m: float
    distances_m: tuple[float, ...]
    flux_fractions: tuple[float, ...] | None = None
    static_opd_m: Float[np.ndarray, "y x"] | None = field(default=None, compare=False)
    static_grid: Grid | None = None
    spectrum: Spectrum | None = None
    colour_distances_m: tuple[tuple[float, ...], ...] | None = None
    star: ApparentStar = POINT
    motion: Motion = "none"
    moments: int = 1
    dead_share: float = 0.0

    def in_mean_phase(self, band: LightBand, law: LensLaw) -> "SensorGeometry":
        """The same for a model of one colour of light that has many.

        Behind lenses that keep distance times wavelength the images of all colours add up the phases of one path: the
        model works at the wavelength of the mean phase, with the planes where they are for it. Behind achromatic ones
        images differ by more than that, and the model stays where it is (docs/colour.md).

        Args:
            band: The light.
            law: The lenses.
        """
        if law.kind == "achromatic":
            return self
        places_m = law.distances_m(self.distances_m, (band.effective_m,))[0]
        return replace(self, wavelength_m=band.effective_m, distances_m=tuple(map(float, places_m)))

    def model(self, grid: Grid, *, dtype: str) -> CurvatureSensor:
        """The sensor's optics on a grid of the reconstructor."""
        static, known_on = self.static_opd_m, self.static_grid or self.frame
        static = None if static is None else _resized(static, known_on, grid)
        return CurvatureSensor.build(
            self.pupil.on(grid),
            grid,
            distances_m=self.distances_m,
            spectrum=Spectrum.monochromatic(self.wavelength_m),
            flux_fractions=self.flux_fractions,
            static_opd_m=static,
            dtype=dtype,
        )

    def in_colour(self, grid: Grid, *, dtype: str) -> CurvatureSensor | None:
        """The optics in all colours and moments of the model, without the static aberration; None where it has one."""
        if self.spectrum is None:
            return self.in_motion(grid, dtype=dtype)
        rest_m = self.colour_distances_m or (self.distances_m,) * len(self.spectrum.shares)
        return self._moved(grid, (self.spectrum, np.array(rest_m), self.star), dtype=dtype)

    def in_motion(self, grid: Grid, *, dtype: str) -> CurvatureSensor | None:
        """The same in one colour, and all moments; None where the planes rest."""
        if self.motion != "sine" or self.moments == 1:
            return None
        one = Spectrum.monochromatic(self.wavelength_m)
        return self._moved(grid, (one, np.array([self.distances_m]), POINT), dtype=dtype)

    def _moved(self, grid: Grid, rest: tuple[Spectrum, np.ndarray, ApparentStar], *, dtype: str) -> CurvatureSensor:
        """The optics in some colours, with their planes at rest, and all moments."""
        motion = self.motion if self.moments > 1 else "none"
        moments = membrane_moments(motion, count=self.moments, dead_share=self.dead_share)
        spectrum, places_m, star = moving_light(*rest, moments)
        light = {"distances_m": places_m, "spectrum": spectrum, "star": star}
        return CurvatureSensor.build(self.pupil.on(grid), grid, **light, dtype=dtype)


def _resized(opd_m: Float[np.ndarray, "y x"], frame: Grid, grid: Grid) -> Float[np.ndarray, "v u"]:
    """An aberration on other pixels: means over larger ones, then cubic splines; the rim goes on beyond the frame."""
    coarser = round(grid.pixel_m / frame.pixel_m)
    if coarser > 1:
        opd_m = scipy.ndimage.uniform_filter(opd_m, coarser, mode="nearest")
        if coarser % 2 == 0:  # SciPy centres an even window half a pixel low
            opd_m = scipy.ndimage.shift(opd_m, -0.5, order=3, mode="nearest")
    rows = grid.y_m.ravel() / frame.pixel_m + (frame.shape[0] - 1) / 2
    columns = grid.x_m.ravel() / frame.pixel_m + (frame.shape[1] - 1) / 2
    points = np.meshgrid(rows, columns, indexing="ij")
    return scipy.ndimage.map_coordinates(opd_m, points, order=3, mode="nearest")

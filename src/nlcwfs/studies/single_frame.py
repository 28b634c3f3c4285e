"""The paper's single frame (Guyon 2010, sec. 4.1): one wavefront, four noisy images, one reconstruction."""

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
from jaxtyping import Float

from nlcwfs.beam.grid import Grid
from nlcwfs.config import Config
from nlcwfs.interop.frames_file import FramesFile
from nlcwfs.interop.frames_reconstruction import FramesReconstructor, rms_m
from nlcwfs.interop.simulated_frames import Shot, frames_of
from nlcwfs.interop.wavefront_file import FrameWavefront
from nlcwfs.science.point_spread_function import point_spread_function, strehl_ratio
from nlcwfs.simulation.exposure import Exposure, ExposureSimulator

PAPER_CASE: Sequence[str] = (
    "beam.wavelength_um=0.65",
    "atmosphere.photons=2e4",
    "atmosphere.opd_rms_nm=609",
    "detector.pixels_across_pupil=45",
    "detector.window_pixels=64",
)
"""Sec. 4.1 of the paper, where it differs from Table 1: Kolmogorov with the paper's rms on average."""

PSF_WIDTH = 40
"""Width of the images of the star in lambda / D: four times the seeing of the paper's case."""

PSF_PIXELS = 160


@dataclass(frozen=True, eq=False)
class SingleFrame:
    """One exposure and its reconstruction, judged on the fine grid of the light.

    Attributes:
        frames: The file of the frame.
        found: The reconstruction, on the detector's pixels.
        pupil: Amplitude on the grid of the light, as are the wavefronts.
        opd_m: True wavefront, NaN outside the pupil.
        residual_m: True less found, piston removed; NaN outside.
        psf_before: Image of the star at the wavelength of sensing, 1 at the peak of a perfect telescope.
        psf_after: The same when the wavefront that was found is taken away.
        psf_pixel_rad: Width of a pixel of both.
    """

    frames: FramesFile
    found: FrameWavefront
    light: Grid
    pupil: Float[np.ndarray, "Y X"]
    opd_m: Float[np.ndarray, "Y X"]
    residual_m: Float[np.ndarray, "Y X"]
    psf_before: Float[np.ndarray, "v u"]
    psf_after: Float[np.ndarray, "v u"]
    strehl_before: float
    strehl_after: float
    psf_pixel_rad: float

    @property
    def rms_nm(self) -> float:
        """Rms of the true wavefront on the fine grid, tilt included."""
        return rms_m(self.opd_m, self.pupil**2) * 1e9

    @property
    def residual_rms_nm(self) -> float:
        """Rms of the residual on the fine grid: what detector pixels are too coarse for is in it."""
        return rms_m(self.residual_m, self.pupil**2) * 1e9


def single_frame(config: Config, simulator: ExposureSimulator, exposure: Exposure) -> SingleFrame:
    """Reconstruct one exposure and look at the residual as the telescope would.

    Raises:
        NlcwfsError: If the settings of the estimation contradict each other.
    """
    frames = frames_of(config, simulator, [Shot.of(exposure)])
    reconstructor = FramesReconstructor.build(frames, config.estimation, dtype=str(exposure.opd_m.dtype))
    return judged(simulator, exposure, frames, reconstructor.reconstruct(0))


def judged(simulator: ExposureSimulator, exposure: Exposure, frames: FramesFile, found: FrameWavefront) -> SingleFrame:
    """Compare a reconstruction with the light that made its frames."""
    light, wavelength_m = simulator.light, frames.wavelength_m
    pupil = np.asarray(simulator.sensor.pupil, float)
    true_m = np.asarray(exposure.opd_m, float)
    residual_m = true_m - on_fine_grid(found.opd_m, simulator)
    residual_m = residual_m - np.sum(pupil**2 * residual_m) / np.sum(pupil**2)
    angle_rad = wavelength_m / simulator.shape.diameter_m * PSF_WIDTH / PSF_PIXELS
    images = [
        np.asarray(
            point_spread_function(
                pupil,
                jnp.asarray(opd_m),
                wavelength_m=wavelength_m,
                pixel_m=light.pixel_m,
                angles=Grid((PSF_PIXELS + 1, PSF_PIXELS + 1), angle_rad),
            )
        )
        for opd_m in (true_m, residual_m)
    ]
    strehls = [
        float(strehl_ratio(pupil, jnp.asarray(opd_m), wavelength_m=wavelength_m)) for opd_m in (true_m, residual_m)
    ]
    dark = pupil == 0
    return SingleFrame(
        frames=frames,
        found=found,
        light=light,
        pupil=pupil,
        opd_m=np.where(dark, np.nan, true_m),
        residual_m=np.where(dark, np.nan, residual_m),
        psf_before=images[0],
        psf_after=images[1],
        strehl_before=strehls[0],
        strehl_after=strehls[1],
        psf_pixel_rad=angle_rad,
    )


def on_fine_grid(opd_m: Float[np.ndarray, "y x"], simulator: ExposureSimulator) -> Float[np.ndarray, "Y X"]:
    """A wavefront on detector pixels, NaN outside the pupil, as a smooth one on the grid of the light."""
    filled = fill_outside(opd_m)
    shape = (filled.shape[0] * simulator.factor, filled.shape[1] * simulator.factor)
    fine = np.asarray(jax.image.resize(jnp.asarray(filled), shape, method="cubic"), float)
    margins = [(whole - part) // 2 for whole, part in zip(simulator.light.shape, shape, strict=True)]
    return np.pad(fine, [(margin, margin) for margin in margins])


def fill_outside(opd_m: Float[np.ndarray, "y x"]) -> Float[np.ndarray, "y x"]:
    """Continue a wavefront beyond its rim with the value of the nearest pixel inside and the tilt of the whole.

    Examples:
        >>> fill_outside(np.array([[np.nan, 1.0, 2.0, np.nan]])).round(6) + 0.0
        array([[0., 1., 2., 3.]])
    """
    known = np.isfinite(opd_m)
    rows, columns = np.indices(opd_m.shape)
    planes = np.stack([np.ones(opd_m.shape), rows, columns])
    tilt = np.einsum("a,ayx->yx", np.linalg.lstsq(planes[:, known].T, opd_m[known], rcond=None)[0], planes)
    nearest = np.asarray(scipy.ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True))
    rest = np.where(known, opd_m - tilt, 0)
    return rest[nearest[0], nearest[1]] + tilt

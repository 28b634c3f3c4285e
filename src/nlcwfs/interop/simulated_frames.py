"""Simulated exposures as the file of frames that a real sensor would have written."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.config import Config
from nlcwfs.detector.read import Detector
from nlcwfs.interop.frames_file import FramesFile
from nlcwfs.interop.pupil_fits import read_pupil_shape
from nlcwfs.simulation.colours import bandwidth_m
from nlcwfs.simulation.exposure import (
    Exposure,
    ExposureSimulator,
    distances_m,
    seeing_arcsec,
    wavelength_m,
)
from nlcwfs.simulation.telescope import telescope


def pupil_of(config: Config) -> PupilShape:
    """The telescope of a configuration, read from `beam.pupil_map` where there is one.

    Raises:
        FileFormatError: If the map cannot be read.

    Examples:
        >>> pupil_of(Config()).diameter_m
        8.0
    """
    beam = config.beam
    if beam.pupil_map is None:
        return telescope(config)
    return read_pupil_shape(beam.pupil_map, diameter_m=beam.diameter_m)


@dataclass(frozen=True, eq=False)
class Shot:
    """What a file keeps of an exposure: thousands of them fit in memory, their fine grids do not."""

    electrons: Float[np.ndarray, "plane y x"]
    saturated: Bool[np.ndarray, "plane y x"]
    truth_m: Float[np.ndarray, "y x"]
    lost: Float[np.ndarray, " plane"]

    @classmethod
    def of(cls, exposure: Exposure) -> "Shot":
        """Take it from an exposure."""
        return cls(
            electrons=np.asarray(exposure.frames.electrons, float),
            saturated=np.asarray(exposure.frames.saturated),
            truth_m=np.asarray(exposure.truth_m, float),
            lost=np.asarray(exposure.lost, float),
        )


def frames_of(
    config: Config, simulator: ExposureSimulator, shots: Sequence[Shot], *, rate_hz: float | None = None
) -> FramesFile:
    """The frames with all that their header says, the pupil and the truth included.

    The truth is the wavefront that reaches the planes: a static aberration of the sensor is part of it, because a
    file of frames has no place for it. Gain, read noise and saturation are those at the input of the
    multiplication register, like the electrons.

    Args:
        config: The settings.
        simulator: What made the exposures.
        shots: The exposures, in the order of time if they are a sequence.
        rate_hz: Exposures in a second of a sequence, each as long as it can be; None for independent ones.

    Examples:
        >>> from nlcwfs.config import load_config
        >>> from nlcwfs.simulation.exposure import frame_key
        >>> small = load_config(None, ["detector.pixels_across_pupil=12", "detector.window_pixels=16"])
        >>> simulator = ExposureSimulator.build(small)
        >>> frames = frames_of(small, simulator, [Shot.of(simulator.expose(frame_key(seed=0, frame=0)))])
        >>> frames.electrons.shape, frames.has_frame_axis, round(frames.seeing_arcsec, 2)
        ((1, 4, 16, 16), False, 0.6)
    """
    camera, detector, grid = config.detector, simulator.detector, simulator.frame
    static_m = np.asarray(simulator.on_pixels(simulator.sensor.static_opd_m), float)
    truth_m = np.stack([shot.truth_m for shot in shots]) + static_m
    background = camera.quantum_efficiency * camera.background_photons
    several = len(shots) > 1
    return FramesFile(
        electrons=np.stack([shot.electrons for shot in shots]),
        masked=np.stack([shot.saturated for shot in shots]),
        has_frame_axis=several,
        pixel_m=grid.pixel_m,
        wavelength_m=wavelength_m(config),
        diameter_m=config.beam.diameter_m,
        distances_m=distances_m(config),
        obstruction_ratio=simulator.shape.obstruction_ratio,
        bandwidth_m=bandwidth_m(config),
        chromatic_lenses=config.curvature_sensor.lenses != "achromatic",
        membrane=config.curvature_sensor.membrane,
        membrane_dead_share=config.curvature_sensor.membrane_dead_share,
        gain_electrons_per_adu=camera.gain_electrons_per_adu / camera.em_gain,
        read_noise_electrons=math.sqrt(float(detector.variance_electrons(jnp.zeros(())))),
        dark_electrons=camera.dark_electrons,
        saturation_electrons=_saturation(detector),
        exposure_s=None if rate_hz is None else 1 / rate_hz,
        rate_hz=rate_hz,
        photons=camera.quantum_efficiency * simulator.photons,
        flux_fractions=config.curvature_sensor.flux_fractions,
        seeing_arcsec=seeing_arcsec(simulator.air),
        pupil=simulator.shape.on(grid),
        segments=simulator.shape.labels(grid),
        background=np.full(grid.shape, background) if background else None,
        truth_m=truth_m if several else truth_m[0],
        source="simulation",
    )


def _saturation(detector: Detector) -> float | None:
    """Electrons at which a pixel or the converter is full, None without such a limit."""
    settings = detector.settings
    limits = [settings.full_well_electrons]
    if settings.bits:
        limits.append(float(detector.to_electrons(jnp.asarray(2.0**settings.bits - 1))))
    lowest = min(limits)
    return lowest if math.isfinite(lowest) else None

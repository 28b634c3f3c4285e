"""A closed loop behind an ideal coronagraph: does its halo agree with the closed form?"""

import math
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
import scipy.signal
import scipy.special
from jaxtyping import Array, Float

from nlcwfs.config import Config
from nlcwfs.detector.pixels import integrate_on_pixels
from nlcwfs.errors import SettingsError
from nlcwfs.estimation.photon_bound import fisher_information
from nlcwfs.science.contrast import Halo
from nlcwfs.science.flux_factor import FluxFactor, constant_flux_factor
from nlcwfs.simulation.closed_loop.loop import Loop, LoopState
from nlcwfs.simulation.closed_loop.run import Watch, run_loop
from nlcwfs.studies.contrast_table import MAS_RAD, halo_of, imaging_m, mirror_cutoff, short
from nlcwfs.studies.image_profiles import ring_means
from nlcwfs.studies.study_table import Row

ORIENTATIONS = 4
"""Directions of the waves whose flux factor is measured; each as a sine and a cosine."""

FINEST_CPA, STEP_CPA = 80.0, 0.25
"""Half width and step of the grid on which the aperture's wings are added."""


def run_behind_coronagraph(config: Config, watch: Watch | None = None) -> tuple[Loop, LoopState]:
    """Run the loop of a configuration, the star's image being taken behind an ideal coronagraph.

    Args:
        config: Its `[loop]` counts, with `loop.settle_s` before the image begins.
        watch: Called after each exposure.

    Raises:
        SettingsError: If settings contradict each other, or no image was taken because the loop did not close.
    """
    loop = Loop.build(config)
    state = loop.init()
    state = state._replace(image=loop.light.star_image(imaging_m(config), coronagraph=True))
    state, _ = run_loop(loop, state=state, watch=watch)
    if not int(state.image.exposures):
        raise SettingsError("loop.seconds", "must leave time for the loop to close and to settle", config.loop.seconds)
    return loop, state


def measured_contrast(state: LoopState, angle_rad: Float[np.ndarray, " angle"]) -> Float[np.ndarray, " angle"]:
    """Mean over the azimuth of the coronagraphic long exposure, over the star's peak without coronagraph."""
    image = state.image
    rings = ring_means(np.asarray(image.image, float)) / float(image.strehl)
    places = np.asarray(angle_rad) / image.angles.pixel_m
    if places.max() > len(rings) - 1:
        most_mas = (len(rings) - 1) * image.angles.pixel_m / MAS_RAD
        raise SettingsError("contrast.angles_mas", f"must be within the image of {most_mas:.0f} mas", angle_rad.max())
    return np.exp(np.interp(places, np.arange(1, len(rings)), np.log(rings[1:])))


def measured_flux_factor(
    loop: Loop, state: LoopState, cycles_per_aperture: Float[np.ndarray, " wave"]
) -> Float[np.ndarray, " wave"]:
    r"""Flux factor of the curvature sensor, for the wavefront that the loop leaves.

    The Fisher information F of all modes of the mirror (exact derivatives) gives the variance :math:`c^T F^{-1} c` of
    a wave of unit rms with the coefficients c while all other modes are unknown too; times 4 N it is q. The mean over
    sines and cosines in `ORIENTATIONS` directions.

    Args:
        loop: Has run.
        state: Where it ended.
        cycles_per_aperture: Frequencies.
    """
    light, still, mirror = loop.light, loop.light.still, loop.light.mirror
    left = light.expose(jnp.asarray(state.frame, jnp.int32), state.control.line, state.image, 0 * light.weights)
    part, weights = light.part, np.asarray(light.weights, float)

    def counts(opd_m: Float[Array, "y x"]) -> Float[Array, "plane v u"]:
        images = still.sensor.images(still.on_light(opd_m), 1.0).photons
        return integrate_on_pixels(images, factor=still.factor, window=still.window)

    margins = [(whole - kept) // 2 for whole, kept in zip(still.light.shape, weights.shape, strict=True)]
    inner = tuple(slice(m, m + kept) for m, kept in zip(margins, weights.shape, strict=True))
    shapes = np.zeros((mirror.count, *mirror.shape), np.float32)
    shapes[:, np.asarray(mirror.rows), np.asarray(mirror.columns)] = np.asarray(mirror.shapes)
    information = fisher_information(counts, left.exposure.opd_m[inner], jnp.asarray(shapes))
    radian_m = loop.config.beam.wavelength_um * 1e-6 / (2 * math.pi)
    found = []
    for waves in cycles_per_aperture:
        modes = _waves(part.y_m, part.x_m, weights, float(waves) / still.shape.diameter_m)
        parts = np.stack([np.asarray(mirror.fitted(jnp.asarray(mode, jnp.float32)), float) for mode in modes])
        variance = np.sum(parts * np.linalg.solve(information, parts.T).T, axis=1) / np.sum(parts**2, axis=1)
        found.append(4 * np.mean(variance) / radian_m**2)
    return np.array(found)


def halo_with_wings(
    halo: Halo,
    angle_rad: Float[np.ndarray, " angle"],
    rate_hz: float,
    sensor: FluxFactor,
    cutoff_cpa: float,
) -> Float[np.ndarray, " angle"]:
    r"""The halo as an aperture with a hard edge shows it, what the mirror cannot make included.

    :math:`\int C(f)\, \mathrm{Airy}(f - \theta / \lambda)\, A\, df`: each wave makes the image of the aperture at its
    angle, whose wings reach others. The mean of the aperture, which the coronagraph takes out, is taken out.

    Args:
        halo: Telescope, air and star.
        angle_rad: Angles.
        rate_hz: Exposures in a second.
        sensor: Its flux factor, known at all frequencies up to the cutoff.
        cutoff_cpa: Highest frequency that the mirror makes, cycles per aperture.

    Examples:
        >>> import math
        >>> from nlcwfs.atmosphere.phase_screen import Turbulence
        >>> air, light = Turbulence.from_seeing(seeing_arcsec=0.6), (0.7e-6, 1.6e-6, 7.8e7)
        >>> halo, theta = Halo(air, ((1.0, 10.0),), 8.0, math.pi * 16, *light), np.array([4e-7])
        >>> ideal = constant_flux_factor("ideal", 1.0)
        >>> seen = halo_with_wings(halo, theta, 300.0, ideal, 16.0)[0]
        >>> bool(1.0 < seen / halo.contrast(theta, 300.0, ideal.at(np.array([2.0])))[0] < 1.5)
        True
    """
    n = np.arange(-FINEST_CPA, FINEST_CPA + STEP_CPA / 2, STEP_CPA)
    waves = np.hypot(n[:, None], n[None])
    radii = np.geomspace(STEP_CPA / 2, 2 * FINEST_CPA, 2000)
    angles = radii * halo.imaging_m / halo.diameter_m
    corrected = halo.contrast(angles, rate_hz, sensor.at(np.clip(radii, *_ends(sensor))))
    profile = np.where(radii <= cutoff_cpa, corrected, halo.uncorrected(angles))
    airy = _airy(waves)
    spread = np.interp(waves, radii, profile) * (1 - airy)
    shown = scipy.signal.fftconvolve(spread, airy * (math.pi / 4 * STEP_CPA**2), mode="same")
    rings = ring_means(shown)
    return np.exp(np.interp(halo.cycles_per_aperture(angle_rad) / STEP_CPA, np.arange(len(rings)), np.log(rings)))


def loop_rows(config: Config, loop: Loop, state: LoopState, told_mas: Sequence[float]) -> list[Row]:
    """Measured and predicted halo at angles.

    Args:
        config: Of the loop.
        loop: Has run.
        state: Where it ended.
        told_mas: Angles.
    """
    halo, rate_hz, angle_rad = halo_of(config), config.loop.rate_hz, np.array(told_mas) * MAS_RAD
    waves = halo.cycles_per_aperture(angle_rad)
    if config.loop.sensor == "ideal":
        sensor = constant_flux_factor("noise-free", 0.0)
    else:
        sensor = FluxFactor(config.loop.sensor, waves, measured_flux_factor(loop, state, waves))
    factor, measured = sensor.at(waves), measured_contrast(state, angle_rad)
    lag, noise = halo.lag(angle_rad, rate_hz), halo.photon_noise(rate_hz, factor)
    wings = halo_with_wings(halo, angle_rad, rate_hz, sensor, mirror_cutoff(config))
    return [
        {"sensor": sensor.sensor, "rate_hz": rate_hz, "photons_per_s": halo.photons_per_s}
        | {"static_nm": config.curvature_sensor.static_rms_nm, "seed": config.seed}
        | {"exposures": int(state.image.exposures), "strehl": short(float(state.image.strehl))}
        | {"angle_mas": float(told_mas[k]), "cycles_per_aperture": short(float(waves[k]))}
        | {"flux_factor": short(float(factor[k])), "lag": short(float(lag[k])), "photon_noise": short(float(noise[k]))}
        | {"contrast": short(float(lag[k] + noise[k])), "with_wings": short(float(wings[k]))}
        | {"measured": short(float(measured[k]))}
        for k in range(len(waves))
    ]


def _waves(
    y_m: np.ndarray, x_m: np.ndarray, weights: Float[np.ndarray, "y x"], cycles_per_m: float
) -> Float[np.ndarray, "mode y x"]:
    """Sines and cosines of unit rms over the light, without piston."""
    modes = []
    for turn in (np.arange(ORIENTATIONS) + 0.5) * np.pi / ORIENTATIONS:
        along = 2 * np.pi * cycles_per_m * (y_m * np.sin(turn) + x_m * np.cos(turn))
        for wave in (np.cos(along), np.sin(along)):
            level = wave - np.sum(weights * wave)
            modes.append(np.where(weights > 0, level / np.sqrt(np.sum(weights * level**2)), 0))
    return np.stack(modes)


def _airy(waves: Float[np.ndarray, "y x"]) -> Float[np.ndarray, "y x"]:
    """Image of a round aperture, 1 at its peak."""
    x = np.pi * np.maximum(waves, 1e-9)
    return (2 * scipy.special.j1(x) / x) ** 2


def _ends(sensor: FluxFactor) -> tuple[float, float]:
    return float(sensor.cycles_per_aperture[0]), float(sensor.cycles_per_aperture[-1])

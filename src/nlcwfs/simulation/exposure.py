"""One simulated exposure: a turbulent sky, the light on a fine and wide grid, the frames of the detector."""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import scipy.fft
from jaxtyping import Array, Float, PRNGKeyArray, Shaped

from nlcwfs.atmosphere.phase_screen import PhaseScreens, Turbulence, mean_rms_m
from nlcwfs.beam.air_at_pupil import HighAir
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil import light_weights
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.config import Config
from nlcwfs.constants import ARCSEC_RAD, SEEING_TO_FRIED, SEEING_WAVELENGTH_M
from nlcwfs.curvature_sensor.defocused_images import CurvatureSensor
from nlcwfs.detector.pixels import fraction_outside_window, integrate_on_pixels
from nlcwfs.detector.read import Detector, Frames
from nlcwfs.simulation.colours import colours_of
from nlcwfs.simulation.scintillation import high_air
from nlcwfs.simulation.segment_aberrations import SegmentAberrations
from nlcwfs.simulation.static_aberration import lit_part, static_aberration
from nlcwfs.simulation.telescope import telescope

SMALLEST_LIGHT = 1e-6
"""Light of a detector pixel, over a fully lit one, below which it has no wavefront."""


class Exposure(eqx.Module):
    """What happened in one exposure, and what the detector made of it; batches carry a leading frame axis.

    Attributes:
        opd_m: The star's wavefront on the grid of the light, zero mean over the pupil and zero outside; where the air
            moves, its mean over the exposure.
        photons: Mean photons on every detector pixel, without background.
        frames: What the detector read.
        truth_m: Mean of `opd_m` over the light of every detector pixel of a pupil image; NaN where there is none.
        lost: Share of the light of each plane that misses the detector's window.

    A Shack-Hartmann sensor has spots in place of planes.
    """

    opd_m: Float[Array, "*frame Y X"]
    photons: Float[Array, "*frame plane v u"]
    frames: Frames
    truth_m: Float[Array, "*frame y x"]
    lost: Float[Array, "*frame plane"]


class ExposureSimulator(eqx.Module):
    """Makes exposures of one sensor under one sky.

    Nothing here is on the grid of a reconstructor: the light has `simulation.light_oversampling` cells to a
    detector pixel and a window `simulation.light_window` times the detector's (see `docs/decisions`).

    Attributes:
        shape: The pupil, apart from any grid.
        light: Grid of the light.
        air: The turbulence.
        screens: Draws wavefronts on the part of the grid that holds the pupil.
        sensor: The optics on the grid of the light.
        weights: Share of the light in every cell of the pupil, on the grid of the light.
        detector: The camera.
        wavelength_m: Wavelength of sensing, at which the reconstructor works.
        photons: Photons that the whole sensor gets in one exposure.
        factor: Cells of the light along a detector pixel.
        window: Detector pixels along y and x.
        stand: How the segments of the pupil stand; None where they stand still, or there are none.
        high: Draws wavefronts and amplitudes of air at altitude, in place of `screens`; None where there is none.

    Examples:
        >>> from nlcwfs.config import load_config
        >>> small = ["detector.pixels_across_pupil=12", "detector.window_pixels=16", "atmosphere.opd_rms_nm=100"]
        >>> simulator = ExposureSimulator.build(load_config(None, small))
        >>> exposure = simulator.expose(frame_key(seed=0, frame=3))
        >>> exposure.frames.electrons.shape, simulator.light.shape
        ((4, 16, 16), (128, 128))
    """

    shape: PupilShape = eqx.field(static=True)
    light: Grid = eqx.field(static=True)
    air: Turbulence = eqx.field(static=True)
    screens: PhaseScreens
    sensor: CurvatureSensor
    weights: Float[Array, "y x"]
    detector: Detector
    wavelength_m: float = eqx.field(static=True)
    photons: float = eqx.field(static=True)
    factor: int = eqx.field(static=True)
    window: tuple[int, int] = eqx.field(static=True)
    stand: SegmentAberrations | None = None
    high: HighAir | None = None

    @classmethod
    def build(cls, config: Config, shape: PupilShape | None = None) -> "ExposureSimulator":
        """Prepare the grids, the optics and the sky of a configuration.

        Args:
            config: The settings.
            shape: The pupil, when it is a map that was read from `beam.pupil_map`; else it follows from the settings.

        Raises:
            SettingsError: If settings contradict each other.
            SamplingError: If the pupil does not fit in the window.
        """
        dtype = "float64" if config.precision == "double" else "float32"
        shape, air = telescope(config) if shape is None else shape, turbulence(config)
        light = light_grid(config)
        pupil = shape.on(light)
        cut = lit_part(pupil)
        window = (config.detector.window_pixels, config.detector.window_pixels)
        weights = light_weights(pupil)
        colours = colours_of(config, air)
        return cls(
            shape=shape,
            light=light,
            air=air,
            screens=PhaseScreens.build(air, shape=pupil[cut].shape, pixel_m=light.pixel_m, dtype=dtype),
            sensor=CurvatureSensor.build(
                pupil,
                light,
                distances_m=colours.distances_m,
                spectrum=colours.spectrum,
                flux_fractions=config.curvature_sensor.flux_fractions,
                static_opd_m=static_aberration(config, weights, light),
                star=colours.star,
                dtype=dtype,
            ),
            weights=jnp.asarray(weights, dtype),
            detector=Detector(config.detector),
            wavelength_m=wavelength_m(config),
            photons=config.atmosphere.photons * (1 - config.curvature_sensor.membrane_dead_share),
            factor=config.simulation.light_oversampling,
            window=window,
            stand=SegmentAberrations.build(config.beam.segments, shape, light, pupil, dtype=dtype),
            high=high_air(config, air, colours.spectrum, shape=pupil[cut].shape, pixel_m=light.pixel_m),
        )

    @property
    def log_variance(self) -> float | None:
        """Variance of the logarithm of the amplitude at the wavelength of sensing; None in even light."""
        return None if self.high is None else float(self.high.log_variance[0])

    @property
    def frame(self) -> Grid:
        """The pixels of one plane of the detector."""
        return Grid(self.window, self.light.pixel_m * self.factor)

    @eqx.filter_jit
    def expose(self, key: PRNGKeyArray) -> Exposure:
        """Draw a sky and expose the detector once.

        Args:
            key: Random key of this frame, see `frame_key`.
        """
        key_sky, key_detector = jax.random.split(key)
        opd_m, factor = (self.screens.draw(key_sky), None) if self.high is None else self.high.draw(key_sky)
        opd_m = self.on_light(opd_m)
        if self.stand is not None:
            opd_m = opd_m + self.stand.draw(key)
        return self.expose_to(opd_m, key_detector, factor=None if factor is None else jax.vmap(self.on_light)(factor))

    @eqx.filter_jit
    def expose_to(
        self, opd_m: Float[Array, "Y X"], key: PRNGKeyArray, *, factor: Shaped[Array, "seen Y X"] | None = None
    ) -> Exposure:
        """Expose the detector once to a wavefront that is given.

        Args:
            opd_m: Wavefront on the grid of the light; what lies outside the pupil, and piston, do not count.
            key: Random key of the detector's noise.
            factor: What else multiplies the field at the pupil, see `CurvatureSensor.images`.
        """
        opd_m = self.levelled(opd_m)
        return self.read(opd_m, self.sensor.images(opd_m, self.photons, factor=factor).photons, key)

    def levelled(self, opd_m: Float[Array, "Y X"]) -> Float[Array, "Y X"]:
        """A wavefront without its piston and without what lies outside the pupil."""
        opd_m = opd_m.astype(self.weights.dtype)
        return jnp.where(self.weights > 0, opd_m - jnp.sum(self.weights * opd_m), 0)

    def read(self, opd_m: Float[Array, "Y X"], planes: Float[Array, "plane Y X"], key: PRNGKeyArray) -> Exposure:
        """Let the detector read light that is already on the planes.

        Args:
            opd_m: Wavefront that made the light, levelled; it only goes into the record.
            planes: Photons on the grid of the light.
            key: Random key of the detector's noise.
        """
        photons = integrate_on_pixels(planes, factor=self.factor, window=self.window)
        return Exposure(
            opd_m=opd_m,
            photons=photons,
            frames=self.detector.read(photons, key),
            truth_m=self.on_pixels(opd_m),
            lost=fraction_outside_window(planes, factor=self.factor, window=self.window),
        )

    def on_pixels(self, opd_m: Float[Array, "Y X"]) -> Float[Array, "y x"]:
        """Mean of a wavefront over the light of every detector pixel; NaN where there is none."""
        both = jnp.stack([self.weights, self.weights * opd_m])
        light, weighted = integrate_on_pixels(both, factor=self.factor, window=self.window)
        lit = light > SMALLEST_LIGHT * jnp.max(light)
        return jnp.where(lit, weighted / jnp.where(lit, light, 1), jnp.nan)

    def pixel_weights(self) -> Float[Array, "y x"]:
        """Share of the pupil's light on every detector pixel."""
        return integrate_on_pixels(self.weights[None], factor=self.factor, window=self.window)[0]

    def on_light(self, opd_m: Shaped[Array, "lit_y lit_x"]) -> Shaped[Array, "Y X"]:
        """A wavefront, or a factor, on the part of the grid that holds the pupil, zero around it."""
        margins = [((whole - part) // 2,) * 2 for whole, part in zip(self.light.shape, opd_m.shape, strict=True)]
        return jnp.pad(opd_m, margins)


def frame_key(*, seed: int, frame: int) -> PRNGKeyArray:
    """The random key of a frame: the same however many frames there are.

    Examples:
        >>> bool((jax.random.key_data(frame_key(seed=1, frame=0)) == jax.random.key_data(jax.random.key(1))).all())
        False
    """
    return jax.random.fold_in(jax.random.key(seed), frame)


def wavelength_m(config: Config) -> float:
    """Wavelength of sensing."""
    return config.beam.wavelength_um * 1e-6


def distances_m(config: Config) -> tuple[float, ...]:
    """Signed distance of every plane from the pupil."""
    return tuple(distance_km * 1e3 for distance_km in config.curvature_sensor.distances_km)


def turbulence(config: Config) -> Turbulence:
    """The air of a configuration; `opd_rms_nm` rules over the seeing, outer scale included.

    Examples:
        >>> from nlcwfs.config import load_config
        >>> air = turbulence(load_config(None, ["atmosphere.opd_rms_nm=609"]))
        >>> round(8.0 / air.fried_at(0.65e-6), 1)
        8.2
    """
    sky, diameter_m = config.atmosphere, config.beam.diameter_m
    outer_scale_m = math.inf if sky.outer_scale_m is None else sky.outer_scale_m
    if sky.opd_rms_nm is None:
        return Turbulence.from_seeing(seeing_arcsec=sky.seeing_arcsec, outer_scale_m=outer_scale_m)
    air = Turbulence.from_rms(opd_rms_m=sky.opd_rms_nm * 1e-9, diameter_m=diameter_m)
    if math.isinf(outer_scale_m):
        return air
    calmer = dataclasses.replace(air, outer_scale_m=outer_scale_m)
    missing = mean_rms_m(calmer, diameter_m) / mean_rms_m(air, diameter_m)
    return dataclasses.replace(calmer, fried_m=air.fried_m * missing ** (6 / 5))  # rms ~ r0^(-5/6)


def seeing_arcsec(air: Turbulence) -> float:
    """Seeing at 500 nm: full width of a long exposure in Kolmogorov turbulence of this Fried parameter."""
    return SEEING_TO_FRIED * SEEING_WAVELENGTH_M / air.fried_at(SEEING_WAVELENGTH_M) / ARCSEC_RAD


def light_grid(config: Config) -> Grid:
    """The grid of the light: centred on the detector's window, and of a size that suits the FFT.

    Examples:
        >>> light_grid(Config()).shape
        (1024, 1024)
    """
    detector, simulation = config.detector, config.simulation
    inner = detector.window_pixels * simulation.light_oversampling
    size = math.ceil(inner * simulation.light_window)
    while (size - inner) % 2 or size != scipy.fft.next_fast_len(size):
        size += 1  # odd around odd, even around even: the centres agree
    pixel_m = config.beam.diameter_m / (detector.pixels_across_pupil * simulation.light_oversampling)
    return Grid((size, size), pixel_m)

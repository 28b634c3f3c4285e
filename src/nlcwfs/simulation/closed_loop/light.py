"""What the sensor and the astronomer get while a mirror follows moving air."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from nlcwfs.beam.grid import Grid
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.beam.zernike import zernikes
from nlcwfs.config import Config
from nlcwfs.curvature_sensor.settings import CurvatureSensorSettings
from nlcwfs.feedback.delay_line import DelayLine
from nlcwfs.mirror.mirror import Mirror
from nlcwfs.science.long_exposure import LongExposure
from nlcwfs.simulation.closed_loop.lenslet_light import LensletOptics
from nlcwfs.simulation.closed_loop.optics import CurvatureOptics, LoopOptics
from nlcwfs.simulation.closed_loop.pyramid_light import PyramidOptics
from nlcwfs.simulation.exposure import Exposure, ExposureSimulator
from nlcwfs.simulation.sequence import SCREEN_DIAMETERS, SequenceSimulator
from nlcwfs.simulation.starlight import with_exposures_of
from nlcwfs.simulation.steady_light import refuse_colours, refuse_membrane

SHOWN_CYCLES = 40.0
"""Half width of the star's image in lambda / D."""

IMAGE_PIXELS = 161
"""Pixels along a side of the star's image: two for each lambda / D."""


class Corrected(eqx.Module):
    """One exposure behind the mirror.

    Attributes:
        exposure: What the sensor's detector read; its wavefront is the mean of what the sensor got.
        square_m2: Mean over the moments of the variance over the pupil of what the star's image got.
        image: The star's image so far.
    """

    exposure: Exposure
    square_m2: Float[Array, ""]
    image: LongExposure


class LoopLight(eqx.Module):
    """Air that moves, a mirror that is told, and the light behind both.

    Attributes:
        sequence: The air, the grid of the light, the photons and the detector.
        mirror: On the part of the light's grid that holds the pupil.
        weights: Share of the light there.
        optics: The sensor's.
        reference_m: What the sensor sees when the star's image is flat.
    """

    sequence: SequenceSimulator
    mirror: Mirror
    weights: Float[Array, "lit_y lit_x"]
    optics: LoopOptics
    reference_m: Float[Array, "lit_y lit_x"]

    @classmethod
    def build(cls, config: Config, pupil: PupilShape | None = None) -> "LoopLight":
        """Draw the air and make the mirror.

        Args:
            config: The settings.
            pupil: Its shape, as for `ExposureSimulator.build`.

        Raises:
            SettingsError: If settings contradict each other, or the air would repeat before the end.
            SamplingError: If the pupil does not fit in the window, or the mirror's shapes are too fine for the light.
        """
        if config.loop.sensor == "linear-curvature":
            refuse_membrane(config, because='loop.sensor = "linear-curvature"')
        sequence = SequenceSimulator.build(sequence_config(config), pupil)
        still = sequence.still
        cut = still.screens.low_waves_y.shape[1], still.screens.low_waves_x.shape[1]
        amplitude, part = _middle(still.shape.on(still.light), cut), Grid(cut, still.light.pixel_m)
        diameter_m = config.beam.diameter_m
        dtype = str(still.weights.dtype)
        mirror = Mirror.build(config.mirror, amplitude, part, diameter_m=diameter_m, dtype=dtype)
        weights = _middle(np.asarray(still.weights, float), cut)
        optics = CurvatureOptics(still)
        if config.loop.sensor in ("shack-hartmann", "pyramid"):
            refuse_colours(config, because=f'loop.sensor = "{config.loop.sensor}"')
        if config.loop.sensor == "shack-hartmann":
            optics = LensletOptics.build(config, still, weights > 0)
        if config.loop.sensor == "pyramid":
            optics = PyramidOptics.build(config, still, part)
        reference_m = reference_wavefront_m(config, weights, part)
        return cls(sequence, mirror, jnp.asarray(weights, dtype), optics, jnp.asarray(reference_m, dtype))

    @property
    def still(self) -> ExposureSimulator:
        """The optics."""
        return self.sequence.still

    @property
    def part(self) -> Grid:
        """The part of the light's grid that holds the pupil."""
        return Grid((self.weights.shape[0], self.weights.shape[1]), self.still.light.pixel_m)

    def star_image(self, wavelength_m: float, *, coronagraph: bool = False) -> LongExposure:
        """An image to which nothing has been added yet."""
        still = self.still
        angles = Grid((IMAGE_PIXELS, IMAGE_PIXELS), wavelength_m / still.shape.diameter_m / 2)
        pupil = _middle(still.shape.on(still.light), self.weights.shape)
        scale = {"wavelength_m": wavelength_m, "pixel_m": still.light.pixel_m, "angles": angles}
        return LongExposure.init(pupil, **scale, coronagraph=coronagraph)

    def air_m(self, frame: int) -> Float[Array, "lit_y lit_x"]:
        """The wavefront of the air in the middle of an exposure, without piston."""
        moment_s = jnp.asarray((frame + 0.5) / self.sequence.rate_hz, self.weights.dtype)
        opd_m = self.sequence.flow.opd_m(moment_s)
        return opd_m - jnp.sum(self.weights * opd_m)

    @eqx.filter_jit
    def expose(
        self, frame: Int[Array, ""], line: DelayLine, image: LongExposure, bump_m: Float[Array, "lit_y lit_x"]
    ) -> Corrected:
        """One exposure. A moment in which the mirror changes sees the mean of both shapes.

        Args:
            frame: Its number; frame 0 begins at 0.
            line: The mirror during the exposure.
            image: The star's image so far.
            bump_m: Wavefront in addition to that of the air.
        """
        still, share = self.still, 1 / self.sequence.substeps
        moments_s = self.sequence.moments_s(frame)
        after_m = self.mirror.opd_m(line.after_m)
        before_m = self.mirror.opd_m(line.before_m) if line.share_before > 0 else after_m

        def add(sums: tuple, moment: tuple[Array, Array]) -> tuple[tuple, None]:
            opd_m = self.sequence.flow.opd_m(moment[0]) + bump_m - moment[1] * before_m - (1 - moment[1]) * after_m
            opd_m = jnp.where(self.weights > 0, opd_m - jnp.sum(self.weights * opd_m), 0)
            whole_m = still.on_light(opd_m)
            images = self._images(opd_m, share * still.photons, moment[0])
            left_m = opd_m - self.reference_m
            square = jnp.sum(self.weights * left_m**2)
            return (sums[0] + whole_m * share, sums[1] + images, sums[2] + square * share, sums[3].add(left_m)), None

        dark = jax.eval_shape(lambda opd_m: self.optics.images(opd_m, still.photons), self.weights)
        dtype = self.weights.dtype
        none = (jnp.zeros(still.light.shape, dtype), jnp.zeros(dark.shape, dtype), jnp.zeros((), dtype), image)
        early = self._share_before(line.share_before)
        (opd_m, images, square, image), _ = jax.lax.scan(add, none, (moments_s, early))
        key = jax.random.split(jax.random.fold_in(jax.random.key(self.sequence.seed), frame))[1]
        return Corrected(self.optics.read(opd_m, images, key), square, image)

    def _images(
        self, opd_m: Float[Array, "lit_y lit_x"], photons: float, moment_s: Float[Array, ""]
    ) -> Float[Array, "image v u"]:
        """Of a moment; other sensors than the curvature sensor refuse air that twinkles."""
        factor = self.sequence.factor(moment_s)
        if factor is None or not isinstance(self.optics, CurvatureOptics):
            return self.optics.images(opd_m, photons)
        return self.optics.images(opd_m, photons, factor=factor)

    def _share_before(self, share: float) -> Float[Array, " substep"]:
        """For each moment, the part of its time with the earlier command on the mirror."""
        begins = np.arange(self.sequence.substeps) / self.sequence.substeps
        return jnp.asarray(np.clip((share - begins) * self.sequence.substeps, 0, 1), self.weights.dtype)


def sequence_config(config: Config) -> Config:
    """The same, as the sequence that a loop exposes: its rate, its length, its light, and air that lasts.

    Examples:
        >>> from nlcwfs.config import load_config
        >>> config = sequence_config(load_config(None, ["atmosphere.photons_per_s=3e6", "loop.rate_hz=300"]))
        >>> config.atmosphere.photons, config.simulation.frames
        (10000.0, 300)
    """
    config = with_exposures_of(config, config.loop.rate_hz)
    loop, sky = config.loop, config.atmosphere
    carried_m = max(sky.wind_speeds_m_per_s) * loop.seconds
    width_m = max(SCREEN_DIAMETERS * config.beam.diameter_m, carried_m + 4 * config.beam.diameter_m)
    air = {"screen_width_m": sky.screen_width_m or width_m}
    config = with_planes_of_sensor(config)
    time = {"rate_hz": loop.rate_hz, "frames": loop.frames, "substeps": loop.substeps}
    return config.model_copy(
        update={
            "atmosphere": sky.model_copy(update=air),
            "simulation": config.simulation.model_copy(update=time),
        }
    )


def with_planes_of_sensor(config: Config) -> Config:
    """The same, with the planes of the linear curvature sensor where that one measures.

    Examples:
        >>> from nlcwfs.config import load_config
        >>> with_planes_of_sensor(load_config(None, ["loop.sensor=linear-curvature"])).curvature_sensor.distances_km
        (-1000.0, 1000.0)
    """
    if config.loop.sensor != "linear-curvature":
        return config
    lenses = {"lenses": config.curvature_sensor.lenses, "glasses": config.curvature_sensor.glasses}
    planes = CurvatureSensorSettings(distances_km=config.linear_curvature.distances_km, **lenses)
    return config.model_copy(update={"curvature_sensor": planes})


def reference_wavefront_m(
    config: Config, weights: Float[np.ndarray, "lit_y lit_x"], grid: Grid
) -> Float[np.ndarray, "lit_y lit_x"]:
    """What the sensor sees when the star's image is flat, without piston; zero where there is no light.

    Args:
        config: The settings.
        weights: Share of the light in every cell.
        grid: The cells.

    Examples:
        >>> from nlcwfs.config import load_config
        >>> tilted = load_config(None, ["loop.reference_nm=[0, 40]", "beam.diameter_m=2"])
        >>> one = reference_wavefront_m(tilted, np.full((4, 4), 1 / 16), Grid((4, 4), 0.25))
        >>> (1e9 * one[:, 0]).round(1).tolist()  # twice the height over the radius, of 40 nm
        [-30.0, -10.0, 10.0, 30.0]
    """
    wave_m = 1e-9 * np.array([0.0, *config.loop.reference_nm])
    shapes = zernikes(len(wave_m), grid, diameter_m=config.beam.diameter_m)
    summed = np.tensordot(wave_m, np.asarray(shapes, float), axes=1)
    return np.where(weights > 0, summed - np.sum(weights * summed), 0)


def _middle(array: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    corner = [(whole - part) // 2 for whole, part in zip(array.shape, shape, strict=True)]
    return array[corner[0] : corner[0] + shape[0], corner[1] : corner[1] + shape[1]]

"""Successive exposures of one moving atmosphere."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import scipy.fft
from jaxtyping import Array, Float, Int, PRNGKeyArray

from nlcwfs.atmosphere.frozen_flow import TAPS, FrozenFlow, WindLayer, unrepeated_s
from nlcwfs.atmosphere.phase_screen import PhaseScreens
from nlcwfs.beam.moving_air_at_pupil import Twinkling
from nlcwfs.beam.pupil_shape import PupilShape
from nlcwfs.config import Config
from nlcwfs.errors import SettingsError
from nlcwfs.simulation.exposure import Exposure, ExposureSimulator, frame_key
from nlcwfs.simulation.scintillation import high_flow, without_heights

SCREEN_DIAMETERS = 12
"""Width of the air in diameters of the telescope; 8 m and 10 m/s give 9 s, and Table 1 a screen of 75 MB."""

WIDEST_SCREEN = 12_000
"""Cells along a side of the air. It takes 0.6 GB for each layer, and several times that while it is drawn."""

AIR = 2**31
"""Number of the air's own random key, beyond that of any frame."""


class SequenceSimulator(eqx.Module):
    """Makes the successive exposures of one sensor under one sky that the wind moves.

    An exposure lasts until the next begins. Its light is the sum of `substeps` moments, each in the middle of its part
    of the exposure, and its wavefront is the mean of theirs. The same seed gives the same air at the same time, and
    the same exposures however many there are.

    Attributes:
        still: The sensor, and what makes one exposure.
        flow: The air, as it is at the pupil.
        twinkling: The amplitude that it makes there; None where all of it is at the telescope.
        rate_hz: Exposures in a second.
        substeps: Moments of an exposure.
        seed: Of air and noise.

    Examples:
        >>> from nlcwfs.config import load_config
        >>> small = ["detector.pixels_across_pupil=12", "detector.window_pixels=16", "atmosphere.opd_rms_nm=100"]
        >>> sequence = SequenceSimulator.build(load_config(None, [*small, "simulation.rate_hz=500"]))
        >>> sequence.expose(3).frames.electrons.shape, sequence.longest
        ((4, 16, 16), 4141)
    """

    still: ExposureSimulator
    flow: FrozenFlow
    rate_hz: float = eqx.field(static=True)
    substeps: int = eqx.field(static=True)
    seed: int = eqx.field(static=True)
    twinkling: Twinkling | None = None

    @classmethod
    def build(cls, config: Config, pupil: PupilShape | None = None) -> "SequenceSimulator":
        """Prepare the sensor and draw the air.

        Args:
            config: The settings.
            pupil: Its shape, as for `ExposureSimulator.build`.

        Raises:
            SettingsError: If there is no rate, if the air would repeat before the last frame, if segments do not stand
                still, if layers at altitude cannot be served, or if settings contradict each other.
            SamplingError: If the pupil does not fit in the window.
        """
        rate_hz = config.simulation.rate_hz
        if rate_hz is None:
            raise SettingsError("simulation.rate_hz", "must be given for a sequence (--rate HZ)", "nothing")
        still = ExposureSimulator.build(without_heights(config), pupil)
        if still.stand is not None:
            rule = "must have no pistons and tilts in a sequence or a loop: only single exposures know them yet"
            raise SettingsError("beam.segments", rule, config.beam.segments.layout)
        shape, pixel_m = (still.screens.low_waves_y.shape[1], still.screens.low_waves_x.shape[1]), still.light.pixel_m
        period, layers = _period(config, max(shape), pixel_m), wind_layers(config)
        _check_duration(config, unrepeated_s(layers, shape=shape, pixel_m=pixel_m, period=period), rate_hz)
        dtype, key = str(still.weights.dtype), jax.random.fold_in(jax.random.key(config.seed), AIR)
        screens = PhaseScreens.build(still.air, shape=shape, pixel_m=pixel_m, period=period, dtype=dtype)
        flow = FrozenFlow.build(screens, layers, key, duration_s=config.simulation.frames / rate_hz)
        flow, twinkling = high_flow(config, still.air, flow, pixel_m=pixel_m)
        return cls(
            still=still,
            flow=flow,
            rate_hz=rate_hz,
            substeps=config.simulation.substeps,
            seed=config.seed,
            twinkling=twinkling,
        )

    @property
    def longest(self) -> int | float:
        """Frames until the air repeats; infinite in a calm."""
        return _frames_within(self.flow.unrepeated_s, self.rate_hz)

    def moments_s(self, frame: int | Float[Array, ""] | Int[Array, ""]) -> Float[Array, " substep"]:
        """When the light of an exposure is computed; frame 0 begins at 0."""
        middle = (jnp.arange(self.substeps, dtype=self.still.weights.dtype) + 0.5) / self.substeps
        return (jnp.asarray(frame, middle.dtype) + middle) / self.rate_hz

    @property
    def log_variance(self) -> float | None:
        """Variance of the logarithm of the amplitude; None in even light."""
        return None if self.twinkling is None else float(self.twinkling.variance)

    def factor(self, moment_s: Float[Array, ""]) -> Float[Array, "1 Y X"] | None:
        """What else multiplies the field at the pupil at a moment, on the grid of the light; None in even light."""
        if self.twinkling is None:
            return None
        return self.still.on_light(self.twinkling.amplitude(moment_s))[None]

    def expose(self, frame: int) -> Exposure:
        """One exposure of the sequence, counted from 0."""
        key_detector = jax.random.split(frame_key(seed=self.seed, frame=frame))[1]
        return self._expose(self.moments_s(frame), key_detector)

    @eqx.filter_jit
    def _expose(self, moments_s: Float[Array, " substep"], key: PRNGKeyArray) -> Exposure:
        still, share = self.still, 1 / self.substeps

        def add(
            sums: tuple[Float[Array, "Y X"], Float[Array, "plane Y X"]], moment_s: Float[Array, ""]
        ) -> tuple[tuple[Float[Array, "Y X"], Float[Array, "plane Y X"]], None]:
            opd_m = still.levelled(still.on_light(self.flow.opd_m(moment_s)))
            planes = still.sensor.images(opd_m, share * still.photons, factor=self.factor(moment_s)).photons
            return (sums[0] + share * opd_m, sums[1] + planes), None

        shape, dtype = still.sensor.transfer.shape[1:], still.weights.dtype
        (opd_m, planes), _ = jax.lax.scan(add, (jnp.zeros(shape[1:], dtype), jnp.zeros(shape, dtype)), moments_s)
        return still.read(opd_m, planes, key)


def wind_layers(config: Config) -> list[WindLayer]:
    """The layers of air of a configuration.

    Examples:
        >>> wind_layers(Config())
        [WindLayer(fraction=1.0, speed_m_per_s=10.0, direction_deg=0.0)]
    """
    sky = config.atmosphere
    chosen = zip(sky.layer_fractions, sky.wind_speeds_m_per_s, sky.wind_directions_deg, strict=True)
    return [WindLayer(*layer) for layer in chosen]


def _period(config: Config, window: int, pixel_m: float) -> int:
    """Cells along a side of the air, a number that suits the FFT."""
    chosen_m = config.atmosphere.screen_width_m
    width_m = SCREEN_DIAMETERS * config.beam.diameter_m if chosen_m is None else chosen_m
    narrowest, count = window + TAPS, math.ceil(width_m / pixel_m)
    if not narrowest <= count <= WIDEST_SCREEN:
        rule = f"must be from {narrowest * pixel_m:.4g} to {WIDEST_SCREEN * pixel_m:.4g} m on cells of {pixel_m:.3g} m"
        raise SettingsError("atmosphere.screen_width_m", rule, f"{width_m:g}{' by default' * (chosen_m is None)}")
    while count != scipy.fft.next_fast_len(count):
        count += 1
    return count


def _check_duration(config: Config, longest_s: float, rate_hz: float) -> None:
    """Refuse a sequence that outlasts its air."""
    frames, longest = config.simulation.frames, _frames_within(longest_s, rate_hz)
    after = f"after {longest_s:.3g} s this air repeats itself (atmosphere.screen_width_m, or a wind across the axes)"
    if longest < 1:
        raise SettingsError("simulation.rate_hz", f"must be at least {1 / longest_s:.3g} Hz: {after}", f"{rate_hz:g}")
    if frames > longest:
        raise SettingsError("simulation.frames", f"must be at most {longest} at {rate_hz:g} Hz: {after}", frames)


def _frames_within(longest_s: float, rate_hz: float) -> int | float:
    return longest_s if math.isinf(longest_s) else math.floor(longest_s * rate_hz)

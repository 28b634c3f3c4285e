"""The maximum a posteriori wavefront: the one that photons and turbulence together make most likely."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nlcwfs.beam.grid import Grid
from nlcwfs.constants import ARCSEC_RAD, SEEING_TO_FRIED, SEEING_WAVELENGTH_M
from nlcwfs.estimation import gauss_newton as gn
from nlcwfs.estimation.amplitude_search import with_amplitude
from nlcwfs.estimation.expected_amplitude import ExpectedAmplitude
from nlcwfs.estimation.first_guess import segmented_start, with_strength
from nlcwfs.estimation.fit_quality import speckle_band, unexplained_share
from nlcwfs.estimation.gerchberg_saxton import phase_noise
from nlcwfs.estimation.ladder import finest_level
from nlcwfs.estimation.map_error import MapError
from nlcwfs.estimation.map_solution import Found, Task, searched
from nlcwfs.estimation.map_verdict import map_verdict
from nlcwfs.estimation.outcome import Outcome
from nlcwfs.estimation.phase_prior import expected_air, prior_power
from nlcwfs.estimation.reconstructor import SENSOR_LOSS, TYPICAL_SEEING_ARCSEC, Climb, GerchbergSaxton
from nlcwfs.estimation.resolution_level import Level, Measurement, continued, cropped, pixel_means
from nlcwfs.estimation.segment_steps import SegmentSteps, steps_of
from nlcwfs.estimation.segment_turns import with_turns
from nlcwfs.estimation.sensor_geometry import SensorGeometry
from nlcwfs.estimation.sensor_model import PlaneScale, light_on_pixels, mean_counts, plane_scale
from nlcwfs.estimation.settings import EstimationSettings
from nlcwfs.estimation.speckle_blur import unmodelled_variance
from nlcwfs.estimation.tilt import tilt_phase
from nlcwfs.estimation.wavefront_estimate import WavefrontEstimate
from nlcwfs.estimation.whitened_phase import Unknown, WhitenedPhase

START_NOISE = 0.1
"""Share of the phase noise that is filtered from the first guess, which is smooth already."""


class MaximumAPosteriori(eqx.Module):
    r"""Reconstructs wavefronts of one sensor: photons as the likelihood, turbulence as the prior.

    The unwrapped phase minimises :math:`\sum \mu - n \log \mu + |x|^2 / 2` with :math:`\phi = F^{-1} \sqrt{P} F x`, by
    Fisher scoring (`gauss_newton`) from a coarse-to-fine first guess (`capture`). Then Gerchberg-Saxton on the field
    tears what may be wrong by whole turns (`turn_islands`), and a second solution starts from there: a wavefront is
    believed when two ways lead to it. It has the methods of `GerchbergSaxton`.

    Attributes:
        level: The sensor on the grid of the model.
        capture: Finds the first guess.
        power: Expected power of each wave, for turbulence of strength 1.
        tilt_rms_rad: Expected rms of the tilt along one axis, for strength 1.
        beyond_cells: Variance of the phase beyond the model's cells, for strength 1, rad^2.
        band: See `speckle_band`.
        error: Tells the error bars.
        steps: Of the segments of the pupil; None for a pupil of one piece.
        amplitude: What is expected of the amplitude where it is estimated, else None.

    Examples:
        >>> from nlcwfs.beam.pupil_shape import PupilShape
        >>> geometry = SensorGeometry(
        ...     pupil=PupilShape(diameter_m=8.0),
        ...     frame=Grid((32, 32), pixel_m=0.36),
        ...     wavelength_m=0.65e-6,
        ...     distances_m=(-3.5e6, 3.5e6),
        ... )
        >>> solver = MaximumAPosteriori.build(geometry, EstimationSettings(modes=100))
        >>> estimate = solver.estimate(jnp.ones((2, 32, 32)), jnp.ones((2, 32, 32), bool))
        >>> estimate.opd_m.shape, estimate.outcome.succeeded
        ((32, 32), False)
    """

    level: Level
    capture: GerchbergSaxton
    power: Float[Array, "y fx"]
    tilt_rms_rad: Float[Array, ""]
    beyond_cells: Float[Array, ""]
    band: Float[Array, "v fu"]
    error: MapError
    steps: SegmentSteps | None
    amplitude: ExpectedAmplitude | None
    settings: EstimationSettings = eqx.field(static=True)
    geometry: SensorGeometry = eqx.field(static=True)

    @classmethod
    def build(
        cls, geometry: SensorGeometry, settings: EstimationSettings, *, dtype: str = "float32"
    ) -> "MaximumAPosteriori":
        """Precompute filters, travel and error bars.

        Args:
            geometry: The sensor.
            settings: Options; without a seeing and Fried's parameter the strength of the turbulence is measured.
            dtype: Precision.

        Raises:
            SettingsError: If an option contradicts another, or a prior is impossible.
            SamplingError: If the pupil does not fit on the frames.
        """
        options, diameter_m, wavelength_m = settings.map, geometry.pupil.diameter_m, geometry.wavelength_m
        told = settings.seeing_arcsec or TYPICAL_SEEING_ARCSEC
        air = expected_air(settings.prior, seeing_arcsec=told, diameter_m=diameter_m)
        if settings.prior.fried_m is not None:
            told = SEEING_TO_FRIED * SEEING_WAVELENGTH_M / (settings.prior.fried_m * ARCSEC_RAD)
            settings = settings.model_copy(update={"seeing_arcsec": told})
        level = finest_level(geometry, air, oversampling=options.oversampling, window=options.window, dtype=dtype)
        steps = steps_of(geometry, level, settings.prior, dtype=dtype)
        start = options.capture if steps is None else options.segment_capture
        first = settings.model_copy(update={"gerchberg_saxton": start, "unwrapping": "carried"})
        capture = GerchbergSaxton.build(geometry, first, dtype=dtype)
        if settings.prior.cutoff_cpa is None:
            # What is told is where the measuring starts: taken as it is, half the seeing loses a tenth of the frames.
            capture = dataclasses.replace(capture, measures_strength=True)
        lit_cells = float(jnp.sum(level.light))
        power = prior_power(
            level.grid, settings.prior, air, wavelength_m=wavelength_m, diameter_m=diameter_m, lit_pixels=lit_cells
        )
        beyond = unmodelled_variance(air, wavelength_m=wavelength_m, cutoff_per_m=1 / (2 * level.grid.pixel_m))
        return cls(
            level=level,
            capture=capture,
            power=jnp.asarray(power, dtype),
            tilt_rms_rad=jnp.asarray(air.tilt_rms_rad(wavelength_m, diameter_m=diameter_m), dtype),
            beyond_cells=jnp.asarray(beyond, dtype),
            band=jnp.asarray(
                speckle_band(Grid(level.measured_shape, geometry.frame.pixel_m), diameter_m=diameter_m), dtype
            ),
            error=MapError.build(geometry, settings, level, air, dtype=dtype),
            steps=steps,
            amplitude=ExpectedAmplitude.build(geometry, settings, level, air, dtype=dtype),
            settings=settings,
            geometry=geometry,
        )

    def estimate(
        self,
        counts: Float[Array, "plane y x"],
        usable: Bool[Array, "plane y x"],
        *,
        read_variance: float | Float[Array, ""] = 0.0,
        start_m: Float[Array, "y x"] | None = None,
    ) -> WavefrontEstimate:
        """The wavefront behind one exposure.

        Args:
            counts: Photo-electrons on the frames' pixels, background subtracted.
            usable: False for pixels to ignore.
            read_variance: Variance of a pixel without light, electrons squared.
            start_m: Wavefront to start from, same pixels; replaces the tilt of the centroids.

        Returns:
            The estimate on the frames' pixels.
        """
        return self.account(self.found(self.capture.measurement(counts, usable, read_variance), start_m))

    def found(
        self,
        near: Measurement,
        start_m: Float[Array, "y x"] | None = None,
        mirror_rad: Float[Array, "Y X"] | None = None,
    ) -> Found:
        """All that the estimate is made of: first guess, solutions, healings.

        With the shape of a mirror that was taken out before the sensor saw the rest, the whole turbulence is found.
        """
        slope, climb = self.capture.search(near, start_m)
        if mirror_rad is not None:
            climb = eqx.tree_at(lambda c: c.phase_rad, climb, climb.phase_rad + self.on_capture(mirror_rad))
        climb = with_strength(self.capture, near, climb) if self.steps is None else self.on_segments(near, climb)
        task, unknown = self.prepared(near, slope, climb, mirror_rad)
        search = searched(task, self.settings.map, unknown, (climb.iterations, climb.ffts))
        search, wrong_turn = with_turns(task, self.settings, search)
        log_amplitude = None
        if self.amplitude is not None:
            search, log_amplitude = with_amplitude(task, self.settings.map, search, self.amplitude(climb.strength))
        return Found(task, search, slope, climb.strength, wrong_turn, log_amplitude)

    def on_capture(self, phase_rad: Float[Array, "y x"]) -> Float[Array, "v u"]:
        """A phase of the model's grid on that of the first guess."""
        factor = self.level.oversampling
        return pixel_means(phase_rad, factor, self.capture.levels[-1].grid.shape)

    def on_segments(self, near: Measurement, climb: Climb) -> Climb:
        """The first guess of a field, unwrapped segment by segment on the model's grid, and the strength it shows."""
        prior = self.prior(self.power * climb.strength, self.tilt_rms_rad * jnp.sqrt(climb.strength))
        noise = SENSOR_LOSS * phase_noise(self.level, near)
        wrapped_rad = continued(self.level, climb.phase_rad, near)
        return segmented_start(self.level, prior, climb, wrapped_rad, noise, learns=self.capture.measures_strength)

    def prepared(
        self,
        near: Measurement,
        slope: Float[Array, "2"],
        climb: Climb,
        mirror_rad: Float[Array, "y x"] | None = None,
    ) -> tuple[Task, Unknown]:
        """The task of one exposure and the first guess, on the grid of the model."""
        level = self.level
        phase_rad = continued(level, climb.phase_rad, near)
        measured = near.padded(level.measured_shape)
        known_rad = self.known_rad(slope) - (0 if mirror_rad is None else mirror_rad)
        scale = self.plane_scale(measured, known_rad + phase_rad)
        prior = self.prior(self.power * climb.strength, self.tilt_rms_rad * jnp.sqrt(climb.strength))
        task = self.task(measured, known_rad, scale, prior, climb.strength)
        return task, prior.start(phase_rad, noise_variance=START_NOISE / task.problem.information)

    def known_rad(self, slope: Float[Array, "2"]) -> Float[Array, "y x"]:
        """The phase of a tilt and of the static aberration."""
        wavelength_m, level = self.geometry.wavelength_m, self.level
        return tilt_phase(slope, level.grid, wavelength_m) + level.optics.static_opd_m * (2 * np.pi / wavelength_m)

    def plane_scale(self, measured: Measurement, phase_rad: Float[Array, "y x"]) -> PlaneScale:
        """Counts and background of each plane, judged with a phase that is nearly right."""
        options = self.settings.map
        shares = self.level.optics.flux_fractions if options.flux == "given" else None
        light = light_on_pixels(self.level, phase_rad)
        return plane_scale(light, measured, fits_background=options.fits_background, shares=shares)

    def prior(self, power: Float[Array, "y fx"], tilt_rms_rad: Float[Array, ""]) -> WhitenedPhase:
        """Unknowns for this power."""
        diameter_m = self.geometry.pupil.diameter_m
        return WhitenedPhase.build(
            self.level.grid, power, tilt_rms_rad=tilt_rms_rad, diameter_m=diameter_m, steps=self.steps
        )

    def task(
        self,
        measured: Measurement,
        known_rad: Float[Array, "y x"],
        scale: PlaneScale,
        prior: WhitenedPhase,
        strength: Float[Array, ""],
    ) -> Task:
        """What is to be solved for one exposure."""
        problem = self.problem(measured, known_rad, scale, prior)
        return Task(problem, prior, self.level, measured, scale, self.beyond_cells * strength)

    def problem(
        self, measured: Measurement, known_rad: Float[Array, "y x"], scale: PlaneScale, prior: gn.Prior
    ) -> gn.Problem:
        """Counts, and what is expected of the phase behind them."""
        level, lit = self.level, jnp.sum(self.level.light)
        dark = self.settings.map.dark_share * scale.counts * level.oversampling**2 / lit + measured.read_variance
        photons = jnp.sum(jnp.where(measured.usable, measured.counts, 0))
        return gn.Problem(
            expected=lambda phase_rad: mean_counts(level, scale, phase_rad),
            counts=jnp.where(measured.usable, measured.counts, 0),
            usable=measured.usable,
            dark=jnp.maximum(dark, jnp.finfo(dark.dtype).tiny),
            known_rad=known_rad,
            prior=prior,
            information=4 * jnp.maximum(photons, 1) / (SENSOR_LOSS * lit),
            shown=Unknown(jnp.ones((), self.power.dtype), jnp.ones(2, self.power.dtype)),
        )

    def account(self, found: Found) -> WavefrontEstimate:
        """Wavefront, error bars and verdict of the best solution."""
        task, best, strength = found.task, found.search.best, found.strength
        metres = self.geometry.wavelength_m / (2 * np.pi)
        phase_rad = task.problem.known_rad + task.problem.prior.phase_rad(best.unknown)
        opd_m = self.on_frame(phase_rad) * metres - self.on_frame(self.level.optics.static_opd_m)
        opd_m = self.levelled(opd_m)
        measured, shape = task.measured, self.geometry.frame.shape
        unexplained = unexplained_share(measured, best.model, self.band)
        code = map_verdict(
            found.search, unexplained=unexplained, measured=measured, finite=jnp.all(jnp.isfinite(opd_m))
        )
        bars = self.error.bars(task, phase_rad, strength, found.log_amplitude)
        believed = (code == Outcome.CONVERGED) | (code == Outcome.BUDGET_SPENT)
        told = self.error.told_rad(bars, strength, believed) * metres
        residual = jnp.where(measured.usable, measured.counts - best.model, 0)
        return WavefrontEstimate(
            opd_m=opd_m,
            predicted_error_m=told,
            unexplained=unexplained,
            residual=jnp.stack([cropped(plane, shape) for plane in residual]),
            iterations=best.steps,
            ffts=best.ffts + bars.ffts,
            outcome_code=code,
            strength=strength,
            error_bars=bars,
            wrong_turn=found.wrong_turn,
            log_amplitude=None if found.log_amplitude is None else self.levelled(self.on_frame(found.log_amplitude)),
        )

    def levelled(self, on_frame: Float[Array, "v u"]) -> Float[Array, "v u"]:
        """A map on the pixels of the frames without its mean over the light."""
        light = self.on_frame(self.level.light)
        return on_frame - jnp.sum(light * on_frame) / jnp.sum(light)

    def on_frame(self, array: Float[Array, "y x"]) -> Float[Array, "v u"]:
        """From the model's grid to the pixels of the frames: the mean over each."""
        factor = self.level.oversampling
        return pixel_means(array, factor, self.geometry.frame.shape)

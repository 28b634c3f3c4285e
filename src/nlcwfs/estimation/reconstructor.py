"""The whole way from counts to a wavefront: start, coarse to fine, unwrapping, verdict."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.modes import ModalBasis
from nlcwfs.estimation import gerchberg_saxton as gs
from nlcwfs.estimation.centroid_tilt import centroid_tilt
from nlcwfs.estimation.fit_quality import BELIEVED, speckle_band, unexplained_share, verdict
from nlcwfs.estimation.iterate import iterate
from nlcwfs.estimation.ladder import build_ladder
from nlcwfs.estimation.resolution_level import Level, Measurement, cropped, pixel_means, resample_phase
from nlcwfs.estimation.sensor_geometry import SensorGeometry
from nlcwfs.estimation.settings import EstimationSettings, GerchbergSaxtonSettings
from nlcwfs.estimation.speckle_blur import unmodelled_variance
from nlcwfs.estimation.tilt import mean_slope, tilt_phase
from nlcwfs.estimation.turbulence_filter import expected_error
from nlcwfs.estimation.turbulence_strength import slope_weights, updated_strength
from nlcwfs.estimation.unwrapping import SlopeUnwrapper
from nlcwfs.estimation.wavefront_estimate import WavefrontEstimate
from nlcwfs.estimation.whole_turns import PASSES, slip_filter, without_slips

TYPICAL_SEEING_ARCSEC = 0.6
"""Strength 1 of the turbulence: Table 1 of the paper."""

FIRST_STRENGTH_AT_FRIED = 0.1
"""Unknown turbulence starts as if r0 were a tenth of the telescope: weak enough to be captured."""

SENSOR_LOSS = 3.0
"""Photons that these sensors need over the quantum limit, 1 / (4 N) rad^2: 2.7 to 3.5 in study 01 (`sensor_loss`)."""


class GerchbergSaxton(eqx.Module):
    """Reconstructs wavefronts of one sensor with the paper's algorithm.

    Build it once, then call `estimate` for every exposure; it may be compiled (`equinox.filter_jit`) and mapped
    over frames (`jax.vmap`).

    Examples:
        >>> from nlcwfs.beam.grid import Grid
        >>> from nlcwfs.beam.pupil_shape import PupilShape
        >>> geometry = SensorGeometry(
        ...     pupil=PupilShape(diameter_m=8.0),
        ...     frame=Grid((32, 32), pixel_m=0.36),
        ...     wavelength_m=0.65e-6,
        ...     distances_m=(-3.5e6, 3.5e6),
        ... )
        >>> solver = GerchbergSaxton.build(geometry, EstimationSettings())
        >>> counts = jnp.ones((2, 32, 32))
        >>> estimate = solver.estimate(counts, jnp.ones((2, 32, 32), bool))
        >>> estimate.opd_m.shape
        (32, 32)
    """

    levels: tuple[Level, ...]
    unwrapper: SlopeUnwrapper | None
    first_strength: Float[Array, ""]
    band: Float[Array, "v fu"]
    smooth: Float[Array, "y fx"]
    beyond_pixels: Float[Array, ""]
    settings: EstimationSettings = eqx.field(static=True)
    geometry: SensorGeometry = eqx.field(static=True)
    measures_strength: bool = eqx.field(static=True)

    @classmethod
    def build(
        cls,
        geometry: SensorGeometry,
        settings: EstimationSettings,
        *,
        basis: ModalBasis | None = None,
        dtype: str = "float32",
    ) -> "GerchbergSaxton":
        """Precompute filters, travel and projections.

        Args:
            geometry: The sensor.
            settings: Options; `seeing_arcsec` left out means that the strength is measured.
            basis: Modes on the frames' pixels, needed for `unwrapping = "slopes"`.
            dtype: Precision.

        Raises:
            SettingsError: If an option contradicts another.
            SamplingError: If the pupil does not fit on the frames.
        """
        air = Turbulence.from_seeing(seeing_arcsec=settings.seeing_arcsec or TYPICAL_SEEING_ARCSEC)
        telescope_over_fried = geometry.pupil.diameter_m / air.fried_at(geometry.wavelength_m)
        measures = settings.seeing_arcsec is None
        weaker = (1 / FIRST_STRENGTH_AT_FRIED / telescope_over_fried) ** (5 / 3) if measures else 1.0
        unwrapper = None
        if settings.unwrapping == "slopes" and basis is not None:
            labels = geometry.pupil.labels(geometry.frame)
            unwrapper = SlopeUnwrapper.build(basis, passes=settings.remainder_passes, labels=labels, dtype=dtype)
        levels = build_ladder(geometry, settings.gerchberg_saxton, air, dtype=dtype)
        finest, diameter_m = levels[-1].grid, geometry.pupil.diameter_m
        beyond = unmodelled_variance(air, wavelength_m=geometry.wavelength_m, cutoff_per_m=1 / (2 * finest.pixel_m))
        measured = Grid(levels[-1].measured_shape, geometry.frame.pixel_m)
        return cls(
            levels=levels,
            band=jnp.asarray(speckle_band(measured, diameter_m=diameter_m), dtype),
            smooth=jnp.asarray(slip_filter(finest, diameter_m=diameter_m), dtype),
            beyond_pixels=jnp.asarray(beyond, dtype),
            unwrapper=unwrapper,
            first_strength=jnp.asarray(weaker, dtype),
            settings=settings,
            geometry=geometry,
            measures_strength=measures,
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
            start_m: Wavefront to start from, same pixels; replaces the start of the settings.

        Returns:
            The estimate on the frames' pixels.
        """
        measured = self.measurement(counts, usable, read_variance)
        slope, climb = self.search(measured, start_m)
        return self._account(measured, slope, climb)

    def measurement(
        self, counts: Float[Array, "plane y x"], usable: Bool[Array, "plane y x"], read_variance: float | Array
    ) -> Measurement:
        """The counts in the window of the model."""
        dtype = self.first_strength.dtype
        measured = Measurement(counts.astype(dtype), usable, jnp.asarray(read_variance, dtype))
        return measured.padded(self.levels[-1].measured_shape)

    def search(
        self, measured: Measurement, start_m: Float[Array, "y x"] | None = None
    ) -> tuple[Float[Array, "2"], "Climb"]:
        """Coarse to fine: the tilt (y, x; m/m) and, on the grid of the last level, the phase beside it."""
        dtype = self.first_strength.dtype
        start_m = None if start_m is None else start_m.astype(dtype)
        slope = self._starting_slope(measured, start_m)
        climb = Climb(
            phase_rad=self._starting_phase(start_m, slope),
            strength=self.first_strength,
            iterations=jnp.asarray(0, jnp.int32),
            ffts=jnp.asarray(0, jnp.int32),
            change_rad=jnp.asarray(jnp.inf, dtype),
        )
        for level in self.levels:
            climb = self._climb(level, measured.binned(level.binning), slope, climb)
        return slope, climb

    def _climb(self, level: Level, measured: Measurement, slope: Float[Array, "2"], climb: "Climb") -> "Climb":
        """All the cutoffs of one level."""
        options = self.settings.gerchberg_saxton
        carried = options.filter == "turbulence"
        tilt_rad = tilt_phase(slope, level.grid, self.geometry.wavelength_m)
        static_rad = level.optics.static_opd_m * (2 * np.pi / self.geometry.wavelength_m)
        weights = jnp.asarray(slope_weights(level.grid), tilt_rad.dtype)
        noise = SENSOR_LOSS * gs.phase_noise(level, measured)
        learns = self.measures_strength and carried and level is not self.levels[-1]
        planes = measured.counts.shape[0]
        low_pass = None
        if options.filter == "low-pass":
            low_pass = gs.low_pass_factor(
                level.grid,
                cutoff_per_m=options.low_pass_cpa / self.geometry.pupil.diameter_m,
                centre_per_m=slope / self.geometry.wavelength_m,
            )
        if level.structures is not None or options.amplitude == "poisson":
            measured = measured.smoothed(level.smoothing, keep_counts=level.structures is None)
            climb = eqx.tree_at(lambda c: c.ffts, climb, climb.ffts + planes)

        def one_cutoff(climb: Climb, cutoff: Int[Array, ""]) -> tuple[Climb, None]:
            power = level.power[cutoff]
            problem = gs.problem_at(level, measured, options, tilt_rad + static_rad, cutoff, climb.strength, low_pass)
            state = iterate(
                lambda state: gs.step(problem, options, state),
                lambda state: gs.terminate(problem, state),
                gs.init(climb.phase_rad),
            )
            strength = climb.strength
            if learns:
                whole_rad = state.phase_rad + tilt_rad
                strength = updated_strength(strength, whole_rad, level.light, power, weights, noise)
            ffts = state.iteration * gs.ffts_per_iteration(planes, options, blurs=level.structures is not None)
            climb = Climb(
                state.phase_rad,
                strength,
                climb.iterations + state.iteration,
                climb.ffts + ffts,
                state.change_rad,
            )
            return climb, None

        phase_rad = resample_phase(climb.phase_rad, level.grid.shape, wrapped=not carried)
        climb = eqx.tree_at(lambda c: c.phase_rad, climb, phase_rad)
        return jax.lax.scan(one_cutoff, climb, jnp.arange(level.power.shape[0]))[0]

    def _starting_slope(self, measured: Measurement, start_m: Float[Array, "y x"] | None) -> Float[Array, "2"]:
        """The tilt (y, x) that the whole reconstruction is relative to, metres per metre."""
        frame = self.geometry.frame
        if start_m is not None:
            return mean_slope(start_m, self._on_frame(self.levels[-1].light), frame)
        if self.settings.gerchberg_saxton.start == "flat":
            return jnp.zeros(2, measured.counts.dtype)
        return centroid_tilt(
            measured.counts,
            measured.usable.astype(measured.counts.dtype),
            np.array(self.geometry.distances_m),
            pixel_m=frame.pixel_m,
        )

    def _starting_phase(self, start_m: Float[Array, "y x"] | None, slope: Float[Array, "2"]) -> Float[Array, "y x"]:
        """The rest of the first guess, on the grid of the first level."""
        level, frame = self.levels[0], self.geometry.frame
        if start_m is None:
            return jnp.zeros(level.grid.shape, self.first_strength.dtype)
        scale = 2 * np.pi / self.geometry.wavelength_m
        rest_rad = start_m.astype(slope.dtype) * scale - tilt_phase(slope, frame, self.geometry.wavelength_m)
        whole = self.levels[-1].measured_shape
        margins = [((a - b) // 2, (a - b) // 2) for a, b in zip(whole, frame.shape, strict=True)]
        return resample_phase(jnp.pad(rest_rad, margins), level.grid.shape, wrapped=False)

    def _account(self, measured: Measurement, slope: Float[Array, "2"], climb: "Climb") -> WavefrontEstimate:
        """Unwrap, compare with the counts, judge."""
        level, wavelength_m = self.levels[-1], self.geometry.wavelength_m
        tilt_rad = tilt_phase(slope, level.grid, wavelength_m)
        static_rad = level.optics.static_opd_m * (2 * np.pi / wavelength_m)
        everything = gs.plane_groups(level, measured, GerchbergSaxtonSettings(scheme="averaged"))[0]
        near = gs.pupil_light(level, climb.phase_rad + tilt_rad + static_rad)
        far = jnp.fft.ifft2(jnp.fft.fft2(near)[None] * everything.transfer)
        model = gs.modelled_counts(level, everything, far)
        unexplained = unexplained_share(measured, model, self.band)
        phase_rad, slip_ffts = climb.phase_rad, 0
        if self.settings.gerchberg_saxton.filter == "turbulence":
            phase_rad, slip_ffts = without_slips(phase_rad, self.smooth), PASSES
        phase_rad = self._on_frame(phase_rad + tilt_rad)
        if self.unwrapper is not None:
            phase_rad = self.unwrapper.unwrapped(phase_rad)
        opd_m = phase_rad * (wavelength_m / (2 * np.pi))
        light = self._on_frame(level.light)
        opd_m = opd_m - jnp.sum(light * opd_m) / jnp.sum(light)
        noise = SENSOR_LOSS * gs.phase_noise(level, measured)
        seen_rad = expected_error(level.power[0] * climb.strength, noise, level.grid)
        residual = jnp.where(measured.usable, measured.counts - model, 0)
        return WavefrontEstimate(
            opd_m=opd_m,
            predicted_error_m=jnp.sqrt(seen_rad**2 + climb.strength * self.beyond_pixels)
            * (wavelength_m / (2 * np.pi)),
            unexplained=unexplained,
            residual=jnp.stack([cropped(plane, self.geometry.frame.shape) for plane in residual]),
            iterations=climb.iterations,
            ffts=climb.ffts + 3 * measured.counts.shape[0] + 1 + slip_ffts,
            outcome_code=verdict(
                unexplained=unexplained,
                believed=BELIEVED[self.settings.gerchberg_saxton.filter],
                plane_counts=everything.total.reshape(-1),
                rests=climb.change_rad < level.tolerance_rad,
                finite=jnp.all(jnp.isfinite(opd_m)),
            ),
            strength=climb.strength,
        )

    def _on_frame(self, array: Float[Array, "y x"]) -> Float[Array, "v u"]:
        """From the finest grid to the pixels of the frames: the mean over each."""
        factor = self.levels[-1].oversampling
        return pixel_means(array, factor, self.geometry.frame.shape)


class Climb(eqx.Module):
    """What one level hands to the next.

    Attributes:
        phase_rad: The phase found, without the starting tilt.
        strength: Variance of the turbulence over that of the filters.
        iterations: Iterations so far.
        ffts: Two-dimensional FFTs so far.
        change_rad: How much the last iteration moved the phase.
    """

    phase_rad: Float[Array, "y x"]
    strength: Float[Array, ""]
    iterations: Int[Array, ""]
    ffts: Int[Array, ""]
    change_rad: Float[Array, ""]

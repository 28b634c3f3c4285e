"""The cheap rival: binned images and their moments times one matrix, and Gerchberg-Saxton updates on top if wanted."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.modes import ModalBasis, modal_basis
from nlcwfs.errors import SettingsError
from nlcwfs.estimation import gerchberg_saxton as gs
from nlcwfs.estimation.binned_features import BinnedFeatures, bin_size
from nlcwfs.estimation.fit_quality import BELIEVED, speckle_band, unexplained_share, verdict
from nlcwfs.estimation.ladder import build_ladder
from nlcwfs.estimation.linear_map import Judgement, LinearMap, learn
from nlcwfs.estimation.linear_settings import LinearSettings
from nlcwfs.estimation.linear_training import TrainingLight, draw_training_set, pivot_slope
from nlcwfs.estimation.linear_trial import Trial, try_updates
from nlcwfs.estimation.modes_beyond_pupil import modes_beyond_pupil
from nlcwfs.estimation.reconstructor import FIRST_STRENGTH_AT_FRIED, TYPICAL_SEEING_ARCSEC
from nlcwfs.estimation.resolution_level import Level, Measurement, resample_phase, sum_blocks
from nlcwfs.estimation.sensor_geometry import SensorGeometry
from nlcwfs.estimation.settings import EstimationSettings, GerchbergSaxtonSettings
from nlcwfs.estimation.speckle_blur import unmodelled_variance
from nlcwfs.estimation.tilt import tilt_phase
from nlcwfs.estimation.wavefront_estimate import WavefrontEstimate

JUDGES = 10
"""For ten training wavefronts one more is drawn that is not learnt from."""

TRIALS = 160
"""At most so many exposures, at each of a few numbers of photons, measure what updates leave of the error."""

EXPLAINS = 0.6
"""Unexplained share above which a matrix alone is not believed: it blurs speckles even where it is right.

At D / r0 = 8.2 (2e4 photons, error 65 nm) it leaves 0.4 to 0.7, of wavefronts of 100 and 300 nm 0.2 to 0.4."""

UPDATE_LEAVES = 0.3
"""Share of what is unexplained that an update leaves; measured 0.17 for the first, 0.3 for the second."""


class LinearReconstructor(eqx.Module):
    """Reconstructs wavefronts of one sensor with one matrix (Johnson et al.).

    It has the methods of `GerchbergSaxton`. Building it draws the training wavefronts: seconds for small frames,
    half a minute for 64 x 64 pixels and the default number.

    Attributes:
        features: What is seen of the images.
        map: From features to modes.
        modes: On the pixels of the model's window, beyond the pupil as turbulence goes on.
        level: The sensor at full resolution.
        band: See `speckle_band`.
        strongest: Variance of the strongest training wavefronts over that of the strength `WavefrontEstimate` is
            relative to.
        trial: What updates leave of the error; None without updates.

    Examples:
        >>> from nlcwfs.beam.pupil_shape import PupilShape
        >>> geometry = SensorGeometry(PupilShape(8.0), Grid((16, 16), 0.7), 0.65e-6, (-3.5e6, 3.5e6))
        >>> few = LinearSettings(modes=10, training_screens=40)
        >>> solver = LinearReconstructor.build(geometry, EstimationSettings(), linear=few)
        >>> estimate = solver.estimate(jnp.ones((2, 16, 16)), jnp.ones((2, 16, 16), bool))
        >>> estimate.opd_m.shape, int(estimate.iterations)
        ((16, 16), 0)
    """

    features: BinnedFeatures
    map: LinearMap
    modes: Float[Array, "mode y x"]
    level: Level
    band: Float[Array, "v fu"]
    strongest: Float[Array, ""]
    trial: Trial | None
    linear: LinearSettings = eqx.field(static=True)
    options: GerchbergSaxtonSettings = eqx.field(static=True)
    geometry: SensorGeometry = eqx.field(static=True)

    @classmethod
    def build(
        cls,
        geometry: SensorGeometry,
        settings: EstimationSettings,
        *,
        linear: LinearSettings | None = None,
        dtype: str = "float32",
    ) -> "LinearReconstructor":
        """Draw the training wavefronts, learn the matrix.

        Args:
            geometry: The sensor.
            settings: `seeing_arcsec` is the strength to learn from; left out, a range of strengths is. Updates follow
                the options of `gerchberg_saxton` at full resolution.
            linear: Options of the matrix.
            dtype: Precision.

        Raises:
            SettingsError: If bins are larger than the frame.
            SamplingError: If the pupil does not fit on the frames, or its pixels do not carry so many modes.
        """
        linear = LinearSettings() if linear is None else linear
        bin_pixels = linear.bin_pixels or bin_size(geometry)
        if bin_pixels > min(geometry.frame.shape):
            raise SettingsError(
                "estimation.linear.bin_pixels", f"must fit on frames of {geometry.frame.shape}", bin_pixels
            )
        air, strongest = strongest_air(geometry, settings)
        told = settings.seeing_arcsec is not None
        alone = {"coarse_cutoffs_cpa": (), "binning": 1, "gain": linear.gain}
        options = settings.gerchberg_saxton.model_copy(update=alone)
        level = build_ladder(geometry, options, air, dtype=dtype)[-1]
        diameter_m, window = geometry.pupil.diameter_m, Grid(level.measured_shape, geometry.frame.pixel_m)
        whole = modal_basis(geometry.pupil.on(window), window, diameter_m=diameter_m, count=linear.modes)
        features = BinnedFeatures(geometry.frame, geometry.distances_m, bin_pixels)
        light = TrainingLight.build(
            geometry, air, weakest=1.0 if told else linear.weakest, oversampling=linear.light_oversampling
        )
        judges = -(-linear.training_screens // JUDGES)
        keys = jax.random.split(jax.random.key(linear.training_seed), linear.training_screens + judges)
        basis = basis_on_frame(whole, geometry.frame)
        training = draw_training_set(light, features, basis, follow_tilt=linear.follow_tilt, keys=keys)
        unit_m2 = (diameter_m / air.fried_at(geometry.wavelength_m)) ** (5 / 3) * radian_m(geometry) ** 2
        beyond_m2 = unit_m2 * max(whole.kolmogorov_total_rad2 - float(np.sum(whole.kolmogorov_rad2)), 0)
        noise = features.noise(training.images, np.asarray(level.optics.flux_fractions, float))
        solver = cls(
            features=features,
            map=learn(training, noise, judges=judges, beyond_m2=beyond_m2, dtype=dtype),
            modes=jnp.asarray(modes_beyond_pupil(whole, window, diameter_m=diameter_m), dtype),
            level=level,
            band=jnp.asarray(speckle_band(window, diameter_m=diameter_m), dtype),
            strongest=jnp.asarray(strongest, dtype),
            trial=None,
            linear=linear,
            options=options,
            geometry=geometry,
        )
        return solver._tried(light, air) if linear.gerchberg_saxton_updates else solver

    def _tried(self, light: TrainingLight, air: Turbulence) -> "LinearReconstructor":
        """The same, knowing what updates leave of the error."""
        trials = min(TRIALS, -(-self.linear.training_screens // JUDGES))
        keys = jax.random.split(jax.random.fold_in(jax.random.key(self.linear.training_seed), 1), trials)
        cutoff_per_m = 1 / (2 * self.geometry.frame.pixel_m)
        beyond_rad2 = unmodelled_variance(air, wavelength_m=self.geometry.wavelength_m, cutoff_per_m=cutoff_per_m)
        trial = try_updates(self.estimate, light, keys, beyond_m2=beyond_rad2 * radian_m(self.geometry) ** 2)
        trial = jax.tree.map(lambda one: one.astype(self.modes.dtype), trial)
        return eqx.tree_at(lambda solver: solver.trial, self, trial, is_leaf=lambda leaf: leaf is None)

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
            start_m: Not used: a matrix starts nowhere. Here because iterative estimators have it.

        Returns:
            The estimate on the frames' pixels.
        """
        dtype = self.modes.dtype
        measured = Measurement(counts.astype(dtype), usable, jnp.asarray(read_variance, dtype))
        filled = measured.binned(1).counts
        slope = jnp.zeros(2, dtype)
        if self.linear.follow_tilt:
            slope = pivot_slope(filled, self.features)
        seen = self.features.of(filled, usable, slope=slope)
        judged = self.map.judge(seen, effective_photons(measured))
        phase_rad = jnp.tensordot(judged.coefficients_m, self.modes, axes=1) / radian_m(self.geometry)
        phase_rad = resample_phase(phase_rad, self.level.grid.shape, wrapped=False)
        measured = measured.padded(self.level.measured_shape)
        state, ffts = self._updated(measured, slope, judged, phase_rad)
        return self._account(measured, slope, judged, state, ffts)

    def _updated(
        self, measured: Measurement, slope: Float[Array, "2"], judged: Judgement, phase_rad: Float[Array, "y x"]
    ) -> tuple[gs.GerchbergSaxtonState, int]:
        """The phase after the updates, and their FFTs."""
        state, updates = gs.init(phase_rad), self.linear.gerchberg_saxton_updates
        if updates == 0:
            return state, 0
        planes, ffts = measured.counts.shape[0], 0
        if self.options.amplitude == "poisson":
            measured, ffts = measured.smoothed(self.level.smoothing, keep_counts=True), planes
        low_pass = None
        if self.options.filter == "low-pass":
            low_pass = gs.low_pass_factor(
                self.level.grid,
                cutoff_per_m=self.options.low_pass_cpa / self.geometry.pupil.diameter_m,
                centre_per_m=slope / self.geometry.wavelength_m,
            )
        reference_rad = self._reference(slope)
        first = jnp.asarray(0, jnp.int32)
        problem = gs.problem_at(self.level, measured, self.options, reference_rad, first, judged.ratio, low_pass)
        state = jax.lax.fori_loop(0, updates, lambda _, state: gs.step(problem, self.options, state), state)
        return state, ffts + updates * gs.ffts_per_iteration(planes, self.options, blurs=False)

    def _reference(self, slope: Float[Array, "2"]) -> Float[Array, "y x"]:
        """The phase that is never smoothed: the tilt that the bins followed, and the static aberration."""
        tilt_rad = tilt_phase(slope, self.level.grid, self.geometry.wavelength_m)
        return tilt_rad + self.level.optics.static_opd_m / radian_m(self.geometry)

    def _account(
        self,
        measured: Measurement,
        slope: Float[Array, "2"],
        judged: Judgement,
        state: gs.GerchbergSaxtonState,
        ffts: int,
    ) -> WavefrontEstimate:
        """Compare with the counts, judge."""
        level, frame = self.level, self.geometry.frame
        everything = gs.plane_groups(level, measured, GerchbergSaxtonSettings(scheme="averaged"))[0]
        near = gs.pupil_light(level, state.phase_rad + self._reference(slope))
        far = jnp.fft.ifft2(jnp.fft.fft2(near)[None] * everything.transfer)
        model = gs.modelled_counts(level, everything, far)
        unexplained = unexplained_share(measured, model, self.band)
        phase_rad = state.phase_rad + tilt_phase(slope, level.grid, self.geometry.wavelength_m)
        light, phase_rad = (sum_blocks(one[None], level.oversampling)[0] for one in (level.light, phase_rad))
        seen = middle(phase_rad.shape, frame.shape)
        opd_m, light = phase_rad[seen] * (radian_m(self.geometry) / level.oversampling**2), light[seen]
        opd_m = opd_m - jnp.sum(light * opd_m) / jnp.sum(light)
        updates, planes = self.linear.gerchberg_saxton_updates, measured.counts.shape[0]
        variance_m2 = judged.variance_m2
        if self.trial is not None:
            variance_m2 = self.trial.after(variance_m2, effective_photons(measured))
        return WavefrontEstimate(
            opd_m=opd_m,
            predicted_error_m=jnp.sqrt(variance_m2),
            unexplained=unexplained,
            residual=jnp.where(measured.usable, measured.counts - model, 0)[:, *seen],
            iterations=state.iteration,
            # The model's light, then four real transforms a plane for the share that is not explained.
            ffts=jnp.asarray(ffts + 3 * planes + 1, jnp.int32),
            outcome_code=verdict(
                unexplained=unexplained,
                believed=max(EXPLAINS * UPDATE_LEAVES**updates, BELIEVED[self.options.filter]),
                plane_counts=everything.total.reshape(-1),
                rests=state.change_rad < level.tolerance_rad if updates else jnp.asarray(True),
                finite=jnp.all(jnp.isfinite(opd_m)),
            ),
            strength=judged.ratio * self.strongest,
        )


def effective_photons(measured: Measurement) -> Float[Array, ""]:
    """Photons that would be as noisy by themselves: read noise adds its variance over the pixels to theirs.

    Examples:
        >>> frames = Measurement(jnp.full((1, 2, 2), 25.0), jnp.ones((1, 2, 2), bool), jnp.asarray(25.0))
        >>> float(effective_photons(frames))  # twice the variance
        50.0
    """
    photons = jnp.maximum(jnp.sum(jnp.where(measured.usable, measured.counts, 0)), 1)
    return photons**2 / (photons + measured.read_variance * jnp.sum(measured.usable.astype(photons.dtype)))


def radian_m(geometry: SensorGeometry) -> float:
    """Path of one radian of phase."""
    return geometry.wavelength_m / (2 * np.pi)


def middle(outer: tuple[int, ...], inner: tuple[int, int]) -> tuple[slice, slice]:
    """The pixels of a window around those of a frame with the same centre."""
    rows, columns = ((have - want) // 2 for have, want in zip(outer[-2:], inner, strict=True))
    return slice(rows, rows + inner[0]), slice(columns, columns + inner[1])


def strongest_air(geometry: SensorGeometry, settings: EstimationSettings) -> tuple[Turbulence, float]:
    """The strongest turbulence to learn from, and its variance over that which `strength` is relative to.

    As told; else telescopes of ten r0, from where the iterative reconstructor starts, too.
    """
    air = Turbulence.from_seeing(seeing_arcsec=settings.seeing_arcsec or TYPICAL_SEEING_ARCSEC)
    if settings.seeing_arcsec is not None:
        return air, 1.0
    diameter_m = geometry.pupil.diameter_m
    fried_m = FIRST_STRENGTH_AT_FRIED * diameter_m
    stronger = (air.fried_at(geometry.wavelength_m) / fried_m) ** (5 / 3)
    return Turbulence(fried_m, geometry.wavelength_m), stronger


def basis_on_frame(basis: ModalBasis, frame: Grid) -> ModalBasis:
    """The modes of the model's window on the pixels of the frames alone."""
    seen = middle(basis.modes.shape, frame.shape)
    weights, modes = np.asarray(basis.weights)[seen], np.asarray(basis.modes)[:, *seen]
    return eqx.tree_at(lambda b: (b.modes, b.weights), basis, (modes, weights))

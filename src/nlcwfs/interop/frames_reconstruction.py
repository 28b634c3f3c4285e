"""From a file of frames to wavefronts: the sensor that its header describes, and a reconstructor for it."""

import math
import time
from collections.abc import Iterable, Iterator, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.beam.pupil import light_weights
from nlcwfs.beam.zernike import ZernikeFit
from nlcwfs.curvature_sensor.defocused_images import CurvatureSensor
from nlcwfs.estimation.maximum_a_posteriori import MaximumAPosteriori
from nlcwfs.estimation.method import Reconstructor, build_reconstructor
from nlcwfs.estimation.outcome import Outcome
from nlcwfs.estimation.sensor_geometry import SensorGeometry
from nlcwfs.estimation.settings import EstimationSettings
from nlcwfs.estimation.unwrapping_basis import unwrapping_basis
from nlcwfs.estimation.wavefront_estimate import WavefrontEstimate
from nlcwfs.interop.frames_file import FramesFile
from nlcwfs.interop.frames_sensor import scored_pupil, sensor_geometry, well_seen_zernikes
from nlcwfs.interop.missed_light import missed_by_wavefronts, missed_on_average, wide_optics
from nlcwfs.interop.wavefront_errors import ErrorReport, effective_photons, photon_sigma_m
from nlcwfs.interop.wavefront_file import FrameWavefront

MOST_ZERNIKES = 800
"""More are in no optician's table; the wavefront itself holds them all."""


class FramesReconstructor(eqx.Module):
    """Reconstructs the frames of one file, one at a time, and accounts for each.

    Attributes:
        frames: The file.
        settings: Options.
        geometry: The sensor that the header describes.
        photo_electrons: The light alone.
        solver: The method, made for this sensor.
        weights: Share of the light in every pixel of a frame; zero outside the pupil.
        fit: The Zernikes that these pixels tell apart.
        report: Errors from the error bars of the method, where it tells any.
        wide: The optics on a wider window, to know what the detector's window misses.
        read_variance: Variance of a pixel without starlight, electrons squared.
        dtype: Precision.

    Examples:
        >>> frames = FramesFile(
        ...     electrons=np.full((1, 2, 20, 20), 9.0), masked=np.zeros((1, 2, 20, 20), bool), has_frame_axis=False,
        ...     pixel_m=0.5, wavelength_m=0.65e-6, diameter_m=8.0, distances_m=(-3e6, 3e6),
        ... )
        >>> reconstructor = FramesReconstructor.build(frames, EstimationSettings(method="gerchberg-saxton"))
        >>> found = reconstructor.reconstruct(0)
        >>> found.opd_m.shape, int(reconstructor.noll[-1]) == len(found.coefficient_m)
        ((20, 20), True)
    """

    frames: FramesFile = eqx.field(static=True)
    settings: EstimationSettings = eqx.field(static=True)
    geometry: SensorGeometry = eqx.field(static=True)
    photo_electrons: Float[np.ndarray, "frame plane y x"]
    solver: Reconstructor
    weights: Float[np.ndarray, "y x"]
    fit: ZernikeFit
    report: ErrorReport | None
    wide: CurvatureSensor
    read_variance: float = eqx.field(static=True)
    dtype: str = eqx.field(static=True)

    @classmethod
    def build(
        cls, frames: FramesFile, settings: EstimationSettings, *, dtype: str = "float32"
    ) -> "FramesReconstructor":
        """Prepare everything that the frames of a file share.

        Args:
            frames: The file.
            settings: Method and options; a seeing that they leave open is measured from each frame.
            dtype: Precision.

        Raises:
            SettingsError: If an option contradicts another, or a prior is impossible.
            SamplingError: If the pixels cannot carry the pupil.
        """
        # SEEING of the header does not rule: behind a closed loop it tells nothing of the wavefronts that come, and a
        # filter told eleven times too strong a turbulence finds 2 % of the paper's frames (study 01, seeing-0.6).
        lights = {"wavelengths": settings.map.wavelengths, "moments": settings.map.membrane_moments}
        geometry = sensor_geometry(frames, **lights)
        slopes = settings.method == "gerchberg-saxton" and settings.unwrapping == "slopes"
        basis = unwrapping_basis(geometry, scored_pupil(geometry), modes=settings.modes) if slopes else None
        solver = build_reconstructor(geometry, settings, basis=basis, dtype=dtype)
        return cls.around(frames, settings, solver, dtype=dtype)

    @classmethod
    def around(
        cls, frames: FramesFile, settings: EstimationSettings, solver: Reconstructor, *, dtype: str
    ) -> "FramesReconstructor":
        """The same for a method that is made already, for the sensor of these frames."""
        geometry = sensor_geometry(frames)
        pupil = scored_pupil(geometry)
        fit = well_seen_zernikes(pupil, geometry, most=min(settings.modes, MOST_ZERNIKES))
        background = 0.0 if frames.background is None else float(np.mean(frames.background))
        return cls(
            frames=frames,
            settings=settings,
            geometry=geometry,
            photo_electrons=frames.photo_electrons(),
            solver=solver,
            weights=light_weights(pupil),
            fit=fit,
            report=ErrorReport.build(solver, fit) if isinstance(solver, MaximumAPosteriori) else None,
            wide=wide_optics(geometry, dtype=dtype),
            read_variance=frames.read_noise_electrons**2 + frames.dark_electrons + max(background, 0.0),
            dtype=dtype,
        )

    @property
    def noll(self) -> np.ndarray:
        """Noll index of every Zernike that is listed."""
        return np.arange(1, self.fit.matrix.shape[0] + 1)

    def compile(self) -> float:
        """Compile the solver ahead of the first frame; returns the seconds that it took."""
        started = time.perf_counter()
        jax.block_until_ready(_estimate(self.solver, *self.inputs(0)).opd_m)
        return time.perf_counter() - started

    def reconstruct(self, number: int) -> FrameWavefront:
        """The wavefront of one frame, counted from 0."""
        started = time.perf_counter()
        estimate = jax.block_until_ready(_estimate(self.solver, *self.inputs(number)))
        return self.account(number, estimate, seconds=time.perf_counter() - started)

    def each(self, numbers: Iterable[int]) -> Iterator[tuple[int, FrameWavefront]]:
        """Frames one after the other, each an exposure of its own, with their numbers."""
        for number in numbers:
            yield number, self.reconstruct(number)

    def inputs(self, number: int) -> tuple[Array, Array, Array]:
        """Counts, usable pixels and read variance of a frame."""
        counts = jnp.asarray(self.photo_electrons[number], self.dtype)
        return counts, jnp.asarray(~self.frames.masked[number]), jnp.asarray(self.read_variance, self.dtype)

    def account(self, number: int, estimate: WavefrontEstimate, *, seconds: float) -> FrameWavefront:
        """An estimate as a file holds it.

        Args:
            number: Of the frame.
            estimate: What was found in it.
            seconds: How long that took.
        """
        opd_m = np.where(self.weights > 0, np.asarray(estimate.opd_m, float), np.nan)
        truth_m = self.frames.truth_m
        if truth_m is not None:
            truth_m = truth_m if truth_m.ndim == 2 else truth_m[number]
        residual = np.where(self.frames.masked[number], np.nan, np.asarray(estimate.residual, float))
        log_amplitude = None if estimate.log_amplitude is None else np.asarray(estimate.log_amplitude, float)
        bars = estimate.error_bars if estimate.outcome.succeeded else None
        limit_nm = loss = None
        if self.report is not None and bars is not None:
            limit_nm, loss = self.report.quantum_limit_nm(bars), self.report.photon_loss(bars)
        return FrameWavefront(
            opd_m=opd_m,
            rms_nm=rms_m(opd_m, self.weights) * 1e9,
            outcome=outcome_name(estimate.outcome),
            iterations=int(estimate.iterations),
            ffts=int(estimate.ffts),
            predicted_error_nm=float(estimate.predicted_error_m) * 1e9,
            runtime_s=seconds,
            coefficient_m=np.asarray(self.fit.coefficients(opd_m), float),
            sigma_m=self.zernike_sigma_m(number, estimate),
            error_nm=None if truth_m is None else rms_m(opd_m - truth_m, self.weights) * 1e9,
            quantum_limit_nm=limit_nm,
            photon_loss=loss,
            wrong_turn=None if estimate.wrong_turn is None else float(estimate.wrong_turn),
            residual=residual,
            amplitude=None if log_amplitude is None else np.where(self.weights > 0, np.exp(log_amplitude), np.nan),
            sentence=estimate.outcome.sentence,
        )

    def zernike_sigma_m(self, number: int, estimate: WavefrontEstimate) -> Float[np.ndarray, " noll"]:
        """One sigma of every Zernike coefficient: from error bars where there are any, else from photon noise."""
        if self.report is not None and estimate.error_bars is not None:
            return self.report.zernike_sigma_m(estimate, estimate.error_bars)
        known = int((~self.frames.masked[number]).sum())
        electrons = float(self.photo_electrons[number].sum())
        photons = effective_photons(electrons, pixels=known, read_variance=self.read_variance)
        return photon_sigma_m(self.fit, self.weights, photons=photons, wavelength_m=self.geometry.wavelength_m)

    def light_outside(self, opds_m: Sequence[Float[np.ndarray, "y x"]]) -> Float[np.ndarray, " plane"]:
        """Share of the light of each plane that misses the window of the frames.

        The larger of two estimates: by these wavefronts, which hold the tilt but not the finest waves, and by
        the mean over turbulence as strong as theirs, which holds both on average.
        """
        rms = max(float(np.mean([rms_m(opd_m, self.weights) for opd_m in opds_m])), 1e-12)
        air = Turbulence.from_rms(opd_rms_m=rms, diameter_m=self.geometry.pupil.diameter_m)
        if self.settings.seeing_arcsec is not None:
            air = Turbulence.from_seeing(seeing_arcsec=self.settings.seeing_arcsec)
        return np.maximum(missed_by_wavefronts(self.wide, opds_m), missed_on_average(self.geometry, air))


@eqx.filter_jit
def _estimate(
    solver: Reconstructor,
    counts: Float[Array, "plane y x"],
    usable: Bool[Array, "plane y x"],
    read_variance: Float[Array, ""],
) -> WavefrontEstimate:
    return solver.estimate(counts, usable, read_variance=read_variance)


def rms_m(opd_m: Float[np.ndarray, "y x"], weights: Float[np.ndarray, "y x"]) -> float:
    """Rms over the light, piston removed; pixels that are NaN do not count.

    Examples:
        >>> rms_m(np.array([[1.0, 3.0, np.nan]]), np.array([[0.25, 0.25, 0.5]]))
        1.0
    """
    known = np.isfinite(opd_m) & (weights > 0)
    if not known.any():
        return math.nan
    values, light = opd_m[known], weights[known] / weights[known].sum()
    return math.sqrt(float(np.sum(light * (values - np.sum(light * values)) ** 2)))


def outcome_name(outcome: Outcome) -> str:
    """The outcome in a word or two, as files carry it.

    Examples:
        >>> outcome_name(Outcome.CONVERGED), outcome_name(Outcome.BUDGET_SPENT)
        ('converged', 'budget spent')
    """
    return outcome.name.lower().replace("_", " ")


def is_success(name: str) -> bool:
    """Whether an outcome that was read from a file means that the wavefront may be used.

    Examples:
        >>> is_success("budget spent"), is_success("not explained"), is_success("bad frame")
        (True, False, False)
    """
    return any(outcome.succeeded and outcome_name(outcome) == name for outcome in Outcome)

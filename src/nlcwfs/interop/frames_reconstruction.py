"""From a file of frames to wavefronts: the sensor that its header describes, and a reconstructor for it."""

import math
import time
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.fft
from jaxtyping import Array, Bool, Float

from nlcwfs.atmosphere.phase_screen import Turbulence
from nlcwfs.beam.grid import Grid
from nlcwfs.beam.modes import ModalBasis, modal_basis
from nlcwfs.beam.pupil import inside, light_weights
from nlcwfs.beam.sampling_cost import SensedLight, light_outside
from nlcwfs.beam.zernike import ZernikeFit
from nlcwfs.curvature_sensor.defocused_images import CurvatureSensor, centred_in
from nlcwfs.detector.pixels import fraction_outside_window
from nlcwfs.estimation.outcome import Outcome
from nlcwfs.estimation.reconstructor import SENSOR_LOSS, GerchbergSaxton
from nlcwfs.estimation.sensor_geometry import SensorGeometry
from nlcwfs.estimation.settings import EstimationSettings
from nlcwfs.estimation.wavefront_estimate import WavefrontEstimate
from nlcwfs.interop.frames_file import FramesFile
from nlcwfs.interop.frames_sensor import scored_pupil, sensor_geometry, well_seen_zernikes
from nlcwfs.interop.wavefront_file import FrameWavefront

MOST_ZERNIKES = 800
"""More are in no optician's table; the wavefront itself holds them all."""

WIDE = 2
"""The window that tells how much light a detector misses holds twice the frame and twice the pupil."""


class FramesReconstructor(eqx.Module):
    """Reconstructs the frames of one file, one at a time, and accounts for each.

    Attributes:
        frames: The file.
        settings: Options.
        geometry: The sensor that the header describes.
        photo_electrons: The light alone.
        solver: The algorithm, made for this sensor.
        weights: Share of the light in every pixel of a frame; zero outside the pupil.
        fit: The Zernikes that these pixels tell apart.
        wide: The optics on a wider window, to know what the detector's window misses.
        read_variance: Variance of a pixel without starlight, electrons squared.

    Examples:
        >>> frames = FramesFile(
        ...     electrons=np.full((1, 2, 20, 20), 9.0), masked=np.zeros((1, 2, 20, 20), bool), has_frame_axis=False,
        ...     pixel_m=0.5, wavelength_m=0.65e-6, diameter_m=8.0, distances_m=(-3e6, 3e6),
        ... )
        >>> reconstructor = FramesReconstructor.build(frames, EstimationSettings())
        >>> found = reconstructor.reconstruct(0)
        >>> found.opd_m.shape, int(reconstructor.noll[-1]) == len(found.coefficient_m)
        ((20, 20), True)
    """

    frames: FramesFile = eqx.field(static=True)
    settings: EstimationSettings = eqx.field(static=True)
    geometry: SensorGeometry = eqx.field(static=True)
    photo_electrons: Float[np.ndarray, "frame plane y x"]
    solver: GerchbergSaxton
    weights: Float[np.ndarray, "y x"]
    fit: ZernikeFit
    wide: CurvatureSensor
    read_variance: float = eqx.field(static=True)

    @classmethod
    def build(
        cls, frames: FramesFile, settings: EstimationSettings, *, dtype: str = "float32"
    ) -> "FramesReconstructor":
        """Prepare everything that the frames of a file share.

        Args:
            frames: The file.
            settings: Options; a seeing that they leave open is measured from each frame.
            dtype: Precision.

        Raises:
            SettingsError: If an option contradicts another.
            SamplingError: If the pixels cannot carry the pupil.
        """
        # SEEING of the header does not rule: behind a closed loop it tells nothing of the wavefronts that come, and a
        # filter told eleven times too strong a turbulence finds 2 % of the paper's frames (study 01, seeing-0.6).
        geometry = sensor_geometry(frames)
        pupil = scored_pupil(geometry)
        basis = _basis(pupil, geometry, settings) if settings.unwrapping == "slopes" else None
        background = 0.0 if frames.background is None else float(np.mean(frames.background))
        return cls(
            frames=frames,
            settings=settings,
            geometry=geometry,
            photo_electrons=frames.photo_electrons(),
            solver=GerchbergSaxton.build(geometry, settings, basis=basis, dtype=dtype),
            weights=light_weights(pupil),
            fit=well_seen_zernikes(pupil, geometry, most=min(settings.modes, MOST_ZERNIKES)),
            wide=geometry.model(_wide_grid(geometry), dtype=dtype),
            read_variance=frames.read_noise_electrons**2 + frames.dark_electrons + max(background, 0.0),
        )

    @property
    def noll(self) -> np.ndarray:
        """Noll index of every Zernike that is listed."""
        return np.arange(1, self.fit.matrix.shape[0] + 1)

    def compile(self) -> float:
        """Compile the solver ahead of the first frame; returns the seconds that it took."""
        started = time.perf_counter()
        jax.block_until_ready(self._estimate(0).opd_m)
        return time.perf_counter() - started

    def reconstruct(self, number: int) -> FrameWavefront:
        """The wavefront of one frame, counted from 0."""
        started = time.perf_counter()
        estimate = jax.block_until_ready(self._estimate(number))
        seconds = time.perf_counter() - started
        opd_m = np.where(self.weights > 0, np.asarray(estimate.opd_m, float), np.nan)
        truth_m = self.frames.truth_m
        if truth_m is not None:
            truth_m = truth_m if truth_m.ndim == 2 else truth_m[number]
        residual = np.where(self.frames.masked[number], np.nan, np.asarray(estimate.residual, float))
        return FrameWavefront(
            opd_m=opd_m,
            rms_nm=rms_m(opd_m, self.weights) * 1e9,
            outcome=outcome_name(estimate.outcome),
            iterations=int(estimate.iterations),
            ffts=int(estimate.ffts),
            predicted_error_nm=float(estimate.predicted_error_m) * 1e9,
            runtime_s=seconds,
            coefficient_m=np.asarray(self.fit.coefficients(opd_m), float),
            sigma_m=self.zernike_sigma_m(number),
            error_nm=None if truth_m is None else rms_m(opd_m - truth_m, self.weights) * 1e9,
            residual=residual,
            sentence=estimate.outcome.sentence,
        )

    def zernike_sigma_m(self, number: int) -> Float[np.ndarray, " noll"]:
        """One sigma of every Zernike coefficient, from photon and read noise.

        A mode of unit rms is known to 1 / (2 sqrt(N)) rad at the quantum limit; a sensor of speckles needs
        `SENSOR_LOSS` times the photons. Pixels of read noise weaken N photo-electrons to N^2 / (N + pixels *
        variance). What the filter takes away and what the pixels cannot hold is not in it.
        """
        known = ~self.frames.masked[number]
        electrons = max(float(self.photo_electrons[number].sum()), 1.0)
        effective = electrons**2 / (electrons + int(known.sum()) * self.read_variance)
        one_mode_m = math.sqrt(SENSOR_LOSS) / (2 * math.sqrt(effective)) * self.geometry.wavelength_m / (2 * np.pi)
        matrix, lit = np.asarray(self.fit.matrix), np.asarray(self.fit.lit)
        light = self.weights[lit]
        return one_mode_m * np.sqrt(np.sum(matrix[:, lit] ** 2 / light, axis=1))  # 1 each on a full disc

    def light_outside(self, opds_m: Sequence[Float[np.ndarray, "y x"]]) -> Float[np.ndarray, " plane"]:
        """Share of the light of each plane that misses the window of the frames.

        The larger of two estimates: by these wavefronts, which hold the tilt but not the finest waves, and by
        the mean over turbulence as strong as theirs, which holds both on average.
        """
        shape, diameter_m = self.geometry.frame.shape, self.geometry.pupil.diameter_m
        found = np.mean([_light_outside(self.wide, np.nan_to_num(opd_m), shape) for opd_m in opds_m], axis=0)
        rms = max(float(np.mean([rms_m(opd_m, self.weights) for opd_m in opds_m])), 1e-12)
        air = Turbulence.from_rms(opd_rms_m=rms, diameter_m=diameter_m)
        if self.settings.seeing_arcsec is not None:
            air = Turbulence.from_seeing(seeing_arcsec=self.settings.seeing_arcsec)
        wavelength_m = self.geometry.wavelength_m
        light = SensedLight(diameter_m, wavelength_m, fried_m=air.fried_at(wavelength_m))
        window_m = min(self.geometry.frame.width_m)
        both_sides = {abs(distance_m) for distance_m in self.geometry.distances_m}
        usual = {z: light_outside(light, distance_m=z, window_m=window_m) if z else 0.0 for z in both_sides}
        return np.maximum(found, [usual[abs(distance_m)] for distance_m in self.geometry.distances_m])

    def _estimate(self, number: int) -> WavefrontEstimate:
        dtype = self.solver.first_strength.dtype
        counts = jnp.asarray(self.photo_electrons[number], dtype)
        usable = jnp.asarray(~self.frames.masked[number])
        return _estimate(self.solver, counts, usable, jnp.asarray(self.read_variance, dtype))


@eqx.filter_jit
def _estimate(
    solver: GerchbergSaxton,
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


def _basis(pupil: Float[np.ndarray, "y x"], geometry: SensorGeometry, settings: EstimationSettings) -> ModalBasis:
    carried = int(0.7 * np.sum(inside(pupil)))  # pi / 4 of the pixels is half a cycle per pixel, less the rim
    count = max(1, min(settings.modes, carried))
    return modal_basis(pupil, geometry.frame, diameter_m=geometry.pupil.diameter_m, count=count)


def _wide_grid(geometry: SensorGeometry) -> Grid:
    pupil_pixels = geometry.pupil.diameter_m / geometry.frame.pixel_m

    def size(frame: int) -> int:
        count = math.ceil(WIDE * max(frame, pupil_pixels))
        while (count - frame) % 2 or count != scipy.fft.next_fast_len(count):
            count += 1
        return count

    return Grid((size(geometry.frame.shape[0]), size(geometry.frame.shape[1])), geometry.frame.pixel_m)


def _light_outside(
    wide: CurvatureSensor, opd_m: Float[np.ndarray, "y x"], window: tuple[int, int]
) -> Float[np.ndarray, " plane"]:
    rows, columns = wide.pupil.shape
    whole = jnp.asarray(centred_in(opd_m, (rows, columns)), wide.pupil.dtype)
    return np.asarray(_fraction_outside(wide, whole, window), float)


@eqx.filter_jit
def _fraction_outside(
    wide: CurvatureSensor, opd_m: Float[Array, "y x"], window: tuple[int, int]
) -> Float[Array, " plane"]:
    return fraction_outside_window(wide.images(opd_m, 1.0).photons, factor=1, window=window)

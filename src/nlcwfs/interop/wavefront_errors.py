"""What a file says about the errors of a wavefront: sigmas of its Zernikes, the quantum limit, the sensor's loss."""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from nlcwfs.beam.pupil import light_weights
from nlcwfs.beam.zernike import ZernikeFit
from nlcwfs.curvature_sensor.defocused_images import centred_in
from nlcwfs.estimation.error_bars import ErrorBars, projected_sigma
from nlcwfs.estimation.maximum_a_posteriori import MaximumAPosteriori
from nlcwfs.estimation.reconstructor import SENSOR_LOSS
from nlcwfs.estimation.wavefront_estimate import WavefrontEstimate
from nlcwfs.interop.frames_sensor import window_pupil


class ErrorReport(eqx.Module):
    """Turns the error bars of modes into what a file holds; made once for all frames of a sensor.

    Attributes:
        matrix: What a unit of every mode adds to each Zernike coefficient.
        elsewhere: Square of what each Zernike holds beyond the modes; it errs like the last mode.
        prior_rad2: Variance of every mode in turbulence of strength 1.
        band: Number of every mode's band.
        radian_m: Path of one radian.

    Examples:
        >>> from nlcwfs.beam.grid import Grid
        >>> from nlcwfs.beam.pupil_shape import PupilShape
        >>> from nlcwfs.estimation.sensor_geometry import SensorGeometry
        >>> from nlcwfs.estimation.settings import EstimationSettings
        >>> from nlcwfs.interop.frames_sensor import scored_pupil, well_seen_zernikes
        >>> geometry = SensorGeometry(PupilShape(8.0), Grid((24, 24), 0.5), 0.65e-6, (-3e6, 3e6))
        >>> solver = MaximumAPosteriori.build(geometry, EstimationSettings(modes=60))
        >>> report = ErrorReport.build(solver, well_seen_zernikes(scored_pupil(geometry), geometry, most=60))
        >>> report.matrix.shape, bool((report.elsewhere[1:10] < 0.05).all())
        ((45, 60), True)
    """

    matrix: Float[np.ndarray, "noll mode"]
    elsewhere: Float[np.ndarray, " noll"]
    prior_rad2: Float[np.ndarray, " mode"]
    band: Int[np.ndarray, " mode"]
    radian_m: float = eqx.field(static=True)

    @classmethod
    def build(cls, solver: MaximumAPosteriori, fit: ZernikeFit) -> "ErrorReport":
        """Fit the Zernikes to every mode.

        Args:
            solver: Tells the error bars of modes on the window of its model.
            fit: The Zernikes on the pixels of a frame.
        """
        error, geometry = solver.error, solver.geometry
        seen = (np.asarray(error.modes.rows), np.asarray(error.modes.columns))
        whole = np.stack([centred_in(one, error.modes.shape)[seen] for one in np.asarray(fit.matrix, float)])
        weights = light_weights(window_pupil(geometry, error.modes.shape))[seen]
        matrix = whole @ np.asarray(error.modes.modes, float).T
        # Modes and piston are orthonormal under these weights (Bessel); rounding may leave a little below zero.
        elsewhere = np.sum(whole**2 / weights, axis=1) - np.sum(matrix**2, axis=1) - np.sum(whole, axis=1) ** 2
        return cls(
            matrix=matrix,
            elsewhere=np.maximum(elsewhere, 0),
            prior_rad2=np.asarray(error.modes.turbulent_rad2, float) * float(error.strength_one),
            band=np.asarray(error.modes.band),
            radian_m=geometry.wavelength_m / (2 * np.pi),
        )

    def zernike_sigma_m(self, estimate: WavefrontEstimate, bars: ErrorBars) -> Float[np.ndarray, " noll"]:
        """One sigma of every Zernike coefficient.

        Scaled like the predicted error of the whole wavefront, which knows that the light is known only as well as
        the phase. Where the wavefront is not believed, nothing is known beyond the turbulence.
        """
        if not estimate.outcome.succeeded:
            prior_rad2 = self.prior_rad2 * max(float(estimate.strength), 1.0)
            return self.radian_m * np.sqrt(self.matrix**2 @ prior_rad2 + self.elsewhere * prior_rad2[-1])
        sigma_rad = np.asarray(projected_sigma(bars, jnp.asarray(self.matrix, bars.mode_rad2.dtype)), float)
        whole_m = self.radian_m * float(bars.wavefront_rad)
        scale = float(estimate.predicted_error_m) / whole_m if whole_m > 0 else 1.0
        return scale * self.radian_m * np.sqrt(sigma_rad**2 + self.elsewhere * float(bars.mode_rad2[-1]))

    def quantum_limit_nm(self, bars: ErrorBars) -> float | None:
        """Rms error of the wavefront that no sensor could beat with this light; None where it is not known."""
        limit = float(bars.quantum_rad) * self.radian_m * 1e9
        return limit if math.isfinite(limit) else None

    def photon_loss(self, bars: ErrorBars) -> float | None:
        """Photons that this sensor needs relative to the quantum limit, median over the modes; None if not known.

        Of the information alone, as in `photon_bound`: a ratio of predicted variances would count the turbulence,
        which helps both.
        """
        loss = float(np.median(np.asarray(bars.sensor_loss, float)[self.band]))
        return loss if math.isfinite(loss) else None


def photon_sigma_m(
    fit: ZernikeFit, weights: Float[np.ndarray, "y x"], *, photons: float, wavelength_m: float
) -> Float[np.ndarray, " noll"]:
    """One sigma of every Zernike coefficient from photon noise, for methods that tell no error bars.

    A mode of unit rms is known to 1 / (2 sqrt(N)) rad at the quantum limit; a sensor of speckles needs `SENSOR_LOSS`
    times the photons. What a filter takes away and what the pixels cannot hold is not in it.

    Args:
        fit: The Zernikes on the pixels of a frame.
        weights: Share of the light in every pixel.
        photons: Photons that would be as noisy by themselves.
        wavelength_m: Wavelength of sensing.

    Examples:
        >>> from nlcwfs.beam.grid import Grid
        >>> from nlcwfs.beam.pupil import circular_pupil
        >>> from nlcwfs.beam.zernike import zernike_fit
        >>> grid = Grid((40, 40), pixel_m=0.2)
        >>> pupil = circular_pupil(grid, diameter_m=8.0)
        >>> fit = zernike_fit(pupil, grid, diameter_m=8.0, count=6)
        >>> sigma_m = photon_sigma_m(fit, light_weights(pupil), photons=7500.0, wavelength_m=2 * np.pi)
        >>> sigma_m.round(2).tolist()  # sqrt(3 / 7500) / 2
        [0.01, 0.01, 0.01, 0.01, 0.01, 0.01]
    """
    one_mode_m = math.sqrt(SENSOR_LOSS / photons) / 2 * wavelength_m / (2 * np.pi)
    matrix, lit = np.asarray(fit.matrix), np.asarray(fit.lit)
    return one_mode_m * np.sqrt(np.sum(matrix[:, lit] ** 2 / weights[lit], axis=1))  # 1 each on a full disc


def effective_photons(electrons: float, *, pixels: int, read_variance: float) -> float:
    """Photons that would be as noisy by themselves: read noise weakens N to N^2 / (N + pixels * variance).

    Examples:
        >>> effective_photons(100.0, pixels=4, read_variance=25.0)
        50.0
    """
    electrons = max(electrons, 1.0)
    return electrons**2 / (electrons + pixels * read_variance)

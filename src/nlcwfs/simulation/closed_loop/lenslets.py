"""The Shack-Hartmann sensor in a loop: spots become the mirror's modes, with filters that the loop itself teaches."""

import math
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nlcwfs.comparison_sensors.settings import ShackHartmannSettings
from nlcwfs.config import Config
from nlcwfs.estimation.loop_reconstructor import loop_reconstructor
from nlcwfs.estimation.outcome import Outcome
from nlcwfs.estimation.spot_centroids import (
    Slopes,
    SpotFilter,
    centre_of_gravity,
    matched_filter,
    weighted_centre_of_gravity,
)
from nlcwfs.estimation.spot_model import MeanSpot, SpotModel
from nlcwfs.simulation.closed_loop.lenslet_light import LensletOptics
from nlcwfs.simulation.closed_loop.lenslet_modes import LensletModes
from nlcwfs.simulation.closed_loop.light import LoopLight
from nlcwfs.simulation.closed_loop.sight import Sight
from nlcwfs.simulation.exposure import Exposure, wavelength_m

HALVED = 0.5
"""While a loop closes, what is left to correct falls at least so far, in square, within `STEADY` exposures."""

STEADY = 2
"""Exposures in a row without such a fall after which the loop counts as closed."""

SETTLED = 10
"""Exposures after closing at which spots and noise are as they will stay, and the reconstructor is made once more."""


class SpotsState(NamedTuple):
    """Memory of a loop with lenslets.

    Attributes:
        spot: Running mean of what a spot looks like.
        since: Exposures that are in it.
        matrix: Reconstructor in use, metres of each mode of the mirror per radian of slope.
        predicted_m: Error that it expects of itself.
        least_m2: The least that was ever left to correct, in square.
        steady: Exposures in a row in which it was not halved.
        frames: Exposures with light since the loop closed; -1 while it is open.
    """

    spot: Float[Array, "1 v u"]
    since: int
    matrix: Float[Array, "mode slope"]
    predicted_m: float
    least_m2: float
    steady: int
    frames: int


class FollowedSpots(eqx.Module):
    """Lenslets, a centroid or matched filter, and the minimum-variance modes of the mirror.

    The sensor knows the strength of the air and its wind, as an expert who has measured them. It has no belief: every
    exposure with light is believed.
    """

    optics: LensletOptics
    settings: ShackHartmannSettings = eqx.field(static=True)
    modes: LensletModes = eqx.field(static=True)
    begun: Float[Array, "1 v u"]
    light: Float[Array, " spot"]
    starts_closed: bool = eqx.field(static=True)

    @classmethod
    def build(cls, config: Config, light: LoopLight, optics: LensletOptics) -> "FollowedSpots":
        """Prepare filters and modes of a configuration.

        Raises:
            SettingsError: If settings contradict each other.
        """
        sensor, settings = optics.sensor, config.shack_hartmann
        share = jnp.sum(sensor.amplitude**2, (1, 2))
        flat_m = jnp.zeros(optics.along_y.shape[:1] + optics.along_x.shape[:1], optics.along_y.dtype)
        flat = sensor.images(flat_m, 1.0).photons
        spot = jnp.mean(flat, axis=0, keepdims=True)
        starts_closed = config.loop.start == "closed"
        if not starts_closed:
            spot = blurred(spot, sensor.pixel_rad, wavelength_m(config), light.still.air.fried_at(wavelength_m(config)))
        return cls(
            optics=optics,
            settings=settings,
            modes=LensletModes.build(config, light, optics),
            begun=spot / jnp.sum(spot),
            light=share / jnp.sum(share),
            starts_closed=starts_closed,
        )

    def measure(
        self,
        exposure: Exposure,
        usable: Bool[Array, "spot v u"],
        mirror_m: Float[Array, "lit_y lit_x"],
        memory: SpotsState | None,
    ) -> tuple[Sight, SpotsState | None]:
        """What an exposure shows; see `LoopSensor`."""
        electrons = exposure.frames.electrons
        total = self.total(electrons)
        if not total > 0:
            rest_m = jnp.zeros(self.modes.count, self.begun.dtype)
            return Sight(rest_m, Outcome.NO_LIGHT, math.nan, 0, False), memory
        state = memory or self._begin(total)
        kept = min(self.settings.memory, state.since / (state.since + 1))
        dtype = self.begun.dtype
        numbers = jnp.asarray(total, dtype), jnp.asarray(kept, dtype)
        residual_m, spot = self._looked(electrons, usable, (state.spot, state.matrix), numbers)
        left_m2 = float(jnp.sum(residual_m**2))
        steady = 0 if left_m2 < HALVED * state.least_m2 else state.steady + 1
        frames = state.frames + 1 if state.frames >= 0 else (0 if steady >= STEADY else -1)
        after = state._replace(
            spot=spot, since=state.since + 1, least_m2=min(left_m2, state.least_m2), steady=steady, frames=frames
        )
        if frames == 0:
            after = after._replace(since=1)  # spots of an open loop are forgotten
        if frames in (0, SETTLED):
            after = self._made(after, total, closed=True)
        sight = Sight(residual_m, Outcome.CONVERGED, state.predicted_m, 0, frames >= 0)
        return sight, after

    def skip(self, memory: SpotsState | None) -> tuple[None, SpotsState | None]:
        """Spots stay as they are; see `LoopSensor`."""
        return None, memory

    def filter_of(self, spot: Float[Array, "1 v u"], total: float | Float[Array, ""]) -> SpotFilter:
        """The way to a spot's place that the settings ask for.

        Args:
            spot: Mean spot.
            total: Electrons of a whole exposure.
        """
        settings, model = self.settings, SpotModel.of_mean(spot, pixel_rad=self.optics.sensor.pixel_rad)
        if settings.centroid == "matched":
            extra = self.optics.still.detector.variance_without_light * len(self.light) / total
            return matched_filter(model, extra_electrons2=extra)
        if settings.centroid == "weighted":
            width_rad = settings.weight_lambda_over_d * self._lambda_over_d
            return weighted_centre_of_gravity(model, fwhm_rad=width_rad)
        return centre_of_gravity(model, threshold=settings.threshold if settings.centroid == "thresholded" else 0.0)

    def total(self, electrons: Float[Array, "spot v u"]) -> float:
        """Electrons of a whole exposure that are looked at."""
        return float(self._total(electrons))

    def noise_rad2(self, spot: Float[Array, "1 v u"], total: float) -> Float[np.ndarray, " slope"]:
        """Variance of every slope, along y and then x of each spot, from photon and read noise.

        Args:
            spot: Mean spot.
            total: Electrons of a whole exposure.
        """
        spots = self.filter_of(spot, total)
        if self.settings.centroid == "thresholded":  # its noise has no closed form; that of all light is near
            spots = centre_of_gravity(SpotModel.of_mean(spot, pixel_rad=self.optics.sensor.pixel_rad))
        extra = self.optics.still.detector.variance_without_light
        of_photons = np.asarray(spots.variance(spot), float)
        of_pixels = np.asarray(spots.variance(spot, extra_electrons2=1.0), float) - of_photons
        flux = np.asarray(self.light, float)[:, None] * total
        return (of_photons / flux + extra * of_pixels / flux**2).ravel()

    def slopes(
        self,
        electrons: Float[Array, "spot v u"],
        usable: Bool[Array, "spot v u"],
        spot: Float[Array, "1 wv wu"],
        total: Float[Array, ""],
    ) -> tuple[Slopes, Float[Array, "1 wv wu"]]:
        """Slopes of an exposure, and what its spots look like in the mean.

        Args:
            electrons: Photo-electrons of every pixel, background subtracted.
            usable: Pixels that were read; a spot that lacks one has no weight.
            spot: Mean spot.
            total: Electrons of the whole exposure.
        """
        electrons, whole = self._window(electrons), jnp.all(self._window(usable), axis=(1, 2))
        slopes = self.filter_of(spot, total).measure_faint(electrons, self.light)
        weight = slopes.weight * whole.astype(slopes.weight.dtype)
        return Slopes(slopes.slope, weight), MeanSpot(spot, 0.0).updated(electrons).shape

    @property
    def _lambda_over_d(self) -> float:
        sensor = self.optics.sensor
        return sensor.pixel_rad * self.settings.pixels / self.settings.field_lambda_over_d

    def _window(self, electrons: Float[Array, "spot v u"] | Bool[Array, "spot v u"]) -> Array:
        """The pixels that are looked at: as many off each side."""
        chosen, field = self.settings.window_lambda_over_d, self.settings.field_lambda_over_d
        if chosen is None or chosen >= field:
            return electrons
        off = min(round(self.settings.pixels * (1 - chosen / field) / 2), (self.settings.pixels - 2) // 2)
        return electrons[:, off : self.settings.pixels - off, off : self.settings.pixels - off]

    @eqx.filter_jit
    def _total(self, electrons: Float[Array, "spot v u"]) -> Float[Array, ""]:
        return jnp.sum(self._window(electrons))

    def _begin(self, total: float) -> SpotsState:
        """Before the first exposure with light, which tells how much of it there is."""
        spot = self._window(self.begun)
        empty = SpotsState(spot / jnp.sum(spot), 1, jnp.zeros((0, 0), spot.dtype), 0.0, math.inf, 0, -1)
        return self._made(empty, total, closed=self.starts_closed)

    def _made(self, state: SpotsState, total: float, *, closed: bool) -> SpotsState:
        """The same with a reconstructor for the spots and the light as they are."""
        made = loop_reconstructor(self.modes.known, noise_rad2=self.noise_rad2(state.spot, total), closed=closed)
        matrix = jnp.asarray(self.modes.commands(made.matrix), self.begun.dtype)
        return state._replace(matrix=matrix, predicted_m=math.sqrt(float(np.sum(made.error_m2))))

    @eqx.filter_jit
    def _looked(
        self,
        electrons: Float[Array, "spot v u"],
        usable: Bool[Array, "spot v u"],
        known: tuple[Float[Array, "1 wv wu"], Float[Array, "mode slope"]],
        numbers: tuple[Float[Array, ""], Float[Array, ""]],
    ) -> tuple[Float[Array, " mode"], Float[Array, "1 wv wu"]]:
        """Modes of the residual, and the mean spot with this exposure in it."""
        (spot, matrix), (total, memory) = known, numbers
        slopes, seen = self.slopes(electrons, usable, spot, total)
        residual_m = matrix @ (slopes.slope * slopes.weight[:, None]).ravel()
        return residual_m, memory * spot + (1 - memory) * seen


def blurred(
    spot: Float[Array, "1 v u"], pixel_rad: float, wavelength_m: float, fried_m: float
) -> Float[Array, "1 v u"]:
    r"""A spot after a long exposure through turbulence: its transfer function times that of the air.

    :math:`\exp(-3.44 (\lambda u / r_0)^{5/3})` at the angular frequency u (Fried 1966).

    Examples:
        >>> spot = jnp.zeros((1, 9, 9)).at[0, 4, 4].set(1.0)
        >>> wide = blurred(spot, 1e-6, 0.85e-6, 0.3)
        >>> round(float(wide.sum()), 2), bool(wide[0, 4, 4] < 0.2)
        (0.96, True)
    """
    _, rows, columns = spot.shape
    u = np.hypot(np.fft.fftfreq(2 * rows, pixel_rad)[:, None], np.fft.rfftfreq(2 * columns, pixel_rad)[None, :])
    transfer = np.exp(-3.44 * (wavelength_m * u / fried_m) ** (5 / 3))
    spectrum = np.fft.rfft2(np.asarray(spot, float), s=(2 * rows, 2 * columns))
    wide = np.fft.irfft2(spectrum * transfer, s=(2 * rows, 2 * columns))
    return jnp.asarray(np.maximum(wide[:, :rows, :columns], 0), spot.dtype)

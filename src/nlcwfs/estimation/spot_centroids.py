"""Where the spots of a Shack-Hartmann sensor are: centres of gravity and the matched filter, all with gain 1."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nlcwfs.errors import SettingsError
from nlcwfs.estimation.spot_model import SpotModel

FAINTEST = 1e-3
"""The matched filter trusts no pixel fainter than this share of the brightest of its spot: the running mean knows the
wings badly, and a perfect spot has zeros where the filter would be infinite."""


NEARLY_NOTHING = 1e-6
"""Keeps the three unknowns of a dark spot apart; calibration takes it out elsewhere."""


class Slopes(eqx.Module):
    """Mean slope of the wavefront over each subaperture.

    Attributes:
        slope: Along y and x, metres of path per metre of pupil, which is an angle in radians.
        weight: 1 where there was light to measure, else 0 and the slope is 0.
    """

    slope: Float[Array, "spot 2"]
    weight: Float[Array, " spot"]


class SpotFilter(eqx.Module):
    """A slope as a ratio of two weighted sums over the pixels of a spot, less its value for a flat wavefront.

    Attributes:
        along_y: Weights in radians of the slope along y, scaled so that a small tilt is measured as itself.
        along_x: The same along x.
        flux: Weights of the flux.
        zero: What a flat wavefront gives, taken off.
        threshold: Share of a spot's brightest pixel that is taken off all of them first; 0 takes nothing.

    Examples:
        Light one pixel of 1 microradian right of the middle.

        >>> import jax.numpy as jnp
        >>> from nlcwfs.estimation.spot_centroids import centre_of_gravity
        >>> from nlcwfs.estimation.spot_model import SpotModel
        >>> spot = jnp.zeros((1, 7, 7)).at[0, 2:5, 2:5].set(1.0)
        >>> model = SpotModel.of_mean(spot, pixel_rad=1e-6)
        >>> found = centre_of_gravity(model).measure(jnp.roll(spot, 1, axis=2))
        >>> [round(float(angle) * 1e6, 3) for angle in found.slope[0]]
        [0.0, 1.0]
    """

    along_y: Float[Array, "spot v u"]
    along_x: Float[Array, "spot v u"]
    flux: Float[Array, "spot v u"]
    zero: Float[Array, "spot 2"]
    threshold: float = eqx.field(static=True, default=0.0)

    def measure(self, electrons: Float[Array, "spot v u"]) -> Slopes:
        """Slopes of one exposure, each spot divided by its own light.

        A spot without light has slope 0 and weight 0.

        Args:
            electrons: Photo-electrons of every pixel, background and dark subtracted.
        """
        moments = self._moments(electrons)
        seen = moments[:, 2] > 0
        flux = jnp.where(seen, moments[:, 2], 1)
        slope = jnp.where(seen[:, None], moments[:, :2] / flux[:, None] - self.zero, 0)
        return Slopes(slope, seen.astype(slope.dtype))

    def measure_faint(self, electrons: Float[Array, "spot v u"], light: Float[Array, " spot"]) -> Slopes:
        """Slopes of one exposure, each spot divided by the light that it has on average.

        A spot with few photons then says little, as it should: its noise is of the size of the others', and an empty
        one gives zero without harm. Better than `measure` below some 20 photons a spot.

        Args:
            electrons: Photo-electrons of every pixel, background and dark subtracted.
            light: The share of each subaperture in the light of all, sum 1; the frame's own total sets the scale.
        """
        moments = self._moments(electrons)
        total = jnp.sum(moments[:, 2])
        seen = (moments[:, 2] > 0) & (total > 0) & (light > 0)
        flux = jnp.where(seen, total * light, 1)
        about_zero = moments[:, :2] - self.zero * moments[:, 2:]
        return Slopes(jnp.where(seen[:, None], about_zero / flux[:, None], 0), seen.astype(moments.dtype))

    def variance(self, mean: Float[Array, "spot v u"], *, extra_electrons2: float = 0.0) -> Float[Array, "spot 2"]:
        r"""Variance of the slopes in rad^2 for spots of this mean; not for thresholds.

        First order in the noise: :math:`\sum (h - s f)^2 V / (\sum f \mu)^2`, weights h and f, slope s.

        Args:
            mean: Photo-electrons expected on every pixel.
            extra_electrons2: Variance of every pixel beyond that of its photons: read noise, dark, sky.
        """
        flux = jnp.sum(self.flux * mean, axis=(1, 2))
        found = []
        for weights in (self.along_y, self.along_x):
            slope = jnp.sum(weights * mean, axis=(1, 2)) / flux
            about = weights - slope[:, None, None] * self.flux
            found.append(jnp.sum(about**2 * (mean + extra_electrons2), axis=(1, 2)) / flux**2)
        return jnp.stack(found, axis=1)

    def _moments(self, electrons: Float[Array, "spot v u"]) -> Float[Array, "spot 3"]:
        if self.threshold > 0:
            brightest = jnp.max(electrons, axis=(1, 2), keepdims=True)
            electrons = jnp.maximum(electrons - self.threshold * brightest, 0)
        return _sums(jnp.stack([self.along_y, self.along_x, self.flux]), electrons)


def centre_of_gravity(model: SpotModel, *, threshold: float = 0.0) -> SpotFilter:
    """Centre of all the light in the window.

    Its photon noise grows with the window: the wings of a square lenslet fall as 1 / angle^2, and each part of the
    window adds as much variance. A threshold cuts read noise; with photon noise alone it gains little.

    Args:
        model: Spots to calibrate the gain on.
        threshold: Share of the brightest pixel that is subtracted first.

    Raises:
        SettingsError: If the threshold is not between 0 and 1.

    Examples:
        >>> spot = jnp.zeros((1, 9, 9)).at[0, 3:6, 3:6].set(1.0)
        >>> model = SpotModel.of_mean(spot, pixel_rad=1.0)
        >>> float(centre_of_gravity(model, threshold=0.5).measure(5 * spot).weight[0])
        1.0
    """
    if not 0 <= threshold < 1:
        raise SettingsError("threshold", "must be at least 0 and below 1", threshold)
    angle_y, angle_x = _angles(model)
    return _calibrated(model, angle_y, angle_x, jnp.ones_like(angle_y), threshold)


def weighted_centre_of_gravity(model: SpotModel, *, fwhm_rad: float) -> SpotFilter:
    """Centre of the light under a Gaussian (Nicolle et al. 2004, Opt. Lett. 29, 2743), its gain calibrated.

    Args:
        model: Spots to calibrate the gain on.
        fwhm_rad: Full width at half maximum of the weight; about that of the spot is best.

    Raises:
        SettingsError: If the width is not positive.

    Examples:
        >>> spot = jnp.zeros((1, 9, 9)).at[0, 3:6, 3:6].set(1.0)
        >>> model = SpotModel.of_mean(spot, pixel_rad=1.0)
        >>> found = weighted_centre_of_gravity(model, fwhm_rad=4.0).measure(spot)
        >>> bool(abs(found.slope).max() < 1e-6)
        True
    """
    if not fwhm_rad > 0:
        raise SettingsError("fwhm_rad", "must be a positive angle", fwhm_rad)
    angle_y, angle_x = _angles(model)
    weight = jnp.exp(-4 * np.log(2.0).astype(angle_y.dtype) * (angle_y**2 + angle_x**2) / fwhm_rad**2)
    return _calibrated(model, angle_y * weight, angle_x * weight, weight, 0.0)


def matched_filter(model: SpotModel, *, extra_electrons2: float | Float[Array, ""] = 0.0) -> SpotFilter:
    r"""The most likely small shift of a known spot of unknown brightness.

    The noise-optimal matched filter of Gilles & Ellerbroek (2006, Appl. Opt. 45, 6568), for photon noise: weights
    :math:`\partial_s \mu / V` with the variance V of the pixels, made blind to the brightness and to the shift across.
    No unbiased estimate of a small shift has less noise.

    Args:
        model: The mean spot; in a running loop its running mean, see `MeanSpot`.
        extra_electrons2: Variance of every pixel beyond that of its photons, in the unit of `model.mean` squared.

    Examples:
        >>> spot = jnp.zeros((1, 9, 9)).at[0, 3:6, 3:6].set(1.0)
        >>> model = SpotModel.of_mean(spot, pixel_rad=1.0)
        >>> found = matched_filter(model, extra_electrons2=0.1).measure(spot)
        >>> bool(abs(found.slope).max() < 1e-6)
        True
    """
    faintest = FAINTEST * jnp.max(model.mean, axis=(1, 2), keepdims=True)
    variance = jnp.maximum(model.mean, faintest) + extra_electrons2
    variance = jnp.where(variance > 0, variance, 1)  # of a dark spot
    shapes = jnp.stack([model.along_y * model.pixel_rad, model.along_x * model.pixel_rad, model.mean])
    weighted = shapes / variance[None]
    fisher = jnp.einsum("asvu,bsvu->sab", weighted, shapes)
    scale = jnp.sqrt(jnp.diagonal(fisher, axis1=1, axis2=2))
    scale = jnp.where(scale > 0, scale, 1)
    unit = fisher / (scale[:, :, None] * scale[:, None, :]) + NEARLY_NOTHING * jnp.eye(3, dtype=fisher.dtype)[None]
    inverse = jnp.linalg.inv(unit) / (scale[:, :, None] * scale[:, None, :])
    along_y, along_x, flux = jnp.einsum("sab,bsvu->asvu", inverse, weighted)
    return _calibrated(model, along_y * model.pixel_rad, along_x * model.pixel_rad, flux, 0.0)


def _angles(model: SpotModel) -> tuple[Float[Array, "1 v u"], Float[Array, "1 v u"]]:
    """Angle along y and along x of every pixel."""
    _, rows, columns = model.mean.shape
    y, x = ((np.arange(count) - (count - 1) / 2) * model.pixel_rad for count in (rows, columns))
    dtype = model.mean.dtype
    flat = jnp.zeros((1, rows, columns), dtype)
    return flat + jnp.asarray(y[None, :, None], dtype), flat + jnp.asarray(x[None, None, :], dtype)


def _sums(weights: Float[Array, "kind one v u"], light: Float[Array, "spot v u"]) -> Float[Array, "spot kind"]:
    """Weighted sums over the pixels of every spot."""
    kinds, own = weights.shape[:2]
    if own == 1:
        return light.reshape(light.shape[0], -1) @ weights.reshape(kinds, -1).T
    return jnp.stack([jnp.sum(one * light, axis=(1, 2)) for one in weights], axis=1)


def _calibrated(
    model: SpotModel,
    along_y: Float[Array, "one v u"],
    along_x: Float[Array, "one v u"],
    flux: Float[Array, "one v u"],
    threshold: float,
) -> SpotFilter:
    """Scale the weights until the model's own small shift is measured as itself; a dark spot stays at weight 0."""

    def of_pixels(light: Float[Array, "spot v u"]) -> Float[Array, "spot v u"]:
        if threshold == 0:
            return light
        return jnp.maximum(light - threshold * jnp.max(light, axis=(1, 2), keepdims=True), 0)

    def ratios(light: Float[Array, "spot v u"]) -> Float[Array, "spot 2"]:
        sums = _sums(jnp.stack([along_y, along_x, flux]), of_pixels(light))
        seen = sums[:, 2] != 0
        return jnp.where(seen[:, None], sums[:, :2] / jnp.where(seen, sums[:, 2], 1)[:, None], 0)

    step = model.pixel_rad * 0.1
    gains = []
    for axis, change in enumerate((model.along_y, model.along_x)):
        there, back = ratios(model.mean + step * change), ratios(model.mean - step * change)
        gains.append((there[:, axis] - back[:, axis]) / (2 * step))
    gain = jnp.stack(gains, axis=1)
    gain = jnp.where(gain > 0, gain, 1)
    along_y = along_y / gain[:, 0, None, None]
    along_x = along_x / gain[:, 1, None, None]
    flux = jnp.broadcast_to(flux, along_y.shape)
    return SpotFilter(along_y, along_x, flux, ratios(model.mean) / gain, threshold)

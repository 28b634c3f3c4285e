"""What the pyramid of a loop shows of the mirror's modes, amid residuals from the open loop's to the closed one's."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from nlcwfs.beam.grid import Grid
from nlcwfs.comparison_sensors.pyramid import Pyramid
from nlcwfs.config import Config
from nlcwfs.estimation.gain_regimes import Regime
from nlcwfs.estimation.mean_response import mean_derivative
from nlcwfs.mirror.mirror import Mirror
from nlcwfs.simulation.closed_loop.driven_modes import DrivenModes
from nlcwfs.simulation.closed_loop.light import LoopLight
from nlcwfs.simulation.closed_loop.pyramid_light import PyramidOptics, pyramid_on

SHARES = (1.0, 0.25, 0.06, 0.015, 0.004, 0.0)
"""Part of the open loop's variance in the residual of each regime, beyond that of the closed loop."""

DRAWS = 8
"""Wavefronts, each with both signs, whose light is averaged in a regime."""

DERIVATIVES = 12
"""Derivatives that are averaged in a regime, at least; of a modulated pyramid twice the points of its circle."""

SAMPLED = 24
"""Modes whose gains are asked in a regime; those of the others lie between them."""

FINENESS = 2
"""Cells along a pixel in the derivatives: coarser than the light, eight times faster, 1 % off."""

NOISE_SHARE = 3.0
"""Variance of a mode's noise in the closed loop, over the quantum limit of an exposure, as the regimes assume it."""


RESIDUAL_KEY = 40961
"""Random key of the residuals: not that of any sky."""


class Direction(eqx.Module):
    """A pyramid seen from single points of its circle, the mean of which is its image."""

    sensor: Pyramid

    def __call__(self, opd_m: Float[Array, "y x"], number: Int[Array, ""]) -> Float[Array, "image v u"]:
        """Share of the light on the pixels from one point."""
        one = eqx.tree_at(lambda it: it.circle_rad, self.sensor, self.sensor.circle_rad[number][None])
        return one.images(opd_m, 1.0).photons


class Residuals:
    """Draws wavefronts as a loop leaves them: the mirror's modes of a share of the air's strength, and all beyond."""

    def __init__(self, light: LoopLight, drive: DrivenModes) -> None:
        self.light, self.drive = light, drive
        self.parts: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def closed_m2(self) -> Float[np.ndarray, " driven"]:
        """Variance of the driven modes that a closed loop leaves, about."""
        still = self.light.still
        radian_m = still.wavelength_m / (2 * math.pi)
        noise_m2 = NOISE_SHARE * radian_m**2 / (4 * still.photons)
        return np.minimum(self.drive.open_m2[: self.drive.driven], self.drive.moved_m2 + noise_m2)

    def prior_m2(self, share: float) -> Float[np.ndarray, " driven"]:
        """The same in a regime."""
        open_m2, closed_m2 = self.drive.open_m2[: self.drive.driven], self.closed_m2()
        return closed_m2 + share * (open_m2 - closed_m2)

    def draw_m(self, share: float, number: int) -> Float[np.ndarray, "lit_y lit_x"]:
        """A wavefront; odd numbers are the negatives of the even ones before."""
        if number // 2 not in self.parts:
            key = jax.random.fold_in(jax.random.key(RESIDUAL_KEY), number // 2)
            beyond_m, fitted_m = _drawn(self.light, self.drive.modes, key)
            self.parts[number // 2] = np.asarray(beyond_m), np.asarray(fitted_m)
        beyond_m, fitted_m = self.parts[number // 2]
        kept, count, modes = np.ones(fitted_m.size), self.drive.driven, self.drive.modes
        kept[:count] = np.sqrt(self.prior_m2(share) / self.drive.open_m2[:count])
        lit = np.asarray(modes.rows), np.asarray(modes.columns)
        drawn_m = beyond_m.copy()
        drawn_m[lit] += (kept * fitted_m).astype(fitted_m.dtype) @ np.asarray(modes.shapes)
        return drawn_m * (-1) ** number


@eqx.filter_jit
def _drawn(
    light: LoopLight, modes: Mirror, key: PRNGKeyArray
) -> tuple[Float[Array, "lit_y lit_x"], Float[Array, " mode"]]:
    """What the modes cannot make of a screen, without piston, and the modes."""
    screen_m = light.still.screens.draw(key)
    fitted_m = modes.fitted(screen_m)
    beyond_m = screen_m - modes.opd_m(fitted_m)
    return jnp.where(light.weights > 0, beyond_m - jnp.sum(light.weights * beyond_m), 0), fitted_m


def pyramid_regimes(
    config: Config, light: LoopLight, optics: PyramidOptics, drive: DrivenModes
) -> tuple[Float[np.ndarray, "pixel mode"], tuple[Regime, ...]]:
    """Response to every driven mode in the closed loop, and the regimes from the open loop to it.

    Args:
        config: The settings.
        light: Air, pupil and mirror.
        optics: The pyramid.
        drive: The modes.
    """
    residuals, cells = Residuals(light, drive), _coarser(light.part, optics.sensor.pixel_m)
    model = Direction(pyramid_on(config, light.still, cells))
    maps = np.stack([_on_cells(one, light, cells) for one in _shapes(drive)])
    points = len(optics.sensor.circle_rad)
    cycles = np.asarray(drive.modes.cycles_per_aperture, float)[: drive.driven]
    some = np.unique(np.round(np.geomspace(1, drive.driven, min(SAMPLED, drive.driven))).astype(int) - 1)

    def derivative(share: float, chosen: np.ndarray | slice) -> Float[np.ndarray, "pixel mode"]:
        count = max(DERIVATIVES, 2 * points) if points > 1 else DERIVATIVES
        amid = ((_on_cells(residuals.draw_m(share, n), light, cells), 5 * n % points) for n in range(count))
        dtype = light.weights.dtype
        drawn = ((jnp.asarray(one, dtype), number) for one, number in amid)
        return mean_derivative(model, jnp.asarray(maps[chosen], dtype), drawn)

    response = derivative(0.0, slice(None))
    seen = float(np.sum(np.asarray(_images(optics, jnp.zeros_like(light.weights)))))
    regimes = []
    for share in SHARES:
        gains = np.ones(drive.driven)
        if share:
            amid, here = derivative(share, some), response[:, some]
            told = np.sum(amid * here, axis=0) / np.sum(here**2, axis=0)
            gains = np.interp(np.log(cycles), np.log(cycles[some]), np.maximum(told, 0.0))
        shown = [np.asarray(_images(optics, jnp.asarray(residuals.draw_m(share, n)))) for n in range(2 * DRAWS)]
        regimes.append(_regime(np.array(shown), response / seen, gains, residuals.prior_m2(share)))
    return response / seen, tuple(regimes)


def _regime(
    shown: Float[np.ndarray, "draw image v u"],
    response: Float[np.ndarray, "pixel mode"],
    gains: Float[np.ndarray, " mode"],
    prior_m2: Float[np.ndarray, " mode"],
) -> Regime:
    lights = shown.reshape(len(shown), -1).astype(float)
    lights /= lights.sum(axis=1, keepdims=True)
    mean = lights.mean(axis=0)
    bright = float(np.sum(mean**2))
    away = float(np.sum((lights - mean) ** 2)) / len(lights)
    linear = float(np.sum(response**2 @ (gains**2 * prior_m2)))
    return Regime(
        mean=mean,
        gains=gains,
        prior_m2=prior_m2,
        scatter=max(away - linear, 0.0) / bright,
        contrast=away / bright,
    )


@eqx.filter_jit
def _images(optics: PyramidOptics, opd_m: Float[Array, "lit_y lit_x"]) -> Float[Array, "image v u"]:
    return optics.images(opd_m, 1.0)


def _shapes(drive: DrivenModes) -> Float[np.ndarray, "mode lit_y lit_x"]:
    mirror = drive.modes
    shapes = np.zeros((drive.driven, *mirror.shape), np.float32)
    shapes[:, np.asarray(mirror.rows), np.asarray(mirror.columns)] = np.asarray(mirror.shapes)[: drive.driven]
    return shapes


def _coarser(part: Grid, pixel_m: float) -> Grid:
    """Whole cells of the light put together, `FINENESS` and more to a pixel, where they divide its grid."""
    fits = [n for n in range(1, 17) if part.shape[0] % n == part.shape[1] % n == 0]
    times = max(n for n in fits if n == 1 or n * part.pixel_m * FINENESS <= pixel_m * (1 + 1e-9))
    return Grid((part.shape[0] // times, part.shape[1] // times), part.pixel_m * times)


def _on_cells(opd_m: np.ndarray, light: LoopLight, cells: Grid) -> Float[np.ndarray, "y x"]:
    """Mean of a wavefront over the light of coarser cells."""
    times = light.part.shape[0] // cells.shape[0]
    weights = np.asarray(light.weights)

    def summed(values: np.ndarray) -> np.ndarray:
        return values.reshape(cells.shape[0], times, cells.shape[1], times).sum((1, 3))

    total = summed(weights)
    return np.where(total > 0, summed(weights * opd_m) / np.where(total > 0, total, 1), 0)

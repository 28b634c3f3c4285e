"""The pyramid in a loop: pixels become the mirror's modes, linearly, with the gain that the residual leaves."""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nlcwfs.config import Config
from nlcwfs.estimation.gain_regimes import Regime, regime_estimator, regime_of
from nlcwfs.estimation.outcome import Outcome
from nlcwfs.simulation.closed_loop.driven_modes import DrivenModes
from nlcwfs.simulation.closed_loop.light import LoopLight
from nlcwfs.simulation.closed_loop.pyramid_light import PyramidOptics
from nlcwfs.simulation.closed_loop.pyramid_regimes import pyramid_regimes
from nlcwfs.simulation.closed_loop.sight import Sight
from nlcwfs.simulation.exposure import Exposure

DARK = 0.2
"""An image with less than this part of its light is not looked at."""

CALM = 3
"""Regimes, the last of the list, in which a loop is as good as closed: up to 1.5 % of the open loop's variance ..."""

STEADY = 2
"""... for so many exposures in a row."""


class PyramidState(NamedTuple):
    """Memory of a loop with a pyramid.

    Attributes:
        weights: Of every pixel in each regime, for the light that there is.
        inverse: The rest of the estimator of each regime, and then of the calm ones in a loop that has settled.
        predicted_m: Error that each expects of itself.
        steady: Exposures in a row in the calm regimes.
    """

    weights: Float[Array, "regime pixel"]
    inverse: Float[Array, "estimator mode driven"]
    predicted_m: tuple[float, ...]
    steady: int


class FollowedPyramid(eqx.Module):
    """All pixels of four pupil images, and the minimum-variance modes of the mirror.

    No slopes: every pixel counts with its own noise, and light that is diffracted beyond the rim counts, too. The
    response is the exact derivative of the optics, mean over residuals as the loop leaves them, so that the optical
    gain is right; how uneven the light is tells of each exposure how rough the wavefront is, and which gain is due.
    """

    drive: DrivenModes
    regimes: tuple[Regime, ...]
    response: Float[Array, "pixel mode"]
    means: Float[Array, "regime pixel"]
    read_variance: float = eqx.field(static=True)

    @classmethod
    def build(cls, config: Config, light: LoopLight, optics: PyramidOptics) -> "FollowedPyramid":
        """Push all modes through the optics.

        Raises:
            SettingsError: If no mode is slow enough to be driven.
        """
        cutoff = config.pyramid.cutoff_cpa or config.pyramid.pixels / 2
        drive = DrivenModes.build(config, light, cutoff_cpa=cutoff, setting="pyramid.cutoff_cpa")
        response, regimes = pyramid_regimes(config, light, optics, drive)
        dtype = light.weights.dtype
        return cls(
            drive=drive,
            regimes=regimes,
            response=jnp.asarray(response, dtype),
            means=jnp.asarray(np.stack([one.mean for one in regimes]), dtype),
            read_variance=light.still.detector.variance_without_light,
        )

    def measure(
        self,
        exposure: Exposure,
        usable: Bool[Array, "image v u"],
        mirror_m: Float[Array, "lit_y lit_x"],
        memory: PyramidState | None,
    ) -> tuple[Sight, PyramidState | None]:
        """What an exposure shows; see `LoopSensor`."""
        electrons = exposure.frames.electrons
        total = float(jnp.sum(electrons))
        if not total > 0:
            rest_m = jnp.zeros(self.drive.count, self.response.dtype)
            return Sight(rest_m, Outcome.NO_LIGHT, math.nan, 0, False), memory
        state = memory or self._begin(total)
        noise = 1 / total + electrons.size * self.read_variance / total**2
        uneven = np.asarray(self._uneven(electrons, usable, jnp.asarray(noise, self.response.dtype)), float)
        regime = regime_of(uneven, self.regimes)
        calm = regime >= len(self.regimes) - CALM
        which = regime + CALM if calm and state.steady >= STEADY else regime
        seen = electrons, usable, jnp.asarray(regime)
        residual_m = self._looked(*seen, state.weights, state.inverse[which])
        steady = state.steady + 1 if calm else 0
        sight = Sight(residual_m, Outcome.CONVERGED, state.predicted_m[which], 0, steady >= STEADY)
        return sight, state._replace(steady=steady)

    def skip(self, memory: PyramidState | None) -> tuple[None, PyramidState | None]:
        """Nothing is expected; see `LoopSensor`."""
        return None, memory

    def _begin(self, total: float) -> PyramidState:
        """The estimators of all regimes, at the first exposure with light, which tells how much of it there is."""
        response = np.asarray(self.response, float)
        open_m2 = self.drive.open_m2[: self.drive.driven]
        settled = [one._replace(prior_m2=open_m2) for one in self.regimes[-CALM:]]
        noise = {"electrons": total, "read_variance": self.read_variance}
        made = [regime_estimator(response, one, moved_m2=None, **noise) for one in self.regimes]
        made += [regime_estimator(response, one, moved_m2=self.drive.moved_m2, **noise) for one in settled]
        dtype = self.response.dtype
        return PyramidState(
            weights=jnp.asarray(np.stack([one.weights for one in made[: len(self.regimes)]]), dtype),
            inverse=jnp.asarray(np.stack([self.drive.commands(one.inverse) for one in made]), dtype),
            predicted_m=tuple(math.sqrt(float(np.sum(one.error_m2))) for one in made),
            steady=0,
        )

    @eqx.filter_jit
    def _uneven(
        self, electrons: Float[Array, "image v u"], usable: Bool[Array, "image v u"], noise: Float[Array, ""]
    ) -> Float[Array, " regime"]:
        """Square of what differs from the mean light of each regime, noise taken off, over that of the mean."""
        signal = jax.vmap(lambda mean: self._signal(electrons, usable, mean))(self.means)
        return (jnp.sum(signal**2, axis=1) - noise) / jnp.sum(self.means**2, axis=1)

    def _signal(
        self, electrons: Float[Array, "image v u"], usable: Bool[Array, "image v u"], mean: Float[Array, " pixel"]
    ) -> Float[Array, " pixel"]:
        """Share of the light on every pixel, less its mean; zero where a pixel or a whole image is dead."""
        mean = mean.reshape(electrons.shape)
        lit = jnp.sum(electrons, (1, 2)) > DARK * jnp.sum(mean, (1, 2)) * jnp.sum(electrons)
        known = usable & lit[:, None, None]
        light, wanted = jnp.where(known, electrons, 0), jnp.where(known, mean, 0)
        part = jnp.sum(wanted)  # of the light that these pixels should get
        return (light / jnp.sum(light) * part - wanted).ravel()

    @eqx.filter_jit
    def _looked(
        self, electrons: Array, usable: Array, regime: Array, weights: Array, inverse: Array
    ) -> Float[Array, " mode"]:
        """Modes of the residual."""
        signal = self._signal(electrons, usable, self.means[regime])
        return inverse @ (self.response.T @ (weights[regime] * signal))

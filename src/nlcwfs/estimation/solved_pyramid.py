"""The non-linear pyramid: the most likely wavefront behind its images, from a wavefront that is nearly right."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nlcwfs.comparison_sensors.pyramid import Pyramid
from nlcwfs.estimation import gauss_newton as gn
from nlcwfs.estimation.followed_air import FollowedAir
from nlcwfs.estimation.reconstructor import SENSOR_LOSS
from nlcwfs.estimation.resolution_level import cropped
from nlcwfs.estimation.sensor_model import PlaneScale
from nlcwfs.estimation.sequence_memory import Memory
from nlcwfs.estimation.tilt import mean_slope, tilt_phase
from nlcwfs.estimation.whitened_phase import Unknown

FIRST = (10,) * 6
"""Conjugate gradients of each step of a first frame, whose phase is open as turbulence is ..."""

NEXT = (3, 3)
"""... and of the frames after it."""


class Solved(eqx.Module):
    """What a frame shows.

    Attributes:
        residual_rad: Phase that the sensor saw, on the model's cells.
        chi2: Of the counts less the model, over the number of pixels that were read.
        memory: What the next frame is to know.
    """

    residual_rad: Float[Array, "Y X"]
    chi2: Float[Array, ""]
    memory: Memory


class SolvedPyramid(eqx.Module):
    r"""The non-linear pyramid: the same estimator as of the curvature sensor, on the four images of the pupil.

    The phase minimises :math:`\sum \mu - n \log \mu + |x|^2 / 2`, see `MaximumAPosteriori`, by Fisher scoring with the
    exact Jacobian of the wave optics. All images have one gain, that of the whole sensor: what goes from image to image
    is signal. Where the curvature sensor captures with its speckles, this one needs a start that is nearly right, such
    as that of a linear reconstructor in a loop that has closed.

    Attributes:
        optics: The prism, on the middle of the model's cells.
        air: How the turbulence goes on from frame to frame.
        light: Light of every cell, over that of a fully lit one.
        dark_share: Share of the mean count that counts as noise everywhere.

    Examples:
        See `simulation.closed_loop.pyramid_solved`, which makes one from the settings of a loop.
    """

    optics: Pyramid
    air: FollowedAir
    light: Float[Array, "Y X"]
    dark_share: float = eqx.field(static=True)

    def start(
        self,
        counts: Float[Array, "image v u"],
        usable: Bool[Array, "image v u"],
        guess_rad: Float[Array, "Y X"],
        *,
        known_rad: Float[Array, "Y X"],
        read_variance: float = 0.0,
    ) -> Solved:
        """The wavefront of a first frame.

        Args:
            counts: Photo-electrons, background subtracted.
            usable: False for pixels to ignore.
            guess_rad: The residual, nearly.
            known_rad: What is added to the air: minus the shape of a mirror.
            read_variance: Variance of a pixel without light, electrons squared.
        """
        grid, dtype = self.air.whole.grid, self.light.dtype
        metres = self.air.whole.wavelength_m / (2 * np.pi)
        # The tilt of the mirror goes to the tilt of the air, which no periodic window can hold.
        slope = -mean_slope(known_rad * metres, self.light, grid).astype(dtype)
        one = jnp.ones((), dtype)
        unseen = self.air.unseen(one, slope, PlaneScale(one, 0 * one))
        total_rad = tilt_phase(slope, grid, self.air.whole.wavelength_m) + known_rad
        problem = self._problem(counts, usable, total_rad, unseen, guess_rad, read_variance)
        unknown = self.air.prior(unseen).start(guess_rad - total_rad, noise_variance=1 / problem.information)
        state = gn.init(problem, unknown)
        for inner in FIRST:
            state = gn.step(problem, inner, state)
        return self._solved(problem, unseen, state.unknown)

    def follow(
        self,
        counts: Float[Array, "image v u"],
        usable: Bool[Array, "image v u"],
        memory: Memory,
        *,
        known_rad: Float[Array, "Y X"],
        read_variance: float = 0.0,
    ) -> Solved:
        """The wavefront of the next frame; arguments as for `start`."""
        expected = self.air.expected(memory)
        total_rad = (
            tilt_phase(memory.slope, self.air.whole.grid, self.air.whole.wavelength_m) + expected.phase_rad + known_rad
        )
        problem = self._problem(counts, usable, total_rad, expected, total_rad, read_variance)
        unknown = self.air.prior(expected).nothing()
        for inner in NEXT:
            direction, _ = gn.direction_of_step(problem, inner, unknown)
            unknown = gn.plus(unknown, direction, 1.0)
        return self._solved(problem, expected, unknown)

    def images(self, phase_rad: Float[Array, "Y X"]) -> Float[Array, "image v u"]:
        """Light of unit power at the pupil, on the pixels."""
        inner = self.optics.amplitude.shape
        opd_m = cropped(phase_rad, (inner[0], inner[1])) * (self.air.whole.wavelength_m / (2 * np.pi))
        return self.optics.images(opd_m, 1.0).photons

    def _problem(
        self,
        counts: Array,
        usable: Array,
        known_rad: Float[Array, "Y X"],
        expected: Memory,
        nearly_rad: Float[Array, "Y X"],
        read_variance: float,
    ) -> gn.Problem:
        """Counts, and what is expected of the phase behind them; the gain is that of a phase that is nearly right."""
        known = usable.astype(counts.dtype)
        total = jnp.maximum(jnp.sum(known * counts), 1)
        light = self.images(nearly_rad)
        gain = total / jnp.sum(known * light)
        dark = self.dark_share * total / jnp.sum(known) + read_variance
        return gn.Problem(
            expected=lambda phase_rad: gain * self.images(phase_rad),
            counts=jnp.where(usable, counts, 0),
            usable=usable,
            dark=jnp.full((1, 1, 1), dark, counts.dtype),
            known_rad=known_rad,
            prior=self.air.prior(expected),
            information=4 * total / (SENSOR_LOSS * jnp.sum(self.light)),
            shown=Unknown(jnp.ones((), counts.dtype), jnp.ones(2, counts.dtype)),
        )

    def _solved(self, problem: gn.Problem, expected: Memory, unknown: Unknown) -> Solved:
        residual_rad = problem.known_rad + problem.prior.phase_rad(unknown)
        model = problem.expected(residual_rad)
        missed = jnp.where(problem.usable, (problem.counts - model) ** 2 / (model + problem.dark), 0)
        chi2 = jnp.sum(missed) / jnp.sum(problem.usable.astype(missed.dtype))
        return Solved(residual_rad, chi2, self.air.seen(expected, problem, unknown, jnp.sum(self.light)))

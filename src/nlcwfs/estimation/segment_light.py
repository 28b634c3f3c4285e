r"""How the images change with the pistons of segments, all else held: light of two segments interferes in every color.

The light of segment s arrives in color c as :math:`E_{sc}`. Its piston of t wavelengths of sensing turns that by
:math:`2 \pi t_s \lambda / \lambda_c`, so the images are the sum over pairs and colors of

.. math:: 2 \Re \sum_c E_{sc} E^*_{s'c} \exp[2 \pi i (t_s - t_{s'}) \lambda / \lambda_c]

and of what no piston changes. The maps of these products are computed once; their weighted products with one another
and with the counts then tell the misfit of any pistons without another image.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from nlcwfs.beam.field import pupil_field
from nlcwfs.curvature_sensor.defocused_images import CurvatureSensor
from nlcwfs.estimation.map_solution import Solution, Task
from nlcwfs.estimation.resolution_level import Level
from nlcwfs.estimation.segment_steps import SegmentSteps

FITS = 4
"""Steps of Gauss and Newton to the nearest fringe: at most a quarter of a turn each."""

UNSEEN = 1e-5
"""Part of the mean curvature that holds pistons of segments that no light tells, for single precision."""


class SegmentLight(eqx.Module):
    """Misfit of the counts, in nats, as a function of the pistons of the segments, near a wavefront that is known.

    Attributes:
        pull: Product of each map with the counts that the known wavefront leaves, over their variance.
        gram: Products of the maps with each other, over the variance of the counts.
        ratios: Wavelength of sensing over that of each color.
        here: Pistons of the known wavefront beside the air, in wavelengths of sensing.
        rms: Expected piston, in the same.
        pairs: Segments of each product.
    """

    pull: Float[Array, " map"]
    gram: Float[Array, "map map"]
    ratios: Float[Array, " colour"]
    here: Float[Array, " segment"]
    rms: Float[Array, ""]
    pairs: tuple[tuple[int, int], ...] = eqx.field(static=True)

    @classmethod
    def build(cls, task: Task, steps: SegmentSteps, known: Solution) -> "SegmentLight":
        """Let every segment shine alone, and multiply the light of pairs.

        Args:
            task: The exposure.
            steps: The segments.
            known: The wavefront around which they move.

        Raises:
            ValueError: If the model has one color.
        """
        problem, colours = task.problem, task.level.colours
        if colours is None:
            raise ValueError("task.level.colours: must be there, got None")
        phase_rad = problem.known_rad + problem.prior.phase_rad(known.unknown)
        maps = task.scale.counts[None, None, None] * interference(task.level, steps, phase_rad)
        counts = jnp.maximum(problem.counts, 0)
        weight = problem.usable.astype(counts.dtype) / ((known.model + counts) / 2 + problem.dark)
        left = (weight * (problem.counts - known.model)).ravel()
        flat = maps.reshape(-1, left.size)
        wavelengths_m = jnp.asarray(colours.spectrum.wavelengths_m, left.dtype)
        rms = steps.rms_rad[0] / (2 * jnp.pi)
        return cls(
            pull=flat @ left,
            gram=(flat * weight.ravel()[None]) @ flat.T,
            ratios=task.level.optics.spectrum.wavelengths_m[0] / wavelengths_m,
            here=known.unknown.slope[2 : 2 + steps.count] * rms,
            rms=rms,
            pairs=steps.pairs,
        )

    def cost(self, turns: Float[Array, " segment"]) -> Float[Array, ""]:
        """By how many nats these pistons, added to the known ones, are less likely than nothing added."""
        change = self._factors(turns) - self._factors(jnp.zeros_like(turns))
        prior = jnp.sum((self.here + turns) ** 2 - self.here**2) / (2 * self.rms**2)
        return change @ self.gram @ change / 2 - self.pull @ change + prior

    def fitted(self, turns: Float[Array, " segment"]) -> tuple[Float[Array, " segment"], Float[Array, ""]]:
        """The nearest pistons that are most likely, and their cost."""
        none = self._factors(jnp.zeros_like(turns))

        def closer(_: Int[Array, ""], carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            now, best, least = carry
            slopes = jax.jacfwd(self._factors)(now)
            seen = self.gram @ slopes
            uphill = seen.T @ (self._factors(now) - none) - self.pull @ slopes + (self.here + now) / self.rms**2
            curvature = slopes.T @ seen + jnp.eye(len(now), dtype=now.dtype) / self.rms**2
            # No light tells a piston of all: it stays, or it were lost in the rounding of bright light.
            curvature = curvature + jnp.trace(curvature) / len(now) * (1 + UNSEEN * jnp.eye(len(now), dtype=now.dtype))
            now = now - jnp.clip(jnp.linalg.solve(curvature, uphill), -0.25, 0.25)
            cost = self.cost(now)
            return now, jnp.where(cost < least, now, best), jnp.minimum(cost, least)

        start = (turns, turns, self.cost(turns))
        _, best, least = jax.lax.fori_loop(0, FITS, closer, start)
        return best, least

    def _factors(self, turns: Float[Array, " segment"]) -> Float[Array, " map"]:
        first, second = np.array(self.pairs).T
        angle = 2 * jnp.pi * (turns[first] - turns[second])[None] * self.ratios[:, None]
        return jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=2).ravel()


def interference(
    level: Level, steps: SegmentSteps, phase_rad: Float[Array, "y x"]
) -> Float[Array, "colour pair 2 plane v u"]:
    r"""What the light of two segments makes together, on the measured pixels of every plane.

    Of every color and pair :math:`2 \Re E_s E^*_{s'}` and :math:`-2 \Im E_s E^*_{s'}`, which go with the cosine and
    the sine of the angle by which s is turned against s'. Light of unit power at the pupil, as `light_on_pixels`.

    Args:
        level: The sensor in many colors.
        steps: The segments.
        phase_rad: Of the wavelength of sensing.
    """
    sensor, planes, kind = level.colours, level.optics.transfer.shape[1], level.optics.transfer.dtype
    if sensor is None:
        raise ValueError("level.colours: must be there, got None")
    opd_m = phase_rad * (level.optics.spectrum.wavelengths_m[0] / (2 * np.pi)) + sensor.static_opd_m
    alone = steps.labels.reshape(1, *steps.shape) == jnp.arange(steps.count)[:, None, None]
    first, second = np.array(steps.pairs).T
    own_transfer = sensor.transfer if len(sensor.transfer) > 1 else None
    own_smear = sensor.visibility if sensor.visibility is not None and len(sensor.visibility) > 1 else None

    def of_colour(one: tuple[Array, Array, Array | None, Array | None]) -> Array:
        wavelength_m, share, transfer, smear = one
        near = pupil_field(sensor.pupil, opd_m, wavelength_m=wavelength_m, photons=share)[None] * alone.astype(kind)
        transfer = sensor.transfer[0] if transfer is None else transfer
        smear = sensor.visibility[0] if smear is None and sensor.visibility is not None else smear
        far = jax.lax.map(lambda field: jnp.fft.ifft2(jnp.fft.fft2(field)[None] * transfer), near)

        def of_pair(pair: tuple[Array, Array]) -> Array:
            product = far[pair[0]] * jnp.conj(far[pair[1]])
            parts = (2 * product.real, -2 * product.imag)
            return jnp.stack([level.on_pixels(planes * _seen(sensor, part, smear)) for part in parts])

        return jax.lax.map(of_pair, (jnp.asarray(first), jnp.asarray(second)))

    spectrum = sensor.spectrum
    colours = (jnp.asarray(one, opd_m.dtype) for one in (spectrum.wavelengths_m, spectrum.shares))
    return jax.lax.map(of_colour, (*colours, own_transfer, own_smear))


def _seen(sensor: CurvatureSensor, light: Float[Array, "plane y x"], smear: Array | None) -> Float[Array, "plane y x"]:
    """Shared among the planes, and smeared by the size of the star."""
    light = sensor.flux_fractions[:, None, None] * light
    if smear is None:
        return light
    waves = jnp.fft.rfft2(light) * smear.astype(sensor.transfer.dtype)
    return jnp.fft.irfft2(waves, s=light.shape[1:]).astype(light.dtype)

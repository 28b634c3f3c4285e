"""Unwrapping a noisy phase: the turbulence that best explains its wrapped differences."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nlcwfs.estimation.angle import wrap
from nlcwfs.estimation.gauss_newton import conjugate_gradients, plus
from nlcwfs.estimation.whitened_phase import Unknown, WhitenedPhase

NOISE = 1.0
"""Variance of a wrapped difference of neighbouring cells, rad^2: photon noise and the turbulence between them."""

OUTLIER_RAD = 1.0
"""Differences that miss by more than this count less and less: they are whole turns that wrapping took away."""


def unwrapped(
    phase_rad: Float[Array, "y x"], lit: Bool[Array, "y x"], prior: WhitenedPhase, *, rounds: int = 3, inner: int = 8
) -> Float[Array, "y x"]:
    r"""The phase with whole turns added, so that it looks like turbulence.

    Least squares of the wrapped differences, :math:`\sum v\, (\nabla\phi - W(\nabla\psi))^2 + |x|^2`, x the phase in
    units of its prior; again and again with differences that do not fit weighing less (:math:`v = 1/(1 + r^2)`),
    because least squares alone spreads every missed turn over the whole pupil (Ghiglia & Romero 1996, JOSA A 13, 1999).
    What is then left of the measured phase, wrapped, is added inside the pupil.

    Args:
        phase_rad: Phase, known up to whole turns.
        lit: Where it is known.
        prior: What is expected of the phase.
        rounds: Solutions, each with new weights.
        inner: Conjugate gradients of each.

    Examples:
        A ramp of 1 rad a pixel, wrapped, comes back.

        >>> import jax.numpy as jnp
        >>> from nlcwfs.beam.grid import Grid
        >>> prior = WhitenedPhase.build(Grid((16, 16), 1.0), 100 * jnp.ones((16, 9)), tilt_rms_rad=9.0, diameter_m=16.0)
        >>> ramp = jnp.broadcast_to(jnp.arange(16.0), (16, 16))
        >>> lit = jnp.zeros((16, 16), bool).at[2:14, 2:14].set(True)
        >>> found = unwrapped(wrap(ramp), lit, prior)
        >>> bool(jnp.std((found - ramp)[lit]) < 0.01)
        True
    """
    known = lit.astype(phase_rad.dtype)
    pairs = [known * jnp.roll(known, -1, axis) for axis in (0, 1)]
    wanted = [pair * wrap(_difference(phase_rad, axis)) for axis, pair in enumerate(pairs)]
    weights = [pair / NOISE for pair in pairs]
    unknown = prior.nothing()
    for _ in range(rounds):
        unknown = _fitted(prior, unknown, wanted, weights, inner)
        smooth = prior.phase_rad(unknown)
        missed = [_difference(smooth, axis) - goal for axis, goal in enumerate(wanted)]
        weights = [pair / (NOISE * (1 + (miss / OUTLIER_RAD) ** 2)) for pair, miss in zip(pairs, missed, strict=True)]
    rest = phase_rad - smooth
    if prior.steps is not None:  # differences tell nothing of a step across a gap
        offset = prior.steps.mean_turns(rest)
        return smooth + offset + known * wrap(rest - offset)
    offset = jnp.arctan2(jnp.sum(known * jnp.sin(rest)), jnp.sum(known * jnp.cos(rest)))
    return smooth + known * wrap(rest - offset)


def unwrapping_ffts(*, rounds: int = 3, inner: int = 8) -> int:
    """FFTs of `unwrapped`; two real ones count as one.

    Examples:
        >>> unwrapping_ffts()
        30
    """
    return rounds * (inner + 2)


def _fitted(
    prior: WhitenedPhase,
    unknown: Unknown,
    wanted: list[Float[Array, "y x"]],
    weights: list[Float[Array, "y x"]],
    inner: int,
) -> Unknown:
    """Weighted least squares of differences, from a first guess."""

    def pulled(differences: list[Float[Array, "y x"]]) -> Unknown:
        total = sum(
            _difference_transposed(w * d, axis) for axis, (w, d) in enumerate(zip(weights, differences, strict=True))
        )
        return prior.transposed(jnp.asarray(total))

    def curvature(v: Unknown) -> Unknown:
        phase_rad = prior.phase_rad(v)
        bent = pulled([_difference(phase_rad, axis) for axis in (0, 1)])
        return plus(bent, v, 1.0)

    gradient = plus(pulled(wanted), curvature(unknown), -1.0)
    step = conjugate_gradients(curvature, gradient, _preconditioner(prior), prior, inner)
    return plus(unknown, step, 1.0)


def _preconditioner(prior: WhitenedPhase) -> Unknown:
    """Inverse curvature as if differences were known in the whole window."""
    rows, columns = prior.tilt.shape[1:]
    turn_y = 2 * np.pi * np.fft.fftfreq(rows)[:, None]
    turn_x = 2 * np.pi * np.fft.rfftfreq(columns)[None]
    steps = (4 - 2 * np.cos(turn_y) - 2 * np.cos(turn_x)) / NOISE
    slopes = jnp.stack([jnp.sum(_difference(prior.tilt[axis], axis)[:-1, :-1] ** 2) for axis in (0, 1)])
    waves = 1 / (1 + prior.amplitude**2 * jnp.asarray(steps, prior.amplitude.dtype))
    slope = 1 / (1 + slopes / (8 * NOISE))
    if prior.steps is not None:
        slope = jnp.concatenate([slope, jnp.ones(3 * prior.steps.count, slope.dtype)])
    return Unknown(waves, slope)


def _difference(phase_rad: Float[Array, "y x"], axis: int) -> Float[Array, "y x"]:
    """Next pixel minus this one; around the end."""
    return jnp.roll(phase_rad, -1, axis) - phase_rad


def _difference_transposed(array: Float[Array, "y x"], axis: int) -> Float[Array, "y x"]:
    return jnp.roll(array, 1, axis) - array

"""Gerchberg-Saxton over the defocused planes, the phase carried from one iteration to the next."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float, Int

from nlcwfs.beam.grid import Grid
from nlcwfs.estimation.amplitude_constraint import doubt_factor, mean_count, modulus_factor
from nlcwfs.estimation.angle import angle, phasor, wrap
from nlcwfs.estimation.resolution_level import Level, Measurement
from nlcwfs.estimation.settings import GerchbergSaxtonSettings
from nlcwfs.estimation.speckle_blur import SPEED, blurred
from nlcwfs.estimation.turbulence_filter import smoothed_phase, wiener_filter

LARGEST_BEYOND = 3.0
"""Unmodelled variance (rad^2) beyond which steps grow no further."""


class GerchbergSaxtonState(eqx.Module):
    """What an iteration hands to the next.

    Attributes:
        phase_rad: The phase on the model's grid, without the reference.
        previous_rad: The phase one iteration earlier, for fast-forward.
        change_rad: Rms over the pupil by which the last iteration moved the phase.
        iteration: Number of iterations so far.
    """

    phase_rad: Float[Array, "y x"]
    previous_rad: Float[Array, "y x"]
    change_rad: Float[Array, ""]
    iteration: Int[Array, ""]


class PlaneGroup(NamedTuple):
    """Planes that are taken together, and what was measured on them.

    Attributes:
        transfer: Fresnel factor from the pupil.
        share: Weight of each plane in the mean of the returning light, sum 1.
        counts: Photo-electrons; 0 where not usable.
        expected: The counts smoothed, see `Measurement`.
        usable: Which pixels were measured.
        total: Sum of the counts.
        mean: Mean count of the usable pixels.
        blur: Fourier factor of the model's images, for the turbulence that is not modelled yet; None for none.
    """

    transfer: Complex[Array, "p y x"]
    share: Float[Array, " p"]
    counts: Float[Array, "p v u"]
    expected: Float[Array, "p v u"]
    usable: Bool[Array, "p v u"]
    total: Float[Array, "p 1 1"]
    mean: Float[Array, "p 1 1"]
    blur: Float[Array, "p v fu"] | None


class Problem(NamedTuple):
    """One measurement at one resolution.

    Attributes:
        level: The sensor.
        groups: All planes at once, or one after the other.
        read_variance: Variance of a pixel without light, electrons squared.
        reference_rad: Phase that is added and never smoothed: starting tilt and static aberration.
        kept: Share of each wave that the filter keeps, see `turbulence_filter`.
        gain: Length of a step.
        low_pass: Factor on the spectrum of the returning light; None without that filter.
    """

    level: Level
    groups: list[PlaneGroup]
    read_variance: Float[Array, ""]
    reference_rad: Float[Array, "y x"]
    kept: Float[Array, "y fx"]
    gain: Float[Array, ""]
    low_pass: Float[Array, "y x"] | None


def init(phase_rad: Float[Array, "y x"]) -> GerchbergSaxtonState:
    """The state before the first iteration."""
    far = jnp.asarray(jnp.inf, phase_rad.dtype)
    return GerchbergSaxtonState(phase_rad, phase_rad, far, jnp.asarray(0, jnp.int32))


def step(problem: Problem, settings: GerchbergSaxtonSettings, state: GerchbergSaxtonState) -> GerchbergSaxtonState:
    """One Gerchberg-Saxton iteration over all planes.

    Fast-forward: the iteration starts ahead of the phase, along its last step. Then, for all planes at once
    (`averaged`) or one after the other (`serial`): light to the plane, modulus towards the measured one, light
    back; the pupil's modulus is put back by keeping the phase only.
    """
    level = problem.level
    phase_rad = state.phase_rad + level.fast_forward * (state.phase_rad - state.previous_rad)
    for group in problem.groups:
        phase_rad = _through_planes(problem, settings, phase_rad, group)
    moved = phase_rad - state.phase_rad
    # Piston does not count. Both sums share one pass over the pixels.
    mean, square = jnp.sum(level.weight * moved), jnp.sum(level.weight * moved**2)
    change_rad = jnp.sqrt(jnp.maximum(square - mean**2, 0))
    return GerchbergSaxtonState(phase_rad, state.phase_rad, change_rad, state.iteration + 1)


def terminate(problem: Problem, state: GerchbergSaxtonState) -> Array:
    """Whether the level is done: its iterations are used up, the phase rests, or left the finite numbers."""
    level = problem.level
    rests = state.change_rad < level.tolerance_rad
    lost = (state.iteration > 0) & ~jnp.isfinite(state.change_rad)
    return (state.iteration >= level.iterations) | rests | lost


def pupil_light(level: Level, phase_rad: Float[Array, "y x"]) -> Complex[Array, "y x"]:
    """Light of unit power at the pupil with this phase."""
    light = phasor(phase_rad)
    return level.modulus.astype(light.dtype) * light


def plane_groups(
    level: Level,
    measurement: Measurement,
    settings: GerchbergSaxtonSettings,
    *,
    blur: Float[Array, "plane v fu"] | None = None,
) -> list[PlaneGroup]:
    """The planes as the scheme takes them: `averaged` all at once, `serial` one by one."""
    counts = jnp.where(measurement.usable, measurement.counts, 0)
    planes = counts.shape[0]
    at_once = planes if settings.scheme == "averaged" else 1
    groups = []
    for first in range(0, planes, at_once):
        part = slice(first, first + at_once)
        share = level.optics.flux_fractions[part]
        groups.append(
            PlaneGroup(
                transfer=level.optics.transfer[0, part],
                share=share / jnp.sum(share),
                counts=counts[part],
                expected=(counts if measurement.expected is None else measurement.expected)[part],
                usable=measurement.usable[part],
                total=jnp.sum(counts[part], axis=(1, 2), keepdims=True),
                mean=mean_count(counts[part], measurement.usable[part]),
                blur=None if blur is None else blur[part],
            )
        )
    return groups


def problem_at(
    level: Level,
    measured: Measurement,
    settings: GerchbergSaxtonSettings,
    reference_rad: Float[Array, "y x"],
    cutoff: Int[Array, ""],
    strength: Float[Array, ""],
    low_pass: Float[Array, "y x"] | None,
) -> Problem:
    """What one cutoff of a level has to solve, for turbulence of this strength."""
    # Blurred images answer the phase more weakly, by the coherence that is left: steps grow by its inverse.
    gain = level.gain * jnp.exp(jnp.minimum(strength * level.beyond[cutoff], LARGEST_BEYOND))
    blur = None
    if level.structures is not None:
        blur = level.smoothing[None] * jnp.exp(-0.5 * SPEED * strength * level.structures[cutoff])
    return Problem(
        level=level,
        groups=plane_groups(level, measured, settings, blur=blur),
        read_variance=measured.read_variance,
        reference_rad=reference_rad,
        kept=wiener_filter(level.power[cutoff] * strength, gain * phase_noise(level, measured)),
        gain=gain,
        low_pass=low_pass,
    )


def modelled_counts(level: Level, group: PlaneGroup, far: Complex[Array, "p y x"]) -> Float[Array, "p v u"]:
    """The model's light on the measured pixels, in the photo-electrons of each plane."""
    seen = level.on_pixels(far.real**2 + far.imag**2)
    share = jnp.sum(jnp.where(group.usable, seen, 0), axis=(1, 2), keepdims=True)
    return seen * (group.total / jnp.maximum(share, jnp.finfo(seen.dtype).tiny))


def _through_planes(
    problem: Problem, settings: GerchbergSaxtonSettings, phase_rad: Float[Array, "y x"], group: PlaneGroup
) -> Float[Array, "y x"]:
    """To some planes and back: the phase after the measured moduli have been imposed there."""
    level = problem.level
    whole_rad = phase_rad + problem.reference_rad
    near = pupil_light(level, whole_rad)
    far = jnp.fft.ifft2(jnp.fft.fft2(near)[None] * group.transfer)
    factor = level.on_cells(_factor_on_pixels(problem, settings, far, group))
    weighted = jnp.conj(group.transfer) * group.share[:, None, None].astype(far.dtype)
    spectrum = jnp.sum(jnp.fft.fft2(far * factor.astype(far.dtype)) * weighted, axis=0)
    if problem.low_pass is not None:
        spectrum = spectrum * problem.low_pass.astype(far.dtype)
    # Not the angle of a product with `near`: the compiler would compute its sines and cosines twice.
    turned_rad = wrap(angle(jnp.fft.ifft2(spectrum)) - whole_rad)
    phase_rad = phase_rad + problem.gain * level.light * turned_rad
    if settings.filter != "turbulence":
        return phase_rad
    return smoothed_phase(phase_rad, problem.kept)


def _factor_on_pixels(
    problem: Problem, settings: GerchbergSaxtonSettings, far: Complex[Array, "p y x"], group: PlaneGroup
) -> Float[Array, "p v u"]:
    """By how much to multiply the light on the measured pixels."""
    model = modelled_counts(problem.level, group, far)
    if group.blur is not None:
        model = blurred(model, group.blur)
    factor = modulus_factor(
        group.counts,
        model,
        group.usable,
        method=settings.amplitude,
        read_variance=problem.read_variance,
        doubt=problem.level.doubt,
        mean=group.mean,
        expected=group.expected,
    )
    if group.blur is None:
        return factor
    return 1 + blurred(factor - 1, group.blur)


def phase_noise(level: Level, measurement: Measurement) -> Float[Array, ""]:
    """Variance of the phase that photon noise allows in a fully lit pixel: 1 / (4 photons), rad^2."""
    total = jnp.sum(jnp.where(measurement.usable, measurement.counts, 0))
    photons = jnp.maximum(total, 1) / jnp.sum(level.light)
    mean = jnp.mean(mean_count(measurement.counts, measurement.usable), keepdims=True)
    return jnp.squeeze(doubt_factor(mean, level.doubt)) / (4 * photons)


def ffts_per_iteration(planes: int, settings: GerchbergSaxtonSettings, *, blurs: bool) -> int:
    """Two-dimensional complex FFTs of one iteration; two real ones (filter, blur) count as one.

    Examples:
        >>> ffts_per_iteration(4, GerchbergSaxtonSettings(filter="none"), blurs=False)
        10
    """
    filtering = 1 if settings.filter == "turbulence" else 0
    blurring = 2 * planes if blurs else 0
    if settings.scheme == "averaged":
        return 2 * planes + 2 + filtering + blurring
    return planes * (4 + filtering) + blurring


def low_pass_factor(grid: Grid, *, cutoff_per_m: float, centre_per_m: Float[Array, "2"]) -> Float[Array, "y x"]:
    """The paper's filtering inside the loop, as a smooth cut of the returning light, `exp(-(f / cutoff)^4)`.

    Args:
        grid: Cells of the model.
        cutoff_per_m: Where the light falls to 1/e.
        centre_per_m: Frequency (y, x) of the beam's tilt: slope / wavelength.
    """
    y_per_m = jnp.asarray(grid.fy_per_m, centre_per_m.dtype) - centre_per_m[0]
    x_per_m = jnp.asarray(grid.fx_per_m, centre_per_m.dtype) - centre_per_m[1]
    return jnp.exp(-(((y_per_m**2 + x_per_m**2) / cutoff_per_m**2) ** 2))

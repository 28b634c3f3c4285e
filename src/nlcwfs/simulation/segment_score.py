"""How far an estimate is from the truth on a pupil made of segments: steps apart from what is inside."""

import math
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from nlcwfs.curvature_sensor.defocused_images import centred_in
from nlcwfs.detector.pixels import integrate_on_pixels
from nlcwfs.simulation.exposure import ExposureSimulator

QUARTER = 0.25
"""Least light of a pixel that counts, over that of a full one."""


@dataclass(frozen=True)
class SegmentScore:
    """Errors of one estimate, all rms over the light; piston of the whole pupil never counts.

    Attributes:
        piston_m: Of the piston of the segments, whole turns included: what a mirror gets.
        piston_modulo_m: The same modulo the wavelength: what one colour can tell.
        inside_m: Inside the segments: the piston of each removed, its tip and tilt not.
        straightened_m: The same with the tip and tilt of each removed, too.
        turns: Whole wavelengths that the piston of each segment is off, against the first.
    """

    piston_m: float
    piston_modulo_m: float
    inside_m: float
    straightened_m: float
    turns: tuple[int, ...]


def segment_score(
    error_m: Float[np.ndarray, "y x"],
    weights: Float[np.ndarray, "y x"],
    labels: Int[np.ndarray, "y x"],
    *,
    wavelength_m: float,
) -> SegmentScore:
    """Part the error of a wavefront into steps between segments and errors inside them.

    Nothing is unwrapped: a pixel that is a turn off inside a segment counts as that.

    Args:
        error_m: Estimate minus truth.
        weights: Share of the light; pixels without light, or with an error that is not finite, do not count.
        labels: Segment of each pixel.
        wavelength_m: Of the sensor.

    Examples:
        Two segments, the second a wavelength and 10 nm too high, with a ripple of 3 nm in both.

        >>> ripple_m = 3e-9 * np.array([[1.0, -1.0, 1.0, -1.0, 1.0, -1.0]])
        >>> labels = np.array([[0, 0, 0, 1, 1, 1]])
        >>> weights = np.array([[1.0, 1.0, 0.0, 0.0, 1.0, 1.0]])
        >>> score = segment_score(ripple_m + 660e-9 * labels, weights, labels, wavelength_m=650e-9)
        >>> [round(1e9 * one, 3) for one in (score.piston_m, score.piston_modulo_m, score.inside_m)], score.turns
        ([330.0, 5.0, 3.0], (0, 1))
    """
    known = np.isfinite(error_m) & (weights > 0)
    if not known.any():
        return SegmentScore(math.nan, math.nan, math.nan, math.nan, ())
    error_m, share, labels = error_m[known], weights[known] / weights[known].sum(), labels[known]
    names, labels = np.unique(labels, return_inverse=True)
    light = np.bincount(labels, share)
    pistons_m = np.bincount(labels, share * error_m) / light
    rows, columns = np.nonzero(known)
    inside_m2, straightened_m2 = np.zeros(len(names)), np.zeros(len(names))
    for number in range(len(names)):
        own = labels == number
        rest_m, part = error_m[own] - pistons_m[number], share[own]
        root = np.sqrt(part)
        ramps = np.stack([np.ones(own.sum()), rows[own], columns[own]], axis=1)
        straight_m = ramps @ np.linalg.lstsq(ramps * root[:, None], rest_m * root, rcond=None)[0]
        inside_m2[number] = np.sum(part * rest_m**2)
        straightened_m2[number] = np.sum(part * (rest_m - straight_m) ** 2)
    phasor = np.exp(2j * np.pi * pistons_m / wavelength_m)
    mean = np.angle(np.sum(light * phasor))
    modulo_m = np.angle(phasor * np.exp(-1j * mean)) * wavelength_m / (2 * np.pi)
    modulo_m -= np.sum(light * modulo_m)
    turns = np.round((pistons_m - pistons_m[0] - modulo_m + modulo_m[0]) / wavelength_m)
    return SegmentScore(
        piston_m=float(np.sqrt(np.sum(light * (pistons_m - np.sum(light * pistons_m)) ** 2))),
        piston_modulo_m=float(np.sqrt(np.sum(light * modulo_m**2))),
        inside_m=float(np.sqrt(inside_m2.sum())),
        straightened_m=float(np.sqrt(straightened_m2.sum())),
        turns=tuple(int(turn) for turn in turns),
    )


def segment_pixels(simulator: ExposureSimulator) -> tuple[Int[np.ndarray, "y x"], Float[np.ndarray, "y x"]] | None:
    """Segment of every detector pixel, and its light where one segment has it alone; None for a pupil of one piece.

    A pixel that two segments share has a mean wavefront that is of neither; it gets no weight, and neither does one
    that is less than a quarter lit.

    Examples:
        >>> from nlcwfs.config import load_config
        >>> small = ["beam.segments.layout=sparse", "detector.pixels_across_pupil=16", "detector.window_pixels=16"]
        >>> labels, weights = segment_pixels(ExposureSimulator.build(load_config(None, small)))
        >>> labels[8, [2, 13]].tolist(), (weights[8, [2, 8, 13]] > 0).tolist()
        ([2, 0], [True, False, True])
    """
    fine, coarse = simulator.shape.labels(simulator.light), simulator.shape.labels(simulator.frame)
    if fine is None or coarse is None:
        return None
    weights, factor = np.asarray(simulator.weights, float), simulator.factor
    own = centred_in(np.kron(coarse, np.ones((factor, factor))), simulator.light.shape)
    both = jnp.asarray(np.stack([weights, weights * (own != fine)]))
    light, foreign = np.asarray(integrate_on_pixels(both, factor=factor, window=simulator.window), float)
    alone = (foreign <= 0) & (light > QUARTER * light.max())
    return coarse, np.where(alone, light, 0)

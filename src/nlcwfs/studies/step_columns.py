"""What the rows of a study tell of the steps between segments, and of what is inside them."""

import math
from collections.abc import Sequence

import numpy as np
from astropy.stats import binom_conf_interval
from jaxtyping import Bool, Float, Int

from nlcwfs.simulation.segment_score import SegmentScore, segment_score
from nlcwfs.studies.study_table import Row

Pixels = tuple[Int[np.ndarray, "y x"], Float[np.ndarray, "y x"]]
"""Segment of every pixel, and its light."""


def step_errors(
    error_m: Float[np.ndarray, "y x"], segments: Pixels | None, *, wavelength_m: float
) -> SegmentScore | None:
    """The score of one screen; None for a pupil of one piece.

    Examples:
        >>> step_errors(np.zeros((1, 2)), None, wavelength_m=650e-9) is None
        True
    """
    if segments is None:
        return None
    labels, weights = segments
    return segment_score(error_m, weights, labels, wavelength_m=wavelength_m)


def steps_captured(scores: list[SegmentScore | None], captured_nm: float) -> Bool[np.ndarray, " screen"]:
    """Which screens have their steps right modulo the wavelength.

    Examples:
        >>> steps_captured([SegmentScore(1e-6, 2e-9, 3e-9, 3e-9, (0, 1)), None], captured_nm=5.0).tolist()
        [True, False]
    """
    return np.array([score is not None and 1e9 * score.piston_modulo_m < captured_nm for score in scores])


def step_columns(scores: list[SegmentScore | None], captured_nm: float) -> Row:
    """Median and worst over the screens; nothing for a pupil of one piece.

    Examples:
        >>> step_columns([None], captured_nm=5.0)
        {}
        >>> row = step_columns([SegmentScore(1e-6, 2e-9, 4e-9, 3e-9, (0, 1))], captured_nm=5.0)
        >>> row["piston_modulo_nm"], row["inside_nm"], row["captured_steps"], row["right_turns"]
        (2.0, 4.0, 1.0, 0.0)
    """
    known = [score for score in scores if score is not None]
    if not known:
        return {}
    row: Row = {"captured_steps": float(steps_captured(scores, captured_nm).mean())}
    for name in ("piston_modulo", "inside", "straightened"):
        values_nm = np.nan_to_num([1e9 * getattr(score, f"{name}_m") for score in known], nan=1e6)
        row |= {f"{name}_nm": round(float(np.median(values_nm)), 2)}
        row |= {f"{name}_worst_nm": round(float(np.max(values_nm)), 2)}
    return row | {"right_turns": float(np.mean([not any(score.turns) for score in known]))}


def turn_columns(scores: Sequence[SegmentScore | None], told_wrong: Sequence[float]) -> Row:
    """How often whole wavelengths are right, and how often the estimates themselves expect them to be wrong.

    Args:
        scores: Of the screens.
        told_wrong: Probability that each estimate tells for a segment that is whole wavelengths off; NaN for none.

    Returns:
        The share of the screens that are right with Wilson's interval of 95 %, and the mean of what was told; of the
        screens that are wrong the least and the median of what they told. Nothing where nothing was told.

    Examples:
        >>> right, wrong = (SegmentScore(0.0, 0.0, 0.0, 0.0, (0, turn)) for turn in (0, 1))
        >>> row = turn_columns([right, right, right, wrong], [0.0, 0.0, 0.1, 0.9])
        >>> [round(row[name], 3) for name in ("turns_right", "turns_right_low", "turns_right_high", "told_wrong")]
        [0.75, 0.301, 0.954, 0.25]
    """
    known = [(score, told) for score, told in zip(scores, told_wrong, strict=True) if score is not None]
    if not known or any(math.isnan(told) for _, told in known):
        return {}
    told = np.array([one for _, one in known])
    right = np.array([bool(score.turns) and not any(score.turns) for score, _ in known])
    low, high = binom_conf_interval(int(right.sum()), len(right), confidence_level=0.95, interval="wilson")
    of_wrong = told[~right]
    return {
        "turns_right": float(right.mean()),
        "turns_right_low": round(float(low), 4),
        "turns_right_high": round(float(high), 4),
        "told_wrong": float(f"{told.mean():.3g}"),
        "told_of_wrong_least": float(f"{of_wrong.min():.3g}") if len(of_wrong) else math.nan,
        "told_of_wrong_median": float(f"{np.median(of_wrong):.3g}") if len(of_wrong) else math.nan,
        "told_of_right_median": float(f"{np.median(told[right]):.3g}") if right.any() else math.nan,
    }

"""What the rows of a study tell of the steps between segments, and of what is inside them."""

import numpy as np
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

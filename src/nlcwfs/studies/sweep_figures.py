"""The figures that a sweep asks for, drawn from the rows of its table."""

from pathlib import Path

from nlcwfs.errors import FileFormatError
from nlcwfs.studies.study_figures import Drawings

SWEEP_FIGURES: Drawings = {}
"""What `figures = [...]` of a sweep may name; here a drawing and its caption join."""


def check_figures(path: Path, names: tuple[str, ...]) -> None:
    """Refuse a figure that there is not, before anything is computed.

    Args:
        path: The sweep's file, for the message.
        names: Figures that it asks for.

    Raises:
        FileFormatError: If there is no such figure.
    """
    for name in names:
        if name not in SWEEP_FIGURES:
            raise FileFormatError(f"{path}: figures: must be of {sorted(SWEEP_FIGURES)}, got {name}")

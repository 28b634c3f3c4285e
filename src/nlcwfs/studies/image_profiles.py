"""Mean profiles of the stars' images of a sweep's runs, in a table of their own, for no repository keeps the images."""

import io
from collections.abc import Sequence
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.table import Table
from jaxtyping import Float

from nlcwfs.interop import Provenance, atomic_write
from nlcwfs.studies.study_table import Row
from nlcwfs.studies.sweep_run import RUNS

PROFILES = "profiles.ecsv"
"""Beside the sweep's table; a column for each run whose image was kept."""

IMAGE = "psf.fits"


def ring_means(image: Float[np.ndarray, "v u"]) -> Float[np.ndarray, " ring"]:
    """Mean over rings one pixel wide around the axis, the first is the middle itself.

    Examples:
        >>> y, x = np.mgrid[-3:4, -3:4]
        >>> ring_means(np.round(np.hypot(y, x))).tolist()
        [0.0, 1.0, 2.0, 3.0]
    """
    middle = [(size - 1) / 2 for size in image.shape]
    y, x = (np.arange(size) - centre for size, centre in zip(image.shape, middle, strict=True))
    ring = np.round(np.hypot(y[:, None], x[None, :])).astype(int).ravel()
    rings = int(min(middle)) + 1
    light = np.bincount(ring, np.asarray(image, float).ravel())[:rings]
    return light / np.bincount(ring)[:rings]


def keep_profiles(folder: Path, rows: Sequence[Row], stamp: Provenance) -> Table | None:
    """Take the profiles of the images that were kept into the table, which keeps those that it has.

    Args:
        folder: Of the sweep.
        rows: Its points, in their order.
        stamp: Of the table.

    Returns:
        The table, with the angle in arcsec first; None when no image was ever kept.
    """
    path = folder / PROFILES
    known = Table.read(path, format="ascii.ecsv") if path.is_file() else Table()
    found = Table()
    for name in [str(row["point"]) for row in rows]:
        image = folder / RUNS / name / IMAGE
        if image.is_file():
            with fits.open(image) as hdus:
                profile, step = ring_means(np.asarray(hdus[0].data)), float(hdus[0].header["PIXSCALE"])
            _add(found, name, profile, step)
        elif name in known.colnames:
            _add(found, name, np.asarray(known[name]), float(known["angle_arcsec"][1]))
    if not found.colnames:
        return None
    if found.colnames != known.colnames or any(not np.allclose(found[name], known[name]) for name in found.colnames):
        found.meta = {"provenance": stamp.as_dict()}
        text = io.StringIO()
        found.write(text, format="ascii.ecsv")
        with atomic_write(path) as temporary:
            temporary.write_text(text.getvalue(), encoding="utf-8")
    return found


def _add(table: Table, name: str, profile: np.ndarray, step_arcsec: float) -> None:
    """A column; images of another scale than the first do not fit beside it and are left out."""
    angle = np.round(np.arange(len(profile)) * step_arcsec, 6)
    if not table.colnames:
        table["angle_arcsec"] = angle * u.arcsec
    if len(angle) == len(table) and np.allclose(angle, table["angle_arcsec"], rtol=1e-3):
        table[name] = np.array([float(f"{value:.4g}") for value in profile])

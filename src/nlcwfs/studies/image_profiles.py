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

IMAGE, ANGLE = "psf.fits", "angle_arcsec"


class Profiles(dict[str, np.ndarray]):
    """Mean intensity over rings by the name of the run, and the angle of the rings under `ANGLE`."""


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


def keep_profiles(folder: Path, rows: Sequence[Row], stamp: Provenance) -> Profiles:
    """Take the profiles of the images that were kept into the table, which keeps those that it has.

    Args:
        folder: Of the sweep.
        rows: Its points, in their order.
        stamp: Of the table.

    Returns:
        What the table holds; nothing when no image was ever kept.
    """
    known, found = read_profiles(folder), Profiles()
    for name in [str(row["point"]) for row in rows]:
        image = folder / RUNS / name / IMAGE
        if image.is_file():
            with fits.open(image) as hdus:
                hdu = hdus[0]
                profile = ring_means(np.asarray(hdu.data))  # pyright: ignore
                _add(found, name, profile, float(hdu.header["PIXSCALE"]))  # pyright: ignore
        elif name in known:
            _add(found, name, known[name], float(known[ANGLE][1]))
    same = found.keys() == known.keys() and all(np.allclose(found[name], known[name]) for name in found)
    if found and not same:
        columns = {name: values * u.arcsec if name == ANGLE else values for name, values in found.items()}
        text = io.StringIO()
        Table(columns, meta={"provenance": stamp.as_dict()}).write(text, format="ascii.ecsv")
        with atomic_write(folder / PROFILES) as temporary:
            temporary.write_text(text.getvalue(), encoding="utf-8")
    return found


def read_profiles(folder: Path) -> Profiles:
    """What the table of a sweep holds; nothing if there is none.

    Args:
        folder: Of the sweep.
    """
    path = folder / PROFILES
    if not path.is_file():
        return Profiles()
    table = Table.read(path, format="ascii.ecsv")
    return Profiles({name: np.asarray(table[name], float) for name in table.colnames})


def _add(profiles: Profiles, name: str, profile: np.ndarray, step_arcsec: float) -> None:
    """A column; images of another scale than the first do not fit beside it and are left out."""
    angle = np.round(np.arange(len(profile)) * step_arcsec, 6)
    profiles.setdefault(ANGLE, angle)
    if len(angle) == len(profiles[ANGLE]) and np.allclose(angle, profiles[ANGLE], rtol=1e-3):
        profiles[name] = np.array([float(f"{value:.4g}") for value in profile])

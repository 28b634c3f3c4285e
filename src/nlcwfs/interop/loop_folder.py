"""The folder of a run of the loop: settings, numbers, telemetry, image, and where to go on."""

import json
import pickle
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import aotpy
import jax
import numpy as np
from astropy.io import fits
from astropy.table import Table

from nlcwfs.config import Config, digest, to_toml
from nlcwfs.constants import ARCSEC_RAD
from nlcwfs.errors import FileFormatError
from nlcwfs.interop.atomic_write import atomic_write
from nlcwfs.interop.loop_sensor_aot import aot_sensor
from nlcwfs.interop.provenance import Provenance
from nlcwfs.simulation.closed_loop.loop import GROUPS, Loop, LoopState, Record
from nlcwfs.simulation.closed_loop.run import LoopTelemetry

CONFIG, SUMMARY, TELEMETRY, RECORDS, IMAGE, CHECKPOINT, PICTURE = (
    "config.toml",
    "summary.json",
    "telemetry.fits",
    "frames.ecsv",
    "psf.fits",
    "checkpoint.pickle",
    "loop.png",
)


def prepare_folder(folder: Path, config: Config, *, resume: bool) -> None:
    """Make the folder of a run and write its settings.

    Raises:
        FileFormatError: If the folder cannot be made, holds a run already, or is to be resumed with other settings.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileFormatError(f"{folder}: must be a folder that can be written, got {error.strerror}") from None
    if (folder / CONFIG).exists() and not resume:
        raise FileFormatError(f"{folder}: must be empty or new, got a folder with a run (--resume goes on with it)")
    if not (resume and (folder / CHECKPOINT).exists()):
        write_config(folder, config)


def write_config(folder: Path, config: Config) -> None:
    """The settings of a run."""
    with atomic_write(folder / CONFIG) as path:
        path.write_text(to_toml(config), encoding="utf-8")


def write_checkpoint(folder: Path, config: Config, state: LoopState, records: list[Record]) -> None:
    """Where the run stands; written whole or not at all. A pickle: read only those of your own."""
    content = jax.tree.map(_on_disk, (state, records))
    with atomic_write(folder / CHECKPOINT) as path:
        path.write_bytes(pickle.dumps((digest(config), content)))


def read_checkpoint(folder: Path, config: Config) -> tuple[LoopState, list[Record]] | None:
    """Where a run stopped; None if it had not begun.

    Raises:
        FileFormatError: If the checkpoint is damaged, or made with other settings.
    """
    path = folder / CHECKPOINT
    if not path.exists():
        return None
    try:
        made_with, (state, records) = pickle.loads(path.read_bytes())
    except (OSError, ValueError, EOFError, AttributeError, ImportError, pickle.UnpicklingError, TypeError) as error:
        raise FileFormatError(f"{path}: must be a whole checkpoint of this version, got {error}") from None
    if made_with != digest(config):
        raise FileFormatError(f"{path}: must be resumed with the settings of {folder / CONFIG}, got others")
    return jax.tree.map(_in_memory, state), records


def _on_disk(leaf: Any) -> Any:
    return np.asarray(leaf) if isinstance(leaf, jax.Array) else leaf


def _in_memory(leaf: Any) -> Any:
    return jax.numpy.asarray(leaf) if isinstance(leaf, np.ndarray) else leaf


def write_summary(folder: Path, numbers: dict[str, Any], stamp: Provenance) -> None:
    """The numbers of a run as `summary.json`, with its stamp."""
    with atomic_write(folder / SUMMARY) as path:
        path.write_text(json.dumps(numbers | {"provenance": stamp.as_dict()}, indent=2) + "\n", encoding="utf-8")


def write_image(folder: Path, state: LoopState, stamp: Provenance) -> None:
    """The star's long exposure as FITS, in units of the peak without aberration."""
    image = state.image
    hdu = fits.PrimaryHDU(np.asarray(image.image, np.float32))
    hdu.header["BUNIT"] = ("peak", "peak of a perfect telescope")
    hdu.header["WAVELEN"] = (image.wavelength_m, "[m] wavelength of the image")
    hdu.header["PIXSCALE"] = (image.angles.pixel_m / ARCSEC_RAD, "[arcsec] on the sky")
    hdu.header["STREHL"] = (float(image.strehl), "intensity on the axis")
    hdu.header["NEXP"] = (int(image.exposures), "moments that were added up")
    for key, value, comment in stamp.cards():
        hdu.header[key] = (value, comment)
    with atomic_write(folder / IMAGE) as path:
        hdu.writeto(path, overwrite=True)


def write_telemetry(folder: Path, loop: Loop, state: LoopState, records: list[Record], stamp: Provenance) -> None:
    """What was recorded, as the AO telemetry standard wants it (AOT, Gomes et al. 2024, JATIS 10, 2), in SI units."""
    told = LoopTelemetry.of(records)
    rate_hz, still = loop.config.loop.rate_hz, loop.light.still
    time = aotpy.Time(
        "exposures", timestamps=list(np.arange(len(records)) / rate_hz), frame_numbers=list(range(len(records)))
    )
    telescope = aotpy.MainTelescope("telescope", enclosing_diameter=still.shape.diameter_m)
    star = aotpy.NaturalGuideStar("star")
    detector = aotpy.Detector("detector", frame_rate=rate_hz, integration_time=1 / rate_hz)
    measured = aotpy.Image("measured modes", told.measured_m[:, None, :].astype(np.float32), unit="m", time=time)
    sensor = aot_sensor(loop, star, detector, measured)
    mirror = aotpy.DeformableMirror("mirror", telescope=telescope, n_valid_actuators=loop.light.mirror.count)
    control = aotpy.ControlLoop(
        "loop",
        commanded_corrector=mirror,
        input_sensor=sensor,
        time=time,
        closed=state.closed_at >= 0,
        commands=aotpy.Image("commands", told.command_m.astype(np.float32), unit="m", time=time),
        residual_commands=measured,
        framerate=rate_hz,
        delay=loop.config.feedback.latency_frames / rate_hz,
    )
    begun = datetime.now(UTC)
    system = aotpy.AOSystem(
        ao_mode="SCAO",
        date_beginning=begun,
        date_end=begun,
        name="nlcwfs simulation",
        main_telescope=telescope,
        sources=[star],
        wavefront_sensors=[sensor],
        wavefront_correctors=[mirror],
        loops=[control],
        metadata=[aotpy.Metadatum(key, value, comment) for key, value, comment in stamp.cards()],
    )
    if int(state.image.exposures):
        system.strehl_ratio, system.strehl_wavelength = float(state.image.strehl), state.image.wavelength_m
    with atomic_write(folder / TELEMETRY) as path:
        path.unlink(missing_ok=True)
        system.write_to_file(str(path))


def write_records(folder: Path, loop: Loop, records: list[Record], stamp: Provenance) -> None:
    """One row for each exposure, as `frames.ecsv`."""
    told = LoopTelemetry.of(records)
    columns: dict[str, np.ndarray] = {"time_s": np.round(np.arange(len(records)) / loop.config.loop.rate_hz, 6)}
    columns["rms_nm"] = np.round(told.rms_nm, 3)
    for place, name in enumerate(GROUPS):
        columns[f"{name}_nm"] = np.round(told.group_nm[:, place], 3)
    columns |= {"predicted_nm": np.round(told.predicted_nm, 3), "outcome": told.outcome}
    columns |= {"followed": told.closed, "linear": told.linear, "ffts": told.ffts}
    table = Table(columns, meta=stamp.as_dict())
    with atomic_write(folder / RECORDS) as path:
        table.write(path, format="ascii.ecsv", overwrite=True)

"""The halo of several sensors against angle and rate, as rows of a table."""

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import astropy.units as u
import numpy as np
from astropy.table import Table
from jaxtyping import Float

from nlcwfs.atmosphere.star import collecting_area_m2
from nlcwfs.config import Config
from nlcwfs.constants import ARCSEC_RAD
from nlcwfs.errors import FileFormatError, SettingsError
from nlcwfs.interop import Provenance, atomic_write
from nlcwfs.interop.sensitivity_table import read_flux_factors
from nlcwfs.science.contrast import Halo
from nlcwfs.science.flux_factor import ROUNDING, FluxFactor, constant_flux_factor, shack_hartmann_curve
from nlcwfs.simulation.exposure import turbulence, wavelength_m
from nlcwfs.simulation.starlight import starlight_per_s
from nlcwfs.studies.study_table import Row

MAS_RAD = ARCSEC_RAD / 1000

GIVEN, BEST = "given", "best"
"""What the rate of a row is: asked for, or the best for its angle."""

UNITS = {"rate_hz": u.Hz, "angle_mas": u.mas}


class ContrastStudy(NamedTuple):
    """What is compared.

    Attributes:
        halo: Telescope, air and star.
        sensors: The flux factor of each, in the order of the settings.
        rates_hz: Rates that are asked for.
        told_mas: Angles that are told one by one.
        angles_mas: These and those of the curves, increasing.
    """

    halo: Halo
    sensors: tuple[FluxFactor, ...]
    rates_hz: tuple[float, ...]
    told_mas: tuple[float, ...]
    angles_mas: Float[np.ndarray, " angle"]

    @classmethod
    def of(cls, config: Config) -> "ContrastStudy":
        """Read the flux factors and check the angles.

        Raises:
            SettingsError: If a sensor is unknown, an angle is beyond the mirror or what is known of a sensor, or a
                sensor is blind to all of them.
            FileFormatError: If the table of sensitivities cannot be read.

        Examples:
            >>> study = ContrastStudy.of(Config.model_validate({"atmosphere": {"photons_per_s": 7.8e7}}))
            >>> [sensor.sensor for sensor in study.sensors], len(study.angles_mas)
            (['shack-hartmann-18', 'curvature'], 61)
        """
        settings = config.contrast
        told = tuple(sorted(settings.angles_mas or _octaves(config)))
        curve = np.geomspace(told[0], told[-1], settings.curve_points) if len(told) > 1 else np.array([])
        angles = np.unique(np.round(np.concatenate([np.array(told), curve]), 6))
        halo = halo_of(config)
        _check_mirror(config, halo, told)
        sensors = tuple(flux_factor_of(name, config) for name in settings.sensors)
        for sensor in sensors:
            _check_sight(sensor, halo, told)
        return cls(halo, sensors, settings.rates_hz, told, angles)

    def factor(self, sensor: FluxFactor, angles_mas: Float[np.ndarray, " angle"]) -> Float[np.ndarray, " angle"]:
        """Flux factor of a sensor at angles."""
        return sensor.at(self.halo.cycles_per_aperture(np.asarray(angles_mas) * MAS_RAD))

    def rows(self) -> list[Row]:
        """Every sensor, rate and angle at which it sees: a blind sensor has no rows there."""
        rows: list[Row] = []
        angle_rad = self.angles_mas * MAS_RAD
        for sensor in self.sensors:
            factor = self.factor(sensor, self.angles_mas)
            seen = np.isfinite(factor)
            for rate_hz in self.rates_hz:
                rows += self._rows(sensor.sensor, GIVEN, np.full(seen.sum(), rate_hz), seen, factor)
            best = self.halo.best_rate_hz(angle_rad[seen], factor[seen])
            rows += self._rows(sensor.sensor, BEST, best, seen, factor)
        return rows

    def _rows(
        self, sensor: str, rate: str, rates_hz: np.ndarray, seen: np.ndarray, factor: Float[np.ndarray, " angle"]
    ) -> list[Row]:
        """Rows of one sensor at one choice of the rate."""
        rows: list[Row] = []
        for angle_mas, q, rate_hz in zip(self.angles_mas[seen], factor[seen], rates_hz, strict=True):
            angle_rad = np.array([angle_mas * MAS_RAD])
            lag = float(self.halo.lag(angle_rad, rate_hz)[0])
            noise = float(self.halo.photon_noise(rate_hz, np.array([q]))[0])
            row: Row = {"sensor": sensor, "rate": rate, "rate_hz": short(rate_hz), "angle_mas": float(angle_mas)}
            row["cycles_per_aperture"] = short(float(self.halo.cycles_per_aperture(angle_rad)[0]))
            row |= {"told": int(angle_mas in self.told_mas), "flux_factor": short(float(q))}
            row |= {"lag": short(lag), "photon_noise": short(noise), "contrast": short(lag + noise)}
            rows.append(row | {"uncorrected": short(float(self.halo.uncorrected(angle_rad)[0]))})
        return rows

    def blind(self) -> list[str]:
        """Sensors that are blind at an angle that is told, in words."""
        lines = []
        for sensor in self.sensors:
            seen = np.isfinite(self.factor(sensor, np.array(self.told_mas)))
            hidden = [f"{angle:g}" for angle, sees in zip(self.told_mas, seen, strict=True) if not sees]
            if hidden:
                lines.append(f"{sensor.sensor} is blind to the waves at {', '.join(hidden)} mas: no contrast there")
        return lines


def halo_of(config: Config) -> Halo:
    """Telescope, air, star and delay of a configuration.

    Raises:
        SettingsError: If it tells no photons a second.

    Examples:
        >>> halo = halo_of(Config.model_validate({"atmosphere": {"photons_per_s": 7.8e7}, "beam": {"diameter_m": 6.5}}))
        >>> round(halo.area_m2, 1), halo.winds
        (33.2, ((1.0, 10.0),))
    """
    sky, beam = config.atmosphere, config.beam
    photons_per_s = starlight_per_s(config)
    if photons_per_s is None:
        raise SettingsError("atmosphere.photons_per_s", "must be given, or atmosphere.star.magnitude", "neither")
    return Halo(
        air=turbulence(config),
        winds=tuple(zip(sky.layer_fractions, sky.wind_speeds_m_per_s, strict=True)),
        diameter_m=beam.diameter_m,
        area_m2=collecting_area_m2(diameter_m=beam.diameter_m, obstruction_ratio=beam.obstruction_ratio),
        sensing_m=wavelength_m(config),
        imaging_m=imaging_m(config),
        photons_per_s=photons_per_s,
        latency_exposures=config.feedback.latency_frames,
    )


def imaging_m(config: Config) -> float:
    """Wavelength of the image.

    Examples:
        >>> round(1e6 * imaging_m(Config()), 3)
        0.85
    """
    return (config.contrast.imaging_wavelength_um or config.loop.science_wavelength_um) * 1e-6


def mirror_cutoff(config: Config) -> float:
    """Highest frequency that the mirror makes, cycles per aperture.

    Examples:
        >>> mirror_cutoff(Config())
        16.0
    """
    mirror = config.mirror
    if mirror.kind == "actuators":
        return (mirror.actuators_across - 1) / 2
    # As many modes as fill the disc of frequencies: pi / 4 to the square of a cycle per aperture.
    return mirror.cutoff_cpa if mirror.modes is None else 2 * math.sqrt(mirror.modes) / math.pi


def flux_factor_of(name: str, config: Config) -> FluxFactor:
    """The flux factor of a sensor: that of the table if it is in it, else the closed form.

    Raises:
        SettingsError: If there is no such sensor.
        FileFormatError: If the table cannot be read.

    Examples:
        >>> flux_factor_of("ideal", Config()).factor.tolist()
        [1.0, 1.0]
    """
    settings = config.contrast
    path, rms_rad = settings.sensitivity_table, settings.sensitivity_rms_rad
    tabled = {} if path is None else read_flux_factors(path, rms_rad=rms_rad)
    if name in tabled:
        return tabled[name]
    if name == "shack-hartmann":
        return shack_hartmann_curve(config.shack_hartmann.subapertures)
    known = {"ideal": 1.0, "curvature": settings.curvature_flux_factor}
    if name not in known:
        listed = ", ".join(dict.fromkeys([*known, "shack-hartmann", *sorted(tabled)]))
        raise SettingsError("contrast.sensors", f"must be of {listed} (contrast.sensitivity_table adds its own)", name)
    return constant_flux_factor(name, known[name])


def write_table(path: Path, rows: Sequence[Row], stamp: Provenance) -> None:
    """Write rows as a stamped ECSV table, whole or not at all.

    Args:
        path: The file.
        rows: All with the same columns.
        stamp: What made them.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "contrast.ecsv"
        >>> write_table(path, [{"angle_mas": 41.0}], Provenance.collect({}, seed=None, device="cpu"))
        >>> str(Table.read(path)["angle_mas"].unit)
        'mas'
    """
    columns = {name: [row[name] for row in rows] for name in rows[0]}
    units = {name: unit for name, unit in UNITS.items() if name in columns}
    text = io.StringIO()
    Table(columns, units=units, meta={"provenance": stamp.as_dict()}).write(text, format="ascii.ecsv")
    with atomic_write(path) as temporary:
        temporary.write_text(text.getvalue(), encoding="utf-8")


def read_table(path: Path, needed: Sequence[str]) -> list[Row]:
    """The rows of such a table; none if there is no file.

    Args:
        path: The file.
        needed: Columns that it must have.

    Raises:
        FileFormatError: If the file is no such table.

    Examples:
        >>> read_table(Path("no-such-table.ecsv"), ["sensor"])
        []
    """
    if not path.is_file():
        return []
    try:
        table = Table.read(path.read_text(encoding="utf-8").splitlines(), format="ascii.ecsv")
    except Exception as error:  # astropy and its YAML have a dozen kinds
        reason = " ".join(str(error).split())[:200]
        raise FileFormatError(f"{path}: must be a table of contrast (delete it to start anew), got {reason}") from None
    missing = [name for name in needed if name not in table.colnames]
    if missing:
        rule = f"must have the columns {', '.join(needed)} (delete it to start anew), got no {missing[0]}"
        raise FileFormatError(f"{path}: {rule}")
    columns = [table[name].tolist() for name in table.colnames]
    return [dict(zip(table.colnames, values, strict=True)) for values in zip(*columns, strict=True)]


def _octaves(config: Config) -> list[float]:
    """Angles of 1, 2, 4 ... cycles per aperture that the mirror makes."""
    count = int(math.log2(max(1.0, mirror_cutoff(config)))) + 1
    return [2.0**octave * imaging_m(config) / config.beam.diameter_m / MAS_RAD for octave in range(count)]


def _check_mirror(config: Config, halo: Halo, told_mas: Sequence[float]) -> None:
    """The mirror must make the waves of every angle."""
    cutoff = mirror_cutoff(config)
    most_mas = cutoff * halo.imaging_m / halo.diameter_m / MAS_RAD
    for angle_mas in told_mas:
        if angle_mas > most_mas * ROUNDING:
            waves = angle_mas / most_mas * cutoff
            rule = f"must be at most {most_mas:.0f} mas, the {cutoff:.3g} cycles per aperture that the mirror makes"
            raise SettingsError("contrast.angles_mas", rule, f"{angle_mas:g} ({waves:.3g} cycles per aperture)")


def _check_sight(sensor: FluxFactor, halo: Halo, told_mas: Sequence[float]) -> None:
    """The sensor must be known at every angle, and see at one of them."""
    try:
        factor = sensor.at(halo.cycles_per_aperture(np.array(told_mas) * MAS_RAD))
    except SettingsError as error:
        raise SettingsError("contrast.angles_mas", *_reworded(error)) from None
    if not np.isfinite(factor).any():
        raise SettingsError("contrast.sensors", "must see the waves of an angle", f"{sensor.sensor}, blind to all")


def _reworded(error: SettingsError) -> tuple[str, str]:
    """Rule and value of an error about a frequency."""
    rule, _, value = str(error).partition(": ")[2].rpartition(", got ")
    return rule, value


def short(value: float) -> float:
    """Six digits: enough for a table that people read.

    Examples:
        >>> short(0.123456789)
        0.123457
    """
    return float(f"{value:.6g}")

"""Every setting in one record, read from TOML and from the command line; defaults are Guyon 2010, Table 1.

`Config` has one section for each stage, in the order of the light. The settings of a stage live with the
stage, in its `settings.py`; here they are read, checked against each other, written and fingerprinted.
"""

import hashlib
import json
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from nlcwfs.atmosphere.settings import AtmosphereSettings
from nlcwfs.beam.segment_layouts import segments_of
from nlcwfs.beam.settings import BeamSettings
from nlcwfs.comparison_sensors.settings import LinearCurvatureSettings, PyramidSettings, ShackHartmannSettings
from nlcwfs.config_messages import ConfigError, problems_in_words, unknown_key
from nlcwfs.config_text import commented_toml, plain_toml
from nlcwfs.curvature_sensor.settings import FARTHEST_KM, CurvatureSensorSettings
from nlcwfs.detector.presets import IDEAL
from nlcwfs.detector.settings import DetectorSettings
from nlcwfs.errors import FileFormatError, SettingsError
from nlcwfs.estimation.settings import EstimationSettings
from nlcwfs.feedback.settings import FeedbackSettings
from nlcwfs.mirror.settings import MirrorSettings
from nlcwfs.science.settings import ContrastSettings
from nlcwfs.simulation.closed_loop.settings import LoopSettings
from nlcwfs.simulation.settings import SimulationSettings

_PRESET = ["detector", "preset"]
_DIGEST_DIGITS = 16
_PREAMBLE = """\
# Every setting of nlcwfs with its default; a file needs only what it changes.
# A key behind a # is optional, or follows from another key; remove the # to set it.
# The unit of a value is the end of its name. Sections stand in the order of the light.

"""


class Config(BaseModel):
    """All settings of one computation.

    Examples:
        >>> config = Config(seed=3)
        >>> config.seed, config.beam.diameter_m
        (3, 8.0)
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    seed: int = Field(
        default=0,
        ge=0,
        lt=2**32,  # the key of a larger seed depends on the precision
        description="Same settings and same seed, same numbers: sky and noise are drawn from it.",
    )
    precision: Literal["single", "double"] = Field(
        default="single", description="Floating point of the computation: 32 or 64 bits."
    )
    atmosphere: AtmosphereSettings = Field(default_factory=AtmosphereSettings)
    beam: BeamSettings = Field(default_factory=BeamSettings)
    contrast: ContrastSettings = Field(default_factory=ContrastSettings)
    curvature_sensor: CurvatureSensorSettings = Field(default_factory=CurvatureSensorSettings)
    detector: DetectorSettings = Field(default_factory=DetectorSettings)
    estimation: EstimationSettings = Field(default_factory=EstimationSettings)
    feedback: FeedbackSettings = Field(default_factory=FeedbackSettings)
    linear_curvature: LinearCurvatureSettings = Field(default_factory=LinearCurvatureSettings)
    loop: LoopSettings = Field(default_factory=LoopSettings)
    mirror: MirrorSettings = Field(default_factory=MirrorSettings)
    pyramid: PyramidSettings = Field(default_factory=PyramidSettings)
    shack_hartmann: ShackHartmannSettings = Field(default_factory=ShackHartmannSettings)
    simulation: SimulationSettings = Field(default_factory=SimulationSettings)

    @model_validator(mode="after")
    def _sections_agree(self) -> "Config":
        object.__setattr__(self, "curvature_sensor", placed(self.curvature_sensor, self.beam))
        cross_checks(self)
        return self


def placed(sensor: CurvatureSensorSettings, beam: BeamSettings) -> CurvatureSensorSettings:
    r"""The same sensor with distances in place of waves of defocus, so that all else knows distances only.

    A lens that adds defocus of w waves, peak to valley over a pupil of diameter D, images at the focus what a plane at
    :math:`D^2 / (8 \lambda w)` shows without it (see `docs/design.md`).

    Raises:
        SettingsError: If a plane would be farther than any may be.

    Examples:
        >>> beam = BeamSettings()
        >>> sensor = placed(CurvatureSensorSettings(defocus_waves=(-2.5, 5.0)), beam)
        >>> [round(distance_km) for distance_km in sensor.distances_km]
        [-3765, 1882]
    """
    if sensor.defocus_waves is None:
        return sensor
    waves = sensor.defocus_waves
    distances_km = tuple(beam.diameter_m**2 / (8e-6 * beam.wavelength_um * one) / 1e3 for one in waves)
    if max(map(abs, distances_km)) > FARTHEST_KM:
        least = beam.diameter_m**2 / (8e-6 * beam.wavelength_um * FARTHEST_KM * 1e3)
        rule = f"must be at least {least:.2g} to either side, a plane at {FARTHEST_KM:g} km"
        raise SettingsError("curvature_sensor.defocus_waves", rule, list(waves))
    return CurvatureSensorSettings(**{**dict(sensor), "distances_km": distances_km, "defocus_waves": None})


def cross_checks(config: Config) -> None:
    """Refuse sections that are each valid but cannot go together.

    Only what takes no time: the images themselves are not computed here. What a sampling that can work
    costs is for `beam.sampling.check_sampling` to say, before light travels.

    Raises:
        SettingsError: If the window of the detector does not hold the pupil, or segments overlap or leave it.
    """
    window, pupil = config.detector.window_pixels, config.detector.pixels_across_pupil
    if window < pupil:
        rule = f"must be at least detector.pixels_across_pupil ({pupil}) to hold the pupil"
        raise SettingsError("detector.window_pixels", rule, window)
    segments_of(config.beam)


def load_config(path: Path | str | None = None, overrides: Sequence[str] = ()) -> Config:
    """Read settings from a TOML file, then from `section.key=value` of the command line.

    The value of an override is TOML; text may go without quotes, and nothing behind the equals sign means
    the default. Overrides are stronger than the file and later ones stronger than earlier ones: to choose
    a preset this way is to drop what the file says of the keys that the preset fills.

    Args:
        path: The file; None for the defaults.
        overrides: Settings that replace those of the file.

    Raises:
        FileFormatError: If the file cannot be read or is not TOML.
        SettingsError: If a key is unknown or a value breaks a rule; one line for each problem.

    Examples:
        >>> config = load_config(None, ["beam.diameter_m=6.5", "detector.preset=EMCCD"])
        >>> config.beam.diameter_m, config.detector.em_gain
        (6.5, 600.0)
        >>> load_config(None, ["beam.diameter_m=-3"])
        Traceback (most recent call last):
        ...
        nlcwfs.config_messages.ConfigError: beam.diameter_m: must be a number from 0.01 to 100 [m], got -3
    """
    document = {} if path is None else _read_toml(Path(path))
    assignments = [_parse_override(text) for text in overrides]
    if any(keys == _PRESET for keys, _ in assignments) and isinstance(document.get("detector"), dict):
        document["detector"] = {key: value for key, value in document["detector"].items() if key not in IDEAL}
    for keys, value in assignments:
        _assign(document, keys, value)
    return _validate(document)


def default_toml() -> str:
    """Write every key with its default, under a comment that says what it is; reads back as `Config()`.

    Examples:
        >>> print(default_toml())
        # Every setting of nlcwfs ...
        [beam]
        # Diameter of the telescope. A number from 0.01 to 100 [m].
        diameter_m = 8.0
        ...
    """
    return _PREAMBLE + commented_toml(Config(), ruled_by_another=[f"detector.{key}" for key in IDEAL])


def to_toml(config: Config) -> str:
    """Write a configuration in full, as it was used; reads back as the same configuration.

    Examples:
        >>> print(to_toml(Config(seed=3)))
        seed = 3
        precision = "single"
        <BLANKLINE>
        [atmosphere]
        photons = 20000.0
        ...
    """
    return plain_toml(config)


def digest(config: Config) -> str:
    """Fingerprint of a configuration, to tell whether two results come from the same settings.

    First 16 hexadecimal digits of the SHA-256 of the settings as JSON with sorted keys and no blanks.

    Examples:
        >>> digest(Config()) == digest(load_config()) != digest(Config(seed=1))
        True
    """
    canonical = json.dumps(config.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()[:_DIGEST_DIGITS]


def _read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file, with one line of complaint that starts with its name."""
    try:
        text = path.read_bytes().decode("utf-8-sig")  # editors on Windows may write a byte order mark
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{path}: must be UTF-8 text, got byte {error.object[error.start]:#04x}") from None
    except FileNotFoundError:
        raise FileFormatError(f"{path}: no such file") from None
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # also numbers too long and lists too deep for Python
        reason = str(error).replace("end of document", f"line {len(text.splitlines())}, the end")
        raise FileFormatError(f"{path}: not valid TOML: {reason[:1].lower()}{reason[1:]}") from None


def _parse_override(text: str) -> tuple[list[str], Any]:
    """Split `section.key=value` into the path of the key and its value; None means the default."""
    if any("\ud800" <= character <= "\udfff" for character in text):  # how Python holds bytes that are no text
        raise SettingsError("--set", "must be UTF-8 text", ascii(text))
    name, equals, written = (part.strip() for part in text.partition("="))
    keys = [key.strip() for key in name.split(".")]
    if not equals or not all(keys):
        raise SettingsError("--set", "must be section.key=value", text)
    value = _parse_value(written)
    problem = unknown_key(Config, keys, value)
    if problem:
        raise ConfigError([problem])
    return keys, value


def _parse_value(written: str) -> Any:
    """Read a TOML value; text that is none stands for itself."""
    if not written:
        return None
    try:
        document = tomllib.loads(f"value = {written}")
    except (ValueError, RecursionError):
        return written
    return document["value"] if len(document) == 1 else written


def _assign(document: dict[str, Any], keys: Sequence[str], value: Any) -> None:
    """Put a value at its place; a section is merged into what is there, None takes the key away."""
    *above, last = keys
    for key in above:
        if not isinstance(document.get(key), dict):
            document[key] = {}
        document = document[key]
    if value is None:
        document.pop(last, None)
    elif isinstance(value, dict) and isinstance(document.get(last), dict):
        document[last] = document[last] | value
    else:
        document[last] = value


def _validate(document: Mapping[str, Any]) -> Config:
    """Check everything; strictly, so that neither text nor true passes for a number."""
    try:
        # through JSON, where a list is allowed to become a tuple and text a path even when strict
        return Config.model_validate_json(json.dumps(document, default=str), strict=True)
    except ValidationError as error:
        raise ConfigError(problems_in_words(Config, error)) from None

"""The question of a study and the cases that answer it, as written in its `study.toml`."""

import math
import tomllib
from pathlib import Path
from typing import Any, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from nlcwfs.config import Config, load_config
from nlcwfs.errors import FileFormatError, SettingsError

FigureName = Literal[
    "convergence",
    "photons-and-turbulence",
    "cost",
    "calibration",
    "segments",
    "turns",
    "sky-budgets",
    "colours-for-lenses",
]
"""What there is to draw, see `study_figures`."""


class Capture(NamedTuple):
    """When a wavefront counts as found.

    Attributes:
        captured_nm: Its error is below this.
        score: Which error judges what is believed: on the grid of the light (`fine`), or of the mean over every
            detector pixel (`pixels`); or of the pistons of segments modulo the wavelength (`segments`); with `turns`
            the page tells of their whole wavelengths instead.
    """

    captured_nm: float
    score: Literal["fine", "pixels", "segments", "turns"] = "fine"


class Case(BaseModel):
    """One row of the table: a sensor, a sky and a reconstructor, over many screens.

    Attributes:
        name: Unique within the study.
        group: Cases of a group belong into one table or picture.
        telescope_over_fried: D / r0 at the sensing wavelength; replaces `atmosphere.opd_rms_nm`.
        screens: Number of screens; that of the study when left out.
        light: `finer` runs the light on its own grid; `matched` on the grid of the reconstructor, which flatters.
        strength: `measured` from the frames, or `known` to the reconstructor.
        bound: Whether to compute the photon bound.
        twinkling: Settings of an air, on top of the case's own, whose scintillation varies the light, drawn apart from
            the wavefront: what a loop sees, whose mirror takes the phase out and leaves the amplitude.
        set: Settings, as on the command line.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    group: str
    telescope_over_fried: float | None = Field(default=None, gt=0)
    screens: int | None = Field(default=None, ge=1)
    light: Literal["finer", "matched"] = "finer"
    strength: Literal["measured", "known"] = "measured"
    bound: bool = False
    twinkling: tuple[str, ...] = ()
    set: tuple[str, ...] = ()


class Study(BaseModel):
    """A question, what all its cases share, and the cases.

    Attributes:
        question: What is asked.
        answer: The first line of its page, written when the table is there.
        notes: The end of its page.
        groups: Heading of each group of cases.
        figures: What to draw of the table, see `study_figures`.
        screens: Screens of a case, unless it says otherwise.
        captured_nm: Error below which a screen counts as captured.
        score: Which error that is, see `Capture`.
        set: Settings that all cases share.
        case: The cases.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    question: str
    answer: str = "Not answered yet"
    notes: str = ""
    groups: dict[str, str] = {}
    figures: tuple[FigureName, ...] = ()
    screens: int = Field(default=100, ge=1)
    captured_nm: float = Field(default=60.0, gt=0)
    score: Literal["fine", "pixels", "segments", "turns"] = "fine"
    set: tuple[str, ...] = ()
    case: tuple[Case, ...]

    @property
    def capture(self) -> Capture:
        """When a screen counts as captured."""
        return Capture(self.captured_nm, self.score)

    def screens_of(self, case: Case) -> int:
        """How many screens a case takes."""
        return case.screens or self.screens

    def config_of(self, case: Case) -> Config:
        """The full configuration of a case.

        Raises:
            SettingsError: If a setting is impossible.
        """
        config = load_config(None, [*self.set, *case.set])
        if case.telescope_over_fried is None:
            return config
        wavelength_nm = config.beam.wavelength_um * 1e3
        rms_nm = wavelength_nm / (2 * math.pi) * math.sqrt(1.0299 * case.telescope_over_fried ** (5 / 3))
        return load_config(None, [*self.set, *case.set, f"atmosphere.opd_rms_nm={rms_nm!r}"])

    def air_of(self, case: Case) -> Config | None:
        """The configuration of the air that makes the light of a case twinkle; None where it is steady.

        Raises:
            SettingsError: If a setting is impossible.
        """
        return load_config(None, [*self.set, *case.set, *case.twinkling]) if case.twinkling else None

    def configs(self, path: Path) -> dict[str, Config]:
        """The configuration of every case, by its name.

        Args:
            path: The study's file, for the message.

        Raises:
            FileFormatError: If a setting is impossible; names the file and the case.
        """
        configs = {}
        for case in self.case:
            try:
                configs[case.name] = self.config_of(case)
                self.air_of(case)
            except SettingsError as error:
                where = "set" if str(error) == self._shared_problem() else f"case {case.name}"
                reason = "; ".join(str(error).splitlines())
                raise FileFormatError(f"{path}: {where}: {reason}") from None
        return configs

    def _shared_problem(self) -> str:
        """What is wrong with the settings that all cases share."""
        try:
            load_config(None, self.set)
        except SettingsError as error:
            return str(error)
        return ""


def read_study(folder: Path) -> Study:
    """The study of a folder.

    Raises:
        FileFormatError: If `study.toml` is missing or wrong.
    """
    path = folder / "study.toml"
    if not path.is_file():
        raise FileFormatError(f"{path}: must exist, got no such file")
    try:
        content: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))
        study = Study.model_validate(content, strict=False)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise FileFormatError(f"{path}: must be TOML, got {error}") from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        got = "nothing" if first["type"] == "missing" else repr(first["input"])
        raise FileFormatError(f"{path}: {where}: {first['msg']}, got {got}") from None
    names = [case.name for case in study.case]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise FileFormatError(f"{path}: case.name: must be unique, got twice {sorted(twice)}")
    return study

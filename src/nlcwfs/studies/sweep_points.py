"""The question of a sweep and its points, runs of the loop over a grid of settings, as written in its `sweep.toml`."""

import hashlib
import itertools
import json
import re
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from nlcwfs.config import Config, load_config
from nlcwfs.config_messages import problems_in_words
from nlcwfs.config_text import toml_value
from nlcwfs.errors import FileFormatError, SettingsError

SEED = "seed"
"""The setting over which statistics are taken; the innermost of every grid, so that a mirror serves many seeds."""

Grid = dict[str, list[Any]]
"""Values of each setting, by its whole path."""

NAME = re.compile(r"\w[\w.+-]*")
"""Of a case: it becomes a part of the name of a folder."""

PLAIN = str | int | float | list | dict
"""What a value may be; TOML knows dates, too."""

LONGEST_VALUE, LONGEST_NAME = 40, 180
"""Letters of a value in the name of a point, and of that name: file systems allow 255."""


class Point(NamedTuple):
    """One run of the loop.

    Attributes:
        name: Unique within the sweep; also that of its folder.
        case: Family that it belongs to.
        config: Its settings.
        columns: Those of its settings that the table tells.
        keep: Whether its folder is kept.
        digest: Fingerprint of what it differs by from the defaults.
    """

    name: str
    case: str
    config: Config
    columns: dict[str, str | int | float]
    keep: bool
    digest: str


class SweepCase(BaseModel):
    """A family of points.

    Attributes:
        name: Unique within the sweep.
        set: Settings, as on the command line; stronger than those of the sweep.
        grid: Lists of values, beside those of the sweep or instead of them.
        keep: Whether whole runs are kept; as the sweep says when left out.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    set: tuple[str, ...] = ()
    grid: dict[str, Any] = {}
    keep: bool | None = Field(default=None, strict=True)


class Sweep(BaseModel):
    """A question, what all its points share, and its cases.

    Attributes:
        question: What is asked.
        answer: The first line of its page, written when the table is there.
        notes: The end of its page.
        figures: What to draw of the table, see `sweep_figures`.
        config: File of settings, seen from the sweep's folder.
        set: Settings that all points share; stronger than the file.
        grid: Lists of values: every combination is a point.
        keep: Whether whole runs are kept, with telemetry and image.
        case: The cases; one without a name when left out.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    question: str
    answer: str = "Not answered yet"
    notes: str = ""
    figures: tuple[str, ...] = ()
    config: str | None = None
    set: tuple[str, ...] = ()
    grid: dict[str, Any] = {}
    keep: bool = Field(default=False, strict=True)
    case: tuple[SweepCase, ...] = Field(default=(SweepCase(name="all"),), min_length=1)

    def varied(self) -> list[str]:
        """Settings that any grid varies, the seed last."""
        named = dict.fromkeys(key for case in self.case for key in self.grid_of(case))
        return [*(key for key in named if key != SEED), SEED]

    def grid_of(self, case: SweepCase) -> Grid:
        """The grid of a case, the seed last.

        Raises:
            SettingsError: If a setting has no list of values.
        """
        grid = flat_grid(self.grid) | flat_grid(case.grid)
        return {key: grid[key] for key in sorted(grid, key=lambda key: key == SEED)}


def flat_grid(written: dict[str, Any], above: str = "") -> Grid:
    """A grid with the whole path of every key, however TOML was written.

    Args:
        written: Lists of values, also in sections.
        above: Path of the section, with its dot.

    Raises:
        SettingsError: If a setting has no list of values.

    Examples:
        >>> flat_grid({"loop": {"rate_hz": [100, 200]}, "beam.diameter_m": [8]})
        {'loop.rate_hz': [100, 200], 'beam.diameter_m': [8]}
    """
    flat: Grid = {}
    for key, values in written.items():
        if isinstance(values, dict):
            flat |= flat_grid(values, f"{above}{key}.")
        elif isinstance(values, list) and values and all(isinstance(each, PLAIN) for each in values):
            flat[above + key] = values
        else:
            raise SettingsError(f"grid.{above}{key}", "must be a list of numbers, texts or lists", values)
    return flat


def read_sweep(path: Path) -> tuple[Sweep, tuple[Point, ...]]:
    """The sweep of a file, or of a folder with `sweep.toml`, and its points, each with settings that can be.

    Raises:
        FileFormatError: If the file is missing or wrong, or a setting in it is impossible; names file and case.
    """
    path = sweep_file(path)
    if not path.is_file():
        raise FileFormatError(f"{path}: must exist, got no such file")
    try:
        sweep = Sweep.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise FileFormatError(f"{path}: must be TOML, got {error}") from None
    except ValidationError as error:
        raise FileFormatError(f"{path}: {problems_in_words(Sweep, error)[0]}") from None
    names = [case.name for case in sweep.case]
    if len(set(names)) < len(names):
        raise FileFormatError(f"{path}: case.name: must be unique, got {names}")
    points = tuple(_points(path, sweep))
    twice = [name for name, count in Counter(point.name for point in points).items() if count > 1]
    if twice:
        raise FileFormatError(f"{path}: points must differ in the letters or digits of a value, got twice {twice[0]}")
    return sweep, points


def sweep_file(path: Path) -> Path:
    """The file of a sweep, of which the user may name the folder.

    Examples:
        >>> sweep_file(Path("rates.toml")).name
        'rates.toml'
    """
    return path / "sweep.toml" if path.is_dir() else path


def _points(path: Path, sweep: Sweep) -> Iterator[Point]:
    file = None if sweep.config is None else path.parent / sweep.config
    for case in sweep.case:
        try:
            if not NAME.fullmatch(case.name):
                raise SettingsError("name", "must be letters, digits and . _ + -", case.name)
            for values in itertools.product(*sweep.grid_of(case).values()):
                yield _point(sweep, case, file, dict(zip(sweep.grid_of(case), values, strict=True)))
        except SettingsError as error:
            where = "set" if str(error) == _shared_problem(file, sweep) else f"case {case.name}"
            raise FileFormatError(f"{path}: {where}: {'; '.join(str(error).splitlines())}") from None


def _point(sweep: Sweep, case: SweepCase, file: Path | None, chosen: dict[str, Any]) -> Point:
    assigned = [f"{key}={toml_value(value)}" for key, value in chosen.items()]
    config = load_config(file, [*sweep.set, *case.set, *assigned])
    keep = sweep.keep if case.keep is None else case.keep
    name = ",".join([case.name, *(f"{key}={_in_name(value)}" for key, value in chosen.items())])
    columns = {key: told for key in sweep.varied() if (told := _told(config, key, chosen)) is not None}
    return Point(_shortened(name, LONGEST_NAME), case.name, config, columns, keep, point_digest(config, keep=keep))


def point_digest(config: Config, *, keep: bool) -> str:
    """What a row is the answer to: every setting that is not the default, and whether the run was to be kept.

    A setting or a section that is new and left at its default makes no stored row stale.

    Examples:
        >>> point_digest(Config(), keep=False) == point_digest(Config(seed=0), keep=False)
        True
    """
    told = _flattened(config.model_dump(mode="json", exclude_defaults=True)) | ({"keep": True} if keep else {})
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:16]


def _shared_problem(file: Path | None, sweep: Sweep) -> str:
    """What is wrong with the settings that all points share."""
    try:
        load_config(file, sweep.set)
    except SettingsError as error:
        return str(error)
    return ""


def _in_name(value: Any) -> str:
    """A value in the name of a point, which is also that of a folder."""
    text = value if isinstance(value, str) else toml_value(value)
    return _shortened(re.sub(r"[^\w.+-]+", "_", text), LONGEST_VALUE)


def _shortened(text: str, longest: int) -> str:
    """A text that is too long ends with a fingerprint of the whole."""
    return text if len(text) <= longest else text[: longest - 9] + "~" + hashlib.sha256(text.encode()).hexdigest()[:8]


def _told(config: Config, key: str, chosen: dict[str, Any]) -> str | int | float | None:
    """A setting as the table tells it: also of points whose own grid does not name it."""
    value: Any = config.model_dump(mode="json")
    for part in key.split("."):
        value = value.get(part) if isinstance(value, dict) else None
    if value is None:
        value = chosen.get(key)
    return value if value is None or (isinstance(value, str | int | float) and value is not True) else toml_value(value)


def _flattened(content: dict[str, Any]) -> dict[str, Any]:
    """Nested tables as one, without the empty ones."""
    flat = {}
    for key, value in content.items():
        flat |= {f"{key}.{below}": each for below, each in _flattened(value).items()} if isinstance(value, dict) else {}
        flat |= {} if isinstance(value, dict) else {key: value}
    return flat

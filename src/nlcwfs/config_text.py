"""Settings as TOML text; knows no section by name."""

import json
import re
import textwrap
from collections.abc import Collection, Iterator
from enum import Enum
from pathlib import PurePath
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from nlcwfs.config_rules import rule_in_words, split_unit

_COMMENT_WIDTH = 100
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


def toml_value(value: Any) -> str:
    r"""Write a value as TOML does.

    Raises:
        TypeError: If TOML has no such value.

    Examples:
        >>> print(toml_value([1.5, True, 'a "b"\n', {"x": 2, "y": None}]))
        [1.5, true, "a \"b\"\n", {x = 2}]
    """
    match value:
        case bool():
            return "true" if value else "false"
        case Enum():
            return toml_value(value.value)
        case int() | float():
            return repr(value)
        case str() | PurePath():
            return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")
        case list() | tuple():
            return f"[{', '.join(toml_value(item) for item in value)}]"
        case BaseModel():
            return toml_value(dict(value))
        case dict():
            pairs = (f"{toml_key(key)} = {toml_value(item)}" for key, item in value.items() if item is not None)
            return f"{{{', '.join(pairs)}}}"
        case _:
            raise TypeError(f"TOML cannot hold a {type(value).__name__}")


def toml_key(key: str) -> str:
    """Write the name of a key as TOML does: bare when it can be.

    Examples:
        >>> toml_key("diameter_m"), toml_key("two words")
        ('diameter_m', '"two words"')
    """
    return key if _BARE_KEY.fullmatch(key) else toml_value(key)


def plain_toml(settings: BaseModel) -> str:
    """Write every value of a record as TOML, without comments; keys that hold None are left out.

    Examples:
        >>> from nlcwfs.simulation.settings import SimulationSettings
        >>> print(plain_toml(SimulationSettings()), end="")
        frames = 1
        light_oversampling = 4
        light_window = 2.0
        substeps = 4
    """
    blocks = []
    for path, section in _sections(settings):
        keys = [f"{toml_key(key)} = {toml_value(value)}" for key, value in _keys(section) if value is not None]
        blocks.append("\n".join([*_header(path), *keys]))
    return "\n\n".join(blocks) + "\n"


def commented_toml(settings: BaseModel, *, ruled_by_another: Collection[str] = ()) -> str:
    """Write every key of a record as TOML, under a comment: its description, its rule and its unit.

    Optional keys that hold nothing are commented out, with their field's first example as the value.

    Args:
        ruled_by_another: Paths of keys whose default depends on another key; they are commented out too.

    Examples:
        >>> from nlcwfs.atmosphere.settings import AtmosphereSettings
        >>> print(commented_toml(AtmosphereSettings()))
        # Photons that the whole sensor gets in one exposure, shared by its planes. A number greater
        ...
        #outer_scale_m = 25.0
        ...
    """
    blocks = []
    for path, section in _sections(settings):
        header = _header(path)
        if header:
            blocks.append("\n".join([*_comment((type(section).__doc__ or "").strip().split("\n")[0]), *header]))
        for key, value in _keys(section):
            field = type(section).model_fields[key]
            mark = "#" if value is None or ".".join((*path, key)) in ruled_by_another else ""
            shown = (field.examples or [""])[0] if value is None else value
            blocks.append("\n".join([*_comment(_explain(key, field)), f"{mark}{key} = {toml_value(shown)}"]))
    return "\n\n".join(blocks) + "\n"


def _sections(settings: BaseModel, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], BaseModel]]:
    """Yield a record and the records inside it, in order, each with its path."""
    yield path, settings
    for key, value in settings:
        if isinstance(value, BaseModel):
            yield from _sections(value, (*path, key))


def _keys(section: BaseModel) -> Iterator[tuple[str, Any]]:
    """Yield the keys of a record that are not records themselves."""
    return ((key, value) for key, value in section if not isinstance(value, BaseModel))


def _header(path: tuple[str, ...]) -> list[str]:
    """The line that opens a section; none for the outermost."""
    return [f"[{'.'.join(toml_key(key) for key in path)}]"] if path else []


def _explain(key: str, field: FieldInfo) -> str:
    """The description, the rule and the unit of a key as sentences."""
    rule, unit = rule_in_words(field.annotation, field.metadata), split_unit(key)[1]
    rule_and_unit = " ".join(filter(None, [rule, unit and f"[{unit}]"]))
    return " ".join(_sentence(text) for text in (field.description or "", rule_and_unit) if text)


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:].rstrip('.')}."


def _comment(text: str) -> list[str]:
    return [f"# {line}" for line in textwrap.wrap(text, _COMMENT_WIDTH - 2, break_on_hyphens=False)]

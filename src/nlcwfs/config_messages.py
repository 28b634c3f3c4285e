"""What is wrong with a user's settings, one line for each problem; knows no section by name."""

import difflib
from collections.abc import Iterator, Sequence
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from nlcwfs.config_rules import rule_in_words, split_unit, unwrap
from nlcwfs.config_text import toml_key, toml_value
from nlcwfs.errors import NlcwfsError, SettingsError

_LONGEST_VALUE = 80
_SLIP = 0.92  # one letter too many in seven
_SAME_STEM = 0.8  # ratio of difflib: distance and distances are 0.94, wavelength and seeing 0.25
_NOT_SET = object()


class ConfigError(SettingsError):
    """One or more settings break their rules; the message has one line for each.

    Examples:
        >>> print(ConfigError(["beam.diameter_m: must be a number, got true", "seed: unknown key, got 3"]))
        beam.diameter_m: must be a number, got true
        seed: unknown key, got 3
    """

    def __init__(self, problems: Sequence[str]) -> None:
        NlcwfsError.__init__(self, "\n".join(problems))
        self.problems = tuple(problems)

    def __reduce__(self) -> tuple[type, tuple[tuple[str, ...]]]:
        return ConfigError, (self.problems,)


def problems_in_words(model: type[BaseModel], error: ValidationError) -> list[str]:
    """Turn pydantic's findings into lines `path.of.key: rule, got value`, each problem once.

    Args:
        model: The record that was validated.
        error: What pydantic says about it.

    Examples:
        >>> from nlcwfs.atmosphere.settings import AtmosphereSettings
        >>> try:
        ...     AtmosphereSettings(photons=-3)
        ... except ValidationError as error:
        ...     problems_in_words(AtmosphereSettings, error)
        ['photons: must be a number greater than 0, got -3']
    """
    found = [details for details in error.errors(include_url=False) if not _is_echo(details)]
    return list(dict.fromkeys(_problem(model, details) for details in found))


def unknown_key(model: type[BaseModel], keys: Sequence[str], value: object) -> str | None:
    """Say what is wrong with the path of a key; None where there is such a key.

    Args:
        model: The outermost record.
        keys: Path of the key, from the outermost section inwards.
        value: What the key was given.

    Examples:
        >>> from nlcwfs.atmosphere.settings import AtmosphereSettings
        >>> unknown_key(AtmosphereSettings, ["seeing_mas"], 600)
        'seeing_mas: unknown key, got 600; the unit is in the name: did you mean seeing_arcsec [arcsec]?'
        >>> unknown_key(AtmosphereSettings, ["photon"], 600)
        'photon: unknown key, got 600; did you mean photons?'
    """
    section: type[BaseModel] | None = model
    for key in keys:
        if section is None:
            return None  # inside a value: its own rule says more
        if key not in section.model_fields:
            return f"{_line(_dotted(keys), 'unknown key', value)}; {_suggestion(model, section, key)}"
        section = _section_type(section.model_fields[key].annotation)
    return None


def _is_echo(details: ErrorDetails) -> bool:
    """Whether a list counts as too short only because its bad items, reported too, were taken out."""
    least = details.get("ctx", {}).get("min_length", 0)
    return details["type"] == "too_short" and len(details["input"]) >= least


def _problem(model: type[BaseModel], details: ErrorDetails) -> str:
    """One finding of pydantic as a line."""
    keys, owner, rule = _place(model, details["loc"])
    value, kind = details["input"], details["type"]
    if kind == "extra_forbidden":
        return unknown_key(model, [str(key) for key in keys], value) or _line(_dotted(keys), "unknown key", value)
    if kind == "value_error":
        return _own_rule(keys, owner, str(details.get("ctx", {}).get("error", details["msg"])), value)
    if kind == "missing":
        return f"{_dotted(keys)}: must be given"
    if kind == "finite_number":
        return _line(_dotted(keys), "must be a finite number", value)
    return _line(_dotted(keys), f"must be {rule}" if rule else _plain(details["msg"]), value)


def _own_rule(keys: Sequence[str | int], owner: type[BaseModel] | None, sentence: str, value: object) -> str:
    """A rule that a settings class raised itself: `key must ...` names the key that it is about."""
    key, _, rule = sentence.partition(" ")
    if owner is None:
        return _line(_dotted(keys), rule if keys and key == keys[-1] else sentence, value)
    if key not in owner.model_fields or not isinstance(value, dict):
        return f"{_dotted(keys) or 'settings'}: {sentence}"
    where = _dotted([*keys, key])
    return _line(where, rule, value[key]) if key in value else f"{where}: {rule}, got its default"


def _place(
    model: type[BaseModel], location: Sequence[str | int]
) -> tuple[list[str | int], type[BaseModel] | None, str]:
    """Where pydantic found something: the path without its marks for alternatives, the section, the rule."""
    keys: list[str | int] = []
    section: type[BaseModel] | None = model
    annotation, metadata, unit = model, [], ""
    for part in location:
        if section is not None and part in section.model_fields:
            field = section.model_fields[str(part)]
            annotation, metadata, unit = field.annotation, field.metadata, split_unit(str(part))[1]
        elif isinstance(part, int):
            options, _ = unwrap(annotation)
            annotation, metadata = next(iter(get_args(options[0])), Any), []
        elif section is None:
            section = _section_type(annotation, name=part)
            continue
        keys.append(part)
        section = _section_type(annotation)
    rule = rule_in_words(annotation, metadata)
    return keys, section, f"{rule} [{unit}]" if rule and unit else rule


def _section_type(annotation: Any, *, name: str | None = None) -> type[BaseModel] | None:
    """The settings class that a key holds; among alternatives the one of this name."""
    options = [each for each in unwrap(annotation)[0] if isinstance(each, type) and issubclass(each, BaseModel)]
    if name is not None:
        options = [each for each in options if each.__name__ == name]
    return options[0] if len(options) == 1 else None


def _suggestion(root: type[BaseModel], section: type[BaseModel], key: str) -> str:
    """Which key the user may have meant: a slip of a letter, the same name elsewhere, another unit, a near spelling."""
    here, everywhere = list(section.model_fields), dict(_all_keys(root))
    slip = difflib.get_close_matches(key, here, n=1, cutoff=_SLIP)
    if slip and not _differ_in_unit(key, slip[0]):
        return f"did you mean {slip[0]}?"
    for path, name in everywhere.items():
        if name == key:
            return f"did you mean {path}?"
    elsewhere = [(path, name) for path, name in everywhere.items() if name not in here]
    for path, name in [*zip(here, here, strict=True), *elsewhere]:
        if _differ_in_unit(key, name):
            return f"the unit is in the name: did you mean {path} [{split_unit(name)[1]}]?"
    near = difflib.get_close_matches(key, here, n=1)
    if near:
        return f"did you mean {near[0]}?"
    for path, name in elsewhere:
        if difflib.get_close_matches(key, [name], cutoff=_SAME_STEM):
            return f"did you mean {path}?"
    return f"known are {', '.join(here)}"


def _differ_in_unit(given: str, known: str) -> bool:
    """Whether two keys are about the same thing in different units."""
    (given_stem, given_unit), (known_stem, known_unit) = split_unit(given), split_unit(known)
    if not known_unit or given_unit == known_unit:
        return False
    return difflib.SequenceMatcher(None, given_stem, known_stem).ratio() >= _SAME_STEM


def _all_keys(section: type[BaseModel], above: str = "") -> Iterator[tuple[str, str]]:
    """Yield the path and the name of every key, sections included."""
    for key, field in section.model_fields.items():
        yield above + key, key
        inner = _section_type(field.annotation)
        if inner is not None:
            yield from _all_keys(inner, f"{above}{key}.")


def _dotted(keys: Sequence[str | int]) -> str:
    """The path of a key as a user writes it; an item of a list, counted from 0, in brackets."""
    return "".join(f"[{key}]" if isinstance(key, int) else f".{toml_key(key)}" for key in keys).removeprefix(".")


def _line(path: str, rule: str, value: object) -> str:
    return str(SettingsError(path or "settings", rule, _shown(value)))


def _shown(value: object) -> str:
    """The value as the user wrote it in TOML, cut when it is long."""
    text = "nothing" if value is None else toml_value(value)
    return text if len(text) <= _LONGEST_VALUE else f"{text[: _LONGEST_VALUE - 3]}..."


def _plain(message: str) -> str:
    """A message of pydantic for which there are no words of ours."""
    return message.replace("Input should be", "must be")

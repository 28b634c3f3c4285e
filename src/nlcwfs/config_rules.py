"""What a key may hold, in words, read off the types and bounds of the settings; knows no section by name."""

import json
from collections.abc import Iterable, Mapping
from pathlib import PurePath
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

UNITS: Mapping[str, str] = {
    **{unit: unit for unit in ("m", "km", "cm", "mm", "um", "nm", "s", "ms", "us", "deg", "rad", "mrad")},
    **{unit: unit for unit in ("arcsec", "arcmin", "mas", "pixels", "electrons", "photons", "adu", "percent")},
    **{"hz": "Hz", "khz": "kHz", "mhz": "MHz", "micron": "um", "microns": "um", "k": "K", "hpa": "hPa"},
}
"""Last words of keys that are units, and how they are printed."""

_NOUNS: Mapping[object, tuple[str, str]] = {
    bool: ("true or false", "true or false"),
    int: ("a whole number", "whole numbers"),
    float: ("a number", "numbers"),
    str: ("text", "texts"),
}


def split_unit(key: str) -> tuple[str, str]:
    """Split the name of a key into what it is about and the unit at its end.

    Examples:
        >>> split_unit("wavelength_um"), split_unit("gain_electrons_per_adu"), split_unit("preset")
        (('wavelength', 'um'), ('gain', 'electrons/adu'), ('preset', ''))
    """
    words = key.split("_")
    if len(words) > 3 and words[-2] == "per" and words[-3] in UNITS and words[-1] in UNITS:
        return "_".join(words[:-3]), f"{UNITS[words[-3]]}/{UNITS[words[-1]]}"
    if len(words) > 1 and words[-1].lower() in UNITS:
        return "_".join(words[:-1]), UNITS[words[-1].lower()]
    return key, ""


def unwrap(annotation: Any, metadata: Iterable[Any] = ()) -> tuple[list[Any], list[Any]]:
    """Take the alternatives of a type, without None, and its constraints out of their wrappers.

    Examples:
        >>> unwrap(float | None)
        ([<class 'float'>], [])
    """
    constraints = list(metadata)
    while get_origin(annotation) is Annotated:
        annotation, *more = get_args(annotation)
        for item in more:
            constraints += item.metadata if isinstance(item, FieldInfo) else [item]
    if get_origin(annotation) not in (Union, UnionType):
        return [annotation], constraints
    kept = [option for option in get_args(annotation) if option is not NoneType]
    if len(kept) == 1:
        return unwrap(kept[0], constraints)
    return kept, constraints


def rule_in_words(annotation: Any, metadata: Iterable[Any] = (), *, plural: bool = False) -> str:
    """Say what a key of this type may hold; empty where the type has no plain words.

    Examples:
        >>> from pydantic import Field
        >>> rule_in_words(Annotated[float | None, Field(gt=0, le=10)])
        'a number greater than 0 and at most 10'
        >>> rule_in_words(Annotated[tuple[float, ...], Field(min_length=1)])
        'a list of 1 or more numbers'
        >>> rule_in_words(Literal["single", "double"] | int)
        '"single" or "double" or a whole number'
    """
    options, constraints = unwrap(annotation, metadata)
    if len(options) > 1:
        return " or ".join(filter(None, (rule_in_words(option, constraints) for option in options)))
    option, origin = options[0], get_origin(options[0])
    if origin is Literal:
        names = [json.dumps(item) for item in get_args(option)]
        return " or ".join(filter(None, [", ".join(names[:-1]), names[-1]]))
    if origin in (tuple, list):
        items = get_args(option)
        fixed = len(items) if origin is tuple and Ellipsis not in items else None
        return f"a list of {_count(constraints, fixed)}{rule_in_words(next(iter(items), Any), plural=True)}"
    if isinstance(option, type) and issubclass(option, BaseModel):
        return "sections" if plural else "a section of keys"
    if isinstance(option, type) and issubclass(option, PurePath):
        return "paths" if plural else "a path, as text"
    noun = _NOUNS.get(option, ("", ""))[plural]
    return " ".join(filter(None, [noun, _range(constraints)])) if noun else ""


def _limit(constraints: Iterable[Any], name: str) -> Any:
    """The bound of this name among the constraints of a field, None where it has none."""
    return next((bound for item in constraints if (bound := getattr(item, name, None)) is not None), None)


def _count(constraints: list[Any], fixed: int | None) -> str:
    """How many items a list may hold, with a blank behind."""
    least, most = _limit(constraints, "min_length"), _limit(constraints, "max_length")
    if fixed is not None or (least == most and least is not None):
        return f"{least if fixed is None else fixed} "
    if most is not None:
        return f"{least or 0} to {most} "
    return f"{least} or more " if least else ""


def _range(constraints: list[Any]) -> str:
    """Which numbers are allowed."""
    bounds = {name: _limit(constraints, name) for name in ("gt", "ge", "lt", "le", "multiple_of")}
    words = {
        "gt": "greater than",
        "ge": "of at least",
        "lt": "below",
        "le": "at most",
        "multiple_of": "divisible by",
    }
    if bounds["ge"] is not None and bounds["le"] is not None:
        parts = [f"from {bounds['ge']:.12g} to {bounds['le']:.12g}"]
        words = {"multiple_of": words["multiple_of"]}
    else:
        parts = []
    parts += [f"{word} {bounds[name]:.12g}" for name, word in words.items() if bounds[name] is not None]
    return " and ".join(parts)

"""The leaves of a configuration by their dotted names, such as learner.clip."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Sequence
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

from pydantic.fields import FieldInfo

from simreal.config import RunConfig
from simreal.errors import closest


class Key(NamedTuple):
    """One leaf, as `simreal train --help` prints it."""

    kind: str
    """What a value looks like: int, a|b, [float, float], float or null."""
    default: str
    """Empty where a value must be given."""
    description: str


def config_keys() -> dict[str, Key]:
    """Every leaf of a `RunConfig`, in order."""
    return dict(_keys(RunConfig, ""))


def nearest_key(place: str, own: Sequence[str] = ()) -> str:
    """The end of a message about an unknown key: the nearest valid one, else those beside it."""
    section, _, leaf = place.rpartition(".")
    by_leaf = {name.rpartition(".")[2]: name for name in reversed(config_keys())}
    beside = {name.rpartition(".")[2]: name for name in config_keys() if name.rpartition(".")[0] == section}
    top = {} if section else {name: name for name in (*_sections(), *(item.strip("-") for item in own))}
    for choices in ({leaf: by_leaf[leaf]} if leaf in by_leaf else {}, beside | top, by_leaf):
        if meant := closest(leaf, choices):
            return f"; did you mean '{'--' if own else ''}{choices[meant]}'?"
    return f"; valid: {', '.join(beside | top or dict.fromkeys(_sections()))}"


def _sections() -> list[str]:
    return sorted({name.rpartition(".")[0] for name in config_keys()} - {""})


def _keys(cls: type, prefix: str) -> Iterator[tuple[str, Key]]:
    fields: dict[str, FieldInfo] = cls.__pydantic_fields__  # type: ignore[attr-defined]
    for name, info in fields.items():
        if dataclasses.is_dataclass(info.annotation):
            yield from _keys(info.annotation, f"{prefix}{name}.")
            continue
        default = "" if info.is_required() else _written(info.get_default(call_default_factory=True))
        yield f"{prefix}{name}", Key(_kind(info.annotation), default, info.description or "")


def _written(value: Any) -> str:
    """A default as it would stand in a YAML file."""
    return value if isinstance(value, str) else json.dumps(value)


def _kind(annotation: Any) -> str:
    """A type as a user writes it: int, a|b, [float, float], number or null."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _kind(inner[0])
    if origin is Literal:
        return "|".join(inner)
    if origin in (Union, UnionType):
        return " or ".join(_kind(item) for item in inner)
    if origin is tuple:
        return f"[{', '.join('...' if item is ... else _kind(item) for item in inner)}]"
    if origin is dict:
        return f"{{name: {_kind(inner[1])}}}"
    return "null" if annotation is NoneType else annotation.__name__

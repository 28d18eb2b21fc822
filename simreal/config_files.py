"""Configurations in YAML: shipped ones by name, others by path, any leaf overridden on the command line."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from simreal.config import RUN_CONFIG, RunConfig
from simreal.config_keys import config_keys, nearest_key
from simreal.errors import UserError, nearest

SHIPPED = Path(__file__).parent / "configs"


class _Dumper(yaml.SafeDumper):
    """YAML with a key to a line and a list in a line."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


_Dumper.add_representer(
    list, lambda dumper, items: dumper.represent_sequence("tag:yaml.org,2002:seq", items, flow_style=True)
)


class _Loader(yaml.SafeLoader):
    """YAML in which 3e-4 is a number, as in YAML 1.2 and everywhere else, and a key stands once."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if str(key.value) in seen:
                raise yaml.constructor.ConstructorError(
                    problem=f"'{key.value}' stands twice", problem_mark=key.start_mark
                )
            seen.add(str(key.value))
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
)


def shipped_configs() -> dict[str, Path]:
    """Configurations that come with simreal, name -> file."""
    return {path.stem: path for path in sorted(SHIPPED.glob("*.yaml"))}


def load_config(source: str | Path, overrides: Mapping[str, Any] | None = None) -> RunConfig:
    """The configuration in a file, with some leaves replaced.

    Args:
        source: name of a shipped configuration, or path of a YAML file.
        overrides: dotted name of a leaf -> value, e.g. {"learner.clip": 0.1}.

    Raises:
        UserError: no such configuration, YAML that cannot be read, an unknown key, a value of a wrong type
            or outside its limits.
    """
    path = find_config(source)
    values = read_yaml(path)
    for name, value in (overrides or {}).items():
        _put(values, name, value)
    return build_config(values, str(source), overrides or {})


def find_config(source: str | Path) -> Path:
    """File of a configuration given by name or path.

    Raises:
        UserError: there is none.
    """
    shipped = shipped_configs()
    if str(source) in shipped:
        return shipped[str(source)]
    path = Path(source)
    if path.is_file():
        return path
    if path.suffix in {".yaml", ".yml"} or len(path.parts) > 1:
        raise UserError(f"no configuration file '{source}'")
    raise UserError(
        f"no configuration '{source}'; {nearest(str(source), shipped)}, or the path of a YAML file"
    )


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping in a YAML file.

    Raises:
        UserError: missing or unreadable file, invalid YAML, or no mapping in it.
    """
    try:
        values = yaml.load(path.read_text(encoding="utf-8"), _Loader)
    except yaml.MarkedYAMLError as error:
        line = f":{error.problem_mark.line + 1}" if error.problem_mark else ""
        raise UserError(f"{path}{line}: not valid YAML: {error.problem}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: not valid YAML: {' '.join(str(error).split())}") from error
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}") from error
    if values is None:
        raise UserError(f"{path}: the file is empty; a configuration names at least its environment")
    if not isinstance(values, dict):
        raise UserError(f"{path}: expected a mapping of keys to values, got {type(values).__name__}")
    return values


def build_config(
    values: Mapping[str, Any], source: str, overridden: Mapping[str, Any] | None = None
) -> RunConfig:
    """A configuration from plain values.

    Args:
        values: the keys and sections of a `RunConfig`.
        source: where they come from, for an error.
        overridden: dotted names of those that come from the command line instead.

    Raises:
        UserError: an unknown key, a value of a wrong type or outside its limits.
    """
    try:
        config = RUN_CONFIG.validate_python(values)
    except ValidationError as error:
        first, *more = error.errors(include_url=False)
        place = _dotted(first["loc"])
        given = any(place == name or place.startswith((f"{name}.", f"{name}[")) for name in overridden or {})
        where = f"--{place}" if given else f"{source}: {place}" if place else source
        also = f" (and {len(more)} more)" if more else ""
        raise UserError(f"{where}: {_explain(first, place)}{also}") from error
    for place, value in _leaves(values):
        if isinstance(value, bool) and not isinstance(_get(config, place), bool):
            raise UserError(f"{source}: {place}: must be a {type(_get(config, place)).__name__}, got {value}")
    return config


def to_yaml(config: RunConfig) -> str:
    """The configuration in full, every default written out; `load_config` reads it back to an equal one."""
    return yaml.dump(config.to_dict(), Dumper=_Dumper, sort_keys=False, width=100)


def split_overrides(arguments: Sequence[str], own: Sequence[str]) -> tuple[dict[str, Any], list[str]]:
    """Take `--key.path value` and `--key.path=value` out of a command line.

    Args:
        arguments: the command line.
        own: options such as `--out` that are the command's own and stay.

    Returns:
        Overrides for `load_config`, and the arguments that stay.

    Raises:
        UserError: a key without a value, or a value that is not YAML.
    """
    overrides: dict[str, Any] = {}
    rest: list[str] = []
    waiting = list(arguments)
    while waiting:
        argument = waiting.pop(0)
        option, equals, text = argument.partition("=")
        if not option.startswith("--") or option in own:
            rest.append(argument)
            continue
        name = option.removeprefix("--")
        if name not in config_keys() and not name.startswith("randomizer."):
            raise UserError(f"unknown option '{option}'{nearest_key(name, own)}")
        if not equals:
            if not waiting:
                raise UserError(f"{option}: needs a value")
            text = waiting.pop(0)
        try:
            overrides[name] = yaml.load(text, _Loader)
        except yaml.YAMLError as error:
            raise UserError(f"{option}: '{text}' is not valid YAML") from error
    return overrides, rest


def _put(values: dict[str, Any], name: str, value: Any) -> None:
    *sections, leaf = name.split(".")
    for section in sections:
        inner = values.setdefault(section, {})
        if not isinstance(inner, dict):
            return  # a section that is none is reported when the whole is checked
        values = inner
    values[leaf] = value


def _leaves(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _get(config: Any, place: str) -> Any:
    for name in place.split("."):
        config = config[name] if isinstance(config, Mapping) else getattr(config, name)
    return config


def _dotted(location: tuple[int | str, ...]) -> str:
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location).lstrip(".")


def _explain(error: Any, place: str) -> str:
    kind = error["type"]
    match kind:
        case "unexpected_keyword_argument":
            return f"unknown key{nearest_key(place)}"
        case "missing" if place == "environment":
            return "missing; `simreal list` shows the environments"
        case "missing":
            return "missing"
        case "dataclass_type" | "dict_type":
            return f"must be a section of keys, got {error['input']!r}"
        case "value_error":
            return str(error["ctx"]["error"])
        case _:
            message = error["msg"] if kind == "literal_error" else error["msg"].partition(", ")[0]
            return f"{message.replace('Input should', 'must')}, got {error['input']!r}"

"""What `simreal list` prints."""

from __future__ import annotations

import ast
import importlib.util
from pathlib import Path

from simreal.config_files import load_config, shipped_configs
from simreal.registry import ENVIRONMENTS


def overview() -> str:
    """Environments and shipped configurations, without importing an environment, which takes seconds."""
    environments = {name: _summary(location) for name, location in ENVIRONMENTS.items()}
    configs = {name: _config_summary(name) for name in shipped_configs()}
    return "\n".join(
        [
            "Environments ('simreal list NAME' shows what varies in one)",
            *_columns(environments),
            "",
            "Configurations ('simreal train NAME' trains one)",
            *_columns(configs),
        ]
    )


def environment(name: str) -> str:
    """The factors of an environment with their training ranges, and its sets of worlds.

    Raises:
        UserError: an unknown name.
    """
    from simreal import quiet, registry

    quiet.import_mjx()
    env = registry.make(name)
    factors = {}
    for factor, bound in env.randomizer.bound.items():
        low, high = bound.factor.distribution.range()
        factors[factor] = f"{low:.4g} to {high:.4g} {bound.unit}".rstrip()
    sets = {worldset.name: worldset.description for worldset in env.world_sets}
    return "\n".join(
        [
            f"{name}: {_summary(ENVIRONMENTS[name])}",
            "",
            f"Factors, drawn for every episode ('--randomizer.{next(iter(factors), 'NAME')} [LOW, HIGH]')",
            *_columns(factors),
            "",
            "Sets of worlds ('simreal evaluate RUN --sets NAME,...')",
            *_columns(sets),
        ]
    )


def _config_summary(name: str) -> str:
    config = load_config(name)
    target = "" if config.target_success is None else f", or until {config.target_success:.0%} success"
    return f"{config.environment}: {config.worlds} worlds, {config.steps:,} steps{target}"


def _summary(location: str) -> str:
    """First sentence of an environment's docstring."""
    module, _, name = location.partition(":")
    found = importlib.util.find_spec(module)
    if found is None or found.origin is None:
        return ""
    for node in ast.parse(Path(found.origin).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ClassDef) and node.name == name:
            return (ast.get_docstring(node) or "").partition(". ")[0].splitlines()[0].rstrip(".")
    return ""


def _columns(rows: dict[str, str]) -> list[str]:
    width = max(map(len, rows), default=0)
    return [f"  {name.ljust(width)}  {text}".rstrip() for name, text in rows.items()]

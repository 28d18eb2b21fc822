"""Engines: MuJoCo C for CPUs (`mujoco`), MJX for accelerators and gradients (`mjx`)."""

from __future__ import annotations

import jax

from simreal.engines.base import Data, Engine, Inputs, Physics
from simreal.errors import UserError

ENGINES = ("mujoco", "mjx")

__all__ = ["ENGINES", "Data", "Engine", "Inputs", "Physics", "engine_class", "resolve"]


def resolve(name: str) -> str:
    """The engine that `auto` stands for: `mujoco` on CPU, `mjx` on an accelerator; else the name itself.

    Raises:
        UserError: an unknown name.
    """
    if name == "auto":
        return "mujoco" if jax.default_backend() == "cpu" else "mjx"
    if name not in ENGINES:
        raise UserError(f"engine: {name!r} is unknown; valid: auto, {', '.join(ENGINES)}")
    return name


def engine_class(name: str) -> type[Engine]:
    """The implementation, imported only when it is used."""
    if resolve(name) == "mujoco":
        from simreal.engines.mujoco import MujocoEngine

        return MujocoEngine
    from simreal.engines.mjx import MjxEngine

    return MjxEngine

"""The environments by name."""

from __future__ import annotations

import importlib
import inspect
from typing import TYPE_CHECKING, Any

from simreal.errors import UserError, nearest

if TYPE_CHECKING:
    from simreal.environment import Environment

ENVIRONMENTS: dict[str, str] = {
    "arm_reach": "simreal.envs.arm_reach:ArmReach",
    "cartpole_swingup": "simreal.envs.cartpole_swingup:CartpoleSwingup",
    "go2_walk": "simreal.envs.go2_walk:Go2Walk",
}
"""Name -> module:class. `register` adds to it."""


def register(name: str, location: str) -> None:
    """Makes an environment known by name; `location` is "module:Class"."""
    ENVIRONMENTS[name] = location


def environment_class(name: str) -> type[Environment]:
    """The class of an environment, imported only when it is used.

    Raises:
        UserError: an unknown name.
    """
    if name not in ENVIRONMENTS:
        raise UserError(f"environment: {name!r} is unknown; {nearest(name, ENVIRONMENTS)}")
    module, _, attribute = ENVIRONMENTS[name].partition(":")
    return getattr(importlib.import_module(module), attribute)


def make(name: str, **options: Any) -> Environment:
    """An environment by name; see `simreal.environment.Environment` for the options.

    Raises:
        UserError: an unknown name, or an option that does not fit.
    """
    kind = environment_class(name)
    known = [p for p in inspect.signature(kind).parameters if p != "self"]
    for option in options:
        if option not in known:
            raise UserError(f"make({name!r}): unknown option {option!r}; {nearest(option, known)}")
    return kind(**options)

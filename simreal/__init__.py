"""simreal: train robot policies in thousands of randomised worlds, and measure how well they transfer."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from simreal.errors import UserError

if TYPE_CHECKING:
    from simreal.environment import Environment, State
    from simreal.policy import load_policy
    from simreal.randomizer import Randomizer
    from simreal.registry import make, register
    from simreal.world import World

# XLA writes a page to stderr about made-up processor features whenever it loads a cached program.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

__version__ = "0.1.0"

_LAZY = {
    "Environment": "simreal.environment",
    "State": "simreal.environment",
    "Randomizer": "simreal.randomizer",
    "World": "simreal.world",
    "load_policy": "simreal.policy",
    "make": "simreal.registry",
    "register": "simreal.registry",
}

__all__ = [
    "Environment",
    "Randomizer",
    "State",
    "UserError",
    "World",
    "__version__",
    "load_policy",
    "make",
    "register",
]


def __getattr__(name: str) -> Any:
    """Imports on first use, so that `simreal --help` does not wait for JAX."""
    if name in _LAZY:
        import importlib

        return getattr(importlib.import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'simreal' has no attribute {name!r}")

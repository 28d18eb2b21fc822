"""Imports that talk too much."""

from __future__ import annotations

import contextlib
import io
from types import ModuleType


def import_mjx() -> ModuleType:
    """MJX, without the two lines that it prints where NVIDIA Warp is not installed."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        from mujoco import mjx

    return mjx

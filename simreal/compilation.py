"""JAX's persistent compilation cache, in the user's cache folder."""

from __future__ import annotations

import hashlib
import os
import platform
import sys
from pathlib import Path

SWITCH = "SIMREAL_CACHE"
"""Environment variable: `off` compiles anew every time, a path puts the cache there."""
JAX_SWITCH = "JAX_COMPILATION_CACHE_DIR"
MIN_SECONDS = 0.1
"""Programs that compile faster are not worth a file."""


def cache_folder() -> Path | None:
    """Where compiled programs are kept; None where the cache is switched off.

    Code compiled for one processor can crash another, and home folders are shared between machines, so each
    kind of processor has a folder of its own.
    """
    chosen = os.environ.get(SWITCH, "")
    if chosen.lower() in ("off", "0", "no"):
        return None
    if chosen:
        return Path(chosen).expanduser()
    if os.environ.get(JAX_SWITCH):
        return Path(os.environ[JAX_SWITCH])
    return _user_cache() / "simreal" / "jax" / _processor()


def enable_cache() -> Path | None:
    """Makes JAX keep what it compiles; returns the folder, or None where there is none to write to."""
    folder = cache_folder()
    if folder is None:
        return None
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    import jax

    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", MIN_SECONDS)
    return folder


def cache_size(folder: Path) -> int:
    """Bytes that the cache takes."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) if folder.is_dir() else 0


def _user_cache() -> Path:
    if os.environ.get("XDG_CACHE_HOME"):
        return Path(os.environ["XDG_CACHE_HOME"])
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    return Path.home() / ".cache"


def _processor() -> str:
    """Short name of the instruction set, as far as the system tells it."""
    told = platform.processor()
    listed = Path("/proc/cpuinfo")
    if listed.is_file():
        lines = listed.read_text(encoding="utf-8", errors="replace").splitlines()
        told = next((line for line in lines if line.lower().startswith(("flags", "features"))), told)
    return f"{platform.machine() or 'cpu'}-{hashlib.sha256(told.encode()).hexdigest()[:8]}"

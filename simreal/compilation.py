"""JAX's persistent compilation cache, in the user's cache folder; and compiling while tracing."""

from __future__ import annotations

import functools
import hashlib
import os
import platform
import sys
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Any

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


def for_rare_use() -> dict[str, Any]:
    """`compiler_options` for a program that runs too rarely to be worth optimising: a quarter of the time to
    compile, on a CPU."""
    return dict(_cpu_options(0))


def for_short_use(engine: str) -> dict[str, Any]:
    """`compiler_options` for a program that steps worlds for seconds, not minutes: half the time to compile.

    Where MuJoCo C does the physics, what is left to XLA is matrix products, which are library calls, and
    many small kernels; it runs up to a tenth slower. On `mjx` the physics itself is compiled: {}.
    """
    return dict(_cpu_options(1)) if engine == "mujoco" else {}


@functools.cache
def _cpu_options(level: int) -> dict[str, Any]:
    """An LLVM level, and XLA's older way of writing kernels, which compiles faster; {} on accelerators."""
    import jax

    if jax.default_backend() != "cpu":
        return {}
    options = {"xla_backend_optimization_level": level, "xla_cpu_use_fusion_emitters": False}
    try:
        jax.jit(lambda x: -x, compiler_options=options).lower(0.0).compile()
    except jax.errors.JaxRuntimeError:  # an XLA that has no such option any more
        del options["xla_cpu_use_fusion_emitters"]
    return options


class SideBySide:
    """Compiles programs in threads while others are traced; leaving the block waits for all.

    XLA lets go of Python's lock. Tracing needs it, and the caller's settings of JAX, so it happens in the
    caller's thread.

        with SideBySide() as compile_:
            program, result = compile_(function, *shapes)
            other, _ = compile_(another, result)
        program.result()(...)
    """

    def __init__(self) -> None:
        # XLA keeps nearly two cores busy with one program.
        from simreal.runs import cpu_affinity

        self._pool = ThreadPoolExecutor(max(1, len(cpu_affinity()) // 2), thread_name_prefix="compile")

    def __enter__(self) -> SideBySide:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pool.shutdown(cancel_futures=error is not None)

    def __call__(
        self, function: Callable[..., Any], *arguments: Any, **options: Any
    ) -> tuple[Future[Any], Any]:
        """The program, when it is ready, and the shapes of its result.

        Args:
            function: what to compile.
            arguments: its arguments, or their shapes.
            options: as of `jax.jit`.
        """
        import jax

        traced = jax.jit(function, **options).trace(*arguments)
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), traced.out_info)
        return self._pool.submit(traced.lower().compile), shapes


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

"""What the benchmarks share: interleaved pairs, and the line that names the machine."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable

import jax
import numpy as np


def seconds(call: Callable[[], object]) -> float:
    """Wall time of a call, its result waited for."""
    begin = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - begin


def interleaved(first: Callable[[], object], second: Callable[[], object], pairs: int) -> np.ndarray:
    """(pairs, 2) seconds of two calls, taken in turns so that a noisy machine hits both."""
    seconds(first), seconds(second)
    rows = []
    for i in range(pairs):
        if i % 2:
            b, a = seconds(second), seconds(first)
        else:
            a, b = seconds(first), seconds(second)
        rows.append((a, b))
    return np.array(rows)


def machine() -> str:
    """The device and the number of cores."""
    device = jax.devices()[0]
    kind = platform.machine() if device.platform == "cpu" else device.device_kind
    return f"{device.platform} ({kind}), {len(os.sched_getaffinity(0))} CPU cores, JAX {jax.__version__}"

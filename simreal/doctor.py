"""What this machine offers to simreal, and what is wrong with it."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from simreal import compilation
from simreal.engines import resolve
from simreal.runs import PACKAGES, cpu_affinity


@dataclass(frozen=True)
class Finding:
    """One line of the examination."""

    what: str
    answer: str
    problem: str | None = None
    """What is wrong, and what would mend it."""


def examine(say: Callable[[str], None]) -> list[str]:
    """Says a line for each thing looked at, as it is looked at; returns the problems, said last."""
    problems = []
    for finding in _findings():
        say(f"{finding.what + ':':<14}{finding.answer}")
        if finding.problem is not None:
            problems.append(f"{finding.what}: {finding.problem}")
    for problem in problems:
        say(f"problem: {problem}")
    if not problems:
        say("no problems")
    return problems


def _findings() -> Iterator[Finding]:
    yield Finding("python", f"{platform.python_version()}, {platform.system()} {platform.machine()}")
    yield _versions()
    yield _cores()
    yield _device()
    yield _cache()
    yield _pictures()
    yield _menagerie()


def _versions() -> Finding:
    versions = {name: importlib.metadata.version(name) for name in PACKAGES}
    answer = ", ".join(f"{name} {version}" for name, version in versions.items())
    problem = None
    if versions["mujoco"] != versions["mujoco-mjx"]:
        problem = (
            f"mujoco {versions['mujoco']} and mujoco-mjx {versions['mujoco-mjx']} must be the same release; "
            f"pip install mujoco=={versions['mujoco-mjx']}"
        )
    elif versions["jax"] in ("0.10.2", "0.11.0", "0.11.1"):
        problem = f"jax {versions['jax']} computes some products wrongly; pip install jax==0.10.1"
    return Finding("versions", answer, problem)


def _cores() -> Finding:
    usable, there = len(cpu_affinity()), os.cpu_count() or 1
    return Finding("cores", str(usable) if usable == there else f"{usable} of {there}")


def _device() -> Finding:
    import jax

    try:
        devices = jax.devices()
    except RuntimeError as error:
        return Finding("device", "none", " ".join(str(error).split()))
    return Finding("device", f"{len(devices)} x {devices[0].device_kind}; engine auto is {resolve('auto')}")


def _cache() -> Finding:
    folder = compilation.cache_folder()
    if folder is None:
        return Finding("cache", f"off, by {compilation.SWITCH}; every start compiles anew")
    size = f"{compilation.cache_size(folder) / 1e6:.0f} MB of compiled programs"
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        return Finding("cache", f"{folder}", f"not writable; set {compilation.SWITCH} to a folder that is")
    return Finding("cache", f"{folder}, {size}")


def _pictures() -> Finding:
    import mujoco
    import numpy as np

    from simreal import video

    model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
    with tempfile.TemporaryDirectory() as folder:
        try:
            video.contact_sheet(model, np.zeros((1, 0)), Path(folder) / "probe.png", size=(32, 32))
        except video.RenderingUnavailable as error:
            return Finding("pictures", "none; training and evaluation do without", str(error))
    from mujoco.rendering.classic import gl_context

    return Finding("pictures", f"OpenGL through {gl_context.GLContext.__module__.rpartition('.')[2]}")


def _menagerie() -> Finding:
    import mujoco_menagerie

    robot = mujoco_menagerie.get("unitree_go2")
    root = os.environ.get("MENAGERIE_ROOT")
    version = importlib.metadata.version("mujoco-menagerie")
    try:
        path = robot.path()
    except (mujoco_menagerie.MenagerieError, OSError) as error:
        reason = " ".join(str(error).split())
        return Finding(
            "menagerie",
            f"{version}, without its models",
            f"go2_walk lacks its Unitree Go2 ({reason}); connect to the internet once, or set MENAGERIE_ROOT "
            "to a folder of MuJoCo Menagerie models",
        )
    return Finding("menagerie", f"{version}, {path}{' (MENAGERIE_ROOT)' if root else ''}")

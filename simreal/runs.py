"""The folder of a run: what it was asked to do, what it did it with, and what it measured."""

from __future__ import annotations

import importlib.metadata
import json
import math
import os
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from simreal.config import RunConfig
from simreal.config_files import build_config, read_yaml, to_yaml
from simreal.errors import UserError, closest

RUNS = Path("runs")
PACKAGES = ("simreal", "jax", "jaxlib", "mujoco", "mujoco-mjx", "brax", "flax", "optax", "numpy")


@dataclass(frozen=True)
class Run:
    """A run folder; `create` and `open` give one that exists."""

    folder: Path

    @property
    def config_file(self) -> Path:
        """The configuration, resolved in full."""
        return self.folder / "config.yaml"

    @property
    def manifest_file(self) -> Path:
        """Versions, commit, device, engine, seed, digest of the randomizer."""
        return self.folder / "manifest.json"

    @property
    def metrics_file(self) -> Path:
        """One row of JSON per epoch."""
        return self.folder / "metrics.jsonl"

    @property
    def checkpoints(self) -> Path:
        """One folder per checkpoint."""
        return self.folder / "checkpoints"

    @property
    def policy(self) -> Path:
        """The exported policy, as it was at the end."""
        return self.folder / "policy"

    @property
    def best_policy(self) -> Path:
        """The policy that did best in training."""
        return self.folder / "best"

    @property
    def report(self) -> Path:
        """The page to look at: curves while it trains, everything after an evaluation."""
        return self.folder / "report.html"

    @property
    def quarantine(self) -> Path:
        """A file for each world that blew up."""
        return self.folder / "quarantine"

    @property
    def events(self) -> Path:
        """TensorBoard events."""
        return self.folder / "events"

    @classmethod
    def create(cls, folder: Path, config: RunConfig) -> Run:
        """A new run; its configuration is written.

        Raises:
            UserError: the folder holds something already, or cannot be made.
        """
        cls.check_free(folder)
        run = cls(folder)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            write_text(run.config_file, to_yaml(config))
        except OSError as error:
            raise UserError(f"cannot write to '{folder}': {error.strerror}") from error
        return run

    @staticmethod
    def check_free(folder: Path) -> None:
        """Raises UserError where a new run would overwrite something."""
        if folder.is_dir() and any(folder.iterdir()):
            raise UserError(
                f"'{folder}' is not empty: --resume goes on with the run in it, --out starts one elsewhere"
            )

    @classmethod
    def open(cls, folder: Path) -> Run:
        """A run that exists.

        Raises:
            UserError: there is none in this folder.
        """
        run = cls(folder)
        if not run.config_file.is_file():
            beside = [str(path.parent) for path in sorted(folder.parent.glob("*/config.yaml"))]
            meant = closest(str(folder), beside)
            hint = f"; did you mean '{meant}'?" if meant else f"; runs beside it: {', '.join(beside)}"
            raise UserError(f"no run in '{folder}': it has no config.yaml{hint if beside else ''}")
        return run

    def config(self) -> RunConfig:
        """The configuration that the run was started with.

        Raises:
            UserError: its file is damaged.
        """
        return build_config(read_yaml(self.config_file), str(self.config_file))

    def manifest(self) -> dict[str, Any]:
        """What is known of how the run was made; empty where that is not known."""
        try:
            return json.loads(self.manifest_file.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return {}
        except ValueError as error:
            raise UserError(f"{self.manifest_file}: not valid JSON") from error

    def write_manifest(self, manifest: Mapping[str, Any]) -> None:
        """Replaces the manifest."""
        write_text(self.manifest_file, json.dumps(manifest, indent=2) + "\n")

    def metrics(self) -> list[dict[str, Any]]:
        """The rows of metrics.jsonl; a last row that was cut off in mid-write is left out."""
        if not self.metrics_file.is_file():
            return []
        rows = []
        for line in self.metrics_file.read_text(encoding="utf-8").splitlines():
            try:
                rows.append(json.loads(line))
            except ValueError:
                break
        return rows

    def cut_metrics(self, step: int) -> list[dict[str, Any]]:
        """Drops the rows after a checkpoint's step, and returns those that stay."""
        rows = [row for row in self.metrics() if row["step"] <= step]
        write_text(self.metrics_file, "".join(_row(row) for row in rows))
        return rows

    def add_metrics(self, row: Mapping[str, Any]) -> None:
        """Appends a row; a number that is not finite becomes null."""
        with self.metrics_file.open("a", encoding="utf-8") as file:
            file.write(_row(row))


def new_folder(name: str, seed: int) -> Path:
    """A folder that does not exist yet: runs/<name>-<seed>, then runs/<name>-<seed>-2 and so on."""
    number = 1
    while (folder := _folder(name, seed, number)).exists():
        number += 1
    return folder


def newest_folder(name: str, seed: int) -> Path:
    """The folder that `new_folder` gave last; the first one where it never gave any."""
    number = 1
    while _folder(name, seed, number + 1).exists():
        number += 1
    return _folder(name, seed, number)


def _folder(name: str, seed: int, number: int) -> Path:
    return RUNS / (f"{name}-{seed}" if number == 1 else f"{name}-{seed}-{number}")


def write_text(path: Path, text: str) -> None:
    """Writes a file so that a reader, or a crash, meets the old text or the new one and nothing between."""
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    draft.write_text(text, encoding="utf-8")
    draft.replace(path)


def describe(config: RunConfig, engine: str, randomizer: str) -> dict[str, Any]:
    """A manifest.

    Args:
        config: the run's configuration.
        engine: the engine that `auto` became.
        randomizer: digest of the randomizer.
    """
    return {
        "environment": config.environment,
        "engine": engine,
        "seed": config.seed,
        "randomizer": randomizer,
        "commit": _commit(),
        **session(),
    }


def session() -> dict[str, Any]:
    """What this process runs with. A resumed run is bit-identical only where these are the same."""
    import jax

    device = jax.devices()[0]
    return {
        "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "device": {"platform": device.platform, "kind": device.device_kind, "count": jax.device_count()},
        "cpu_affinity": cpu_affinity(),
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "versions": {name: importlib.metadata.version(name) for name in PACKAGES},
    }


def cpu_affinity() -> list[int]:
    """The cores that this process may use; how many there are changes the order of sums, hence last bits."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def _commit() -> str | None:
    """The commit of the checkout that simreal is imported from, with `+` where files differ from it."""
    source = Path(__file__).resolve().parent.parent
    if not (source / ".git").exists():
        return None
    try:
        head, changes = (
            subprocess.run(
                ["git", "-C", str(source), *arguments], capture_output=True, text=True, timeout=10, check=True
            ).stdout.strip()
            for arguments in (["rev-parse", "HEAD"], ["status", "--porcelain", "--untracked-files=no"])
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return head + ("+" if changes else "")


def _row(row: Mapping[str, Any]) -> str:
    plain = {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in row.items()
    }
    return json.dumps(plain) + "\n"

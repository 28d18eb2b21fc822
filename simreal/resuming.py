"""Whether a run may go on from what another process, or another run, left."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from simreal.checkpoints import Checkpoints
from simreal.config import RunConfig
from simreal.errors import UserError
from simreal.runs import Run

if TYPE_CHECKING:
    from simreal.learner import TrainingState

Say = Callable[[str], None]

MAY_CHANGE = ("engine", "steps", "target_success", "checkpoint", "evaluation", "rollout.quarantine_files")
"""Settings that a resumed run may have otherwise: they do not change what an epoch computes. The engine is
compared as the manifest has it, where `auto` is resolved."""


def take_policy(state: TrainingState, source: Run, say: Say) -> tuple[int, TrainingState]:
    """A fresh state with the networks and the normaliser of another run's newest checkpoint."""
    rest: dict[str, Any] = {
        f.name: None for f in dataclasses.fields(state) if f.name not in ("params", "normalizer")
    }
    found = Checkpoints(source.checkpoints).restore(dataclasses.replace(state, **rest), say, partial=True)
    if found is None:
        raise UserError(f"--from {source.folder}: that run has no checkpoint yet")
    step, other = found
    return step, dataclasses.replace(state, params=other.params, normalizer=other.normalizer)


def check_config(before: RunConfig, now: RunConfig, folder: Path) -> None:
    """Refuses to resume a run as another one."""
    old, new = flat(before.to_dict()), flat(now.to_dict())
    for place, value in new.items():
        then = old.get(place)
        if then != value and place not in MAY_CHANGE and place.partition(".")[0] not in MAY_CHANGE:
            raise UserError(
                f"--resume: {place} is {value} here and {then} in {folder}/config.yaml; "
                f"pass that file as CONFIG, or start a run with --from {folder}"
            )


def flat(values: Mapping[str, Any], whole: Collection[str] = (), prefix: str = "") -> dict[str, Any]:
    """Nested settings by their path, `a.b`; what lies under a path in `whole` stays together."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        place = f"{prefix}{key}"
        nested = isinstance(value, Mapping) and value and place not in whole
        found |= flat(value, whole, f"{place}.") if nested else {place: value}
    return found


def check_manifest(before: Mapping[str, Any], now: Mapping[str, Any], folder: Path, say: Say) -> None:
    """Refuses what would be another run, and says what may change the last bits."""
    if before["engine"] != now["engine"]:
        raise UserError(
            f"--resume: {folder} was run on {before['engine']}, here engine is {now['engine']}; "
            f"pass --engine {before['engine']}"
        )
    if before["randomizer"] != now["randomizer"]:
        raise UserError(
            f"--resume: the training ranges of {now['environment']} have changed since {folder} was started; "
            f"start a run with --from {folder}"
        )
    for name in ("versions", "device"):
        if before[name] != now[name]:
            say(f"note: {name} when this run was started: {before[name]}; now: {now[name]}")
    then, today = len(before["cpu_affinity"]), len(now["cpu_affinity"])
    if then != today:
        say(f"note: this run was started on {then} cores and goes on with {today}: the last bits will differ")

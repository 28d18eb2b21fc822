"""What a run leaves on disk while it trains: metrics, checkpoints, policies, blown worlds."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from simreal import runs
from simreal.checkpoints import Checkpoints
from simreal.config import RunConfig
from simreal.live import LivePage
from simreal.quarantine import Recorder
from simreal.resuming import check_manifest, take_policy
from simreal.runs import Run

if TYPE_CHECKING:
    from simreal.environment import Environment
    from simreal.learner import TrainingState
    from simreal.policy import Policy

RECENT_EPOCHS = 3
"""Epochs in a row that must reach `target_success` before training ends early; the best policy is chosen by
its last as many."""

IDLE_SHARE = 0.01
"""Share of steps waiting for a fresh start that the user is told about."""

Say = Callable[[str], None]


class Keeper:
    """The folder of one run, and what is known of the run so far.

    Args:
        run: the folder.
        config: of the run.
        env: the environment it trains in.
        export: a training state's policy.
        say: takes a line for the user.
        member: which one of a population this is; None: it is a run of its own.
    """

    def __init__(
        self,
        run: Run,
        config: RunConfig,
        env: Environment,
        export: Callable[[TrainingState], Policy],
        say: Say,
        member: int | None = None,
    ) -> None:
        self.run = run
        self.config = config
        self.env = env
        self.say = say
        self._export = export
        kept = config.checkpoint
        self.checkpoints = Checkpoints(run.checkpoints, kept.keep, kept.keep_every, kept.keep_best)
        self.recorder = Recorder(
            run.quarantine,
            self._recording_meta(),
            env.control_dt,
            config.learner.unroll_length,
            config.rollout.quarantine_files,
            member,
        )
        self.rows: list[dict[str, Any]] = []
        self.best: tuple[float, float] | None = None
        self.saved_step: int | None = None
        self._events: Any = None
        title = f"{config.environment}, seed {config.seed}, on {env.engine_name}"
        self._page = LivePage(run.report, title, config.steps)
        self._recorded = self._told_idle = self._told_quarantine = False

    # -- the beginning and the end -------------------------------------------------------------------------

    def start(self, state: TrainingState, source: Run | None) -> TrainingState:
        """A new run, from nothing or with another run's policy."""
        manifest = self._manifest()
        if source is not None:
            step, state = take_policy(state, source, self.say)
            manifest["from"] = {"run": str(source.folder), "step": step}
        self.run.write_manifest(manifest)
        return state

    def resume(self, state: TrainingState, newest: int | None = None) -> TrainingState:
        """The state of the newest sound checkpoint (up to step `newest`), or `state` where there is none."""
        manifest = self.run.manifest() or self._manifest()
        check_manifest(manifest, self._manifest(), self.run.folder, self.say)
        found = self.checkpoints.restore(state, self.say, newest=newest)
        if found is not None:
            self.saved_step, state = found
            self.checkpoints.discard_after(self.saved_step)
        step = self.saved_step or 0
        self.rows = self.run.cut_metrics(step)
        if self.run.best_policy.is_dir():
            scores = [merit(self.rows[max(0, i - RECENT_EPOCHS) : i]) for i in range(1, len(self.rows) + 1)]
            self.best = max((score for score in scores if score is not None), default=None)
        manifest.setdefault("resumed", []).append({"step": step, **runs.session()})
        self.run.write_manifest(manifest)
        runs.write_text(self.run.config_file, runs.to_yaml(self.config))
        self.say(f"going on with {self.run.folder} at step {step:,}")
        return state

    @property
    def seconds(self) -> float:
        """Wall time that the run has taken so far."""
        return self.rows[-1]["wall_seconds"] if self.rows else 0.0

    def open_events(self, step: int) -> None:
        """Begins to write TensorBoard events; a resumed run replaces what it computes again."""
        from tensorboardX import SummaryWriter

        self._events = SummaryWriter(str(self.run.events), purge_step=step + 1 if step else None)

    def close(self) -> None:
        """Waits for the checkpoint that is being written, and ends the events and the page."""
        try:
            self.note_saved(wait=True)
        finally:
            if self._events is not None:
                self._events.close()
            if self._recorded:  # else there may be the full report of a run that was finished before
                self._page.show(self.rows, done=True)

    # -- an epoch ------------------------------------------------------------------------------------------

    def record(
        self, state: TrainingState, values: dict[str, float], before: int, took: float, wall: float
    ) -> dict[str, Any]:
        """The row of an epoch in metrics.jsonl, and what follows from it.

        Args:
            state: after the epoch; only parameters and normaliser are read.
            values: metrics of the epoch.
            before: steps before the epoch.
            took: seconds that the epoch took.
            wall: seconds of the run, this epoch included.
        """
        self.recorder.flush()
        step, values = int(state.steps), dict(values)
        row = {
            "step": step,
            "episode_return": values.pop("episode_return"),
            "success_rate": values.pop("success_rate"),
            "steps_per_second": (step - before) / took,
            "wall_seconds": wall,
            **values,
        }
        self._tell(values, step - before)
        self.run.add_metrics(row)
        self.rows.append(row)
        self._recorded = True
        for name, value in row.items():
            if name != "step" and math.isfinite(value):
                self._events.add_scalar(name, value, step)
        self._page.show(self.rows)
        score = merit(self.rows)
        if score is not None and (self.best is None or score > self.best):
            self.best = score
            self.export(state, self.run.best_policy)
        self.note_saved()
        return row

    def _tell(self, values: Mapping[str, float], steps: int) -> None:
        if values["quarantined"] and not self._told_quarantine:
            self._told_quarantine = True
            kept = f"; such worlds lie in {self.run.quarantine}, and 'simreal replay FILE' shows one again"
            self.say(
                "a world's physics blew up: its episode is over and counts for nothing"
                f"{kept if self.recorder.most else ''}"
            )
        if values["idle_steps"] > IDLE_SHARE * steps and not self._told_idle:
            self._told_idle = True
            self.say(
                f"{values['idle_steps'] / steps:.0%} of the steps waited for a fresh start, "
                "because more episodes ended in an unroll than rollout.reserve holds; a larger one avoids it"
            )

    # -- what is saved -------------------------------------------------------------------------------------

    def save(self, state: TrainingState) -> None:
        """Begins a checkpoint, and writes the policy as it stands."""
        self.note_saved(wait=True)
        score = merit(self.rows)
        self.checkpoints.begin_save(int(state.steps), state, None if score is None else score[0])
        self.export(state, self.run.policy)

    def note_saved(self, wait: bool = False) -> None:
        """Takes notice of a checkpoint that has got to the disk.

        Raises:
            UserError: it has not.
        """
        step = self.checkpoints.finished(wait)
        if step is not None:
            self.saved_step = step

    def export(self, state: TrainingState, folder: Path) -> None:
        """Writes the policy as it stands; a reader meets the old one, none, or all of the new one."""
        draft = folder.with_name(f"{folder.name}.unfinished")
        shutil.rmtree(draft, ignore_errors=True)
        self._export(state).save(draft)
        shutil.rmtree(folder, ignore_errors=True)
        draft.rename(folder)

    def kept(self) -> str:
        """What is left if the run ends here and now."""
        if self.saved_step is None:
            return "no checkpoint was saved yet"
        return f"the checkpoint at step {self.saved_step:,} is intact"

    def _recording_meta(self) -> dict[str, Any]:
        return {
            "environment": self.config.environment,
            "engine": self.env.engine_name,
            "seed": self.config.seed,
            "randomizer": self.env.randomizer.randomizer.digest,
            "config": self.config.to_dict(),
        }

    def _manifest(self) -> dict[str, Any]:
        return runs.describe(self.config, self.env.engine_name, self.env.randomizer.randomizer.digest)


def holds_target(rows: Sequence[Mapping[str, Any]], target: float | None) -> bool:
    """Whether the success rate of the mean action reached `target` in each of the last epochs."""
    last = [row["success_rate"] for row in rows[-RECENT_EPOCHS:]]
    if target is None or len(last) < RECENT_EPOCHS:
        return False
    return all(rate is not None and rate >= target for rate in last)


def merit(rows: Sequence[Mapping[str, Any]]) -> tuple[float, float] | None:
    """How good the policy is, as far as training tells: success of the mean action, then return, over the
    last epochs; None where one of these is not known, as without greedy worlds."""
    last = [(row["success_rate"], row["episode_return"]) for row in rows[-RECENT_EPOCHS:]]
    if len(last) < RECENT_EPOCHS or any(
        value is None or math.isnan(value) for pair in last for value in pair
    ):
        return None
    success, episode_return = np.mean(last, axis=0)
    return float(success), float(episode_return)


def is_finite(state: TrainingState) -> bool:
    """Whether the networks and the normaliser may be saved."""
    leaves = jax.device_get(jax.tree.leaves((state.params, state.normalizer)))
    return all(np.isfinite(leaf).all() for leaf in leaves)

"""The loop around the learner: epochs, metrics, checkpoints, and a clean end however it comes."""

from __future__ import annotations

import errno
import math
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from simreal import quiet, registry, runs
from simreal.checkpoints import Checkpoints
from simreal.config import RunConfig
from simreal.errors import UserError
from simreal.progress import Progress
from simreal.quarantine import Recorder
from simreal.resuming import check_config, check_manifest, take_policy
from simreal.runs import Run
from simreal.stopping import Interrupted, StopRequest

if TYPE_CHECKING:
    from simreal.environment import Environment
    from simreal.learner import Learner, TrainingState

TARGET_EPOCHS = 3
"""Epochs in a row that must reach `target_success` before training ends early; the best policy is chosen by
its last as many."""

IDLE_SHARE = 0.01
"""Share of steps waiting for a fresh start that the user is told about."""


def make_environment(config: RunConfig, engine: str | None = None) -> Environment:
    """The environment of a run, bound to its training ranges.

    Args:
        config: the run's configuration.
        engine: overrides the configuration's engine.

    Raises:
        UserError: unknown environment or factor, or a range that the environment cannot have.
    """
    training = registry.environment_class(config.environment).training.with_ranges(config.randomizer)
    return registry.make(config.environment, engine=engine or config.engine, randomizer=training)


def make_learner(config: RunConfig) -> Learner:
    """The learner of a run; compiles nothing yet."""
    quiet.import_mjx()  # before Brax imports it, and lets it talk
    from simreal.learner import Learner

    return Learner(make_environment(config), config)


def train(
    config: RunConfig,
    out: Path,
    resume: bool = False,
    from_run: Path | None = None,
    build: Callable[[RunConfig], Learner] = make_learner,
) -> Path:
    """Trains until `config.steps`, or until `config.target_success` is held; returns the run folder.

    Args:
        config: what to train.
        out: the run folder.
        resume: go on from the newest checkpoint in `out`.
        from_run: a run whose policy, critic and normaliser a new run starts from.
        build: makes the learner.

    Raises:
        UserError: `out` holds a run already, there is none to resume, or it does not fit the configuration;
            the disk is full; the parameters are no longer finite.
        Interrupted: by SIGINT or SIGTERM, after the epoch in flight was finished and saved.
    """
    if resume and from_run is not None:
        raise UserError(
            "--resume and --from exclude each other: one goes on with a run, the other starts one"
        )
    earlier = Run.open(out) if resume else None
    if earlier is not None:
        check_config(earlier.config(), config, out)
    source = Run.open(from_run) if from_run is not None else None
    learner = build(config)
    run = earlier or Run.create(out, config)
    with StopRequest() as stop, Progress(config.steps) as progress:
        loop = _Loop(learner, config, run, stop, progress)
        if earlier is not None:
            loop.resume()
        else:
            loop.start(source)
        try:
            loop.run_epochs()
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EDQUOT):
                raise
            raise UserError(f"{out}: {error.strerror}; {loop.kept()}") from error
    return out


class _Loop:
    """One call of `train`: the state, the rows so far, and when it was last saved."""

    def __init__(
        self, learner: Learner, config: RunConfig, run: Run, stop: StopRequest, progress: Progress
    ) -> None:
        self.learner = learner
        self.config = config
        self.run = run
        self.stop = stop
        self.progress = progress
        kept = config.checkpoint
        self.checkpoints = Checkpoints(run.checkpoints, kept.keep, kept.keep_every, kept.keep_best)
        self.state: TrainingState = learner.init(config.seed)
        self.recorder = Recorder(
            run.quarantine,
            _recording_meta(learner, config),
            learner.env.control_dt,
            config.learner.unroll_length,
            config.rollout.quarantine_files,
        )
        self.rows: list[dict[str, Any]] = []
        self.best: tuple[float, float] | None = None
        self.saved_step: int | None = None
        self.told_idle = self.told_quarantine = False

    @property
    def step(self) -> int:
        """Environment steps so far."""
        return int(self.state.steps)

    def start(self, source: Run | None) -> None:
        """A new run, from nothing or from another run's policy."""
        manifest = _manifest(self.learner, self.config)
        if source is not None:
            step, self.state = take_policy(self.state, source, self.progress.say)
            manifest["from"] = {"run": str(source.folder), "step": step}
        self.run.write_manifest(manifest)

    def resume(self) -> None:
        """Goes on from the newest sound checkpoint, or from the start where none was saved yet."""
        manifest = self.run.manifest() or _manifest(self.learner, self.config)
        check_manifest(manifest, _manifest(self.learner, self.config), self.run.folder, self.progress.say)
        found = self.checkpoints.restore(self.state, self.progress.say)
        if found is not None:
            self.saved_step, self.state = found
            self.checkpoints.discard_after(self.saved_step)
        self.rows = self.run.cut_metrics(self.step)
        scores = [merit(self.rows[: i + 1]) for i in range(len(self.rows))]
        self.best = max((score for score in scores if score is not None), default=None)
        manifest.setdefault("resumed", []).append({"step": self.step, **runs.session()})
        self.run.write_manifest(manifest)
        runs.write_text(self.run.config_file, runs.to_yaml(self.config))
        self.progress.say(f"going on with {self.run.folder} at step {self.step:,}")

    def run_epochs(self) -> None:
        """Until the steps are done or the target is held; raises Interrupted where it is asked to stop."""
        began = time.monotonic() - (self.rows[-1]["wall_seconds"] if self.rows else 0.0)
        saved_at = time.monotonic()
        env = self.learner.env
        self.progress.say(f"training {env.name} on {env.engine_name} into {self.run.folder}; compiling first")
        with _Events(self.run, self.step) as events:
            while self.step < self.config.steps and not holds_target(self.rows, self.config.target_success):
                row = self.epoch(began)
                events.add(row)
                self.progress.show(row, last=self.step >= self.config.steps)
                self.note_saved(self.checkpoints.finished())
                due = time.monotonic() - saved_at >= self.config.checkpoint.every_seconds
                if due or self.stop.asked:
                    self.save()
                    saved_at = time.monotonic()
                if self.stop.asked:
                    self.note_saved(self.checkpoints.finish())
                    raise Interrupted(
                        f"interrupted; step {self.step:,} is saved, --resume --out {self.run.folder} goes on"
                    )
        # Always: a run that was killed between its last checkpoint and the export has an older policy.
        self.save()
        self.note_saved(self.checkpoints.finish())
        self.progress.say(f"{self._ending()}; {self.run.folder} holds the policy")

    def epoch(self, began: float) -> dict[str, Any]:
        """One epoch and its row in metrics.jsonl."""
        start, before = time.monotonic(), self.step
        self.state, values = self.learner.epoch(self.state, self.recorder.watch)
        self.recorder.flush()
        if not _is_finite(self.state):
            self.note_saved(self.checkpoints.finish())
            raise UserError(
                f"{self.run.folder}: parameters are no longer finite after step {before:,}; {self.kept()}; "
                f"a lower learner.learning_rate or learner.max_gradient_norm may help"
            )
        now = time.monotonic()
        row = {
            "step": self.step,
            "episode_return": values.pop("episode_return"),
            "success_rate": values.pop("success_rate"),
            "steps_per_second": (self.step - before) / (now - start),
            "wall_seconds": now - began,
            **values,
        }
        if values["quarantined"] and not self.told_quarantine:
            self.told_quarantine = True
            self.progress.say(
                f"a world's physics blew up; its episode is over and counts for nothing. Such worlds lie in "
                f"{self.run.quarantine}; 'simreal replay FILE' shows one again"
            )
        if values["idle_steps"] > IDLE_SHARE * (self.step - before) and not self.told_idle:
            self.told_idle = True
            self.progress.say(
                f"{values['idle_steps'] / (self.step - before):.0%} of the steps waited for a fresh start, "
                "because more episodes ended in an unroll than rollout.reserve holds; a larger one avoids it"
            )
        self.run.add_metrics(row)
        self.rows.append(row)
        self.export_if_best()
        return row

    def save(self) -> None:
        """Begins a checkpoint, and writes the policy as it stands."""
        self.note_saved(self.checkpoints.finish())
        score = merit(self.rows)
        self.checkpoints.begin_save(self.step, self.state, None if score is None else score[0])
        self.export(self.run.policy)

    def note_saved(self, step: int | None) -> None:
        """A checkpoint is on disk."""
        if step is not None:
            self.saved_step = step

    def export(self, folder: Path) -> None:
        """Writes the policy as it stands; a reader meets the old one, none, or all of the new one."""
        draft = folder.with_name(f"{folder.name}.unfinished")
        shutil.rmtree(draft, ignore_errors=True)
        self.learner.export(self.state).save(draft)
        shutil.rmtree(folder, ignore_errors=True)
        draft.rename(folder)

    def export_if_best(self) -> None:
        """Writes the policy beside the last one where it has done better than any before."""
        score = merit(self.rows)
        if score is not None and (self.best is None or score > self.best):
            self.best = score
            self.export(self.run.best_policy)

    def kept(self) -> str:
        """What is left if the run ends here and now."""
        if self.saved_step is None:
            return "no checkpoint was saved yet"
        return f"the checkpoint at step {self.saved_step:,} is intact"

    def _ending(self) -> str:
        if self.step >= self.config.steps:
            return f"{self.step:,} steps done"
        return f"success held {self.config.target_success:.0%} at step {self.step:,}"


def holds_target(rows: Sequence[Mapping[str, Any]], target: float | None) -> bool:
    """Whether the success rate of the mean action reached `target` in each of the last epochs."""
    last = [row["success_rate"] for row in rows[-TARGET_EPOCHS:]]
    if target is None or len(last) < TARGET_EPOCHS:
        return False
    return all(rate is not None and rate >= target for rate in last)


def merit(rows: Sequence[Mapping[str, Any]]) -> tuple[float, float] | None:
    """How good the policy is, as far as training tells: success of the mean action, then return, over the
    last epochs; None where one of them has neither."""
    last = [(row["success_rate"], row["episode_return"]) for row in rows[-TARGET_EPOCHS:]]
    if len(last) < TARGET_EPOCHS or any(
        value is None or math.isnan(value) for pair in last for value in pair
    ):
        return None
    success, episode_return = np.mean(last, axis=0)
    return float(success), float(episode_return)


class _Events:
    """TensorBoard events of the metrics; a resumed run replaces what it computes again."""

    def __init__(self, run: Run, step: int) -> None:
        from tensorboardX import SummaryWriter

        self.writer = SummaryWriter(str(run.events), purge_step=step + 1 if step else None)

    def __enter__(self) -> _Events:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.writer.close()

    def add(self, row: Mapping[str, Any]) -> None:
        """One row, under the names that metrics.jsonl has."""
        for name, value in row.items():
            if name != "step" and math.isfinite(value):
                self.writer.add_scalar(name, value, row["step"])


def _recording_meta(learner: Learner, config: RunConfig) -> dict[str, Any]:
    """What every recording of a blown world says of its run."""
    return {
        "environment": config.environment,
        "engine": learner.env.engine_name,
        "seed": config.seed,
        "randomizer": learner.env.randomizer.randomizer.digest,
        "config": config.to_dict(),
    }


def _manifest(learner: Learner, config: RunConfig) -> dict[str, Any]:
    return runs.describe(config, learner.env.engine_name, learner.env.randomizer.randomizer.digest)


def _is_finite(state: TrainingState) -> bool:
    """Whether the networks and the normaliser may be saved."""
    leaves = jax.device_get(jax.tree.leaves((state.params, state.normalizer)))
    return all(np.isfinite(leaf).all() for leaf in leaves)

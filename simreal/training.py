"""The loop around the learner: epochs, metrics, checkpoints, and a clean end however it comes."""

from __future__ import annotations

import contextlib
import errno
import functools
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from simreal import quiet, registry
from simreal.config import RunConfig
from simreal.errors import UserError
from simreal.keeping import Keeper, holds_target, is_finite
from simreal.progress import Progress
from simreal.resuming import check_config
from simreal.runs import Run
from simreal.stopping import Interrupted, StopRequest

if TYPE_CHECKING:
    from simreal.environment import Environment
    from simreal.learner import Learner, TrainingState
    from simreal.population import Population


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
    earlier = _open(config, out) if resume else None
    source = Run.open(from_run) if from_run is not None else None
    learner = build(config)
    run = earlier or Run.create(out, config)
    with StopRequest() as stop, Progress(config.steps) as progress:
        state = learner.init(config.seed)
        keeper = Keeper(run, config, learner.env, learner.export, progress.say)
        state = keeper.resume(state) if earlier is not None else keeper.start(state, source)
        _run(_Alone(learner), state, [keeper], out, stop, progress)
    return out


def train_population(
    configs: Sequence[RunConfig], folders: Sequence[Path], out: Path, resume: bool = False
) -> Path:
    """Trains several runs in one program, each into a folder of its own; see `train`.

    Ends when the steps are done, or when every member holds its `target_success`.

    Args:
        configs: of the members.
        folders: of the members.
        out: the folder above them, for messages.
        resume: go on from the newest checkpoints that all members have.
    """
    quiet.import_mjx()
    from simreal.population import Population, check_members

    check_members(configs)
    earlier = [_open(*pair) for pair in zip(configs, folders, strict=True)] if resume else None
    environments = [make_environment(config) for config in configs]
    population = Population(environments[0], configs, [env.randomizer.ranges for env in environments])
    if earlier is None:
        for folder in folders:
            Run.check_free(folder)
    members = earlier or [Run.create(*pair) for pair in zip(folders, configs, strict=True)]
    with StopRequest() as stop, Progress(configs[0].steps) as progress:
        together = _Together(population)
        state = population.init()
        alone = [together.member(state, i) for i in range(len(configs))]
        keepers = [
            Keeper(run, config, env, functools.partial(population.export, index=i), progress.say, i)
            for i, (run, config, env) in enumerate(zip(members, configs, environments, strict=True))
        ]
        if earlier is None:
            for keeper, own in zip(keepers, alone, strict=True):
                keeper.start(own, None)
        else:
            common = _newest_of_all(keepers, out)
            alone = [keeper.resume(own, common) for keeper, own in zip(keepers, alone, strict=True)]
            state = jax.tree.map(lambda *leaves: jnp.stack(leaves), *alone)
        _run(together, state, keepers, out, stop, progress)
    return out


class _Trainer(Protocol):
    """What the loop drives: one run, or several together."""

    name: str
    engine: str

    def epoch(self, state: Any, keepers: Sequence[Keeper]) -> tuple[Any, list[dict[str, float]]]:
        """An epoch, and the metrics of each member."""

    def member(self, state: Any, index: int) -> Any:
        """The state of one member."""


class _Alone:
    """One run."""

    def __init__(self, learner: Learner) -> None:
        self.learner = learner
        self.name, self.engine = learner.env.name, learner.env.engine_name

    def epoch(self, state: Any, keepers: Sequence[Keeper]) -> tuple[Any, list[dict[str, float]]]:
        state, values = self.learner.epoch(state, keepers[0].recorder.watch)
        return state, [values]

    def member(self, state: Any, index: int) -> Any:
        return state


class _Together:
    """Several runs in one program."""

    def __init__(self, population: Population) -> None:
        self.population = population
        env = population.env
        self.name, self.engine = f"{population.members} x {env.name}", env.engine_name
        self._copied: tuple[Any, Any] = (None, None)

    def epoch(self, state: Any, keepers: Sequence[Keeper]) -> tuple[Any, list[dict[str, float]]]:
        self._copied = (None, None)

        def watch(*seen: Any) -> None:
            for keeper in keepers:
                keeper.recorder.watch(*seen)

        return self.population.epoch(state, watch)

    def member(self, state: TrainingState, index: int) -> TrainingState:
        if self._copied[0] is not state:  # one copy to the host for all members
            self._copied = (state, jax.device_get(state))
        return jax.tree.map(lambda leaf: np.asarray(leaf[index]), self._copied[1])


def _run(
    trainer: _Trainer, state: Any, keepers: Sequence[Keeper], out: Path, stop: StopRequest, progress: Progress
) -> None:
    """Epochs until the steps are done or the target is held; raises Interrupted where it is asked to stop."""
    config = keepers[0].config
    step = int(trainer.member(state, 0).steps)
    began = time.monotonic() - keepers[0].seconds
    saved_at = time.monotonic()
    progress.say(f"training {trainer.name} on {trainer.engine} into {out}; compiling first")

    def save() -> None:
        for keeper in keepers:  # all of the last time are on disk before the first of this time is begun
            keeper.note_saved(wait=True)
        for i, keeper in enumerate(keepers):
            keeper.save(trainer.member(state, i))

    with _told(out, keepers[0]), _closing(keepers, step):
        while step < config.steps and not all(
            holds_target(keeper.rows, keeper.config.target_success) for keeper in keepers
        ):
            start, before = time.monotonic(), step
            state, values = trainer.epoch(state, keepers)
            now = time.monotonic()
            took, wall = now - start, now - began
            alone = [trainer.member(state, i) for i in range(len(keepers))]
            _check_finite(keepers, alone, before)
            rows = [
                keeper.record(alone[i], values[i], before, took, wall) for i, keeper in enumerate(keepers)
            ]
            step = rows[0]["step"]
            progress.show(_overview(rows), last=step >= config.steps)
            stopping = stop.asked  # read once: a signal may come at any time
            if stopping or time.monotonic() - saved_at >= config.checkpoint.every_seconds:
                save()
                saved_at = time.monotonic()
            if stopping:
                for keeper in keepers:
                    keeper.note_saved(wait=True)
                raise Interrupted(
                    f"interrupted; step {step:,} is saved, the same command with --resume --out {out} goes on"
                )
        # Always: a run that was killed between its last checkpoint and the export has an older policy.
        save()
    done = f"{step:,} steps done"
    if step < config.steps:
        done = f"success held {config.target_success:.0%} at step {step:,}"
    holds = "holds the policy" if isinstance(trainer, _Alone) else f"holds {len(keepers)} run folders"
    progress.say(f"{done}; {out} {holds}")


@contextlib.contextmanager
def _closing(keepers: Sequence[Keeper], step: int) -> Iterator[None]:
    """Opens what the keepers write to, and closes it in the end."""
    with contextlib.ExitStack() as stack:
        for keeper in keepers:
            keeper.open_events(step)
            stack.callback(keeper.close)
        yield


@contextlib.contextmanager
def _told(out: Path, keeper: Keeper) -> Iterator[None]:
    """Turns a full disk into one line."""
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise UserError(f"{out}: {error.strerror}; {keeper.kept()}") from error


def _overview(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """One row for the progress line: means over the members."""
    if len(rows) == 1:
        return rows[0]
    mean = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    return mean | {"step": rows[0]["step"], "quarantined": sum(row["quarantined"] for row in rows)}


def _open(config: RunConfig, folder: Path) -> Run:
    """A run that is to be resumed with this configuration."""
    run = Run.open(folder)
    check_config(run.config(), config, folder)
    return run


def _newest_of_all(keepers: Sequence[Keeper], out: Path) -> int | None:
    """The newest step at which every member has a sound checkpoint; None where no member has any.

    Raises:
        UserError: some have checkpoints, but there is no step at which all do.
    """
    sound = [keeper.checkpoints.sound_steps() for keeper in keepers]
    common = set.intersection(*(set(steps) for steps in sound))
    if not common and any(sound):
        raise UserError(
            f"--resume: there is no step at which all {len(keepers)} members in {out} have a checkpoint; "
            f"each can be resumed alone, with --resume --out {keepers[0].run.folder} and so on"
        )
    return max(common, default=None)


def _check_finite(keepers: Sequence[Keeper], states: Sequence[TrainingState], before: int) -> None:
    """Raises UserError where a member's parameters are no longer finite; the others are saved first."""
    fine = [is_finite(state) for state in states]
    if all(fine):
        return
    for keeper, state, good in zip(keepers, states, fine, strict=True):
        keeper.note_saved(wait=True)
        if good:
            keeper.save(state)
            keeper.note_saved(wait=True)
    broken = keepers[fine.index(False)]
    alone = "" if len(keepers) == 1 else "; the other members are saved, and can be resumed each alone"
    raise UserError(
        f"{broken.run.folder}: parameters are no longer finite after step {before:,}; {broken.kept()}; "
        f"a lower learner.learning_rate or learner.max_gradient_norm may help{alone}"
    )

"""`simreal replay`: runs a world that blew up again, and shows it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np

from simreal import registry
from simreal.config_files import build_config
from simreal.environment import Environment, State
from simreal.errors import UserError
from simreal.quarantine import Recording

Say = Callable[[str], None]
SHOWN = 8
"""Factors named, the most extreme ones first; steps shown before the end."""


@dataclass(frozen=True)
class Replay:
    """What the recorded actions lead to. Leaves have a row for each action until the world blew up again."""

    qpos: np.ndarray  # (n + 1, nq), the first before the first action
    qvel: np.ndarray  # (n + 1, nv)
    tasks: object  # the environment's task, leaves (n + 1, ...)
    blew_up: int | None  # index of the action that it blew up under
    exact: bool
    """Whether every state is bit for bit the recorded one."""


def environment_of(recording: Recording, file: Path, engine: str | None = None) -> Environment:
    """The environment that a recording was made in, on the engine it was made on or on another.

    Raises:
        UserError: no such environment, or its training ranges are no longer those of the recording.
    """
    config = build_config(recording.meta["config"], str(file))
    training = registry.environment_class(config.environment).training.with_ranges(config.randomizer)
    env = registry.make(config.environment, engine=engine or recording.meta["engine"], randomizer=training)
    if env.randomizer.randomizer.digest != recording.meta["randomizer"]:
        raise UserError(
            f"{file}: the training ranges of {config.environment} have changed since it was written"
        )
    return env


def replay(env: Environment, recording: Recording) -> Replay:
    """Steps the recorded world with the recorded actions, until it blows up or they end."""
    from simreal.compilation import for_short_use

    step = jax.jit(env.step, compiler_options=for_short_use(env.engine_name))
    state: State = recording.state(env)
    states, blew_up = [state], None
    for i, action in enumerate(recording.actions):
        state = step(state, action)
        states.append(state)
        if state.info["diverged"] > 0:
            blew_up = i
            break
    qpos, qvel = (
        np.stack([np.asarray(getattr(s.physics, name)) for s in states]) for name in ("qpos", "qvel")
    )
    again = len(states) - 1
    exact = all(
        np.array_equal(ours[1:], theirs[:again], equal_nan=True)
        for ours, theirs in ((qpos, recording.qpos), (qvel, recording.qvel))
    )
    tasks = jax.tree.map(lambda *x: np.stack([np.asarray(leaf) for leaf in x]), *[s.task for s in states])
    return Replay(qpos, qvel, tasks, blew_up, exact and blew_up == len(recording.actions) - 1)


def show(file: Path, engine: str | None, out: Path | None, say: Say) -> Path | None:
    """Replays a file, says what happened, and films it; returns the film, or None where nothing can draw.

    Raises:
        UserError: the file or the engine is not usable.
    """
    from simreal.evaluation.film import Episode, film
    from simreal.video import RenderingUnavailable

    recording = Recording.load(file)
    env = environment_of(recording, file, engine)
    again = replay(env, recording)
    for line in describe(env, recording, again):
        say(line)
    folder = out or file.parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
        drawn = np.isfinite(again.qpos).all(axis=1)
        episode = Episode(again.qpos[drawn], jax.tree.map(lambda x: x[drawn], again.tasks), success=False)
        path = film(env, episode, folder, f"{file.stem}-{env.engine_name}")
    except RenderingUnavailable as error:
        say(f"no pictures: {error}")
        return None
    except OSError as error:
        raise UserError(f"{folder}: {error.strerror}") from error
    say(f"film: {path}")
    return path


def describe(env: Environment, recording: Recording, again: Replay) -> list[str]:
    """What the world was, what was recorded, and what the replay did."""
    meta, dt, n = recording.meta, env.control_dt, len(recording.actions)
    lines = [
        f"{meta['environment']}, seed {meta['seed']}, world {meta['world']} at {meta['training_step']:,} "
        f"training steps: blew up on {meta['engine']} {recording.age[-1] * dt:.2f} s into its episode; "
        f"recorded from {(recording.age[0] - 1) * dt:.2f} s on ({n} actions)"
    ]
    state = recording.state(env)
    extreme = sorted(_normalized(env, state).items(), key=lambda item: -abs(item[1]))
    named = [f"{name} {_short(state.world.draws[name])} ({where:+.2f})" for name, where in extreme[:SHOWN]]
    lines.append(
        f"draws, the most extreme first (-1 and 1 are the range's ends): {', '.join(named) or 'none'}"
    )
    if again.blew_up is None:
        lines.append(f"on {env.engine_name} all {n} actions went well")
    else:
        same = "; every state is bit for bit the recorded one" if again.exact else ""
        earlier = (n - 1 - again.blew_up) * dt
        when = f"{earlier:.2f} s earlier" if earlier else "at the same step"
        lines.append(f"on {env.engine_name} it blew up again, {when}{same}")
    lines.append("     time      largest speed    (rad/s or m/s, before the last step)")
    last = len(again.qvel) - 1
    for row in range(max(0, last - SHOWN), last + 1):
        time = (recording.age[0] - 1 + row) * dt
        lines.append(f"  {time:6.2f} s   {np.abs(again.qvel[row]).max():14.6g}")
    return lines


def _normalized(env: Environment, state: State) -> dict[str, float]:
    """Each factor's draw in [-1, 1], of several elements the one farthest out."""
    values, found, at = np.asarray(state.world.normalized), {}, 0
    for name in env.randomizer.draw_distributions:
        size = state.world.draws[name].size
        part = values[at : at + size]
        found[name] = float(part[np.argmax(np.abs(part))])
        at += size
    return found


def _short(draw: object) -> str:
    values = np.asarray(draw).reshape(-1)
    return f"{values[0]:.4g}" if values.size == 1 else f"[{', '.join(f'{v:.3g}' for v in values)}]"

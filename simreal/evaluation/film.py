"""Pictures of a policy at work: one episode in one world, as an animation and as a sheet of stills."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from simreal.compilation import for_rare_use, for_short_use
from simreal.environment import Environment
from simreal.evaluation.evaluator import POLICY_KEY, Draws, PolicyLike

FRAMES_PER_SECOND = 12.5
STILLS = 12


@dataclass(frozen=True)
class Episode:
    """What one episode looked like, a row per control step."""

    qpos: np.ndarray  # (steps, nq)
    tasks: Any  # the environment's task, leaves (steps, ...)
    success: bool


def record(env: Environment, policy: PolicyLike, draws: Draws, index: int, seed: int) -> Episode:
    """The episode that the evaluator ran in world `index` of a set with these draws."""
    world = env.randomizer.build({name: jnp.asarray(value[index]) for name, value in draws.items()})
    key = jax.random.fold_in(jax.random.PRNGKey(seed), index)
    reset = jax.jit(lambda key, world: env.reset(key, world=world), compiler_options=for_rare_use())
    step = jax.jit(env.step, compiler_options=for_short_use(env.engine_name))

    @jax.jit
    def act(state: Any, memory: Any) -> tuple[Any, Any]:
        return policy(state.obs, memory, jax.random.fold_in(state.key, POLICY_KEY))

    state, memory = reset(key, world), policy.initial_state()
    qpos, tasks = [state.physics.qpos], [state.task]
    while not state.done:
        action, memory = act(state, memory)
        state = step(state, action)
        qpos.append(state.physics.qpos)
        tasks.append(state.task)
    rows = jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *tasks)
    return Episode(np.stack([np.asarray(q) for q in qpos]), rows, bool(state.info["success"] > 0))


def film(env: Environment, episode: Episode, folder: Path, name: str) -> Path:
    """Writes `name`.webp (real time) and `name`_stills.png into `folder`; returns the animation's path.

    Raises:
        RenderingUnavailable: no OpenGL works here.
    """
    from simreal.video import add_sphere, contact_sheet, render

    every = max(1, round(1 / (FRAMES_PER_SECOND * env.control_dt)))
    shown = np.arange(0, len(episode.qpos), every)
    model = env.render_model()

    def decorate(scene: Any, frame: int) -> None:
        task = jax.tree.map(lambda leaf: leaf[shown[frame]], episode.tasks)
        for position, radius in env.markers(task):
            add_sphere(scene, position, radius)

    camera = env.camera(model)
    labels = [f"{i * env.control_dt:.1f} s" for i in shown]
    qpos = episode.qpos[shown]
    contact_sheet(
        model, qpos, folder / f"{name}_stills.png", STILLS, camera=camera, geoms=decorate, labels=labels
    )
    return render(model, qpos, folder / f"{name}.webp", 1 / (every * env.control_dt), camera, geoms=decorate)

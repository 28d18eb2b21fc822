"""A simreal environment as a Brax environment, for training functions that know nothing of simreal."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from simreal.environment import Environment, State
from simreal.quiet import import_mjx

import_mjx()  # brax imports it too, and would print about Warp

# ruff: noqa: E402
from brax.envs import base


class BraxEnv(base.Env):
    """Wraps an environment; `reset` draws a World each time it is called.

    `done` reports failure only: Brax's own `EpisodeWrapper` keeps the time, so train with
    `episode_length=env.episode_steps`. Brax's `AutoResetWrapper` starts every later episode from the first
    one's state, and so in the first one's World; simreal's own rollout does not.

    Args:
        env: the simreal environment.
        privileged: whether observations are {"state", "privileged_state"} instead of what the policy sees.
    """

    def __init__(self, env: Environment, privileged: bool = False) -> None:
        self.env = env
        self.privileged = privileged

    def reset(self, rng: jax.Array) -> base.State:
        return self._wrap(self.env.reset(rng), {})

    def step(self, state: base.State, action: jax.Array) -> base.State:
        return self._wrap(self.env.step(state.pipeline_state, action), state.info, state.metrics)

    def _wrap(self, inner: State, info: dict[str, Any], metrics: dict[str, Any] | None = None) -> base.State:
        obs: Any = inner.obs
        if self.privileged:
            obs = {"state": inner.obs, "privileged_state": inner.privileged}
        own = {**inner.metrics, "success": inner.info["success"]}
        return base.State(
            pipeline_state=inner,
            obs=obs,
            reward=inner.reward,
            done=jnp.maximum(inner.info["failed"], inner.info["diverged"]),
            metrics={**(metrics or {}), **own},
            info=info,
        )

    @property
    def observation_size(self) -> base.ObservationSize:
        if not self.privileged:
            return self.env.observation_size
        shape = jax.eval_shape(self.env.reset, jax.random.PRNGKey(0))
        return {"state": shape.obs.shape, "privileged_state": shape.privileged.shape}

    @property
    def action_size(self) -> int:
        return self.env.action_size

    @property
    def backend(self) -> str:
        return self.env.engine_name

    @property
    def dt(self) -> float:
        """Control period (s)."""
        return self.env.control_dt

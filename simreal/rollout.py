"""B worlds side by side, each episode in a world of its own.

A reset is expensive beside a step (a World is built, its derived constants computed), so its cost follows
the number of episodes that end: at most `capacity` worlds are reset in one pass, and passes repeat while any
wait.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct

from simreal.environment import Environment, State
from simreal.randomizer import Ranges
from simreal.world import World

DrawWorld = Callable[[jax.Array, Ranges], World]

_RESET, _STAGGER = 1, 2  # folded into a world's own key, so that no key serves two uses


@struct.dataclass
class RolloutState:
    """All worlds between two control steps."""

    env: State  # every leaf (B, ...)
    episode_return: jax.Array  # (B,) sum of rewards so far
    started: jax.Array  # (B,) bool, False until the first reset
    counted: jax.Array  # (B,) bool, False during a staggered first episode, whose length says nothing


@struct.dataclass
class Ended:
    """The episodes that ended in one step; leaves (B,). Meaningful where `done`."""

    done: jax.Array  # bool, counted episodes only
    episode_return: jax.Array
    success: jax.Array
    diverged: jax.Array


class Rollout:
    """Steps B worlds and renews those whose episode is over.

    Args:
        env: the environment.
        worlds: B.
        capacity: worlds reset in one pass; None chooses from B and the episode length.
        stagger: whether first episodes begin at different ages, so that time limits do not come all at once.
        draw_world: (key, ranges) -> World; default: drawn from the randomizer.
    """

    def __init__(
        self,
        env: Environment,
        worlds: int,
        capacity: int | None = None,
        stagger: bool = True,
        draw_world: DrawWorld | None = None,
    ) -> None:
        self.env = env
        self.worlds = worlds
        self.capacity = min(worlds, capacity or max(4, math.ceil(2 * worlds / env.episode_steps)))
        self.stagger = stagger
        builder = env.randomizer
        self.draw_world = draw_world or (lambda key, ranges: builder.build(builder.sample(key, ranges)))

    def start(self, key: jax.Array) -> RolloutState:
        """B worlds that wait for their first reset, which the first `renew` gives them."""
        shape = jax.eval_shape(self.env.reset, key)
        env = jax.tree.map(lambda leaf: jnp.zeros((self.worlds, *leaf.shape), leaf.dtype), shape)
        env = dataclasses.replace(env, key=jax.random.split(key, self.worlds), done=jnp.ones_like(env.done))
        no = jnp.zeros(self.worlds, bool)
        return RolloutState(env, jnp.zeros_like(env.reward), started=no, counted=no)

    def renew(self, state: RolloutState, ranges: Ranges) -> RolloutState:
        """Resets every world whose episode is over into a fresh World and a fresh start state."""

        def waiting(carry: tuple[RolloutState, jax.Array]) -> jax.Array:
            return jnp.any(carry[1])

        def one_pass(carry: tuple[RolloutState, jax.Array]) -> tuple[RolloutState, jax.Array]:
            state, done = carry
            (rows,) = jnp.nonzero(done, size=self.capacity, fill_value=self.worlds)
            fresh = jax.vmap(self._fresh, in_axes=(0, 0, None))(
                state.env.key[rows], state.started[rows], ranges
            )
            state = jax.tree.map(lambda old, new: old.at[rows].set(new, mode="drop"), state, fresh)
            return state, done.at[rows].set(False, mode="drop")

        return jax.lax.while_loop(waiting, one_pass, (state, state.env.done > 0))[0]

    def _fresh(self, key: jax.Array, started: jax.Array, ranges: Ranges) -> RolloutState:
        world_key, start_key = jax.random.split(jax.random.fold_in(key, _RESET))
        env = self.env.reset(start_key, world=self.draw_world(world_key, ranges))
        counted = started | (not self.stagger)
        age = jax.random.randint(jax.random.fold_in(key, _STAGGER), (), 0, self.env.episode_steps)
        env = dataclasses.replace(env, steps=jnp.where(counted, env.steps, age))
        return RolloutState(env, jnp.zeros_like(env.reward), started=jnp.ones((), bool), counted=counted)

    def step(self, state: RolloutState, action: jax.Array) -> tuple[RolloutState, Ended]:
        """One control step of all worlds; `renew` first. `state.env.obs` is then the final observation of
        those whose episode ended.

        Args:
            state: all worlds, none of them done.
            action: (B, actions).
        """
        env = jax.vmap(self.env.step)(state.env, action)
        episode_return = state.episode_return + env.reward
        ended = Ended(
            done=(env.done > 0) & state.counted,
            episode_return=episode_return,
            success=env.info["success"],
            diverged=env.info["diverged"],
        )
        return dataclasses.replace(state, env=env, episode_return=episode_return), ended

"""B worlds side by side, each episode in a world of its own.

A reset is expensive beside a step (a World is built, its derived constants computed, the engine asked for
what can be read), and most of it is the price of the call, not of the world. So fresh starts are made
`RESERVE` at a time and handed out as episodes end; the next batch is made when the last is used up. The cost
follows the number of episodes that end.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from simreal.environment import Environment, State
from simreal.randomizer import Ranges
from simreal.world import World

DrawWorld = Callable[[jax.Array, Ranges], World]

RESERVE = 64
"""Fresh starts that are made together."""

_STAGGER = 0x737467
"""Folded into a world's key; small numbers would give keys that the environment's split uses."""


@struct.dataclass
class RolloutState:
    """All worlds between two control steps."""

    env: State  # every leaf (B, ...)
    episode_return: jax.Array  # (B,) sum of rewards so far
    started: jax.Array  # (B,) bool, False until the first reset
    counted: jax.Array  # (B,) bool, False during a staggered first episode, whose length says nothing
    reserve: State  # fresh starts, every leaf (RESERVE, ...)
    left: jax.Array  # () int32, how many of them are not used yet
    key: jax.Array  # (2,) uint32, of the next fresh starts


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
        capacity: worlds renewed in one pass; None chooses from B and the episode length. Passes repeat
            while any world waits.
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
        wanted = capacity or max(4, math.ceil(2 * worlds / env.episode_steps))
        self.capacity = min(worlds, wanted, RESERVE)
        self.stagger = stagger
        builder = env.randomizer
        self.draw_world = draw_world or (lambda key, ranges: builder.build(builder.sample(key, ranges)))

    def start(self, key: jax.Array) -> RolloutState:
        """B worlds that wait for their first reset, which the first `renew` gives them."""
        shape = jax.eval_shape(self.env.reset, key)

        def empty(rows: int) -> State:
            return jax.tree.map(lambda leaf: jnp.zeros((rows, *leaf.shape), leaf.dtype), shape)

        env = empty(self.worlds)
        return RolloutState(
            env=dataclasses.replace(env, done=jnp.ones_like(env.done)),
            episode_return=jnp.zeros_like(env.reward),
            started=jnp.zeros(self.worlds, bool),
            counted=jnp.zeros(self.worlds, bool),
            reserve=empty(RESERVE),
            left=jnp.zeros((), jnp.int32),
            key=key,
        )

    def renew(self, state: RolloutState, ranges: Ranges) -> RolloutState:
        """Gives every world whose episode is over a fresh World and a fresh start state."""

        def waiting(state: RolloutState) -> jax.Array:
            return jnp.any(state.env.done > 0)

        def one_pass(state: RolloutState) -> RolloutState:
            state = jax.lax.cond(state.left == 0, lambda s: self._fill(s, ranges), lambda s: s, state)
            return self._hand_out(state)

        return jax.lax.while_loop(waiting, one_pass, state)

    def _fill(self, state: RolloutState, ranges: Ranges) -> RolloutState:
        """Makes RESERVE fresh starts."""

        def fresh(key: jax.Array) -> State:
            world_key, start_key = jax.random.split(key)
            return self.env.reset(start_key, world=self.draw_world(world_key, ranges))

        key, fill_key = jax.random.split(state.key)
        reserve = jax.vmap(fresh)(jax.random.split(fill_key, RESERVE))
        return dataclasses.replace(state, reserve=reserve, left=jnp.asarray(RESERVE, jnp.int32), key=key)

    def _hand_out(self, state: RolloutState) -> RolloutState:
        """Starts the first worlds that wait, `capacity` of them or as many as are in reserve."""
        order = np.arange(self.capacity)
        (rows,) = jnp.nonzero(state.env.done > 0, size=self.capacity, fill_value=self.worlds)
        rows = jnp.where(order < state.left, rows, self.worlds)  # out of bounds: dropped
        slots = jnp.maximum(state.left - 1 - order, 0)
        env = jax.tree.map(lambda leaf: leaf[slots], state.reserve)

        counted = state.started[rows] | (not self.stagger)
        age_keys = jax.vmap(jax.random.fold_in, in_axes=(0, None))(env.key, _STAGGER)
        age = jax.vmap(lambda key: jax.random.randint(key, (), 0, self.env.episode_steps))(age_keys)
        env = dataclasses.replace(env, steps=jnp.where(counted, env.steps, age))

        def put(old: jax.Array, new: jax.Array | float | bool) -> jax.Array:
            return old.at[rows].set(new, mode="drop")

        return dataclasses.replace(
            state,
            env=jax.tree.map(put, state.env, env),
            episode_return=put(state.episode_return, 0.0),
            started=put(state.started, True),
            counted=put(state.counted, counted),
            left=state.left - jnp.sum(rows < self.worlds, dtype=jnp.int32),
        )

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

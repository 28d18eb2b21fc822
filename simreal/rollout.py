"""B worlds side by side, each episode in a world of its own.

A reset is expensive beside a step (a World is built, its derived constants computed, the engine asked for
what can be read), and most of it is the price of the call, not of the world. So fresh starts are kept in a
reserve: `refill` makes them, `BATCH` at a time, between unrolls; `renew` hands them out as episodes end. The
cost follows the number of episodes that end, and the program that steps the worlds contains no reset.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from simreal.environment import Environment, State
from simreal.randomizer import Ranges
from simreal.world import World

DrawWorld = Callable[[jax.Array, Ranges], World]

BATCH = 64
"""Fresh starts that are made together."""

_STAGGER = 0x737467
"""Folded into a world's key; small numbers would give keys that the environment's split uses."""


@struct.dataclass
class Reserve:
    """Fresh starts in a ring: the oldest is used first."""

    starts: State  # every leaf (size, ...)
    first: jax.Array  # () int32, where the oldest one is
    left: jax.Array  # () int32, how many are not used yet
    key: jax.Array  # (2,) uint32, of the next ones


@struct.dataclass
class RolloutState:
    """All worlds between two control steps."""

    env: State  # every leaf (B, ...)
    episode_return: jax.Array  # (B,) sum of rewards so far
    started: jax.Array  # (B,) bool, False until the first reset
    counted: jax.Array  # (B,) bool, False during a staggered first episode, whose length says nothing
    origin: jax.Array  # (B,) int32, place in the reserve that the episode was started from
    memory: Any  # leaves (B, ...), what a policy remembers of the episode; the rollout only empties it
    reserve: Reserve


@struct.dataclass
class Ended:
    """The episodes that ended in one step; leaves (B,). Meaningful where `done`."""

    done: jax.Array  # bool, counted episodes only
    episode_return: jax.Array
    success: jax.Array
    idle: jax.Array  # bool, worlds that waited for a fresh start
    quarantined: jax.Array  # bool, worlds whose physics blew up: their episode is over, and not counted


@struct.dataclass
class Flight:
    """What all worlds did in one step, to look at where one blew up; leaves (B, ...)."""

    age: jax.Array  # int32, control steps of the episode, after the step
    origin: jax.Array  # int32, see RolloutState
    action: jax.Array  # (B, actions), before it was clipped
    qpos: jax.Array  # (B, nq) after the step
    qvel: jax.Array  # (B, nv)
    quarantined: jax.Array  # bool


class Rollout:
    """Steps B worlds and renews those whose episode is over.

    Only where more episodes end than the reserve holds does a world wait for the next `refill`; what it does
    meanwhile is marked as truncated, without reward, and so counts for nothing.

    Args:
        env: the environment.
        worlds: B.
        capacity: worlds renewed in one pass; None chooses from B and the episode length. Passes repeat
            while any world waits and the reserve lasts.
        reserve: fresh starts kept ready, rounded up to a multiple of BATCH; default: one for each world.
        stagger: whether first episodes begin at different ages, so that time limits do not come all at once.
        draw_world: (key, ranges) -> World; default: drawn from the randomizer.
        memory: a policy's memory at the start of an episode, all zeros.
    """

    def __init__(
        self,
        env: Environment,
        worlds: int,
        capacity: int | None = None,
        reserve: int | None = None,
        stagger: bool = True,
        draw_world: DrawWorld | None = None,
        memory: Any = (),
    ) -> None:
        self.env = env
        self.memory = memory
        self.worlds = worlds
        wanted = capacity or max(4, math.ceil(2 * worlds / env.episode_steps))
        self.capacity = min(worlds, wanted)
        self.reserve = BATCH * math.ceil((reserve or worlds) / BATCH)
        self.stagger = stagger
        builder = env.randomizer
        self.draw_world = draw_world or (
            lambda key, ranges: builder.build(builder.sample(key, ranges), ranges)
        )

    def start(self, key: jax.Array) -> RolloutState:
        """B worlds that wait for their first reset, which `refill` and `renew` give them."""
        shape = jax.eval_shape(self.env.reset, key)

        def empty(rows: int) -> State:
            return jax.tree.map(lambda leaf: jnp.zeros((rows, *leaf.shape), leaf.dtype), shape)

        env, none = empty(self.worlds), jnp.zeros((), jnp.int32)
        return RolloutState(
            env=dataclasses.replace(env, done=jnp.ones_like(env.done)),
            episode_return=jnp.zeros_like(env.reward),
            started=jnp.zeros(self.worlds, bool),
            counted=jnp.zeros(self.worlds, bool),
            origin=jnp.zeros(self.worlds, jnp.int32),
            memory=jax.tree.map(lambda leaf: jnp.zeros((self.worlds, *leaf.shape), leaf.dtype), self.memory),
            reserve=Reserve(starts=empty(self.reserve), first=none, left=none, key=key),
        )

    def refill(self, reserve: Reserve, ranges: Ranges) -> Reserve:
        """Makes fresh starts, each in a World of its own, until no more fit."""

        def fresh(key: jax.Array) -> State:
            world_key, start_key = jax.random.split(key)
            return self.env.reset(start_key, world=self.draw_world(world_key, ranges))

        def fits(reserve: Reserve) -> jax.Array:
            return reserve.left + BATCH <= self.reserve

        def fill(reserve: Reserve) -> Reserve:
            key, fill_key = jax.random.split(reserve.key)
            made = jax.vmap(fresh)(jax.random.split(fill_key, BATCH))
            # The place of the next ones is a multiple of BATCH from the beginning, so that they lie together.
            place = (reserve.first + reserve.left) % self.reserve
            starts = jax.tree.map(
                lambda all_, new: jax.lax.dynamic_update_slice_in_dim(all_, new, place, 0),
                reserve.starts,
                made,
            )
            return Reserve(starts=starts, first=reserve.first, left=reserve.left + BATCH, key=key)

        return jax.lax.while_loop(fits, fill, reserve)

    def renew(self, state: RolloutState) -> RolloutState:
        """Gives every world whose episode is over a fresh World and a fresh start, while there are any."""

        def waiting(state: RolloutState) -> jax.Array:
            return jnp.any(state.env.done > 0) & (state.reserve.left > 0)

        return jax.lax.while_loop(waiting, self._hand_out, state)

    def _hand_out(self, state: RolloutState) -> RolloutState:
        """Starts the first worlds that wait, `capacity` of them or as many as are in reserve."""
        reserve, order = state.reserve, np.arange(self.capacity)
        (rows,) = jnp.nonzero(state.env.done > 0, size=self.capacity, fill_value=self.worlds)
        rows = jnp.where(order < reserve.left, rows, self.worlds)  # out of bounds: dropped
        places = ((reserve.first + order) % self.reserve).astype(jnp.int32)
        env = jax.tree.map(lambda leaf: leaf[places], reserve.starts)

        counted = state.started[rows] | (not self.stagger)
        age_keys = jax.vmap(jax.random.fold_in, in_axes=(0, None))(env.key, _STAGGER)
        age = jax.vmap(lambda key: jax.random.randint(key, (), 0, self.env.episode_steps))(age_keys)
        env = dataclasses.replace(env, steps=jnp.where(counted, env.steps, age))

        def put(old: jax.Array, new: jax.Array | float | bool) -> jax.Array:
            return old.at[rows].set(new, mode="drop")

        used = jnp.sum(rows < self.worlds, dtype=jnp.int32)
        return dataclasses.replace(
            state,
            env=jax.tree.map(put, state.env, env),
            episode_return=put(state.episode_return, 0.0),
            started=put(state.started, True),
            counted=put(state.counted, counted),
            origin=put(state.origin, places),
            memory=jax.tree.map(lambda leaf: put(leaf, 0), state.memory),
            reserve=dataclasses.replace(
                reserve, first=(reserve.first + used) % self.reserve, left=reserve.left - used
            ),
        )

    def step(self, state: RolloutState, action: jax.Array) -> tuple[RolloutState, Ended, Flight]:
        """One control step of all worlds; `renew` first. `state.env.obs` is then the final observation of
        those whose episode ended.

        A world that blew up is marked as truncated, not as failed: its physics is no experience, and what it
        did before is learnt from with the value of where it was.

        Args:
            state: all worlds.
            action: (B, actions).
        """
        idle = state.env.done > 0
        env = jax.vmap(self.env.step)(state.env, action)
        quarantined = (env.info["diverged"] > 0) & ~idle
        unreal = idle | quarantined
        env = dataclasses.replace(
            env,
            reward=jnp.where(idle, 0, env.reward),
            done=jnp.where(idle, 1, env.done),
            info=env.info | {"truncation": jnp.where(unreal, 1, env.info["truncation"])},
        )
        episode_return = state.episode_return + env.reward
        ended = Ended(
            done=(env.done > 0) & state.counted & ~unreal,
            episode_return=episode_return,
            success=env.info["success"],
            idle=idle,
            quarantined=quarantined,
        )
        flight = Flight(
            age=env.steps,
            origin=state.origin,
            action=action,
            qpos=env.physics.qpos,
            qvel=env.physics.qvel,
            quarantined=quarantined,
        )
        return dataclasses.replace(state, env=env, episode_return=episode_return), ended, flight

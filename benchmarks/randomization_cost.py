"""What fresh worlds cost: steps/s where everything varies, against nominal worlds and a cached reset.

Both sides have the same actuators and sensors. Actions are small noise about zero, so that episodes end by
their time limit, staggered over the worlds. A factor that adds work to the physics itself shows here too: dry
friction in the Go2's joints, zero in the nominal model, gives the solver twelve more constraints. The line
"without" leaves it out on both sides.

Run it with `python benchmarks/randomization_cost.py [environment:engine[:factor left out] ...]`.
"""

from __future__ import annotations

import dataclasses
import sys

import jax
import jax.numpy as jnp
import numpy as np
from timing import interleaved, machine

import simreal
from simreal.registry import environment_class
from simreal.rollout import Reserve, Rollout, RolloutState

WORLDS = 512
DEFAULT = (
    "go2_walk:mujoco",
    "arm_reach:mujoco",
    "arm_reach:mjx",
    "cartpole_swingup:mujoco",
    "cartpole_swingup:mjx",
)


class CachedRollout(Rollout):
    """Every world starts again from its first state: what a rollout without randomisation may do."""

    def refill(self, reserve: Reserve, ranges) -> Reserve:
        return reserve

    def renew(self, state: RolloutState) -> RolloutState:
        done = state.env.done > 0

        def choose(now, first):
            return jnp.where(done.reshape((-1,) + (1,) * (now.ndim - 1)), first, now)

        # The noise goes on; all else is as at the first start.
        first = dataclasses.replace(self.first.env, key=state.env.key)
        env = jax.tree.map(choose, state.env, first)
        return dataclasses.replace(state, env=env, episode_return=jnp.where(done, 0, state.episode_return))


def caller(rollout: Rollout, steps: int):
    """A call that steps the worlds on by `steps` from where the last call left them."""
    ranges = rollout.env.randomizer.ranges

    @jax.jit
    def run(state, key):
        state = dataclasses.replace(state, reserve=rollout.refill(state.reserve, ranges))

        def one(state, key):
            state = rollout.renew(state)
            action = 0.05 * jax.random.normal(key, (rollout.worlds, rollout.env.action_size))
            state, _, _ = rollout.step(state, action)
            return state, None

        return jax.lax.scan(one, state, jax.random.split(key, steps))[0]

    holder = {"state": None, "key": jax.random.PRNGKey(1)}

    def call():
        holder["key"], key = jax.random.split(holder["key"])
        holder["state"] = run(holder["state"], key)
        return holder["state"].episode_return

    return holder, call


def compare(name: str, engine: str, without: str = "", pairs: int = 15) -> float:
    training = environment_class(name).training
    randomizer = training.replace(**{without: None}) if without else training
    env = simreal.make(name, engine=engine, randomizer=randomizer)
    steps = max(20, env.episode_steps // 10)
    fresh = Rollout(env, WORLDS)
    nominal = CachedRollout(env, WORLDS, draw_world=lambda key, ranges: env.randomizer.build({}))
    fresh_holder, fresh_call = caller(fresh, steps)
    fresh_holder["state"] = fresh.start(jax.random.PRNGKey(0))
    nominal_holder, nominal_call = caller(nominal, steps)

    @jax.jit
    def begin(state):
        reserve = Rollout.refill(nominal, state.reserve, env.randomizer.ranges)
        return Rollout.renew(nominal, dataclasses.replace(state, reserve=reserve))

    started = begin(nominal.start(jax.random.PRNGKey(0)))
    nominal.first = started.replace(env=started.env.replace(steps=jnp.zeros_like(started.env.steps)))
    nominal_holder["state"] = started
    times = interleaved(fresh_call, nominal_call, pairs)
    speeds = WORLDS * steps / times
    ratio = float(np.median(speeds[:, 0] / speeds[:, 1]))
    fast, slow = np.median(speeds, axis=0)
    what = f"{name} {engine}" + (f" without {without}" if without else "")
    print(
        f"{what:46s} fresh {fast:9,.0f} steps/s   nominal, cached {slow:9,.0f} steps/s   ratio {ratio:.3f}",
        flush=True,
    )
    return ratio


if __name__ == "__main__":
    print(machine())
    for case in sys.argv[1:] or DEFAULT:
        compare(*case.split(":"))

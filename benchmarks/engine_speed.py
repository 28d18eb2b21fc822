"""Physics steps per second of the two engines on one environment, interleaved, with the time to compile.

Run it with `python benchmarks/engine_speed.py [environment] [worlds]`.
"""

from __future__ import annotations

import sys

import jax
import jax.numpy as jnp
import numpy as np
from timing import interleaved, machine, seconds

import simreal
from simreal.engines import Inputs


def program(name: str, engine: str, worlds: int, control_steps: int):
    """A jitted scan of bare physics in drawn worlds, the seconds that its first call took, and its steps."""
    env = simreal.make(name, engine=engine)
    build = jax.jit(jax.vmap(lambda key: env.randomizer.build(env.randomizer.sample(key))))
    drawn = build(jax.random.split(jax.random.PRNGKey(0), worlds))
    qpos, qvel, _ = jax.vmap(env.start)(jax.random.split(jax.random.PRNGKey(1), worlds))
    physics = jax.vmap(env.engine.initial)(qpos, qvel)
    controls = jnp.broadcast_to(env.control(jnp.zeros(env.action_size)), (worlds, 1, env.action_size))

    @jax.jit
    def run(drawn, physics):
        def step(physics, _):
            inputs = Inputs(controls=controls, limits={})
            return jax.vmap(env.engine.step)(drawn, physics, inputs)[0], None

        return jax.lax.scan(step, physics, length=control_steps)[0]

    def call():
        return run(drawn, physics)

    return call, seconds(call), env.substeps * control_steps * worlds


def main(name: str = "go2_walk", worlds: int = 256, pairs: int = 5) -> float:
    fast, fast_compile, fast_steps = program(name, "mujoco", worlds, 20)
    slow, slow_compile, slow_steps = program(name, "mjx", worlds, 4)
    times = interleaved(fast, slow, pairs)
    speeds = np.array([fast_steps, slow_steps]) / times
    ratio = float(np.median(speeds[:, 0] / speeds[:, 1]))
    print(machine())
    print(f"{name}, {worlds} worlds, physics steps/s (median of {pairs} interleaved pairs)")
    print(f"  mujoco {np.median(speeds[:, 0]):12,.0f}   first call {fast_compile:5.1f} s")
    print(f"  mjx    {np.median(speeds[:, 1]):12,.0f}   first call {slow_compile:5.1f} s")
    print(f"  ratio  {ratio:12.1f}")
    return ratio


if __name__ == "__main__":
    main(*sys.argv[1:2], *(int(a) for a in sys.argv[2:3]))

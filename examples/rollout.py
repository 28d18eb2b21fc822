"""A simreal environment in your own JAX code: 256 worlds, one scan, and gradients through the physics.

Run it with `python examples/rollout.py`.
"""

import jax
import jax.numpy as jnp

import simreal

WORLDS, STEPS = 256, 100


def main() -> None:
    env = simreal.make("cartpole_swingup")
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), WORLDS))

    @jax.jit
    def run(state: simreal.State, key: jax.Array) -> tuple[simreal.State, tuple[jax.Array, jax.Array]]:
        def step(state: simreal.State, key: jax.Array) -> tuple[simreal.State, tuple[jax.Array, jax.Array]]:
            action = jax.random.uniform(key, (WORLDS, env.action_size), minval=-1, maxval=1)
            state = jax.vmap(env.step)(state, action)
            return state, (state.reward, state.done)

        return jax.lax.scan(step, state, jax.random.split(key, STEPS))

    state, (rewards, done) = run(state, jax.random.PRNGKey(1))
    # `step` goes on after the end of an episode: only what came up to the end counts.
    rewards = jnp.where(jnp.cumsum(done, axis=0) - done == 0, rewards, 0)
    mass = state.world.draws["pole_mass"]
    print(f"{WORLDS} worlds, pole masses x {mass.min():.2f} to x {mass.max():.2f}")
    print(f"mean return of random actions over {STEPS} steps: {rewards.sum(axis=0).mean():.3f}")

    # Gradients need the engine that is written in JAX, with one solver iteration.
    env = simreal.make("cartpole_swingup", engine="mjx", solver_iterations=1)
    start = env.reset(jax.random.PRNGKey(0))

    def return_of(force: jax.Array) -> jax.Array:
        def step(state: simreal.State, _: None) -> tuple[simreal.State, jax.Array]:
            state = env.step(state, force)
            return state, state.reward

        return jnp.sum(jax.lax.scan(step, start, length=10)[1])

    gradient = jax.jit(jax.grad(return_of))(jnp.array([0.1]))
    print(f"d return / d force over 10 steps: {gradient[0]:.2e}")


if __name__ == "__main__":
    main()

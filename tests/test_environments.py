"""The contract that every registered environment keeps."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import ENVIRONMENTS, batched_reset, batched_step, environment, keys

from simreal.registry import ENVIRONMENTS as REGISTERED
from simreal.worldsets import digest

WORLDS = 16


def test_every_registered_environment_is_under_contract():
    assert set(REGISTERED) == set(ENVIRONMENTS)


def random_actions(env, steps, seed=0):
    return jax.random.uniform(jax.random.PRNGKey(seed), (steps, WORLDS, env.action_size), minval=-1, maxval=1)


@pytest.fixture(params=ENVIRONMENTS)
def name(request):
    environment(request.param)
    return request.param


def test_shapes_names_and_units(name):
    env, state = environment(name), batched_reset(name)(keys(WORLDS))
    assert state.obs.shape == (WORLDS, len(env.observations))
    assert all(len(entry) == 2 and all(entry) for entry in env.observations)
    assert env.action_size == len(env.actuators.names)
    assert round(env.control_dt / env.physics_dt) * env.physics_dt == pytest.approx(env.control_dt)
    moved = batched_step(name)(state, random_actions(env, 1)[0])
    before, after = (jax.tree.map(lambda x: (x.shape, x.dtype), s) for s in (state, moved))
    assert after == before
    assert set(moved.info) == {"truncation", "failed", "diverged", "success"}


def test_no_rank_is_promoted_silently(name):
    """With the C engine, that is in all of our own code: MJX and Brax rely on it."""
    env = environment(name)
    with jax.numpy_rank_promotion("raise"):
        state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
        jax.eval_shape(env.step, state, jnp.zeros(env.action_size))


def test_actions_reach_controls_affinely(name):
    env = environment(name)
    zero, a, b = jnp.zeros(env.action_size), *random_actions(env, 2)[:, 0]
    combined = env.control(0.25 * a + 0.5 * b)
    expected = 0.25 * env.control(a) + 0.5 * env.control(b) + 0.25 * env.control(zero)
    np.testing.assert_allclose(combined, expected, atol=1e-5)


def test_same_key_same_bits_other_key_other_world(name):
    reset, step, env = batched_reset(name), batched_step(name), environment(name)
    first, again = (step(reset(keys(WORLDS)), random_actions(env, 1)[0]) for _ in range(2))
    assert jax.tree.all(jax.tree.map(lambda x, y: bool(jnp.array_equal(x, y)), first, again))
    numbers = np.asarray(first.world.number)
    assert len({tuple(n) for n in numbers}) == WORLDS


def test_a_world_does_not_feel_its_neighbours(name):
    """The batch hands all rows to one host call: row i must still depend on row i alone."""
    reset, step, env = batched_reset(name), batched_step(name), environment(name)
    state, actions = reset(keys(WORLDS)), random_actions(env, 3)
    order = np.random.default_rng(0).permutation(WORLDS)
    shuffled = jax.tree.map(lambda x: x[order], state)
    for action in actions:
        state, shuffled = step(state, action), step(shuffled, action[order])
    np.testing.assert_array_equal(state.physics.qpos[order], shuffled.physics.qpos)
    np.testing.assert_array_equal(state.obs[order], shuffled.obs)


def test_step_compiles_once(name):
    env, step = environment(name), batched_step(name)
    state = batched_reset(name)(keys(WORLDS, seed=5))
    for action in random_actions(env, 4):
        state = step(state, action)
    assert step._cache_size() == 1


def test_time_limit_is_truncation_and_not_failure(name):
    env, step = environment(name), batched_step(name)
    state = batched_reset(name)(keys(WORLDS))
    state = state.replace(steps=jnp.full_like(state.steps, env.episode_steps - 2))
    rest = jnp.zeros((WORLDS, env.action_size))
    state = step(state, rest)
    assert not state.done.any()
    state = step(state, rest)
    assert state.done.all()
    assert state.info["truncation"].all()
    assert not state.info["failed"].any()


def test_a_world_that_blows_up_ends_and_stays_finite(name):
    env, step = environment(name), batched_step(name)
    state = batched_reset(name)(keys(WORLDS))
    broken = state.physics.qvel.at[3].set(jnp.nan)
    after = step(state.replace(physics=state.physics.replace(qvel=broken)), random_actions(env, 1)[0])
    assert after.info["diverged"][3] == 1
    assert after.done[3] == 1
    assert after.info["diverged"].sum() == 1
    for leaf in (after.obs, after.privileged, after.reward, *after.metrics.values()):
        assert np.isfinite(np.asarray(leaf)).all()


def test_sets_lie_outside_where_they_claim_to(name):
    env = environment(name)
    names = [s.name for s in env.world_sets]
    assert names[:3] == ["nominal", "train", "held_out"]
    assert len(names) >= 6
    for worldset in env.world_sets:
        worldset.check(env.randomizer)
        draws = worldset.draws(env.randomizer, 24, seed=1)
        if worldset.claims_outside:
            outside = np.zeros(24, bool)
            for factor, distribution in env.randomizer.draw_distributions.items():
                low, high = distribution.range()
                values = draws[factor].reshape(24, -1)
                outside |= ((values < low) | (values > high)).any(axis=1)
            assert outside.all(), f"{worldset.name}: worlds {np.flatnonzero(~outside)} are not outside"
        assert digest(worldset, draws, 1) == digest(worldset, worldset.draws(env.randomizer, 24, seed=1), 1)


def test_delays_of_all_sets_fit_the_buffers(name):
    env = environment(name)
    for worldset in env.world_sets:
        draws = worldset.draws(env.randomizer, 24, seed=0)
        for factor, bound in env.randomizer.bound.items():
            if bound.factor.target.quantity == "delay":
                assert draws[factor].max() <= env.max_delay

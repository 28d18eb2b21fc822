"""Policies that remember: the same in training, in NumPy, and where episodes end."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from simreal.config_files import load_config
from simreal.learner import Learner
from simreal.memory import Recollection
from simreal.policy import Policy
from simreal.training import make_environment

SMALL = {
    "worlds": 16,
    "rollout.greedy_worlds": 4,
    "learner.unroll_length": 12,
    "learner.iterations_per_epoch": 2,
    "learner.epochs": 2,
    "network.policy_layers": [16],
    "network.value_layers": [16],
}


def test_a_history_begins_with_its_first_observation_and_shifts():
    recollection = Recollection(observations=2, history=3)
    memory = recollection.empty(np)
    first, second, third, fourth = (np.full(2, i, np.float32) for i in range(1, 5))
    shown, memory = recollection.see(np, memory, first)
    np.testing.assert_array_equal(shown, [1, 1, 1, 1, 1, 1])
    shown, memory = recollection.see(np, memory, second)
    np.testing.assert_array_equal(shown, [2, 2, 1, 1, 1, 1])
    _, memory = recollection.see(np, memory, third)
    shown, _ = recollection.see(np, memory, fourth)
    np.testing.assert_array_equal(shown, [4, 4, 3, 3, 2, 2])


def test_a_policy_without_memory_has_none():
    assert Recollection(3).empty(np) == ()
    assert Recollection(3).see(np, (), np.ones(3))[1] == ()


@pytest.fixture(scope="module", params=["history", "both"])
def trained(request):
    """A learner with memory and what one epoch makes of it."""
    memory = {"history": {"network.history": 3}}
    memory["both"] = memory["history"] | {"network.recurrent": 8}
    config = load_config("cartpole_swingup", SMALL | memory[request.param])
    learner = Learner(make_environment(config), config)
    state, metrics = learner.epoch(learner.init(0))
    return learner, state, metrics


def test_training_with_memory_is_finite(trained):
    _, state, metrics = trained
    assert metrics["skipped_updates"] == 0
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(jax.device_get(state.params)))


def test_the_first_gradient_step_sees_the_policy_that_acted(trained):
    """Replayed over the unroll, with memories reset where episodes begin, the old logits come out."""
    learner, state, _ = trained
    rollout = dataclasses.replace(
        state.rollout, reserve=learner._programs.refill(state.rollout.reserve, state.ranges)
    )
    late = dataclasses.replace(  # the first worlds reach their time limit in mid-unroll
        rollout, env=rollout.env.replace(steps=rollout.env.steps.at[:5].set(learner.env.episode_steps - 4))
    )
    _, data, _, flight = learner._programs.collect(late, state.params.policy, state.normalizer, state.key)
    assert (np.asarray(flight.age)[-1, :5] < 12).all(), "no episode began in the unroll"
    logits = learner.networks.policy_network.apply(state.normalizer, state.params.policy, data.observation)
    then = data.extras["policy_extras"]["distribution_params"]
    np.testing.assert_allclose(np.asarray(logits), np.asarray(then), atol=2e-5)


def test_the_exported_policy_remembers_as_the_trained_one(trained, tmp_path):
    learner, state, _ = trained
    learner.export(state).save(tmp_path)
    policy = Policy.load(tmp_path)
    rng = np.random.default_rng(0)
    memory, carried = policy.initial_state(), jax.tree.map(jnp.asarray, learner.recollection.empty(np))
    for _ in range(6):
        obs = rng.normal(size=learner.env.observation_size).astype(np.float32)
        action, memory = policy(obs, memory)
        rollout = state.rollout
        env = rollout.env.replace(obs=jnp.asarray(obs)[None], privileged=rollout.env.privileged[:1])
        world = dataclasses.replace(rollout, env=env, memory=jax.tree.map(lambda x: x[None], carried))
        _, logits, after = learner._look(world, state.params.policy, state.normalizer)
        carried = jax.tree.map(lambda x: x[0], after)
        mean = learner.networks.parametric_action_distribution.create_dist(logits).mode()[0]
        np.testing.assert_allclose(action, np.clip(np.asarray(mean), -1, 1), atol=1e-5)
    with pytest.raises(ValueError, match="initial_state"):
        policy(obs)

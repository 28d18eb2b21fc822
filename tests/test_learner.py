"""The learner: advantages by hand, probe environments with known answers, and what must survive."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from flax import struct

import simreal
from simreal.brax_parts import losses
from simreal.config import LearnerConfig, NetworkConfig, RolloutConfig, RunConfig
from simreal.environment import Environment
from simreal.learner import Learner


def test_advantages_by_hand():
    """Three steps, discount 0.5, lambda 0.5; world 0 runs through, 1 fails at step 1, 2 is cut off at step 1.

    World 0: deltas 1 + 0.5*2 - 1 = 1, 1 + 0.5*3 - 2 = 0.5, 1 + 0.5*4 - 3 = 0; corrections from the end: 0,
    0.5, 1 + 0.25*0.5 = 1.125; value targets 2.125, 2.5, 3; advantages 1 + 0.5*2.5 - 1 = 1.25, 0.5, 0.
    World 1: delta at step 1 is 1 - 2 = -1, step 0 gets 1 - 0.25 = 0.75; step 2 is as in world 0.
    World 2: step 1 teaches nothing and passes nothing back; step 0 bootstraps from the value before the cut.
    """
    ones, zeros = np.ones((3, 3), np.float32), np.zeros((3, 3), np.float32)
    truncation, termination = zeros.copy(), zeros.copy()
    termination[1, 1] = 1
    truncation[1, 2] = 1
    values = np.tile(np.array([[1.0], [2.0], [3.0]], np.float32), (1, 3))
    targets, advantages = losses.compute_gae(
        truncation, termination, ones, values, jnp.full(3, 4.0), lambda_=0.5, discount=0.5
    )
    np.testing.assert_allclose(targets[:, 0], [2.125, 2.5, 3.0], rtol=1e-6)
    np.testing.assert_allclose(advantages[:, 0], [1.25, 0.5, 0.0], atol=1e-6)
    np.testing.assert_allclose(targets[:, 1], [1.75, 1.0, 3.0], rtol=1e-6)
    np.testing.assert_allclose(advantages[:, 1], [0.5, -1.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(targets[:, 2], [2.0, 2.0, 3.0], rtol=1e-6)
    np.testing.assert_allclose(advantages[:, 2], [1.0, 0.0, 0.0], atol=1e-6)


@struct.dataclass
class ProbeTask:
    sign: jax.Array  # () -1 or 1
    steps: jax.Array  # () int32


class Probe(Environment):
    """What probes share: a body that nobody moves, an observation of one number."""

    control_dt: ClassVar[float] = 0.01
    physics_dt: ClassVar[float] = 0.01
    episode_length: ClassVar[float] = 1.0
    readings = {"sign": (1, "1")}
    observations = (("sign", "1"),)
    training = simreal.Randomizer()
    length: ClassVar[int] = 1

    def model(self):
        return mujoco.MjModel.from_xml_string(
            """<mujoco>
            <worldbody><body><joint name="slide" type="slide"/><geom size=".1" mass="1"/></body></worldbody>
            <actuator><motor name="push" joint="slide" ctrlrange="-1 1" ctrllimited="true"/></actuator>
            </mujoco>"""
        )

    def start(self, key):
        sign = jnp.where(jax.random.bernoulli(key), 1.0, -1.0)
        return jnp.zeros(1), jnp.zeros(1), ProbeTask(sign, jnp.zeros((), jnp.int32))

    def read(self, data, task):
        return {"sign": task.sign}

    def observe(self, reading, task):
        return reading["sign"][None]

    def advance(self, task, data, action):
        return task.replace(steps=task.steps + 1)

    def failed(self, data, task):
        return task.steps >= self.length

    def succeeded(self, task):
        return jnp.ones((), bool)


class Constant(Probe):
    """One step, reward 1: the value is 1."""

    name = "constant"

    def reward(self, data, task, action, last_action):
        return jnp.ones(())


class Seen(Probe):
    """One step, reward = observation: so is the value."""

    name = "seen"

    def reward(self, data, task, action, last_action):
        return task.sign


class Discounted(Probe):
    """Two steps, reward 1 at the second: the value at the first is the discount."""

    name = "discounted"
    length = 2

    def observe(self, reading, task):
        return task.steps[None].astype(float)

    def reward(self, data, task, action, last_action):
        return jnp.where(task.steps == 2, 1.0, 0.0)


class Acting(Probe):
    """One step, reward falls with the distance of the action to 0.5."""

    name = "acting"

    def reward(self, data, task, action, last_action):
        return -jnp.square(action[0] - 0.5)


class Answering(Probe):
    """One step, the right action is 0.5 times the observation."""

    name = "answering"

    def reward(self, data, task, action, last_action):
        return -jnp.square(action[0] - 0.5 * task.sign)


def probe_config(reserve=65 * 8):
    return RunConfig(
        environment="probe",
        worlds=64,
        learner=LearnerConfig(
            unroll_length=8,
            discount=0.9,
            entropy_cost=0.0,
            iterations_per_epoch=25,
            learning_rate=3e-3,
            clip_value=None,
        ),
        network=NetworkConfig(policy_layers=(32,), value_layers=(32,), initial_noise=0.5),
        rollout=RolloutConfig(stagger=False, greedy_worlds=1, reset_capacity=65, reserve=reserve),
    )


def trained(env, epochs=4, **settings):
    learner = Learner(env, probe_config(**settings))
    state = learner.init(0)
    for _ in range(epochs):
        state, metrics = learner.epoch(state)
    return learner, state, metrics


def value(learner, state, observation):
    seen = {"state": jnp.array([[observation]]), "privileged_state": jnp.array([[observation]])}
    return float(learner.networks.value_network.apply(state.normalizer, state.params.value, seen)[0])


def test_probe_constant_reward():
    learner, state, metrics = trained(Constant())
    assert value(learner, state, 1.0) == pytest.approx(1.0, abs=0.05)
    assert float(metrics["episode_return"]) == pytest.approx(1.0)


def test_worlds_that_wait_for_a_fresh_start_are_counted_and_teach_nothing():
    learner, state, metrics = trained(Constant(), reserve=64)
    # 64 fresh starts for 65 worlds that would use one in each of 8 steps, 25 times.
    assert metrics["idle_steps"] == 25 * (65 * 8 - 64)
    assert metrics["episode_return"] == 1.0
    assert value(learner, state, 1.0) == pytest.approx(1.0, abs=0.05)


def test_probe_reward_seen():
    learner, state, _ = trained(Seen())
    assert value(learner, state, 1.0) == pytest.approx(1.0, abs=0.1)
    assert value(learner, state, -1.0) == pytest.approx(-1.0, abs=0.1)


def test_probe_discount():
    learner, state, _ = trained(Discounted())
    assert value(learner, state, 1.0) == pytest.approx(1.0, abs=0.1)
    assert value(learner, state, 0.0) == pytest.approx(0.9, abs=0.1)


def test_probe_action():
    learner, state, _ = trained(Acting())
    action, _ = learner.export(state)(np.array([1.0], np.float32))
    assert action[0] == pytest.approx(0.5, abs=0.1)


def test_probe_action_that_depends_on_what_is_seen():
    learner, state, _ = trained(Answering())
    policy = learner.export(state)
    for sign in (1.0, -1.0):
        assert policy(np.array([sign], np.float32))[0][0] == pytest.approx(0.5 * sign, abs=0.12)


@pytest.fixture(scope="module")
def acting():
    learner = Learner(Acting(), probe_config())
    return learner, learner.epoch(learner.init(0))[0]


def copy(state):
    return jax.tree.map(jnp.array, state)


def test_same_state_same_bits_and_nothing_compiles_after_the_first_epoch(acting):
    learner, state = acting
    copies = [copy(state) for _ in range(2)]
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, seconds, **_: (
            compiled.append(event) if event.endswith("backend_compile_duration") else None
        )
    )
    first, second = (learner.epoch(copied)[0] for copied in copies)
    assert not compiled
    assert jax.tree.all(jax.tree.map(lambda a, b: bool(jnp.array_equal(a, b)), first.params, second.params))


def test_a_gradient_that_is_not_finite_is_skipped_and_counted(acting):
    learner, state = acting
    state = copy(state)
    before = copy(state.params)
    _, data, ended, _ = learner._programs.collect(
        state.rollout, state.params.policy, state.normalizer, jax.random.PRNGKey(0)
    )
    data = data._replace(reward=data.reward.at[0, 0].set(jnp.nan))
    learnt, metrics = learner._programs.update(dataclasses.replace(state, rollout=()), data, ended)
    params = learnt.params
    assert float(metrics["skipped_updates"]) > 0
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(params))
    assert not jax.tree.all(jax.tree.map(lambda a, b: bool(jnp.array_equal(a, b)), params, before))


def test_an_unseen_observation_is_clipped(acting):
    learner, state = acting
    policy = learner.export(state)
    far, further = (policy(np.array([x], np.float32))[0] for x in (1e6, 1e12))
    np.testing.assert_array_equal(far, further)


def test_the_exported_policy_is_the_trained_one(acting, tmp_path):
    learner, state = acting
    obs = np.linspace(-1, 1, 7, dtype=np.float32)[:, None]
    seen = {"state": jnp.asarray(obs), "privileged_state": jnp.asarray(obs)}
    mean = learner.networks.policy_network.apply(state.normalizer, state.params.policy, seen)[0]
    policy = learner.export(state)
    policy.save(tmp_path / "policy")
    loaded = simreal.load_policy(tmp_path)
    np.testing.assert_allclose(loaded(obs)[0], np.clip(mean, -1, 1), atol=1e-5)
    np.testing.assert_allclose(jax.jit(lambda o: loaded(o)[0])(jnp.asarray(obs)), loaded(obs)[0], atol=1e-5)
    assert loaded.interface.observations == [["sign", "1"]]
    assert loaded.initial_state() == ()
    (tmp_path / "policy" / "weights.npz").write_bytes(b"short")
    with pytest.raises(simreal.UserError, match="damaged"):
        simreal.load_policy(tmp_path)

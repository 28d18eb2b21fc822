"""The Brax adapter, the example scripts, and the benchmark against Brax."""

from __future__ import annotations

import importlib.util
import math
import re
import sys
from pathlib import Path
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import environment

from simreal.brax_adapter import BraxEnv
from simreal.config import NetworkConfig, RolloutConfig, RunConfig
from simreal.learner import Learner

ROOT = Path(__file__).resolve().parents[1]


def script(path: str) -> ModuleType:
    """A script of the repository as a module."""
    spec = importlib.util.spec_from_file_location(Path(path).stem, ROOT / path)
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_brax_sees_failure_but_not_the_time_limit():
    """Brax's own wrapper keeps the time: a `done` of ours at the limit would count as failure there."""
    env = environment("cartpole_swingup")
    wrapped = BraxEnv(env, privileged=True)
    state = jax.jit(wrapped.reset)(jax.random.PRNGKey(0))
    assert wrapped.observation_size == {name: value.shape for name, value in state.obs.items()}
    assert wrapped.action_size == env.action_size
    np.testing.assert_array_equal(state.obs["state"], state.pipeline_state.obs)
    np.testing.assert_array_equal(state.obs["privileged_state"], state.pipeline_state.privileged)

    step, action = jax.jit(wrapped.step), jnp.full(env.action_size, 0.3)
    inner = state.pipeline_state
    last = step(
        state.replace(pipeline_state=inner.replace(steps=inner.steps + env.episode_steps - 1)), action
    )
    assert last.pipeline_state.info["truncation"] == 1
    assert last.done == 0
    off_the_rail = inner.physics.replace(qpos=inner.physics.qpos.at[0].set(5.0))
    assert step(state.replace(pipeline_state=inner.replace(physics=off_the_rail)), action).done == 1

    ours = jax.jit(env.step)(inner, action)
    theirs = step(state, action)
    assert theirs.reward == ours.reward
    np.testing.assert_array_equal(theirs.obs["state"], ours.obs)


@pytest.mark.slow
def test_example_of_brax_training_runs(capsys):
    returns = script("examples/brax_training.py").main(steps=48_000)
    assert len(returns) == 3
    assert all(0 < value < 500 for value in returns)  # the reward lies in [0, 1] and an episode has 500 steps
    steps = [int(line.split()[1]) for line in capsys.readouterr().out.splitlines() if line.startswith("step")]
    assert len(steps) == 3
    assert steps == sorted(steps)
    assert steps[-1] >= 48_000


@pytest.mark.slow
def test_example_of_a_rollout_runs(capsys):
    script("examples/rollout.py").main()
    printed = capsys.readouterr().out
    low, high = map(float, re.findall(r"x (\d+\.\d+)", printed))
    assert 0.7 <= low < 0.75
    assert 1.35 < high <= 1.4
    # Some of the worlds lose 20 at the end of the rail, once each.
    assert -20 < float(re.search(r"mean return .*: (\S+)", printed).group(1)) < 100
    gradient = float(re.search(r"d return / d force .*: (\S+)", printed).group(1))
    assert math.isfinite(gradient)
    assert gradient != 0


@pytest.mark.slow
def test_benchmark_evaluates_as_brax_does():
    """The same returns in the same worlds as Brax's `Evaluator` with the keys of its `train`."""
    from brax.envs.wrappers.training import wrap
    from brax.training.acting import Evaluator

    from simreal.brax_parts import ppo_networks

    env, worlds, seed = environment("cartpole_swingup"), 8, 3
    network = NetworkConfig(policy_layers=(8,), value_layers=(8,), output_scale=1.0)
    config = RunConfig(
        env.name, worlds=8, network=network, rollout=RolloutConfig(greedy_worlds=0), engine=env.engine_name
    )
    learner = Learner(env, config)
    state = learner.init(seed)

    global_and_local = jax.random.split(jax.random.PRNGKey(seed))
    eval_key = jax.random.split(jax.random.fold_in(global_and_local[1], 0), 3)[2]
    make_policy = ppo_networks.make_inference_fn(learner.networks)
    evaluator = Evaluator(
        wrap(BraxEnv(env, privileged=True), env.episode_steps),
        lambda params: make_policy(params, deterministic=True),
        worlds,
        env.episode_steps,
        action_repeat=1,
        key=eval_key,
    )
    benchmark = script("benchmarks/against_brax.py")
    begin, run = map(jax.jit, benchmark.evaluation(learner, worlds))
    key = benchmark.evaluation_key(seed)
    for _ in range(2):
        theirs = evaluator.run_evaluation((state.normalizer, state.params.policy, state.params.value), {})
        key, starts = begin(key)
        ours, success = run(state.params.policy, state.normalizer, starts)
        assert float(ours.std()) > 0
        np.testing.assert_allclose(float(ours.mean()), theirs["eval/episode_reward"], rtol=1e-4)
        np.testing.assert_allclose(float(ours.std()), theirs["eval/episode_reward_std"], rtol=1e-4)
        assert float(success.mean()) == theirs["eval/episode_success"]

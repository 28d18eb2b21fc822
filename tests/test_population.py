"""Several runs in one program: each is what it would be alone."""

from __future__ import annotations

import dataclasses
import shutil
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from simreal import cli
from simreal.checkpoints import Checkpoints
from simreal.config_files import load_config
from simreal.errors import UserError
from simreal.learner import Learner
from simreal.policy import load_policy
from simreal.population import Population, check_members
from simreal.runs import Run
from simreal.training import _newest_of_all, make_environment, train_population

SEEDS = (3, 4, 7)
SMALL = {
    "worlds": 16,
    "steps": 3 * 16 * 10 * 2,
    "rollout.greedy_worlds": 4,
    "learner.unroll_length": 10,
    "learner.iterations_per_epoch": 2,
    "learner.epochs": 2,
    "network.policy_layers": [16],
    "network.value_layers": [16],
}


def config(seed: int, **more):
    return load_config("cartpole_swingup", SMALL | {"seed": seed} | more)


@pytest.fixture(scope="module")
def population():
    configs = [config(seed) for seed in SEEDS]
    return Population(make_environment(configs[0]), configs)


@pytest.fixture(scope="module")
def learnt(population):
    """State and rows of all members after one epoch."""
    state, rows = population.epoch(population.init())
    return jax.device_get(state), rows


def member(state, index):
    return jax.tree.map(lambda leaf: leaf[index], state)


def test_a_member_is_what_it_would_be_alone(population, learnt):
    together, rows = learnt
    learner = Learner(population.env, config(SEEDS[1]))
    alone, row = learner.epoch(learner.init(SEEDS[1]))
    ours = jax.tree.leaves(member(together.params, 1))
    for a, b in zip(ours, jax.tree.leaves(jax.device_get(alone.params)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)
    np.testing.assert_array_equal(together.key[1], alone.key)
    for name, value in row.items():
        np.testing.assert_allclose(rows[1][name], value, atol=1e-4, err_msg=name)


def test_members_differ(learnt):
    together, _ = learnt
    draws = together.rollout.env.world.draws["pole_mass"].reshape(-1)
    assert len(np.unique(draws)) == draws.size, "two worlds share a draw"


def test_the_others_numbers_do_not_change_a_bit_of_a_member(population, learnt):
    before = population.hyper
    try:
        others = {"learning_rate": 5e-3, "entropy_cost": 0.1, "discount": 0.5, "clip": 0.05}
        changed = {name: getattr(before, name).copy() for name in others}
        for name, value in others.items():
            changed[name][1:] = value
        population.hyper = dataclasses.replace(before, **changed)
        state, _ = population.epoch(population.init())
    finally:
        population.hyper = before
    state, usual = jax.device_get(state), learnt[0]
    for a, b in zip(jax.tree.leaves(member(state, 0)), jax.tree.leaves(member(usual, 0)), strict=True):
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes()
    different = jax.tree.leaves(member(state, 1).params), jax.tree.leaves(member(usual, 1).params)
    assert any((a != b).any() for a, b in zip(*different, strict=True))


def test_what_is_compiled_in_may_not_differ():
    check_members([config(0), config(1, **{"learner.learning_rate": 3e-4})])
    with pytest.raises(UserError, match="may not differ in worlds"):
        check_members([config(0), config(1, worlds=32)])
    check_members([config(0, randomizer={"cart_mass": [0.5, 2.0]}), config(1)])
    with pytest.raises(UserError, match=r"may not differ in learner\.adaptive_kl"):
        check_members([config(0), config(0, **{"learner.adaptive_kl": 0.01})])


def test_a_member_that_is_ahead_or_damaged_takes_nothing_from_the_others(tmp_path):
    keepers = []
    for name, steps in (("a", (1, 2, 3)), ("b", (2, 3, 4))):
        checkpoints = Checkpoints(tmp_path / name)
        for step in steps:
            checkpoints.save(step, {"x": np.arange(3) + step})
        keepers.append(SimpleNamespace(checkpoints=checkpoints, run=Run(tmp_path / name)))
    assert _newest_of_all(keepers, tmp_path) == 3
    (tmp_path / "b" / "3" / "sha256.json").unlink()
    assert _newest_of_all(keepers, tmp_path) == 2
    shutil.rmtree(tmp_path / "b" / "2")
    with pytest.raises(UserError, match="no step at which all 2 members"):
        _newest_of_all(keepers, tmp_path)
    assert keepers[1].checkpoints.steps() == [3, 4]


def test_the_critic_of_a_member_sees_draws_by_its_own_ranges(population):
    builder = population.env.randomizer
    wide = make_environment(config(0, randomizer={"cart_mass": [0.5, 2.0]})).randomizer.ranges
    at = list(builder.draw_distributions).index("cart_mass")
    draws = builder.nominal_draws() | {"cart_mass": 1.2}
    assert float(builder.build(draws).normalized[at]) == pytest.approx(1.0)
    assert float(builder.build(draws, wide).normalized[at]) == pytest.approx(-1 + 2 * 0.7 / 1.5)


@pytest.mark.slow
def test_a_population_trains_and_resumes_to_the_same_bits(tmp_path):
    short = [config(seed, steps=SMALL["steps"] // 3) for seed in SEEDS]
    whole = [config(seed) for seed in SEEDS]
    for out, stages in (("at_once", [whole]), ("in_two", [short, whole])):
        for i, configs in enumerate(stages):
            folders = [tmp_path / out / f"seed-{c.seed}" for c in configs]
            train_population(configs, folders, tmp_path / out, resume=i > 0)
    for seed in SEEDS:
        runs = [Run(tmp_path / out / f"seed-{seed}") for out in ("at_once", "in_two")]
        states = [Checkpoints(run.checkpoints).raw() for run in runs]
        for name, leaf in states[0].items():
            assert leaf.tobytes() == states[1][name].tobytes(), name
        assert len(runs[0].metrics()) == 3
        assert runs[0].manifest()["seed"] == seed
        load_policy(runs[0].folder)(np.zeros(6, np.float32))


def test_seeds_must_be_some(capsys):
    assert cli.main(["train", "arm_reach", "--seeds", "0"]) == 2
    assert "--seeds: must be at least 1" in capsys.readouterr().err

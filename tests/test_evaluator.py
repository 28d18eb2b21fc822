"""The evaluator: the same worlds for every policy, honest bookkeeping, any policy."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import environment

import simreal
from simreal.evaluation.evaluator import Evaluator, choose_sets
from simreal.evaluation.ranges import sweep_values

WORLDS = 32


class Idle:
    """Does nothing."""

    def initial_state(self):
        return ()

    def __call__(self, obs, memory, key):
        return jnp.zeros(2), memory


class Servo:
    """A hand-written controller with memory: a PD on the joints, towards where the smoothed error says."""

    def initial_state(self):
        return jnp.zeros(2)

    def __call__(self, obs, memory, key):
        cos, sin, speed = obs[jnp.array([0, 2])], obs[jnp.array([1, 3])], obs[4:6]
        error = obs[10:12]
        smooth = 0.5 * memory + 0.5 * error
        shoulder = jnp.array([cos[0], sin[0]])
        fore = 0.8 * jnp.array([cos[0] * cos[1] - sin[0] * sin[1], sin[0] * cos[1] + cos[0] * sin[1]])
        tip = shoulder + fore
        jacobian = jnp.array([[-tip[1], -fore[1]], [tip[0], fore[0]]])
        turn = jnp.clip(jnp.linalg.solve(jacobian, smooth), -0.6, 0.6)
        return turn * jnp.array([1.5, 1.0]) - jnp.array([0.9, 0.4]) * speed, smooth


@pytest.fixture(scope="module")
def arm():
    return environment("arm_reach")


@pytest.fixture(scope="module")
def servo(arm):
    return Evaluator(arm, Servo(), seed=7, batch=WORLDS)


def test_two_runs_give_the_same_numbers_and_sets_their_digests(arm, servo):
    held_out = next(s for s in arm.world_sets if s.name == "held_out")
    first, second = (servo.run_set(held_out, WORLDS) for _ in range(2))
    np.testing.assert_array_equal(first.episode_return, second.episode_return)
    assert first.digest == second.digest
    assert first.claims_outside
    assert first.digest != servo.run_set(held_out, WORLDS - 1).digest


def test_episodes_do_not_depend_on_the_batch_they_ran_in(arm, servo):
    """More worlds than one batch holds: the first ones come out as before."""
    train = next(s for s in arm.world_sets if s.name == "train")
    draws = train.draws(arm.randomizer, WORLDS + 5, seed=7)
    longer = servo.run(draws)
    shorter = servo.run({name: value[:3] for name, value in draws.items()})
    assert longer["episode_return"].shape == (WORLDS + 5,)
    np.testing.assert_array_equal(longer["episode_return"][:3], shorter["episode_return"])


def test_a_controller_with_memory_beats_doing_nothing(arm, servo):
    nominal = next(s for s in arm.world_sets if s.name == "nominal")
    idle = Evaluator(arm, Idle(), seed=7, batch=WORLDS)
    worked, rested = servo.run_set(nominal, WORLDS), idle.run_set(nominal, WORLDS)
    assert worked.success.mean() > 0.5
    assert rested.success.mean() < 0.2
    assert worked.digest == rested.digest
    assert worked.hardware["peak_torque"].max() <= 40.0 + 1e-3
    assert (worked.steps == arm.episode_steps).all()
    assert (worked.ended_by == 0).all()
    assert rested.hardware["action_rate"].max() == 0


def test_factor_curves_reach_beyond_training_and_stay_possible(arm):
    for factor, bound in arm.randomizer.bound.items():
        values = sweep_values(arm, factor, 7)
        low, high = bound.factor.distribution.range()
        assert values.shape == (7,)
        assert values[-1] >= high - 1e-9
        assert values[0] >= bound.lowest - 1e-9
        assert values[0] < low or bound.lowest >= low - 1e-6
        if bound.factor.target.quantity == "delay":
            assert values[-1] <= arm.max_delay


def test_a_factor_curve_and_a_heat_map_move_their_factors_only(arm, servo):
    curve = servo.run_factor("payload", np.array([0.0, 4.0]), 8)
    assert curve.success.shape == (2, 8)
    assert (curve.train_low, curve.train_high) == (0.0, 0.8)
    assert curve.episode_return[0].mean() > curve.episode_return[1].mean()
    heat = servo.run_heat_map({"payload": curve, "tilt": servo.run_factor("tilt", np.array([0.0]), 8)}, 4)
    assert heat is not None
    assert {heat.factor_x, heat.factor_y} == {"payload", "tilt"}
    assert heat.success.shape == (5, 5, 4)


def test_a_factor_without_effect_gives_the_same_episodes_at_every_value(arm, servo):
    """The worlds, starts and noise along a curve are paired; only the factor moves."""
    inert = servo.run_factor("tilt", np.array([0.005, 0.005, 0.005]), 8)
    np.testing.assert_array_equal(inert.episode_return[0], inert.episode_return[2])


def test_unknown_sets_and_factors(arm, servo):
    with pytest.raises(simreal.UserError, match="did you mean 'held_out'"):
        choose_sets(arm, ["held-out"])
    with pytest.raises(simreal.UserError, match="unknown factor 'paylod'"):
        servo.run_factor("paylod", np.array([0.0]), 4)


def test_a_delay_beyond_the_buffers_is_refused(arm, servo):
    late = arm.world_sets[0].__class__("late", "", "fixed", fixed={"camera_delay": 0.5})
    with pytest.raises(simreal.UserError, match="does not fit"):
        servo.run_set(late, 4)

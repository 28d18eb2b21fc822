"""Every actuator and sensor effect through a whole environment, on both engines, against its closed form.

A bench of carts of 1 kg that slide without friction or gravity, one per effect: what a cart's motor really
does is its change of momentum. One more cart rolls at 1 m/s from 0, so that its position is the time; the
sensors all look at that one.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import simreal
from simreal.distributions import Uniform
from simreal.environment import Environment
from simreal.randomizers import actuator, physics, sensor

DT = 0.002
STEPS = 250
WORLDS = 64
CARTS = ("plain", "delayed", "lagged", "dead", "saturated", "noisy", "wandering", "weak")
CARTS += ("fast", "hot", "played", "loaded")
READINGS = ("exact", "delayed", "biased", "scaled", "noisy", "drifting", "sampled")
READINGS += ("rounded", "lossy", "bursty")
TIME = DT * np.arange(1, STEPS + 1)
"""True position of the rolling cart at each reading after the first."""

FACTORS = {
    "motor_delay": actuator.delay("delayed").set(Uniform(0, 0.05)),
    "motor_lag": actuator.lag("lagged").set(Uniform(0, 0.1)),
    "motor_deadband": actuator.deadband("dead").set(Uniform(0, 1)),
    "motor_saturation": actuator.saturation("saturated").set(Uniform(0.1, 1)),
    "motor_noise": actuator.noise("noisy").set(Uniform(0, 1)),
    "motor_wander": actuator.correlated_noise("wandering").set(Uniform(0, 1)),
    "motor_wander_time": actuator.correlation_time("wandering").set(Uniform(0, 1)),
    "motor_gain": actuator.gain("weak").times(Uniform(0.5, 1.5)),
    "motor_speed": actuator.no_load_speed("fast").set(Uniform(0.1, 10)),
    "motor_limit": actuator.thermal_limit("hot").set(Uniform(0.1, 10)),
    "motor_thermal_time": actuator.thermal_time("hot").set(Uniform(0.1, 10)),
    "motor_backlash": actuator.backlash("played").set(Uniform(0, 1)),
    "load": physics.body_mass("loaded").times(Uniform(1, 3)).at(Uniform(0, 0.4)),
    "sensor_delay": sensor.delay("delayed").set(Uniform(0, 0.05)),
    "sensor_bias": sensor.bias("biased").set(Uniform(-1, 1)),
    "sensor_scale": sensor.scale("scaled").set(Uniform(0.5, 2)),
    "sensor_noise": sensor.noise("noisy").set(Uniform(0, 1)),
    "sensor_drift": sensor.drift("drifting").set(Uniform(0, 1)),
    "sensor_rate": sensor.rate("sampled").set(Uniform(10, 100)),
    "sensor_step": sensor.quantization("rounded").set(Uniform(0, 0.1)),
    "sensor_dropout": sensor.dropout("lossy").set(Uniform(0, 0.5)),
    "sensor_bursts": sensor.burst_rate("bursty").set(Uniform(0, 10)),
    "sensor_burst_length": sensor.burst_duration("bursty").set(Uniform(0.01, 0.5)),
}
VALUES = {
    "motor_delay": 0.023,
    "motor_lag": 0.04,
    "motor_deadband": 0.2,
    "motor_saturation": 0.6,
    "motor_noise": 0.3,
    "motor_wander": 0.5,
    "motor_wander_time": 0.04,
    "motor_gain": 0.8,
    "motor_speed": 0.25,
    "motor_limit": 0.5,
    "motor_thermal_time": 0.5,
    "motor_backlash": 0.3,
    "load": 2.0,
    "load_time": 0.2,
    "sensor_delay": 0.023,
    "sensor_bias": -0.4,
    "sensor_scale": 1.5,
    "sensor_noise": 0.2,
    "sensor_drift": 0.6,
    "sensor_rate": 50.0,
    "sensor_step": 0.05,
    "sensor_dropout": 0.25,
    "sensor_bursts": 4.0,
    "sensor_burst_length": 0.05,
}


def cart(name):
    joint = f'<joint name="{name}" type="slide" axis="1 0 0"/>'
    return f'<body name="{name}">{joint}<geom size=".1" mass="1"/></body>'


def motor(name):
    if name == "played":  # A servo so stiff for its cart that its force tells the command: f = kp (u - q).
        return f'<position name="{name}" joint="{name}" kp="1" ctrlrange="-1 1"/>'
    return f'<motor name="{name}" joint="{name}" ctrlrange="-1 1"/>'


class Bench(Environment):
    """Carts side by side; a reading for each sensor effect."""

    name = "bench"
    control_dt = DT
    physics_dt = DT
    episode_length = 10.0
    readings = dict.fromkeys(READINGS, (1, "m"))
    observations = tuple((name, "m") for name in READINGS)
    training = simreal.Randomizer(**FACTORS)

    def model(self):
        bodies = "".join(map(cart, [*CARTS, "rolling"]))
        return mujoco.MjModel.from_xml_string(
            '<mujoco><option gravity="0 0 0"><flag contact="disable"/></option>'
            f"<worldbody>{bodies}</worldbody><actuator>{''.join(map(motor, CARTS))}</actuator></mujoco>"
        )

    def start(self, key):
        n = len(CARTS) + 1
        return jnp.zeros(n), jnp.zeros(n).at[-1].set(1.0), ()

    def read(self, data, task):
        return dict.fromkeys(READINGS, data.qpos[-1])

    def observe(self, reading, task):
        return jnp.stack([reading[name] for name in READINGS])

    def advance(self, task, data, action):
        return task

    def reward(self, data, task, action, last_action):
        return jnp.zeros(())

    def failed(self, data, task):
        return jnp.zeros((), bool)

    def succeeded(self, task):
        return jnp.ones((), bool)


def commands():
    """(STEPS, carts) what each motor is told."""
    t = np.arange(STEPS)
    out = np.ones((STEPS, len(CARTS)))
    out[:, CARTS.index("delayed")] = t == 5
    out[:, CARTS.index("dead")] = np.linspace(-1, 1, STEPS)
    out[:, CARTS.index("saturated")] = np.linspace(-1, 1, STEPS)
    out[:, CARTS.index("noisy")] = 0
    out[:, CARTS.index("wandering")] = 0
    out[:, CARTS.index("played")] = np.where(t < 100, t / 100, 1 - (t - 100) / 100)
    return out


@functools.cache
def measured(engine):
    """Forces (WORLDS, STEPS) by cart and readings (WORLDS, STEPS) by sensor."""
    env = Bench(engine=engine)
    world = env.randomizer.build(VALUES)

    def episode(key):
        state = env.reset(key, world=world)

        def step(state, action):
            state = env.step(state, action)
            return state, (state.physics.qpos, state.physics.qvel, state.obs)

        return jax.lax.scan(step, state, jnp.asarray(commands(), state.action.dtype))[1]

    keys = jax.random.split(jax.random.PRNGKey(0), WORLDS)
    qpos, qvel, obs = (np.asarray(x, float) for x in jax.jit(jax.vmap(episode))(keys))
    before = np.concatenate([np.zeros_like(qvel[:, :1]), qvel[:, :-1]], axis=1)
    gained = dict(zip(CARTS, np.moveaxis((qvel - before)[..., :-1] / DT, -1, 0), strict=True))
    np.testing.assert_allclose(qpos[..., -1], np.broadcast_to(TIME, qpos.shape[:2]), atol=1e-5)
    gained["played position"] = np.concatenate(
        [np.zeros((WORLDS, 1)), qpos[:, :-1, CARTS.index("played")]], 1
    )
    return gained, dict(zip(READINGS, np.moveaxis(obs, -1, 0), strict=True))


@pytest.fixture(params=["mujoco", "mjx"])
def force(request):
    return measured(request.param)[0]


@pytest.fixture(params=["mujoco", "mjx"])
def seen(request):
    return measured(request.param)[1]


TOLERANCE = {"atol": 2e-4}  # float32: a change of velocity of 2e-3 m/s on velocities of up to 0.5 m/s


def test_a_motor_without_effects_does_as_told(force):
    np.testing.assert_allclose(force["plain"], 1, **TOLERANCE)


def test_a_delay_of_23_ms_splits_an_impulse_between_22_and_24_ms(force):
    expected = np.zeros(STEPS)
    expected[[5 + 11, 5 + 12]] = 0.5
    np.testing.assert_allclose(force["delayed"] - expected, 0, **TOLERANCE)


def test_a_lag_is_a_first_order_step_response(force):
    # The command before the first step is the one that an action of 0 asks for: 0.
    np.testing.assert_allclose(force["lagged"] - (1 - np.exp(-TIME / 0.04)), 0, **TOLERANCE)


def test_a_deadband_and_a_saturation_clip_a_ramp(force):
    ramp = np.linspace(-1, 1, STEPS)
    np.testing.assert_allclose(force["dead"] - (ramp - np.clip(ramp, -0.2, 0.2)), 0, **TOLERANCE)
    np.testing.assert_allclose(force["saturated"] - np.clip(ramp, -0.6, 0.6), 0, **TOLERANCE)


def test_motor_noise_is_white_and_wander_is_correlated(force):
    assert force["noisy"].std() == pytest.approx(0.3, rel=0.02)
    assert force["wandering"].std() == pytest.approx(0.5, rel=0.1)
    for name, correlation in (("noisy", 0.0), ("wandering", np.exp(-DT / 0.04))):
        noise = force[name]
        assert np.corrcoef(noise[:, 1:].ravel(), noise[:, :-1].ravel())[0, 1] == pytest.approx(
            correlation, abs=0.03
        )
        assert abs(np.corrcoef(noise[1:].ravel(), noise[:-1].ravel())[0, 1]) < 0.05


def test_a_gain_scales_the_force(force):
    np.testing.assert_allclose(force["weak"], 0.8, **TOLERANCE)


def test_force_falls_with_speed_to_nothing_at_the_no_load_speed(force):
    # v' = 1 - v / 0.25, in Euler steps of DT from rest.
    n = np.arange(STEPS)
    np.testing.assert_allclose(force["fast"] - (1 - DT / 0.25) ** n, 0, atol=1e-3)


def test_a_hot_motor_falls_back_to_its_continuous_force(force):
    """Heat h' = ((f / 0.5)^2 - h) / 0.5 s; above 1 the peak force falls, to 0.5 N at a heat of 1.5."""
    heat, expected = 0.0, []
    for _ in range(STEPS):
        f = min(1.0, 1.0 + (0.5 - 1.0) * np.clip((heat - 1) / 0.5, 0, 1))
        heat += ((f / 0.5) ** 2 - heat) * (1 - np.exp(-DT / 0.5))
        expected.append(f)
    cold = np.searchsorted(-np.asarray(expected), -1 + 1e-9)
    assert DT * cold == pytest.approx(-0.5 * np.log(1 - 0.25), abs=2 * DT)
    np.testing.assert_allclose(force["hot"] - expected, 0, atol=2e-3)


def test_backlash_loses_its_width_at_a_reversal(force):
    command = force["played"] + force["played position"]  # f = kp (u - q) with kp = 1
    np.testing.assert_allclose(command[:, 99], 0.99 - 0.15, **TOLERANCE)
    # The last command before the reversal is 1 at step 100; 0.01 per step, so 30 of them are lost.
    np.testing.assert_allclose(command[:, 100:130], 1 - 0.15, **TOLERANCE)
    t = np.arange(131, STEPS)
    np.testing.assert_allclose(command[:, 131:] - (1 - (t - 100) / 100 + 0.15), 0, **TOLERANCE)


def test_an_event_in_mid_episode_changes_the_mass_once(force):
    np.testing.assert_allclose(force["loaded"][:, :99], 1, **TOLERANCE)
    np.testing.assert_allclose(force["loaded"][:, 102:], 0.5, **TOLERANCE)


def test_exact_biased_scaled_and_rounded_readings(seen):
    np.testing.assert_allclose(seen["exact"] - TIME, 0, atol=1e-5)
    np.testing.assert_allclose(seen["biased"] - (TIME - 0.4), 0, atol=1e-5)
    np.testing.assert_allclose(seen["scaled"] - 1.5 * TIME, 0, atol=1e-5)
    steps = seen["rounded"] / 0.05
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-4)
    assert np.abs(seen["rounded"] - TIME).max() <= 0.025 + 1e-5


def test_a_sensor_delay_makes_a_ramp_exactly_23_ms_late(seen):
    np.testing.assert_allclose((seen["delayed"] - np.maximum(TIME - 0.023, 0))[:, 12:], 0, atol=1e-5)


def test_sensor_noise_and_drift(seen):
    noise = seen["noisy"] - TIME
    assert noise.std() == pytest.approx(0.2, rel=0.02)
    assert abs(np.corrcoef(noise[:, 1:].ravel(), noise[:, :-1].ravel())[0, 1]) < 0.03
    drift = seen["drifting"] - TIME
    steps = np.diff(drift, axis=1)
    assert steps.std() == pytest.approx(0.6 * np.sqrt(DT), rel=0.02)
    # A random walk: its variance grows with time. 64 worlds tell a standard deviation to about 9 %.
    assert drift[:, -1].std() == pytest.approx(0.6 * np.sqrt(TIME[-1]), rel=0.3)


def test_a_sensor_of_50_hz_holds_each_sample_for_20_ms(seen):
    changed = np.diff(seen["sampled"], axis=1) != 0
    gaps = [np.diff(np.flatnonzero(row)) for row in changed]
    assert set(np.concatenate(gaps)) == {10}
    assert len({int(np.flatnonzero(row)[0]) for row in changed}) > 5  # each world its own phase


def test_dropout_and_bursts_hold_the_last_value_as_often_as_they_say(seen):
    held = np.diff(seen["lossy"], axis=1) == 0
    assert held.mean() == pytest.approx(0.25, abs=0.012)  # 16,000 readings: three standard deviations
    lost = np.diff(seen["bursty"], axis=1) == 0
    # Mean time without a burst is 1 / 4 s, with one 0.05 s.
    assert lost.mean() == pytest.approx(0.05 / (0.25 + 0.05), abs=0.04)
    ends = (lost[:, :-1] & ~lost[:, 1:]).sum()
    assert lost[:, :-1].sum() / ends * DT == pytest.approx(0.05, rel=0.25)

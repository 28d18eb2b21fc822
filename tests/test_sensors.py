"""Every sensor effect against its closed form, at control periods of one and of ten physics steps."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from simreal.errors import UserError
from simreal.sensors import EFFECTS, UNITS, Sensors

PHYSICS_DT = 0.002
SUBSTEPS = (1, 10)
KEY = jax.random.PRNGKey(0)
EVERYTHING = frozenset(EFFECTS)


@pytest.fixture(autouse=True)
def strict_promotion():
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        yield


def make(effects, substeps=1, n=1, max_delay=0.0):
    channels = tuple(f"angle[{i}]" for i in range(n))
    return Sensors(channels, PHYSICS_DT * substeps, frozenset(effects), max_delay)


@partial(jax.jit, static_argnums=0)
def rollout(sensors, parameters, truth, key):
    """Readings (T, n) of true values (T, n); the first comes from `start`."""
    keys = jax.random.split(key, truth.shape[0])
    first, state = sensors.start(parameters, truth[0], keys[0])

    def step(state, inputs):
        reading, state = sensors.apply(parameters, state, *inputs)
        return state, reading

    later = jax.lax.scan(step, state, (truth[1:], keys[1:]))[1]
    return jnp.concatenate([first[None], later])


def read(sensors, parameters, truth, worlds=None):
    """`rollout` in NumPy, of one world (T, n) or of many (worlds, T, n); `truth` is (T,) or (T, n)."""
    n = len(sensors.channels)
    given = {k: jnp.asarray(v, dtype=float) for k, v in parameters.items()}
    parameters = {k: jnp.broadcast_to(given.get(k, v), (n,)) for k, v in sensors.nominal().items()}
    truth = np.broadcast_to(np.reshape(truth, (len(truth), -1)), (len(truth), n))
    truth = jnp.asarray(truth, dtype=float)
    if worlds is None:
        return np.asarray(rollout(sensors, parameters, truth, KEY))
    many = jax.vmap(rollout, in_axes=(None, None, None, 0))
    return np.asarray(many(sensors, parameters, truth, jax.random.split(KEY, worlds)))


def correlation(a, b):
    return np.corrcoef(a.reshape(-1), b.reshape(-1))[0, 1]


# -- delay -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("substeps", SUBSTEPS)
def test_delays_make_a_ramp_exactly_that_late(substeps):
    delays = np.array([0.0, 0.002, 0.0031, 0.02, 0.023, 0.04])
    sensors = make({"delay"}, substeps, n=6, max_delay=0.04)
    time = sensors.control_dt * np.arange(60)
    out = read(sensors, {"delay": delays}, time)
    np.testing.assert_allclose(out[22:], (time[:, None] - delays)[22:], atol=1e-6)
    np.testing.assert_array_equal(out[0], 0)
    np.testing.assert_array_equal(out[:, 0], time.astype(out.dtype))


@pytest.mark.parametrize(("substeps", "split"), [(1, {11: 0.5, 12: 0.5}), (10, {1: 0.85, 2: 0.15})])
def test_delay_of_23_ms_splits_an_impulse_between_its_neighbours(substeps, split):
    truth = np.zeros(30)
    truth[5] = 1
    out = read(make({"delay"}, substeps, max_delay=0.03), {"delay": 0.023}, truth)[:, 0]
    expected = np.zeros(30)
    for steps, weight in split.items():
        expected[5 + steps] = weight
    np.testing.assert_allclose(out, expected, atol=1e-5)


def test_the_delay_line_starts_full_of_the_first_true_value_and_cuts_longer_delays():
    sensors = make({"delay", "bias"}, n=2, max_delay=0.006)
    out = read(sensors, {"delay": [0.006, 9.0], "bias": 0.5}, 3.0 + np.arange(8))
    np.testing.assert_allclose(out[:, 0], 0.5 + np.array([3, 3, 3, 3, 4, 5, 6, 7]), rtol=1e-6)
    np.testing.assert_allclose(out[:, 0], out[:, 1], rtol=1e-6)


# -- scale, bias, quantisation -----------------------------------------------------------------------------


def test_scale_then_bias_then_quantisation():
    truth = np.random.default_rng(0).normal(size=50)
    values = {"scale": 1.1, "bias": 0.3, "quantization": 0.25}
    out = read(make(values), values, truth)[:, 0]
    np.testing.assert_allclose(out, 0.25 * np.round((1.1 * truth + 0.3) / 0.25), atol=1e-6)


def test_quantisation_comes_after_noise_and_zero_means_none():
    sensors = make({"quantization", "noise"}, n=2)
    out = read(sensors, {"quantization": [0.1, 0.0], "noise": 0.3}, np.zeros(500))
    np.testing.assert_allclose(out[:, 0], 0.1 * np.round(out[:, 0] / 0.1), atol=1e-6)
    assert len(np.unique(np.round(out[:, 0], 3))) > 5
    assert len(np.unique(out[:, 1])) == 500


# -- noise and drift ---------------------------------------------------------------------------------------


def test_noise_is_independent_across_steps_worlds_and_channels():
    noise = read(make({"noise"}, n=2), {"noise": [0.1, 0.5]}, np.zeros(1000), worlds=64)
    np.testing.assert_allclose(noise.std(axis=(0, 1)), [0.1, 0.5], rtol=0.015)
    np.testing.assert_allclose(noise[:, 0].std(axis=0), [0.1, 0.5], rtol=0.35)
    assert abs(correlation(noise[:, 1:], noise[:, :-1])) < 0.02
    assert abs(correlation(noise[1:], noise[:-1])) < 0.02
    assert abs(correlation(noise[..., 0], noise[..., 1])) < 0.02


@pytest.mark.parametrize("substeps", SUBSTEPS)
def test_drift_is_a_random_walk_in_time(substeps):
    steps = 1000 // substeps
    drift = read(make({"drift"}, substeps), {"drift": 0.2}, np.zeros(steps + 1), worlds=3000)[..., 0]
    np.testing.assert_array_equal(drift[:, 0], 0)
    for part in (0.25, 0.5, 1.0):
        seconds = part * 2
        variance = drift[:, int(part * steps)].var()
        np.testing.assert_allclose(variance, 0.2**2 * seconds, rtol=0.1)
    halves = drift[:, steps // 2], drift[:, -1] - drift[:, steps // 2]
    assert abs(correlation(*halves)) < 0.06


def test_noise_and_drift_do_not_share_a_key():
    values = {"noise": 1.0, "drift": 1 / np.sqrt(PHYSICS_DT)}
    both = read(make(values), values, np.zeros(3), worlds=3000)[:, 1, 0]
    np.testing.assert_allclose(both.var(), 2, rtol=0.1)


# -- held readings -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("substeps", SUBSTEPS)
def test_rate_samples_as_often_as_it_says_with_a_random_phase(substeps):
    rates = np.array([0.0, 5, 12.5, 30, 50, 1000])
    sensors = make({"rate"}, substeps, n=6)
    steps = round(4 / sensors.control_dt)
    out = read(sensors, {"rate": rates}, np.arange(steps + 1), worlds=40)
    new = np.diff(out, axis=1) > 0
    effective = np.where(rates == 0, np.inf, rates).clip(max=1 / sensors.control_dt)
    assert np.abs(new.sum(axis=1) - 4 * effective).max() <= 1
    for channel in (1, 2, 3):
        period = 1 / (rates[channel] * sensors.control_dt)
        for world in range(40):
            gaps = np.diff(np.flatnonzero(new[world, :, channel]))
            assert set(gaps) <= {np.floor(period + 1e-3), np.ceil(period - 1e-3)}
    first = new[:, :, 1].argmax(axis=1) + 1  # steps until the first sample: uniform over one period
    np.testing.assert_allclose(first.mean() * sensors.control_dt * 5, 0.5, atol=0.2)
    assert first.min() * sensors.control_dt < 0.05
    assert first.max() * sensors.control_dt > 0.15
    held = np.where(new, np.arange(1, steps + 1)[:, None], 0)
    np.testing.assert_array_equal(out[:, 1:], np.maximum.accumulate(held, axis=1))


def test_rate_is_kept_over_100_000_steps():
    rates = np.array([7.0, 30, 33.3, 49.9])
    sensors = make({"rate"}, 10, n=4)
    out = read(sensors, {"rate": rates}, np.arange(100_001))
    samples = (np.diff(out, axis=0) > 0).sum(axis=0)
    np.testing.assert_allclose(samples, rates * 2000, atol=2)


def test_a_held_reading_keeps_its_noise():
    out = read(make({"rate", "noise"}, 1), {"rate": 50, "noise": 1.0}, np.zeros(1001))[:, 0]
    assert 99 <= (np.diff(out) != 0).sum() <= 101


def test_a_lost_sample_is_not_made_up_for_before_the_next_one():
    out = read(make({"rate", "dropout"}), {"rate": 50, "dropout": 0.3}, np.arange(1001), worlds=30)[..., 0]
    new = np.diff(out, axis=1) > 0
    np.testing.assert_allclose(new.mean(), 0.1 * 0.7, rtol=0.06)
    assert all((np.diff(np.flatnonzero(world)) % 10 == 0).all() for world in new)


def test_dropout_repeats_the_last_reading_with_its_probability():
    chance = np.array([0.0, 0.1, 0.5, 1.0])
    out = read(make({"dropout"}, n=4), {"dropout": chance}, np.arange(1001), worlds=20)
    repeated = np.diff(out, axis=1) == 0
    np.testing.assert_allclose(repeated.mean(axis=(0, 1)), chance, atol=0.015)
    np.testing.assert_array_equal(repeated[..., 0], False)
    np.testing.assert_array_equal(out[..., 3], 0)
    assert abs(correlation(repeated[:, 1:, 2], repeated[:, :-1, 2])) < 0.03
    assert abs(correlation(repeated[..., 1], repeated[..., 2])) < 0.03


@pytest.mark.parametrize("substeps", SUBSTEPS)
def test_bursts_have_their_rate_their_mean_duration_and_their_duty(substeps):
    rate, duration = 2.0, 0.2
    sensors = make({"burst_rate"}, substeps, n=2)
    steps = round(40 / sensors.control_dt) // 2
    out = read(
        sensors, {"burst_rate": [rate, 0], "burst_duration": duration}, np.arange(steps + 1), worlds=100
    )
    lost = np.diff(out, axis=1) == 0
    assert not lost[..., 1].any()
    lost = lost[..., 0]
    begins = (lost[:, 1:] & ~lost[:, :-1]).sum()
    ends = (~lost[:, 1:] & lost[:, :-1]).sum()
    np.testing.assert_allclose(lost.sum() * sensors.control_dt / ends, duration, rtol=0.08)
    np.testing.assert_allclose(lost.mean(), duration / (duration + 1 / rate), rtol=0.08)
    np.testing.assert_allclose(begins / ((~lost).sum() * sensors.control_dt), rate, rtol=0.08)


def test_dropout_and_bursts_do_not_share_a_key():
    # With one key for both, the steps that dropout keeps (high draws) are those on which no burst begins.
    values = {"dropout": 0.5, "burst_rate": 0.5 / PHYSICS_DT, "burst_duration": PHYSICS_DT}
    sensors = make({"dropout", "burst_rate"})
    first = np.diff(read(sensors, values, np.arange(2), worlds=2000), axis=1) > 0
    np.testing.assert_allclose(first.mean(), 0.25, atol=0.04)


# -- what holds for all effects ----------------------------------------------------------------------------


def test_the_first_reading_is_spoiled_too():
    values = {
        "scale": 2.0,
        "bias": 0.5,
        "noise": 0.1,
        "quantization": 0.05,
        "delay": 0.01,
        "rate": 10,
        "drift": 1,
    }
    first = read(make(values, max_delay=0.01), values, np.ones(1), worlds=500)[:, 0, 0]
    np.testing.assert_allclose([first.mean(), first.std()], [2.5, 0.1], rtol=0.1)
    np.testing.assert_allclose(first, 0.05 * np.round(first / 0.05), atol=1e-6)


def test_nominal_parameters_change_nothing_and_absent_effects_leave_no_state():
    truth = np.random.default_rng(1).normal(size=(40, 3))
    out = read(make(EVERYTHING, n=3, max_delay=0.02), {}, truth)
    np.testing.assert_array_equal(out, truth.astype(out.dtype))
    sensors = make({"noise", "bias", "scale", "quantization"}, n=3)
    _, state = sensors.start(sensors.nominal(), jnp.zeros(3), KEY)
    assert jax.tree.leaves(state) == []
    assert make(()).nominal() == {}


@pytest.mark.parametrize(("x64", "dtype"), [(False, "float32"), (True, "float32"), (True, "float64")])
def test_dtype_follows_the_reading(x64, dtype):
    with jax.enable_x64(x64):
        sensors = make(EVERYTHING, n=3, max_delay=0.05)

        def everything(reading, key):
            parameters = sensors.nominal(dtype)
            start = sensors.start(parameters, reading, key)
            return start, sensors.apply(parameters, start[1], reading, key)

        start, after = jax.eval_shape(everything, jnp.zeros(3, dtype), jax.random.PRNGKey(0))
    assert {x.dtype.name for x in jax.tree.leaves(after)} == {dtype, "bool"}
    as_tuples = [jax.tree.map(lambda x: (x.shape, x.dtype), s) for s in (start, after)]
    assert as_tuples[0] == as_tuples[1]


def test_gradients_are_finite_at_the_nominal_parameters():
    sensors = make(EVERYTHING, n=2, max_delay=0.01)

    @jax.jit
    @jax.grad
    def gradient(parameters):
        reading, state = sensors.start(parameters, jnp.ones(2), KEY)
        later, _ = sensors.apply(parameters, state, 2 * jnp.ones(2), KEY)
        return jnp.sum(reading) + jnp.sum(later)

    assert all(np.isfinite(g).all() for g in gradient(sensors.nominal()).values())


def test_bad_descriptions_are_refused_with_what_would_be_valid():
    with pytest.raises(UserError, match=r"unknown sensor effects \['nois'\]; valid effects: .*noise"):
        make({"nois"})
    with pytest.raises(UserError, match="control_dt > 0"):
        make((), substeps=0)
    assert UNITS.keys() == {name for parameters in EFFECTS.values() for name in parameters}

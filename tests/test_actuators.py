"""Every actuator effect against its closed form, with one and with ten physics steps per control step."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from simreal.actuators import EFFECTS, HOTTEST, UNITS, Actuators, delay_depth, limit_control
from simreal.errors import UserError

DT = 0.002
SUBSTEPS = (1, 10)
KEY = jax.random.PRNGKey(0)
EVERYTHING = frozenset(EFFECTS)


@pytest.fixture(autouse=True)
def strict_promotion():
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        yield


def make(effects, substeps=1, nu=1, max_delay=0.0, ctrlrange=(-1.0, 1.0)):
    names = tuple(f"motor_{i}" for i in range(nu))
    return Actuators(names, (ctrlrange,) * nu, DT, substeps, frozenset(effects), max_delay)


@partial(jax.jit, static_argnums=0)
def rollout(actuators, parameters, start, commands, key):
    """Controls (T, substeps or 1, nu) for commands (T, nu) after a long rest at `start` (nu,)."""
    first, *keys = jax.random.split(key, 2)
    keys = jax.random.split(keys[0], commands.shape[0])

    def step(state, inputs):
        controls, state = actuators.controls(parameters, state, *inputs)
        return state, controls

    return jax.lax.scan(step, actuators.start(parameters, start, first), (commands, keys))[1]


def play(actuators, parameters, commands, start=None, key=KEY):
    """`rollout` in NumPy, flattened to one control per physics step: (T * substeps, nu)."""
    nu = len(actuators.names)
    given = {k: jnp.asarray(v, dtype=float) for k, v in parameters.items()}
    parameters = {k: jnp.broadcast_to(given.get(k, v), v.shape) for k, v in actuators.nominal().items()}
    start = jnp.zeros(nu) if start is None else jnp.asarray(start, dtype=float)
    commands = np.broadcast_to(np.reshape(commands, (len(commands), -1)), (len(commands), nu))
    controls = rollout(actuators, parameters, start, jnp.asarray(commands, dtype=float), key)
    shape = (len(commands), actuators.substeps, nu)
    return np.broadcast_to(np.asarray(controls), shape).reshape(-1, nu)


# -- delay -----------------------------------------------------------------------------------------------


def test_delay_of_23_ms_splits_an_impulse_between_22_and_24_ms():
    impulse = np.eye(30)[0]
    out = play(make({"delay"}, max_delay=0.03), {"delay": 0.023}, impulse)[:, 0]
    np.testing.assert_allclose(out, (np.eye(30)[11] + np.eye(30)[12]) / 2, atol=1e-5)


def test_delay_of_23_ms_makes_a_ramp_exactly_23_ms_late():
    time = DT * np.arange(60)
    out = play(make({"delay"}, max_delay=0.03), {"delay": 0.023}, time)[:, 0]
    np.testing.assert_allclose(out[15:], time[15:] - 0.023, atol=1e-6)


@pytest.mark.parametrize("substeps", SUBSTEPS)
def test_delays_interpolate_between_physics_steps(substeps):
    delays = np.array([0.0, 0.0005, 0.002, 0.019, 0.02, 0.023, 0.04, 0.0465, 0.05])
    actuators = make({"delay"}, substeps, nu=len(delays), max_delay=0.05)
    commands = np.random.default_rng(0).normal(size=80)
    out = play(actuators, {"delay": delays}, commands, start=np.full(len(delays), 0.7))
    held = np.repeat(commands, substeps)
    time = DT * np.arange(len(held))
    for i, delay in enumerate(delays):
        before = np.concatenate([np.full(100, 0.7), held])
        expected = np.interp(time - delay, DT * np.arange(-100, len(held)), before)
        np.testing.assert_allclose(out[:, i], expected, atol=2e-5, err_msg=f"delay {delay}")
    np.testing.assert_array_equal(out[:, 0], held.astype(out.dtype))


def test_delay_of_whole_steps_survives_rounding():
    # In float32 many of these quotients lie just below a whole number of steps.
    delays = DT * np.arange(41)
    actuators = make({"delay"}, nu=41, max_delay=0.08)
    commands = np.random.default_rng(1).normal(size=90)
    out = play(actuators, {"delay": delays}, commands)
    for steps in range(41):
        expected = np.concatenate([np.zeros(steps), commands])[:90]
        np.testing.assert_allclose(out[:, steps], expected, atol=3e-5)


def test_delay_line_is_no_longer_than_the_longest_delay():
    depths = [
        make({"delay"}, substeps, max_delay=d).start({}, jnp.zeros(1), KEY).commands.shape[0]
        for substeps, d in [
            (1, 0.0),
            (1, 0.02),
            (1, 0.0201),
            (10, 0.0),
            (10, 0.02),
            (10, 0.0201),
            (10, 0.041),
        ]
    ]
    assert depths == [0, 10, 11, 0, 1, 2, 3]
    assert delay_depth(0.14, 0.02) == 7
    out = play(make({"delay"}, max_delay=0.004), {"delay": 0.1}, np.eye(10)[0])[:, 0]
    np.testing.assert_array_equal(out, np.eye(10)[2])


# -- lag, backlash, deadband, saturation -----------------------------------------------------------------


@pytest.mark.parametrize("substeps", [*SUBSTEPS, 12])  # 12: the loop is not unrolled
def test_lag_is_the_exact_first_order_step_response(substeps):
    tau = np.array([0.0, 0.01, 0.04, 0.06])
    out = play(make({"lag"}, substeps, nu=4), {"lag": tau}, np.ones(240 // substeps))
    time = DT * np.arange(1, len(out) + 1)
    np.testing.assert_array_equal(out[:, 0], 1)
    np.testing.assert_allclose(out[:, 1:], 1 - np.exp(-time[:, None] / tau[1:]), atol=2e-6)
    np.testing.assert_allclose([out[4, 1], out[19, 2], out[29, 3]], 1 - np.exp(-1), atol=2e-6)


@pytest.mark.parametrize("substeps", SUBSTEPS)
def test_backlash_loses_its_width_at_a_reversal(substeps):
    width = np.array([0.0, 0.1, 0.3])
    up = np.linspace(0, 1, 101)
    down = np.linspace(1, -1, 201)[1:]
    out = play(make({"backlash"}, substeps, nu=3), {"backlash": width}, np.concatenate([up, down]))[
        substeps - 1 :: substeps
    ]
    np.testing.assert_allclose(out[100], 1 - width / 2, atol=1e-6)
    np.testing.assert_allclose(out[-1], -1 + width / 2, atol=1e-6)
    stuck = np.isclose(out[101:], out[100], atol=1e-6).sum(axis=0)
    np.testing.assert_array_equal(stuck, [0, 10, 30])  # commands, 0.01 apart, that the gap swallows


def test_deadband_swallows_small_commands_and_is_continuous():
    commands = np.array([0.0, 0.1, -0.1, 0.2, 0.3, -0.5])
    out = play(make({"deadband"}), {"deadband": 0.2}, commands)[:, 0]
    np.testing.assert_allclose(out, [0, 0, 0, 0, 0.1, -0.3], atol=1e-7)


def test_saturation_is_about_the_centre_of_ctrlrange():
    actuators = Actuators(
        ("a", "b", "free"), ((-1, 1), (1, 5), (-np.inf, np.inf)), DT, 1, frozenset({"saturation"})
    )
    out = play(actuators, {"saturation": [0.8, 0.5, 0.5]}, np.array([[0.9, 1.5, 99.0], [-2.0, 4.5, -99.0]]))
    np.testing.assert_allclose(out, [[0.8, 2, 99], [-0.8, 4, -99]], rtol=1e-6)


@pytest.mark.parametrize("substeps", SUBSTEPS)
def test_effects_apply_in_the_documented_order(substeps):
    values = {"deadband": 0.1, "saturation": 0.6, "delay": 0.007, "lag": 0.01, "backlash": 0.2}
    commands = np.random.default_rng(2).normal(size=40)
    out = play(make(values, substeps, max_delay=0.02), values, commands)[:, 0]
    command = np.clip(commands - np.clip(commands, -0.1, 0.1), -0.6, 0.6)
    held = np.concatenate([np.zeros(10), np.repeat(command, substeps)])
    late = np.interp(np.arange(len(held)) - 3.5, np.arange(len(held)), held)
    lagged, played, expected = 0.0, 0.0, []
    for value in late:
        lagged += (1 - np.exp(-DT / 0.01)) * (value - lagged)
        played = np.clip(played, lagged - 0.1, lagged + 0.1)
        expected.append(played)
    np.testing.assert_allclose(out, expected[10:], atol=1e-5)


# -- noise -----------------------------------------------------------------------------------------------


def noise_of(effects, parameters, worlds=64, steps=1500, substeps=1):
    """(worlds, steps, nu) noise on a command of zero."""
    actuators = make(effects, substeps, nu=2)
    parameters = {k: jnp.broadcast_to(jnp.asarray(parameters.get(k, v)), (2,)) for k, v in
                  actuators.nominal().items()}  # fmt: skip
    many = jax.vmap(rollout, in_axes=(None, None, None, None, 0))
    keys = jax.random.split(KEY, worlds)
    return np.asarray(many(actuators, parameters, jnp.zeros(2), jnp.zeros((steps, 2)), keys))[:, :, 0]


def correlation(a, b):
    return np.corrcoef(a.reshape(-1), b.reshape(-1))[0, 1]


def test_white_noise_is_independent_across_steps_worlds_and_actuators():
    noise = noise_of({"noise"}, {"noise": np.array([0.1, 0.5])})
    np.testing.assert_allclose(noise.std(axis=(0, 1)), [0.1, 0.5], rtol=0.01)
    assert np.abs(noise.mean(axis=(0, 1))).max() < 0.01
    assert abs(correlation(noise[:, 1:], noise[:, :-1])) < 0.02
    assert abs(correlation(noise[1:], noise[:-1])) < 0.02
    assert abs(correlation(noise[..., 0], noise[..., 1])) < 0.02


@pytest.mark.parametrize("substeps", SUBSTEPS)
def test_correlated_noise_is_stationary_from_the_first_step(substeps):
    period, time = DT * substeps, 0.04
    noise = noise_of(
        {"correlated_noise"}, {"correlated_noise": np.array([0.3, 0.3]), "correlation_time": time},
        worlds=1000, steps=100, substeps=substeps,
    )  # fmt: skip
    np.testing.assert_allclose(noise[:, [0, 1, 10, -1]].std(axis=(0, 2)), 0.3, rtol=0.08)
    np.testing.assert_allclose(noise.std(), 0.3, rtol=0.03)
    for lag in (1, 4):
        expected = np.exp(-lag * period / time)
        assert abs(correlation(noise[:, lag:], noise[:, :-lag]) - expected) < 0.02
    assert abs(correlation(noise[..., 0], noise[..., 1])) < 0.03


def test_correlated_noise_of_infinite_time_is_one_value_per_episode():
    parameters = {"correlated_noise": np.array([0.3, 0.3]), "correlation_time": np.inf}
    noise = noise_of({"correlated_noise"}, parameters, worlds=400, steps=5)
    np.testing.assert_array_equal(noise, noise[:, :1].repeat(5, axis=1))
    np.testing.assert_allclose(noise.std(), 0.3, rtol=0.1)


def test_the_two_noises_do_not_share_a_key():
    parameters = {"noise": 1.0, "correlated_noise": 1.0, "correlation_time": 1e-6}
    both = noise_of({"noise", "correlated_noise"}, parameters, steps=500)
    np.testing.assert_allclose(both.var(), 2, rtol=0.03)
    alone = noise_of({"noise"}, {"noise": 1.0}, steps=500)
    np.testing.assert_allclose(correlation(both, alone), np.sqrt(0.5), atol=0.02)


def test_period_jitter_has_its_mean_and_its_cap():
    actuators = make({"period_jitter"})
    many = jax.jit(jax.vmap(actuators.period_scale, in_axes=(None, 0)))
    keys = jax.random.split(KEY, 20_000)
    scale = np.asarray(many({"period_jitter": jnp.asarray(0.1)}, keys))
    np.testing.assert_allclose([scale.mean(), scale.std()], [1.1, 0.1], rtol=0.02)
    assert scale.min() >= 1
    scale = np.asarray(many({"period_jitter": jnp.asarray(2.0)}, keys))
    assert scale.max() == 3
    np.testing.assert_allclose((scale == 3).mean(), np.exp(-1), atol=0.02)
    assert make({"noise"}).period_scale({}, KEY) is None


# -- force limits ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("substeps", SUBSTEPS)
def test_heat_follows_its_closed_form(substeps):
    actuators = make({"thermal_limit"}, substeps, nu=3)
    parameters = {
        "thermal_limit": jnp.array([2.0, 2.0, jnp.inf]),
        "thermal_time": jnp.array([1.0, 1.0, 1.0]),
        "initial_heat": jnp.array([0.0, 1.2, 0.0]),
    }
    force = jnp.array([-3.0, 0.0, 50.0])
    state = actuators.start(parameters, jnp.zeros(3), KEY)
    steps = 1000 // substeps
    state, _ = jax.lax.scan(lambda s, _: (actuators.after(parameters, s, force), None), state, None, steps)
    elapsed = DT * substeps * steps
    expected = [2.25 * (1 - np.exp(-elapsed)), 1.2 * np.exp(-elapsed), 0]
    np.testing.assert_allclose(state.heat, expected, rtol=1e-4)


def test_heat_folds_the_peak_force_back_to_the_continuous_force():
    actuators = make({"thermal_limit"}, nu=6)
    parameters = actuators.nominal() | {
        "thermal_limit": jnp.array([4.0, 4, 4, 4, 20, jnp.inf]),
        "initial_heat": jnp.array([0.5, 1, 1.25, 2, 2, 0]),
    }
    stall = jnp.array([10.0, 10, 10, 10, 10, jnp.inf])
    limits = actuators.limits(parameters, actuators.start(parameters, jnp.zeros(6), KEY), stall)
    assert limits.keys() == {"stall"}
    np.testing.assert_allclose(limits["stall"][:5], [10, 10, 7, 4, 10])
    assert 1e38 < limits["stall"][5] < np.inf


def test_a_motor_at_full_demand_settles_below_the_hottest():
    actuators = make({"thermal_limit"}, substeps=10)
    parameters = {k: jnp.array([v]) for k, v in zip(EFFECTS["thermal_limit"], (4.0, 0.5, 0.0), strict=True)}
    stall = jnp.array([12.0])

    def step(state, _):
        force = actuators.limits(parameters, state, stall)["stall"]
        return actuators.after(parameters, state, force), (force[0], state.heat[0])

    _, (force, heat) = jax.lax.scan(step, actuators.start(parameters, jnp.zeros(1), KEY), None, 1000)
    assert force[0] == 12
    assert 1 < heat[-1] < HOTTEST
    np.testing.assert_allclose((force[-1] / 4) ** 2, heat[-1], rtol=1e-4)


def test_torque_speed_curve():
    """Motor of gain 5 with full command: force at each speed, driving, braking and beyond no-load speed."""
    speed = np.array([0.0, 10, 20, 25, -10, -20, -25], np.float32)
    gain, bias = np.full(7, 5.0, np.float32), np.zeros((7, 3), np.float32)
    limits = {"stall": np.full(7, 4.0, np.float32), "no_load_speed": np.full(7, 20.0, np.float32)}
    for sign in (1, -1):
        control = np.full(7, sign, np.float32)
        out = limit_control(np, control, sign * speed, 0 * speed, gain, bias, limits)
        np.testing.assert_allclose(5 * sign * out, [4, 2, 0, 0, 4, 4, 4], atol=1e-6)


def test_limit_control_bounds_a_position_servo_alike_in_numpy_and_jax():
    rng = np.random.default_rng(3)
    worlds, nu = 50, 6
    control, length = rng.uniform(-1, 1, (2, worlds, nu))
    velocity = rng.normal(0, 15, (worlds, nu))
    gain = np.array([30.0, 30, -30, 0, 30, 30])
    bias = np.stack([np.full(nu, 0.5), -gain, np.full(nu, -0.5)], axis=-1)
    stall = np.array([8.0, 8, 8, 8, 3.4e38, 8])
    no_load = np.array([20.0, 40, 20, 20, np.inf, np.inf])
    arrays = [np.asarray(x, np.float32) for x in (control, velocity, length, gain, bias)]
    control, velocity, length = arrays[:3]
    limits = {"stall": np.float32(stall), "no_load_speed": np.float32(no_load)}
    kept = [x.copy() for x in arrays]
    out = limit_control(np, *arrays, limits)

    force = gain * control + 0.5 - gain * length - 0.5 * velocity
    limited = gain * out + 0.5 - gain * length - 0.5 * velocity
    high = stall * np.clip(1 - velocity / no_load, 0, 1)
    low = -stall * np.clip(1 + velocity / no_load, 0, 1)
    powered = gain != 0
    np.testing.assert_allclose(limited[:, powered], np.clip(force, low, high)[:, powered], atol=1e-4)
    np.testing.assert_array_equal(out[:, ~powered], control[:, ~powered])
    inside = (force > low + 1e-3) & (force < high - 1e-3)
    np.testing.assert_array_equal(out[inside], control[inside])
    assert inside[:, 4].all()
    assert (~inside[:, powered]).mean() > 0.2
    assert out.dtype == np.float32

    in_jax = jax.jit(jax.vmap(partial(limit_control, jnp), in_axes=(0, 0, 0, None, None, None)))
    np.testing.assert_allclose(in_jax(*arrays, limits), out, atol=1e-6)
    for array, before in zip(arrays, kept, strict=True):
        np.testing.assert_array_equal(array, before)
    assert limit_control(np, *arrays, {}) is control


# -- what holds for all effects --------------------------------------------------------------------------


@pytest.mark.parametrize("substeps", SUBSTEPS)
def test_nominal_parameters_change_nothing(substeps):
    actuators = make(EVERYTHING, substeps, nu=3, max_delay=0.03)
    commands = np.random.default_rng(4).uniform(-1, 1, (20, 3))
    out = play(actuators, {}, commands)
    np.testing.assert_array_equal(out, np.repeat(commands, substeps, axis=0).astype(out.dtype))
    parameters = actuators.nominal()
    state = actuators.start(parameters, jnp.zeros(3), KEY)
    limits = actuators.limits(parameters, state, jnp.full(3, jnp.inf))
    assert actuators.period_scale(parameters, KEY) == 1
    control = jnp.array([0.5, -0.5, 1.0])
    same = limit_control(jnp, control, 9 * control, control, 100 * control, jnp.ones((3, 3)), limits)
    np.testing.assert_array_equal(same, control)


def test_absent_effects_leave_no_state_and_share_one_control():
    actuators = make(EVERYTHING - {"delay", "lag", "backlash", "correlated_noise", "thermal_limit"}, 10)
    state = actuators.start(actuators.nominal(), jnp.zeros(1), KEY)
    assert jax.tree.leaves(state) == []
    controls, state = actuators.controls(actuators.nominal(), state, jnp.ones(1), KEY)
    assert controls.shape == (1, 1)
    assert jax.tree.leaves(state) == []
    assert make({"noise"}).limits({}, state, jnp.ones(1)) == {}
    assert make(()).nominal() == {}


@pytest.mark.parametrize(("x64", "dtype"), [(False, "float32"), (True, "float32"), (True, "float64")])
def test_dtype_follows_the_command(x64, dtype):
    with jax.enable_x64(x64):
        actuators = make(EVERYTHING, 10, nu=3, max_delay=0.05)

        def everything(ctrl, key):
            parameters = actuators.nominal(dtype)
            state = actuators.start(parameters, ctrl, key)
            controls, after = actuators.controls(parameters, state, ctrl, key)
            limits = actuators.limits(parameters, after, ctrl)
            limited = limit_control(jnp, ctrl, ctrl, ctrl, ctrl, jnp.zeros((3, 3), dtype), limits)
            scale = actuators.period_scale(parameters, key)
            return state, actuators.after(parameters, after, ctrl), controls, limited, scale

        before, after, *rest = jax.eval_shape(everything, jnp.zeros(3, dtype), jax.random.PRNGKey(0))
    assert {x.dtype.name for x in jax.tree.leaves((before, after, rest))} == {dtype}
    assert jax.tree.map(lambda x: x.shape, before) == jax.tree.map(lambda x: x.shape, after)
    assert [x.shape for x in rest] == [(10, 3), (3,), ()]


def test_gradients_are_finite_at_the_nominal_parameters():
    actuators = make(EVERYTHING, 3, nu=2, max_delay=0.01)

    def loss(parameters):
        state = actuators.start(parameters, jnp.ones(2), KEY)
        controls, state = actuators.controls(parameters, state, 0.5 * jnp.ones(2), KEY)
        state = actuators.after(parameters, state, controls[0])
        limits = actuators.limits(parameters, state, jnp.full(2, jnp.inf))
        ones = jnp.ones(2)
        last = limit_control(jnp, controls[-1], ones, ones, ones, jnp.zeros((2, 3)), limits)
        return jnp.sum(controls) + jnp.sum(last) + jnp.sum(actuators.period_scale(parameters, KEY))

    gradient = jax.jit(jax.grad(loss))(actuators.nominal())
    assert all(np.isfinite(g).all() for g in gradient.values()), gradient
    assert gradient["delay"].any()


def test_bad_descriptions_are_refused_with_what_would_be_valid():
    with pytest.raises(UserError, match=r"unknown actuator effects \['lagg'\]; valid effects: .*lag"):
        make({"lagg"})
    with pytest.raises(UserError, match="2 actuators but 1 rows"):
        Actuators(("a", "b"), ((-1, 1),), DT, 1)
    with pytest.raises(UserError, match="substeps >= 1"):
        make((), substeps=0)
    assert UNITS.keys() == {name for parameters in EFFECTS.values() for name in parameters}

"""Every episode its own world, drawn as written, on a nominal model that never changes."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from conftest import ENVIRONMENTS, environment, keys, make
from scipy import stats

import simreal
from simreal.distributions import Beta, Choice, LogUniform, Normal, TruncatedNormal, Uniform
from simreal.envs.cartpole_swingup import MODEL, CartpoleSwingup
from simreal.quantities import QUANTITIES, nominal_field
from simreal.randomizers import actuator, disturbance, physics, sensor
from simreal.rollout import Rollout
from simreal.worldsets import WorldSet

DISTRIBUTIONS = [
    Uniform(-1.0, 3.0),
    LogUniform(0.2, 5.0),
    Normal(1.0, 0.5),
    TruncatedNormal(0.0, 1.0, -0.5, 2.0),
    Beta(2.0, 5.0, -1.0, 1.0),
    Choice([1.0, 2.0, 4.0], [1.0, 2.0, 1.0]),
]


@pytest.mark.parametrize("distribution", DISTRIBUTIONS, ids=lambda d: type(d).__name__)
def test_quantiles_follow_the_distribution(distribution):
    u = (jnp.arange(4000) + 0.5) / 4000
    draws = np.asarray(distribution.quantile(u, distribution.parameters()))
    if distribution.continuous:
        assert stats.kstest(draws, distribution.cdf).statistic < 1e-3
    else:
        np.testing.assert_allclose([(draws == v).mean() for v in (1, 2, 4)], [0.25, 0.5, 0.25], atol=1e-3)
    low, high = distribution.support()
    assert draws.min() >= low - 1e-6
    assert draws.max() <= high + 1e-6
    normalized = np.asarray(distribution.normalize(jnp.asarray(draws), distribution.parameters()))
    assert np.abs(normalized).max() <= 1
    assert normalized.min() < -0.9
    assert normalized.max() > 0.7


def episode_starts(name, worlds=256, at_least=2_000):
    """Draws of worlds as a rollout meets them, episode after episode, and whether the model is unchanged."""
    env = environment(name)
    rollout = Rollout(env, worlds, capacity=worlds)
    refill, renew = jax.jit(rollout.refill), jax.jit(rollout.renew)
    before = model_bytes(env.mj_model)
    state = rollout.start(jax.random.PRNGKey(3))
    draws, simultaneous = [], []
    while len(draws) * worlds < at_least:
        reserve = refill(state.reserve, env.randomizer.ranges)
        state = renew(dataclasses.replace(state, reserve=reserve))
        draws.append(jax.tree.map(np.asarray, state.env.world.draws))
        simultaneous.append(np.asarray(state.env.world.number))
        # All episodes end: the next renewal draws them all anew.
        state = dataclasses.replace(state, env=dataclasses.replace(state.env, done=jnp.ones(worlds)))
    joined = {n: np.concatenate([d[n] for d in draws]) for n in draws[0]}
    return env, joined, simultaneous, before == model_bytes(env.mj_model)


def model_bytes(model):
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_every_episode_draws_its_own_world(name):
    env, draws, simultaneous, unchanged = episode_starts(name)
    continuous = {n: d for n, d in env.randomizer.draw_distributions.items() if d.continuous}
    for factor, distribution in continuous.items():
        values = draws[factor]
        assert len(values) >= 2_000
        pvalue = stats.kstest(values.reshape(-1), distribution.cdf).pvalue
        assert pvalue > 0.01 / len(continuous), f"{factor}: {pvalue}"
        assert len(np.unique(values)) > 0.99 * values.size, f"{factor} repeats its draws"
    for numbers in simultaneous:
        assert len({tuple(n) for n in numbers}) == len(numbers)
    assert unchanged, "the nominal model changed"


def test_factors_are_drawn_independently_of_each_other():
    env = environment("cartpole_swingup")
    draws = jax.vmap(env.randomizer.sample)(keys(4000))
    table = np.stack([np.asarray(v).reshape(4000, -1)[:, 0] for v in draws.values()])
    correlation = np.corrcoef(stats.rankdata(table, axis=1)) - np.eye(len(table))
    assert np.abs(correlation).max() < 0.08
    fewer = simreal.make(
        "cartpole_swingup", randomizer=simreal.Randomizer(pole_mass=env.randomizer.factors["pole_mass"])
    )
    np.testing.assert_array_equal(
        jax.vmap(fewer.randomizer.sample)(keys(8))["pole_mass"],
        jax.vmap(env.randomizer.sample)(keys(8))["pole_mass"],
    )


def test_a_thousand_resets_leave_no_trace():
    env = environment("arm_reach")
    before = model_bytes(env.mj_model)
    build = jax.jit(lambda key: env.randomizer.build(env.randomizer.sample(key)))
    for key in keys(1000):
        build(key)
    assert model_bytes(env.mj_model) == before
    nominal = env.randomizer.build({})
    for field, value in nominal.model.items():
        written = nominal_field(env.mj_model, field)
        np.testing.assert_allclose(value, written, rtol=2e-5, atol=1e-6, err_msg=field)


def test_building_twice_is_the_same_world_and_draws_do_not_compound():
    builder = environment("cartpole_swingup").randomizer
    once, twice = (builder.build({"pole_mass": 1.3}) for _ in range(2))
    assert jax.tree.all(jax.tree.map(lambda a, b: bool(jnp.array_equal(a, b)), once, twice))
    model = environment("cartpole_swingup").mj_model
    pole = model.body("pole").id
    assert once.model["body_mass"][pole] == pytest.approx(1.3 * model.body_mass[pole], rel=1e-6)
    np.testing.assert_allclose(once.model["body_inertia"][pole], 1.3 * model.body_inertia[pole], rtol=1e-5)
    assert once.model["body_mass"][model.body("cart").id] == pytest.approx(model.body("cart").mass[0])


def world_of(factor, value, name="go2_walk"):
    env = make(name, randomizer=simreal.Randomizer(factor=factor))
    return env, env.randomizer.build({"factor": value})


def test_gain_kp_kv_and_force_limit_do_what_they_say():
    env, world = world_of(physics.kp("FR_hip").times(Uniform(0.5, 2)), 1.2)
    model, motor = env.mj_model, env.mj_model.actuator("FR_hip").id
    assert world.model["actuator_gainprm"][motor, 0] == pytest.approx(1.2 * model.actuator_gainprm[motor, 0])
    assert world.model["actuator_biasprm"][motor, 1] == pytest.approx(1.2 * model.actuator_biasprm[motor, 1])
    assert world.model["actuator_biasprm"][motor, 2] == pytest.approx(model.actuator_biasprm[motor, 2])
    env, world = world_of(physics.kv("*").times(Uniform(0.5, 2)), 0.8)
    damping = world.model["actuator_biasprm"][:, 2]
    np.testing.assert_allclose(damping, 0.8 * model.actuator_biasprm[:, 2], rtol=1e-6)
    env, world = world_of(actuator.gain("*").times(Uniform(0.5, 2)), 0.7)
    np.testing.assert_allclose(world.model["actuator_biasprm"], 0.7 * model.actuator_biasprm, rtol=1e-6)
    env, world = world_of(physics.force_limit("*").times(Uniform(0.5, 2)), 0.5)
    np.testing.assert_allclose(world.model["actuator_forcerange"], 0.5 * model.actuator_forcerange, rtol=1e-6)


def test_joint_range_gravity_and_reference():
    env, world = world_of(physics.gravity().times(Uniform(0.5, 1.5)), 0.5, "arm_reach")
    np.testing.assert_allclose(world.model["opt.gravity"], [0, 0, -4.905], rtol=1e-6)
    env, world = world_of(physics.gravity_tilt("y").plus(Uniform(-0.2, 0.2)), 0.1, "arm_reach")
    tilted = [-9.81 * np.sin(0.1), 0, -9.81 * np.cos(0.1)]
    np.testing.assert_allclose(world.model["opt.gravity"], tilted, rtol=1e-6)
    env, world = world_of(physics.joint_reference("elbow").plus(Uniform(-0.2, 0.2)), 0.1, "arm_reach")
    np.testing.assert_allclose(world.model["qpos0"], [0, 0.1], rtol=1e-6)
    env, world = world_of(physics.joint_range("FR_calf_joint").times(Uniform(0.5, 1)), 0.5, "go2_walk")
    joint = env.mj_model.joint("FR_calf_joint").id
    low, high = env.mj_model.jnt_range[joint]
    np.testing.assert_allclose(
        world.model["jnt_range"][joint], [low + (high - low) / 4, high - (high - low) / 4], rtol=1e-5
    )


def test_each_draws_one_value_per_element():
    env = simreal.make(
        "arm_reach", randomizer=simreal.Randomizer(d=physics.joint_damping("*").times(Uniform(0.5, 2)).each())
    )
    draws = env.randomizer.sample(jax.random.PRNGKey(0))
    assert draws["d"].shape == (2,)
    assert draws["d"][0] != draws["d"][1]
    world = env.randomizer.build(draws)
    np.testing.assert_allclose(world.model["dof_damping"], draws["d"] * env.mj_model.dof_damping, rtol=1e-6)


def test_events_jump_at_their_time():
    slip = physics.joint_damping("slider").times(Uniform(2, 4)).at(Uniform(1, 2))
    load = physics.body_mass("cart").plus(Uniform(1, 2)).at(Uniform(3, 4))
    env = simreal.make("cartpole_swingup", randomizer=simreal.Randomizer(slip=slip, load=load))
    world = env.randomizer.build({"slip": 3.0, "slip_time": 1.5, "load": 1.0, "load_time": 3.5})
    model, nominal = env.mj_model, env.mj_model.dof_damping[0]
    cart = model.body("cart").id
    for time, damping, mass in ((0.0, 1, 1.0), (1.49, 1, 1.0), (1.5, 3, 1.0), (3.6, 3, 2.0)):
        now = world.at(jnp.asarray(time))
        assert now.model["dof_damping"][0] == pytest.approx(damping * nominal)
        assert now.model["body_mass"][cart] == pytest.approx(mass)
        both = mass + model.body("pole").mass[0]
        assert now.model["body_subtreemass"][cart] == pytest.approx(both, rel=1e-5)
    # The rarer order of events, in one world of a batch.
    swapped = env.randomizer.build({"slip": 3.0, "slip_time": 3.5, "load": 1.0, "load_time": 1.5})
    assert swapped.at(jnp.asarray(2.0)).model["body_mass"][cart] == pytest.approx(2.0)
    assert swapped.at(jnp.asarray(2.0)).model["dof_damping"][0] == pytest.approx(nominal)


class Weighted(CartpoleSwingup):
    """With a body that MuJoCo finds simple: nothing but a slide, the centre of mass at the origin."""

    def model(self):
        weight = '<body name="weight"><joint type="slide"/><geom size=".1" mass="1"/></body>'
        return mujoco.MjModel.from_xml_string(MODEL.replace("</worldbody>", weight + "</worldbody>"))


def test_units_are_those_of_what_is_addressed():
    go2 = environment("go2_walk").randomizer
    assert go2.bound["gyro_noise"].unit == "rad/s"
    assert go2.bound["encoder_noise"].unit == "rad"
    assert go2.bound["motor_delay"].unit == "s"
    assert go2.bound["push_impulse"].unit == "N s"
    assert go2.bound["kp"].unit == "x"
    factors = {
        "play": actuator.backlash("*").set(Uniform(0, 0.1)),
        "far": sensor.drift("gyro").set(Uniform(0, 1)),
    }
    bound = make("go2_walk", randomizer=simreal.Randomizer(**factors)).randomizer.bound
    assert (bound["play"].unit, bound["far"].unit) == ("rad", "rad/s/sqrt(s)")
    assert environment("arm_reach").randomizer.bound["motor_noise"].unit == "N m"


def test_a_sweep_of_no_load_speed_stays_above_zero():
    factor = actuator.no_load_speed("slide").set(Uniform(2, 20))
    env = simreal.make("cartpole_swingup", randomizer=simreal.Randomizer(f=factor))
    assert 0 < env.randomizer.bound["f"].lowest < 0.1


def make_bad(**factors):
    return lambda: simreal.make("cartpole_swingup", randomizer=simreal.Randomizer(**factors))


BAD = {
    "unknown body": (make_bad(f=physics.body_mass("pol").times(Uniform(0.5, 1))), "did you mean 'pole'"),
    "unknown actuator": (make_bad(f=actuator.delay("motor").set(Uniform(0, 0.01))), "valid: slide"),
    "unknown sensor": (make_bad(f=sensor.bias("pole").set(Uniform(0, 0.01))), "pole_angle"),
    "negative mass": (make_bad(f=physics.body_mass("pole").times(Uniform(-0.5, 1))), "must be above 0"),
    "mass minus payload": (make_bad(f=physics.body_mass("pole").plus(Uniform(-3, 1))), "must be above 0"),
    "unbounded mass": (make_bad(f=physics.body_mass("pole").times(Normal(1, 0.1))), "must be above 0"),
    "negative damping": (make_bad(f=physics.joint_damping("*").set(Uniform(-1, 1))), "must be at least 0"),
    "negative delay": (make_bad(f=actuator.delay("*").set(Uniform(-0.01, 0))), "must be at least 0"),
    "delay beyond the buffer": (make_bad(f=actuator.delay("*").set(Uniform(0, 3))), "does not fit"),
    "unbounded delay": (make_bad(f=sensor.delay("*").set(Normal(0.1, 0.1))), "must be at least 0"),
    "scaling nothing": (make_bad(f=physics.armature("*").times(Uniform(0.5, 1))), "use plus or set"),
    "inertia plus": (make_bad(f=physics.body_inertia("pole").plus(Uniform(0, 1))), "valid: times"),
    "backlash of a torque motor": (
        make_bad(f=actuator.backlash("*").set(Uniform(0, 0.1))),
        "no position actuator",
    ),
    "deadband of a servo": (
        lambda: make(
            "go2_walk", randomizer=simreal.Randomizer(f=actuator.deadband("*").set(Uniform(0, 0.1)))
        ),
        "is a position actuator",
    ),
    "centre of mass of a simple body": (
        lambda: Weighted(
            randomizer=simreal.Randomizer(f=physics.body_com("weight").plus(Uniform(-0.1, 0.1)))
        ),
        'add simple="false" to that body',
    ),
    "no speed at all": (make_bad(f=actuator.no_load_speed("*").set(Uniform(0, 10))), "must be above 0"),
    "no force at all": (make_bad(f=actuator.thermal_limit("*").set(Uniform(0, 1))), "must be above 0"),
    "scaling infinity": (
        make_bad(f=actuator.no_load_speed("*").times(Uniform(0.5, 1))),
        "only set changes it",
    ),
    "push on nothing": (make_bad(f=disturbance.push_rate("pol").set(Uniform(0, 1))), "did you mean 'pole'"),
    "no operation": (make_bad(f=physics.body_mass("pole")), "give it an operation"),
    "event before the start": (
        make_bad(f=physics.body_mass("pole").times(Uniform(0.5, 1)).at(Uniform(-1, 1))),
        "at least 0",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_impossible_factors_are_refused_in_one_line(case):
    make, expected = BAD[case]
    with pytest.raises(simreal.UserError) as caught:
        make()
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_one_unknown_name_among_known_ones_is_refused():
    with pytest.raises(simreal.UserError, match="'lower_lnk' addresses nothing; did you mean 'lower_link'"):
        simreal.make(
            "arm_reach",
            randomizer=simreal.Randomizer(
                m=physics.body_mass("upper_link", "lower_lnk").times(Uniform(0.5, 1))
            ),
        )


def test_factors_that_are_impossible_only_together_are_refused():
    light, lighter = (physics.body_mass("tool") for _ in range(2))
    with pytest.raises(simreal.UserError, match="together"):
        simreal.make(
            "arm_reach",
            randomizer=simreal.Randomizer(a=light.times(Uniform(0.2, 1)), b=lighter.plus(Uniform(-0.2, 0))),
        )


@pytest.mark.parametrize("each", [False, True])
def test_setting_unequal_nominal_values_leaves_the_nominal_world_nominal(each):
    factor = physics.joint_damping("*").set(Uniform(0.5, 2))
    env = simreal.make("arm_reach", randomizer=simreal.Randomizer(d=factor.each() if each else factor))
    np.testing.assert_allclose(env.randomizer.build({}).model["dof_damping"], env.mj_model.dof_damping)
    np.testing.assert_allclose(env.randomizer.build({"d": 1.5}).model["dof_damping"], [1.5, 1.5])


def test_low_above_high_is_refused():
    with pytest.raises(ValueError, match="above high"):
        Uniform(2, 1)


def test_a_set_that_touches_the_training_range_is_refused():
    worldset = WorldSet("close", "", "outside", outside={"pole_mass": [(1.3, 2.0)]})
    with pytest.raises(simreal.UserError, match=r"pole_mass in \[1.3, 2\] touches"):
        worldset.check(environment("cartpole_swingup").randomizer)


def test_the_table_names_real_model_fields():
    model = environment("arm_reach").mj_model
    for quantity in QUANTITIES.values():
        for field in quantity.fields:
            owner, attribute = (model.opt, field[4:]) if field.startswith("opt.") else (model, field)
            assert hasattr(owner, attribute)

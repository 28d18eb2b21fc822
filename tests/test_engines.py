"""The two engines agree, and both do what they are told."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import environment

import simreal
from simreal.distributions import Uniform
from simreal.engines import Inputs
from simreal.randomizers import actuator, disturbance, physics, sensor

PHYSICS_STEPS = 200


def trajectory(env, world_draws, controls):
    """qpos (steps, nq) of one world under given controls (steps, nu), one physics step at a time."""
    world = env.randomizer.build(world_draws)
    qpos, qvel, _ = env.start(jax.random.PRNGKey(2))
    substeps = env.substeps
    grouped = controls.reshape(-1, substeps, controls.shape[-1])

    @jax.jit
    def run(world, grouped):
        def step(physics, control):
            physics, _ = env.engine.step(world, physics, Inputs(controls=control, limits={}))
            return physics, physics.qpos

        return jax.lax.scan(step, env.engine.initial(qpos, qvel), grouped)[1]

    return np.asarray(run(world, grouped))


def random_controls(env, seed=0):
    low, high = env.mj_model.actuator_ctrlrange.T
    return jnp.asarray(
        np.random.default_rng(seed).uniform(low, high, (PHYSICS_STEPS, env.mj_model.nu)), float
    )


@pytest.mark.parametrize("name", ["arm_reach", "cartpole_swingup"])
@pytest.mark.parametrize("precise", [False, True], ids=["float32", "float64"])
def test_engines_agree_over_200_physics_steps(name, precise):
    with jax.enable_x64(precise):
        envs = [simreal.make(name, engine=engine) for engine in ("mujoco", "mjx")]
        draws = {"payload": 0.5} if name == "arm_reach" else {"pole_mass": 1.3, "cart_mass": 0.9}
        controls = random_controls(envs[0])
        one, other = (trajectory(env, draws, controls) for env in envs)
        assert one.dtype == (np.float64 if precise else np.float32)
        assert np.abs(one).max() > 0.1
        np.testing.assert_allclose(one, other, atol=1e-8 if precise else 1e-4, rtol=0)


def standing(engine, qpos, steps):
    """Where a Go2 that holds its home pose is after each of `steps` control steps, (steps, nq)."""
    env = environment("go2_walk", engine)
    control = jnp.asarray(env.mj_model.key_ctrl[0], float)[None]

    @jax.jit
    def stand(world, qpos):
        def step(physics, _):
            physics, _ = env.engine.step(world, physics, Inputs(controls=control, limits={}))
            return physics, physics.qpos

        return jax.lax.scan(step, env.engine.initial(qpos, jnp.zeros(env.mj_model.nv)), length=steps)[1]

    return np.asarray(stand(env.randomizer.build({}), jnp.asarray(qpos, float)))


def test_go2_stands_at_the_same_height_on_both_engines():
    home = environment("go2_walk").mj_model.key_qpos[0]
    settled = standing("mujoco", home, 75)[-1]
    here, there = (standing(engine, settled, 50)[:, 2] for engine in ("mujoco", "mjx"))
    assert here[-1] > 0.2
    assert np.abs(here - there).max() < 2e-3


@pytest.mark.parametrize("engine", ["mujoco", "mjx"])
def test_a_push_changes_momentum_by_its_impulse(engine):
    randomizer = simreal.Randomizer(
        rate=disturbance.push_rate("cart").set(Uniform(0, 100)),
        hit=disturbance.push_impulse("cart").set(Uniform(0, 5)),
    )
    env = simreal.make("cartpole_swingup", engine=engine, randomizer=randomizer)
    world = env.randomizer.build({})
    physics = env.engine.initial(jnp.array([0.0, jnp.pi]), jnp.zeros(2))
    push = jnp.array([0.3 / env.control_dt, 0.0, 0.0])
    moved, _ = jax.jit(env.engine.step)(world, physics, Inputs(jnp.zeros((1, 1)), {}, push=push))
    model = env.mj_model
    # Cart and hanging pole share the impulse as two bodies joined by a free hinge do: M qvel = (impulse, 0).
    mass, pole, half = model.body("cart").mass[0], model.body("pole").mass[0], 0.35
    inertia = model.body("pole").inertia[0] + pole * half**2
    matrix = np.array([[mass + pole, -pole * half], [-pole * half, inertia]])
    np.testing.assert_allclose(moved.qvel, np.linalg.solve(matrix, [0.3, 0.0]), rtol=0.05)


@pytest.mark.parametrize("engine", ["mujoco", "mjx"])
def test_the_control_period_stretches_with_jitter(engine):
    randomizer = simreal.Randomizer(jitter=actuator.period_jitter().set(Uniform(0, 0.5)))
    env = simreal.make("cartpole_swingup", engine=engine, randomizer=randomizer)
    physics = env.engine.initial(jnp.array([0.0, 3.0]), jnp.zeros(2))
    inputs = Inputs(jnp.zeros((1, 1)), {}, period_scale=jnp.asarray(1.5))
    moved, _ = jax.jit(env.engine.step)(env.randomizer.build({}), physics, inputs)
    assert float(moved.time) == pytest.approx(1.5 * env.control_dt, rel=1e-5)


def spinning_torque(engine, no_load):
    """Force of the arm's shoulder at full command while it spins at 5 rad/s."""
    randomizer = simreal.Randomizer(speed=actuator.no_load_speed("shoulder").set(Uniform(1, 100)))
    env = simreal.make("arm_reach", engine=engine, randomizer=randomizer)
    state = env.reset(jax.random.PRNGKey(0), world=env.randomizer.build({"speed": no_load}))
    spinning = state.replace(physics=state.physics.replace(qvel=jnp.array([5.0, 0.0])))
    return float(jax.jit(env.step)(spinning, jnp.array([1.0, 0.0])).metrics["peak_torque"])


@pytest.mark.parametrize("engine", ["mujoco", "mjx"])
def test_torque_falls_with_speed_inside_the_engine(engine):
    env = environment("arm_reach")
    full = env.mj_model.actuator_ctrlrange[0, 1]
    assert spinning_torque(engine, 1e6) == pytest.approx(full, rel=1e-3)
    assert spinning_torque(engine, 10.0) == pytest.approx(full * 0.5, rel=0.15)
    assert spinning_torque(engine, 4.0) == pytest.approx(0.0, abs=0.15 * full)


@pytest.mark.parametrize("engine", ["mujoco", "mjx"])
def test_a_delay_reaches_through_reset_and_step(engine):
    """A 23 ms command delay on the environment's own 5 ms grid: nothing for four steps, then the command."""
    randomizer = simreal.Randomizer(
        late=actuator.delay("slide").set(Uniform(0, 0.05)),
        sees=sensor.delay("cart_position").set(Uniform(0, 0.05)),
    )
    env = simreal.make("cartpole_swingup", engine=engine, randomizer=randomizer)
    step = jax.jit(env.step)

    def velocities(delay):
        world = env.randomizer.build({"late": delay})
        state = env.reset(jax.random.PRNGKey(0), world=world)
        rest = env.engine.initial(jnp.array([0.0, jnp.pi]), jnp.zeros(2))
        state, out = state.replace(physics=rest), []
        for _ in range(4):
            state = step(state, jnp.ones(1))
            out.append(float(state.physics.qvel[0]))
        return np.array(out)

    now, late = velocities(0.0), velocities(0.023)
    assert abs(late[0]) < 1e-6
    # One control period (20 ms) and 3 ms of 5 ms lost: the push is 0.4 of a physics step later than a 20 ms
    # delay.
    assert late[1] == pytest.approx(now[0] * (20 - 3) / 20, rel=0.02)


def test_gradients_flow_through_mjx_with_one_iteration():
    env = simreal.make("cartpole_swingup", engine="mjx", randomizer=simreal.Randomizer(), solver_iterations=1)
    state = env.reset(jax.random.PRNGKey(0))
    gradient = jax.jit(jax.grad(lambda a: env.step(state, a).physics.qvel[0]))(jnp.array([0.1]))
    small = 1e-2
    difference = env.step(state, jnp.array([0.1 + small])).physics.qvel[0]
    difference -= env.step(state, jnp.array([0.1 - small])).physics.qvel[0]
    assert gradient[0] == pytest.approx(float(difference) / (2 * small), rel=0.02)
    assert abs(gradient[0]) > 1e-3


@pytest.mark.parametrize(
    ("engine", "advice"),
    [("mujoco", "engine='mjx', solver_iterations=1"), ("mjx", "solver of one iteration")],
)
def test_gradients_that_cannot_be_had_say_how_to_get_them(engine, advice):
    # Dry friction is a constraint, so that the solver has something to iterate on.
    randomizer = simreal.Randomizer(dry=physics.friction_loss("slider").plus(Uniform(0, 1)))
    env = simreal.make("cartpole_swingup", engine=engine, randomizer=randomizer)
    state = env.reset(jax.random.PRNGKey(0))
    with pytest.raises(simreal.UserError, match=advice):
        jax.grad(lambda a: env.step(state, a).physics.qvel[0])(jnp.array([0.1]))


def test_mjx_refuses_a_delay_that_it_would_ignore():
    from simreal.envs.cartpole_swingup import MODEL, CartpoleSwingup

    class Delayed(CartpoleSwingup):
        def model(self):
            import mujoco

            return mujoco.MjModel.from_xml_string(
                MODEL.replace('name="slide"', 'name="slide" delay="0.01" nsample="4"')
            )

    with pytest.raises(simreal.UserError, match="which mjx ignores"):
        Delayed(engine="mjx", randomizer=simreal.Randomizer())


def test_a_varied_friction_loss_is_not_compiled_away_on_mjx():
    randomizer = simreal.Randomizer(dry=physics.friction_loss("slider").plus(Uniform(0, 20)))
    speeds = []
    for engine in ("mujoco", "mjx"):
        env = simreal.make("cartpole_swingup", engine=engine, randomizer=randomizer)
        state = env.reset(jax.random.PRNGKey(0), world=env.randomizer.build({"dry": 15.0}))
        speeds.append(float(jax.jit(env.step)(state, jnp.ones(1)).physics.qvel[0] - state.physics.qvel[0]))
    assert abs(speeds[1]) < 0.1
    assert speeds[0] == pytest.approx(speeds[1], abs=1e-3)


def test_a_reset_does_not_remember_what_the_row_did_before():
    """The host keeps its rows between calls: state, forces and pushes of the last call must not show."""
    env = environment("arm_reach")
    world = env.randomizer.build({})
    start = env.engine.initial(jnp.array([0.3, 0.8]), jnp.zeros(2))
    fresh = env.engine.forward(world, start)
    env.engine.step(world, start, Inputs(jnp.full((1, 2), 15.0), {}))
    again = env.engine.forward(world, start)
    assert jax.tree.all(jax.tree.map(lambda a, b: bool(jnp.array_equal(a, b)), fresh, again))
    assert not again.actuator_force.any()


def test_unknown_options():
    with pytest.raises(simreal.UserError, match="unknown option 'egnine'; did you mean 'engine'"):
        simreal.make("cartpole_swingup", egnine="mjx")


def test_unknown_engine():
    with pytest.raises(simreal.UserError, match="valid: auto, mujoco, mjx"):
        simreal.make("cartpole_swingup", engine="bullet")

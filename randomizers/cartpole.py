"""Ranges and world sets of `cartpole_swingup`. Written before its first training run."""

from __future__ import annotations

from simreal.distributions import LogUniform, Normal, Uniform
from simreal.randomizer import Randomizer
from simreal.randomizers import actuator, disturbance, physics, sensor
from simreal.worldsets import NOMINAL, held_out, stand_in
from simreal.worldsets import TRAIN as TRAIN_SET

TRAIN = Randomizer(
    # Dactyl (OpenAI 2018) scales masses by 0.5 to 1.5 and damping log-uniformly by 0.3 to 3.
    cart_mass=physics.body_mass("cart").times(Uniform(0.8, 1.2)),
    pole_mass=physics.body_mass("pole").times(LogUniform(0.7, 1.4)),
    pole_com=physics.body_com("pole", axis="z").plus(Uniform(-0.04, 0.04)),
    rail_damping=physics.joint_damping("slider").times(LogUniform(0.3, 3.0)),
    hinge_damping=physics.joint_damping("hinge").times(LogUniform(0.3, 3.0)),
    # Motor strength 80 to 120 % and latency up to 40 ms: Tan et al. 2018.
    motor_gain=actuator.gain("slide").times(Uniform(0.8, 1.2)),
    motor_delay=actuator.delay("slide").set(Uniform(0.0, 0.03)),
    motor_lag=actuator.lag("slide").set(Uniform(0.0, 0.02)),
    angle_bias=sensor.bias("pole_angle").set(Normal(0.0, 0.01)),
    angle_noise=sensor.noise("pole_angle").set(Uniform(0.0, 0.01)),
    velocity_noise=sensor.noise("pole_velocity", "cart_velocity").set(Uniform(0.0, 0.05)),
    sensor_delay=sensor.delay("*").set(Uniform(0.0, 0.02)),
    push_rate=disturbance.push_rate("pole").set(Uniform(0.0, 0.3)),
    push_impulse=disturbance.push_impulse("pole").set(Uniform(0.0, 0.05)),
)

SETS = (
    NOMINAL,
    TRAIN_SET,
    held_out(
        cart_mass=[(0.6, 0.78), (1.22, 1.5)],
        pole_mass=[(0.45, 0.68), (1.45, 2.0)],
        pole_com=[(-0.08, -0.045), (0.045, 0.08)],
        rail_damping=[(0.1, 0.28), (3.2, 6.0)],
        motor_gain=[(0.65, 0.78), (1.22, 1.4)],
        motor_delay=[(0.032, 0.05)],
        motor_lag=[(0.022, 0.04)],
        angle_bias=[(-0.06, -0.035), (0.035, 0.06)],
        angle_noise=[(0.012, 0.03)],
        sensor_delay=[(0.022, 0.04)],
        push_impulse=[(0.06, 0.12)],
    ),
    stand_in(
        "worn_motor",
        "a tired motor: 70 % of its force, slow, on a sticky rail",
        motor_gain=0.7,
        motor_lag=0.03,
        rail_damping=4.0,
        motor_delay=0.015,
        angle_noise=0.005,
        velocity_noise=0.03,
    ),
    stand_in(
        "long_pole",
        "a pole 80 % heavier with its weight further out",
        pole_mass=1.8,
        pole_com=0.07,
        motor_delay=0.01,
        angle_noise=0.005,
        velocity_noise=0.03,
    ),
    stand_in(
        "laggy_bus",
        "a slow bus: commands 45 ms and readings 35 ms late",
        motor_delay=0.045,
        sensor_delay=0.035,
        angle_noise=0.005,
        velocity_noise=0.03,
    ),
)

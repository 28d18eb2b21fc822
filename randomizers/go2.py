"""Ranges and world sets of `go2_walk`. Written before its first training run."""

from __future__ import annotations

from simreal.distributions import LogUniform, Normal, Uniform
from simreal.randomizer import Randomizer
from simreal.randomizers import actuator, disturbance, physics, sensor
from simreal.worldsets import NOMINAL, held_out, stand_in
from simreal.worldsets import TRAIN as TRAIN_SET

_FEET = ("FL", "FR", "RL", "RR")

TRAIN = Randomizer(
    # Tan et al. 2018: link masses 80-120 %, motor strength 80-120 %, latency 0-40 ms, contact friction
    # 0.5-1.25, IMU bias +-0.05 rad.
    link_mass=physics.body_mass("*_hip", "*_thigh", "*_calf").times(Uniform(0.85, 1.15)),
    trunk_mass=physics.body_mass("base").times(Uniform(0.85, 1.15)),
    payload=physics.body_mass("base").plus(Uniform(-1.0, 2.0)),  # RMA (Kumar et al. 2021) trains 0 to 6 kg
    trunk_com_x=physics.body_com("base", axis="x").plus(Uniform(-0.03, 0.03)),
    foot_friction=physics.friction(*_FEET).set(Uniform(0.4, 1.25)),
    joint_damping=physics.joint_damping("*_joint").times(LogUniform(0.7, 1.4)),
    joint_friction=physics.friction_loss("*_joint").plus(Uniform(0.0, 0.15)),  # on top of 0.2 N m
    kp=physics.kp("*").times(Uniform(0.85, 1.15)),
    kv=physics.kv("*").times(Uniform(0.8, 1.2)),
    motor_gain=actuator.gain("*").times(Uniform(0.9, 1.1)).each(),  # RMA: 0.90 to 1.10
    motor_delay=actuator.delay("*").set(Uniform(0.0, 0.02)),
    encoder_offset=sensor.bias("joint_position").set(Normal(0.0, 0.01)).each(),
    encoder_noise=sensor.noise("joint_position").set(Uniform(0.0, 0.01)),
    velocity_noise=sensor.noise("joint_velocity").set(Uniform(0.0, 0.5)),
    gyro_noise=sensor.noise("gyro").set(Uniform(0.0, 0.1)),
    gravity_noise=sensor.noise("gravity").set(Uniform(0.0, 0.03)),
    gravity_bias=sensor.bias("gravity").set(Uniform(-0.03, 0.03)).each(),
    imu_delay=sensor.delay("gyro", "gravity").set(Uniform(0.0, 0.01)),
    push_rate=disturbance.push_rate("base").set(Uniform(0.0, 0.3)),
    push_impulse=disturbance.push_impulse("base").set(Uniform(0.0, 6.0)),  # up to 0.4 m/s
)

SETS = (
    NOMINAL,
    TRAIN_SET,
    held_out(
        link_mass=[(0.7, 0.83), (1.17, 1.4)],
        payload=[(2.2, 5.0)],
        trunk_com_x=[(-0.06, -0.035), (0.035, 0.06)],
        foot_friction=[(0.2, 0.38), (1.3, 2.0)],
        joint_damping=[(0.4, 0.65), (1.5, 2.2)],
        joint_friction=[(0.2, 0.6)],
        kp=[(0.65, 0.82), (1.18, 1.4)],
        motor_gain=[(0.75, 0.88), (1.12, 1.25)],
        motor_delay=[(0.022, 0.035)],
        encoder_offset=[(-0.08, -0.035), (0.035, 0.08)],
        gyro_noise=[(0.12, 0.4)],
        gravity_bias=[(-0.08, -0.035), (0.035, 0.08)],
        imu_delay=[(0.012, 0.03)],
        push_impulse=[(7.0, 12.0)],
    ),
    stand_in(
        "payload_5kg",
        "5 kg strapped on the back, a little behind the middle",
        payload=5.0,
        trunk_com_x=-0.03,
        motor_delay=0.01,
        velocity_noise=0.2,
        gyro_noise=0.05,
        gravity_noise=0.01,
    ),
    stand_in(
        "wet_floor",
        "a wet, smooth floor: friction 0.25",
        foot_friction=0.25,
        motor_delay=0.01,
        velocity_noise=0.2,
        gyro_noise=0.05,
        gravity_noise=0.01,
    ),
    stand_in(
        "weak_motors",
        "a low battery and worn gears: 75 % strength, stiff joints",
        motor_gain=0.75,
        joint_damping=1.6,
        joint_friction=0.3,
        motor_delay=0.015,
        velocity_noise=0.2,
        gyro_noise=0.05,
        gravity_noise=0.01,
    ),
)

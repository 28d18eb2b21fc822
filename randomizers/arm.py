"""Ranges and world sets of `arm_reach`. Written before its first training run."""

from __future__ import annotations

from simreal.distributions import LogUniform, Normal, Uniform
from simreal.randomizer import Randomizer
from simreal.randomizers import actuator, physics, sensor
from simreal.worldsets import NOMINAL, held_out, stand_in
from simreal.worldsets import TRAIN as TRAIN_SET

TRAIN = Randomizer(
    # Dactyl (OpenAI 2018): masses x 0.5 to 1.5, damping x log-uniform 0.3 to 3.
    # Peng et al. 2018: masses x 0.25 to 4.
    link_mass=physics.body_mass("upper_link", "lower_link").times(Uniform(0.7, 1.3)).each(),
    payload=physics.body_mass("tool").plus(Uniform(0.0, 0.8)),
    joint_damping=physics.joint_damping("*").times(LogUniform(0.4, 2.5)).each(),
    tilt=physics.gravity_tilt("y").plus(Uniform(-0.01, 0.01)),
    # Motor strength 80 to 120 %, latency up to 40 ms: Tan et al. 2018.
    motor_gain=actuator.gain("*").times(Uniform(0.8, 1.2)).each(),
    motor_delay=actuator.delay("*").set(Uniform(0.0, 0.02)),
    motor_noise=actuator.noise("*").set(Uniform(0.0, 0.5)),
    encoder_bias=sensor.bias("joint_position").set(Normal(0.0, 0.005)).each(),
    encoder_noise=sensor.noise("joint_position").set(Uniform(0.0, 0.002)),
    velocity_noise=sensor.noise("joint_velocity").set(Uniform(0.0, 0.05)),
    camera_noise=sensor.noise("tip_camera").set(Uniform(0.0, 0.004)),
    camera_delay=sensor.delay("tip_camera").set(Uniform(0.02, 0.06)),
)

SETS = (
    NOMINAL,
    TRAIN_SET,
    held_out(
        link_mass=[(0.45, 0.68), (1.35, 2.0)],
        payload=[(0.85, 2.0)],
        joint_damping=[(0.15, 0.38), (2.6, 5.0)],
        tilt=[(-0.03, -0.011), (0.011, 0.03)],
        motor_gain=[(0.6, 0.78), (1.22, 1.5)],
        motor_delay=[(0.022, 0.05)],
        motor_noise=[(0.6, 2.0)],
        encoder_bias=[(-0.04, -0.018), (0.018, 0.04)],
        velocity_noise=[(0.06, 0.2)],
        camera_noise=[(0.005, 0.012)],
        camera_delay=[(0.065, 0.1)],
    ),
    stand_in(
        "worn_motor",
        "a tired shoulder motor at 70 % on stiff joints",
        motor_gain=(0.7, 0.85),
        joint_damping=3.0,
        motor_delay=0.01,
        camera_delay=0.04,
        camera_noise=0.002,
    ),
    stand_in(
        "heavy_tool",
        "a 2 kg tool where 0.3 to 1.1 kg was expected",
        payload=1.7,
        motor_delay=0.01,
        camera_delay=0.04,
        camera_noise=0.002,
    ),
    stand_in(
        "laggy_bus",
        "commands 40 ms and pictures 90 ms late",
        motor_delay=0.04,
        camera_delay=0.09,
        camera_noise=0.002,
    ),
)

"""A pole on a cart: swing it up from hanging and keep it there."""

from __future__ import annotations

from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco
from flax import struct

from simreal.engines import Data
from simreal.environment import Environment
from simreal.randomizers import cartpole

RAIL = 1.5  # m, half its length
UPRIGHT = jnp.deg2rad(10.0)
HOLD = 2.0  # s
FALL = 20.0
"""Reward lost where the cart leaves the rail. What it would have earned is not enough: to a policy with a
horizon of a second or two, swinging up a little sooner is worth falling off one time in five."""

MODEL = f"""
<mujoco model="cartpole">
  <option integrator="Euler"/>
  <visual><global offwidth="640" offheight="480"/></visual>
  <asset>
    <texture name="grid" type="2d" builtin="checker" rgb1=".93 .94 .96" rgb2=".86 .88 .92"
             width="300" height="300"/>
    <texture type="skybox" builtin="gradient" rgb1=".95 .97 1" rgb2=".8 .86 .93" width="64" height="64"/>
    <material name="grid" texture="grid" texrepeat="6 6" texuniform="true"/>
  </asset>
  <worldbody>
    <light pos="0 -2 4" dir="0 .4 -1" directional="true"/>
    <camera name="side" pos="0 -3.2 0.15" xyaxes="1 0 0 0 0 1"/>
    <geom name="wall" type="plane" size="6 6 .1" pos="0 1 0" quat="1 1 0 0" material="grid"
          contype="0" conaffinity="0"/>
    <geom name="rail" type="capsule" fromto="-{RAIL} 0 0 {RAIL} 0 0" size=".02" rgba=".35 .38 .45 1"
          contype="0" conaffinity="0"/>
    <body name="cart">
      <joint name="slider" type="slide" axis="1 0 0" damping="0.5"/>
      <geom name="cart" type="box" size=".12 .08 .06" mass="1.0" rgba=".20 .35 .60 1"
            contype="0" conaffinity="0"/>
      <body name="pole">
        <joint name="hinge" type="hinge" axis="0 1 0" damping="0.002"/>
        <geom name="pole" type="capsule" fromto="0 0 0 0 0 .7" size=".022" mass="0.25" rgba=".88 .45 .12 1"
              contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="slide" joint="slider" gear="1" ctrlrange="-12 12" ctrllimited="true"/>
  </actuator>
</mujoco>
"""


@struct.dataclass
class Held:
    """How long the pole has been up without a break."""

    steps: jax.Array  # () int32


class CartpoleSwingup(Environment):
    """Swing the pole up and hold it. Action: motor force as a share of 12 N.

    Success: upright within 10 degrees, on the rail, during all of the last 2 s of 10. The episode fails where
    the cart leaves the rail.
    """

    name: ClassVar[str] = "cartpole_swingup"
    control_dt: ClassVar[float] = 0.02
    physics_dt: ClassVar[float] = 0.005
    episode_length: ClassVar[float] = 10.0
    readings = {
        "cart_position": (1, "m"),
        "pole_angle": (1, "rad"),
        "cart_velocity": (1, "m/s"),
        "pole_velocity": (1, "rad/s"),
    }
    observations = (
        ("cart_position", "m"),
        ("pole_angle_cos", "1"),
        ("pole_angle_sin", "1"),
        ("cart_velocity", "m/s"),
        ("pole_velocity", "rad/s"),
        ("last_action", "1"),
    )
    training = cartpole.TRAIN
    world_sets = cartpole.SETS

    def model(self) -> mujoco.MjModel:
        return mujoco.MjModel.from_xml_string(MODEL)

    def start(self, key):
        noise = 0.05 * jax.random.normal(key, (4,))
        return noise[:2] + jnp.array([0.0, jnp.pi]), noise[2:], Held(jnp.zeros((), jnp.int32))

    def read(self, data: Data, task: Held):
        return {
            "cart_position": data.qpos[0],
            "pole_angle": data.qpos[1],
            "cart_velocity": data.qvel[0],
            "pole_velocity": data.qvel[1],
        }

    def observe(self, reading, task: Held):
        angle = reading["pole_angle"]
        return jnp.stack(
            [
                reading["cart_position"],
                jnp.cos(angle),
                jnp.sin(angle),
                reading["cart_velocity"],
                reading["pole_velocity"],
                reading["last_action"][0],
            ]
        )

    def advance(self, task: Held, data: Data, action):
        angle = jnp.abs(jnp.mod(data.qpos[1] + jnp.pi, 2 * jnp.pi) - jnp.pi)
        return Held(jnp.where(angle < UPRIGHT, task.steps + 1, 0))

    def reward(self, data: Data, task: Held, action, last_action):
        upright = (1 + jnp.cos(data.qpos[1])) / 2
        centred = 1 - 0.5 * jnp.square(data.qpos[0] / RAIL)
        still = 1 / (1 + 0.1 * upright * jnp.square(data.qvel[1]))
        gentle = 1 - 0.1 * jnp.square(action[0])
        return upright * centred * still * gentle - FALL * self.failed(data, task)

    def failed(self, data: Data, task: Held):
        return jnp.abs(data.qpos[0]) > RAIL

    def succeeded(self, task: Held):
        return task.steps >= round(HOLD / self.control_dt)

    def camera(self, model):
        return "side"

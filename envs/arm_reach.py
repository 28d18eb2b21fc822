"""A planar two-link arm that reaches for points, with joint torques."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco
from flax import struct

from simreal.engines import Data
from simreal.environment import Environment
from simreal.randomizers import arm

LINKS = (1.0, 0.8)  # m
WITHIN = 0.02  # m
HOLD = 0.5  # s

MODEL = """
<mujoco model="arm">
  <option integrator="Euler"/>
  <visual><global offwidth="640" offheight="480"/></visual>
  <asset>
    <texture name="grid" type="2d" builtin="checker" rgb1=".93 .94 .96" rgb2=".86 .88 .92"
             width="300" height="300"/>
    <texture type="skybox" builtin="gradient" rgb1=".95 .97 1" rgb2=".8 .86 .93" width="64" height="64"/>
    <material name="grid" texture="grid" texrepeat="4 4" texuniform="true"/>
  </asset>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <light pos="0 -1 4" dir="0 .2 -1" directional="true"/>
    <camera name="top" pos="0 0 4.6" xyaxes="1 0 0 0 1 0"/>
    <geom name="table" type="plane" size="3 3 .1" pos="0 0 -.1" material="grid"/>
    <body name="upper_link">
      <joint name="shoulder" type="hinge" axis="0 0 1" damping="1.0" armature="0.05"/>
      <geom name="upper_link" type="capsule" fromto="0 0 0 1 0 0" size=".04" mass="3.0" rgba=".20 .35 .60 1"/>
      <body name="lower_link" pos="1 0 0">
        <joint name="elbow" type="hinge" axis="0 0 1" damping="0.6" armature="0.03"/>
        <geom name="lower_link" type="capsule" fromto="0 0 0 .8 0 0" size=".03" mass="1.6"
              rgba=".88 .45 .12 1"/>
        <body name="tool" pos=".8 0 0">
          <geom name="tool" type="sphere" size=".035" mass="0.3" rgba=".2 .2 .25 1"/>
          <site name="tip"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="shoulder" joint="shoulder" gear="1" ctrlrange="-40 40" ctrllimited="true"/>
    <motor name="elbow" joint="elbow" gear="1" ctrlrange="-20 20" ctrllimited="true"/>
  </actuator>
</mujoco>
"""


@struct.dataclass
class Reach:
    """Where to, and for how long the tip has been there without a break."""

    target: jax.Array  # (2,) m
    steps: jax.Array  # () int32


class ArmReach(Environment):
    """Bring the tip of a 1.0 m + 0.8 m arm to a target in its plane. Action: joint torques / (40, 20) N m.

    The arm lies in a horizontal plane that may be tilted. It has encoders and a camera that sees the tip late
    and with noise. Success: the tip within 2 cm of the target during all of the last 0.5 s of 4.
    """

    name: ClassVar[str] = "arm_reach"
    control_dt: ClassVar[float] = 0.02
    physics_dt: ClassVar[float] = 0.005
    episode_length: ClassVar[float] = 4.0
    data_fields = ("site_xpos",)
    readings = {"joint_position": (2, "rad"), "joint_velocity": (2, "rad/s"), "tip_camera": (2, "m")}
    observations = (
        ("shoulder_cos", "1"),
        ("shoulder_sin", "1"),
        ("elbow_cos", "1"),
        ("elbow_sin", "1"),
        ("shoulder_velocity", "rad/s"),
        ("elbow_velocity", "rad/s"),
        ("tip_x", "m"),
        ("tip_y", "m"),
        ("target_x", "m"),
        ("target_y", "m"),
        ("to_target_x", "m"),
        ("to_target_y", "m"),
        ("last_shoulder_action", "1"),
        ("last_elbow_action", "1"),
    )
    training = arm.TRAIN
    world_sets = arm.SETS

    def model(self) -> mujoco.MjModel:
        return mujoco.MjModel.from_xml_string(MODEL)

    def start(self, key):
        pose_key, target_key = jax.random.split(key)
        shoulder, elbow = jax.random.uniform(pose_key, (2,), minval=jnp.array([-2.0, 0.4]), maxval=2.0)
        # A target is the tip of a random pose: reachable, away from the stretched and folded singularities.
        low, high = jnp.array([-2.4, 0.4]), jnp.array([2.4, 2.4])
        target = tip(jax.random.uniform(target_key, (2,), minval=low, maxval=high))
        return jnp.stack([shoulder, elbow]), jnp.zeros(2), Reach(target, jnp.zeros((), jnp.int32))

    def read(self, data: Data, task: Reach):
        return {"joint_position": data.qpos, "joint_velocity": data.qvel, "tip_camera": data.site_xpos[0, :2]}

    def observe(self, reading, task: Reach):
        angles = reading["joint_position"]
        seen = reading["tip_camera"]
        return jnp.concatenate(
            [
                jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1).reshape(-1),
                reading["joint_velocity"],
                seen,
                task.target,
                task.target - seen,
                reading["last_action"],
            ]
        )

    def privileged(self, data: Data, task: Reach):
        error = task.target - data.site_xpos[0, :2]
        return jnp.concatenate([error, jnp.linalg.norm(error, keepdims=True)])

    def advance(self, task: Reach, data: Data, action):
        near = jnp.linalg.norm(data.site_xpos[0, :2] - task.target) < WITHIN
        return dataclasses.replace(task, steps=jnp.where(near, task.steps + 1, 0))

    def reward(self, data: Data, task: Reach, action, last_action):
        distance = jnp.linalg.norm(data.site_xpos[0, :2] - task.target)
        closeness = 0.4 / (1 + 3 * distance) + 0.6 * jnp.exp(-jnp.square(distance / 0.03))
        effort = 0.02 * jnp.sum(jnp.square(action)) + 0.05 * jnp.sum(jnp.square(action - last_action))
        return closeness - effort - 0.002 * jnp.sum(jnp.square(data.qvel))

    def failed(self, data: Data, task: Reach):
        return jnp.any(jnp.abs(data.qvel) > 50.0)

    def succeeded(self, task: Reach):
        return task.steps >= round(HOLD / self.control_dt)

    def camera(self, model):
        return "top"

    def markers(self, task: Reach):
        return [(task.target, 0.05)]


def tip(angles: jax.Array) -> jax.Array:
    """Forward kinematics: tip (2,) m from joint angles (2,) rad."""
    shoulder, both = angles[0], angles[0] + angles[1]
    return jnp.stack(
        [
            LINKS[0] * jnp.cos(shoulder) + LINKS[1] * jnp.cos(both),
            LINKS[0] * jnp.sin(shoulder) + LINKS[1] * jnp.sin(both),
        ]
    )

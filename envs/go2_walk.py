"""The Unitree Go2 of the MuJoCo Menagerie, walking forward at a commanded speed."""

from __future__ import annotations

import dataclasses
import functools
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from simreal.engines import Data
from simreal.environment import Environment
from simreal.errors import UserError
from simreal.randomizers import go2

FEET = ("FR", "FL", "RR", "RL")
JOINTS = tuple(f"{leg}_{joint}" for leg in FEET for joint in ("hip", "thigh", "calf"))
HOME = np.array([0.0, 0.9, -1.8] * 4)  # rad, the model's keyframe "home"
ACTION_SCALE = 0.3  # rad
DRY_FRICTION = 0.2  # N m, from the Menagerie's go2.xml; go2_mjx.xml leaves it out
FOOT_RADIUS = 0.022  # m
CLEARANCE = 0.04  # m, a foot that moves shall be lifted by this much
TOUCH = 0.003  # m, a foot closer to the floor than this stands on it
STANCE = 0.35  # s, a foot that stands longer than this is not stepping
SETTLE = 2.0  # s before the speed counts


@functools.cache
def _spec_path() -> str:
    """The scene's XML in the menagerie, downloaded on first use.

    Raises:
        UserError: the model cannot be had.
    """
    import mujoco_menagerie

    robot = mujoco_menagerie.get("unitree_go2")
    try:
        return str(robot.path() / robot.entry("scene_mjx").file)
    except (mujoco_menagerie.MenagerieError, OSError) as error:
        raise UserError(
            f"go2_walk: the Unitree Go2 model cannot be had ({error}); connect to the internet once, or set "
            "MENAGERIE_ROOT to a folder of MuJoCo Menagerie models"
        ) from None


@struct.dataclass
class Walk:
    """The command, and what has been seen of the gait."""

    command: jax.Array  # () m/s
    air_time: jax.Array  # (4,) s since each foot left the ground
    landed: jax.Array  # (4,) s in the air, of the feet that touched down in this step, else 0
    stance_time: jax.Array  # (4,) s since each foot last left the ground
    feet: jax.Array  # (4, 3) m, where the feet are
    dragged: jax.Array  # () m/s, speed of the feet over ground, weighted by how little they are lifted
    steps: jax.Array  # () int32
    distance: jax.Array  # () m walked forward since the settling time
    counted: jax.Array  # () s over which


class Go2Walk(Environment):
    """Walk forward at 0.3 to 0.8 m/s. Action: joint targets about the home pose, +-0.3 rad, at 50 Hz.

    Observations are what the real robot has: gyro, gravity direction from the IMU, encoders, the last action
    and the command. Success: mean forward speed within 20 % of the command over the last 8 of 10 s, without a
    fall.
    Settings and reward follow a prototype measured for this project; joint targets, observations and air-time
    reward are those of Rudin et al. 2022.
    """

    name: ClassVar[str] = "go2_walk"
    control_dt: ClassVar[float] = 0.02
    physics_dt: ClassVar[float] = 0.004
    episode_length: ClassVar[float] = 10.0
    max_delay: ClassVar[float] = 0.06
    data_fields = ("geom_xpos",)
    readings = {
        "gyro": (3, "rad/s"),
        "gravity": (3, "1"),
        "joint_position": (12, "rad"),
        "joint_velocity": (12, "rad/s"),
    }
    observations = (
        *((f"gyro_{a}", "4 rad/s") for a in "xyz"),
        *((f"gravity_{a}", "1") for a in "xyz"),
        ("command", "0.5 m/s"),
        *((f"{j}_position", "rad from home") for j in JOINTS),
        *((f"{j}_velocity", "20 rad/s") for j in JOINTS),
        *((f"{j}_last_action", "1") for j in JOINTS),
    )
    training = go2.TRAIN
    world_sets = go2.SETS

    def model(self) -> mujoco.MjModel:
        """The scene without visual meshes, with every collision geom."""
        spec = mujoco.MjSpec.from_file(_spec_path())
        for geom in [g for g in spec.geoms if g.type == mujoco.mjtGeom.mjGEOM_MESH]:
            spec.delete(geom)
        for mesh in list(spec.meshes):
            spec.delete(mesh)
        model = spec.compile()
        model.dof_frictionloss[model.jnt_dofadr[model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE]] = DRY_FRICTION
        self._feet = np.array([model.geom(foot).id for foot in FEET])
        # The joints' order in qpos is not the actuators'.
        joints = model.actuator_trnid[:, 0]
        self._qpos, self._qvel = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        self._start = np.array(model.key_qpos[0])
        return model

    def render_model(self) -> mujoco.MjModel:
        """The scene with its visual meshes."""
        model = mujoco.MjModel.from_xml_path(_spec_path())
        model.opt.timestep = self.physics_dt
        return model

    def camera(self, model):
        from simreal.video import tracking_camera

        return tracking_camera(model, "base", distance=1.3, azimuth=90.0, elevation=-12.0)

    def control(self, action):
        return jnp.asarray(HOME, action.dtype) + ACTION_SCALE * action

    def start(self, key):
        command_key, joint_key, velocity_key = jax.random.split(key, 3)
        command = jax.random.uniform(command_key, (), minval=0.3, maxval=0.8)
        home = jnp.asarray(self._start, dtype=float)
        qpos = home + jnp.where(np.arange(home.size) >= 7, 0.05, 0) * jax.random.normal(joint_key, home.shape)
        qvel = 0.05 * jax.random.normal(velocity_key, (self.mj_model.nv,))
        zero, feet = jnp.zeros_like(command), jnp.zeros_like(qpos[:4])
        task = Walk(
            command=command,
            air_time=feet,
            landed=feet,
            stance_time=feet,
            feet=jnp.zeros((4, 3), qpos.dtype),
            dragged=zero,
            steps=jnp.zeros((), jnp.int32),
            distance=zero,
            counted=zero,
        )
        return qpos, qvel, task

    def read(self, data: Data, task: Walk):
        return {
            "gyro": data.qvel[3:6],
            "gravity": to_body(data.qpos[3:7], jnp.asarray([0.0, 0.0, -1.0], data.qpos.dtype)),
            "joint_position": data.qpos[self._qpos],
            "joint_velocity": data.qvel[self._qvel],
        }

    def observe(self, reading, task: Walk):
        return jnp.concatenate(
            [
                0.25 * reading["gyro"],
                reading["gravity"],
                2.0 * task.command[None],
                reading["joint_position"] - jnp.asarray(HOME, task.command.dtype),
                0.05 * reading["joint_velocity"],
                reading["last_action"],
            ]
        )

    def privileged(self, data: Data, task: Walk):
        velocity = to_body(data.qpos[3:7], data.qvel[:3])
        heights = data.geom_xpos[self._feet, 2]
        return jnp.concatenate([velocity, 10 * data.qpos[2:3] - 2.7, 10 * heights, task.air_time])

    def advance(self, task: Walk, data: Data, action):
        feet = data.geom_xpos[self._feet]
        clearance = feet[:, 2] - FOOT_RADIUS
        contact = clearance < TOUCH
        speed = jnp.linalg.norm(feet[:, :2] - task.feet[:, :2], axis=1) / self.control_dt
        low = jnp.clip(1 - clearance / CLEARANCE, 0, 1)
        air_time = task.air_time + self.control_dt
        steps = task.steps + 1
        counts = steps > round(SETTLE / self.control_dt)
        return dataclasses.replace(
            task,
            air_time=jnp.where(contact, 0, air_time),
            landed=jnp.where(contact & (task.air_time > 0), air_time, 0),
            stance_time=jnp.where(contact, task.stance_time + self.control_dt, 0),
            feet=feet,
            # At the first step there is no foot position to compare with.
            dragged=jnp.where(task.steps > 0, jnp.sum(low * speed), 0),
            steps=steps,
            distance=task.distance + jnp.where(counts, forward_speed(data) * self.control_dt, 0),
            counted=task.counted + jnp.where(counts, self.control_dt, 0),
        )

    def reward(self, data: Data, task: Walk, action, last_action):
        velocity = to_body(data.qpos[3:7], data.qvel[:3])
        spin = data.qvel[3:6]
        gravity = to_body(data.qpos[3:7], jnp.asarray([0.0, 0.0, -1.0], data.qpos.dtype))
        off = jnp.square(velocity[0] - task.command) + jnp.square(velocity[1])
        bent = data.qpos[self._qpos] - jnp.asarray(HOME, data.qpos.dtype)
        rate = (
            1.2 * jnp.exp(-off / 0.25)
            + 1.2 * jnp.exp(-off / 0.04)
            + 0.75 * jnp.exp(-jnp.square(spin[2]) / 0.25)
            + 0.2
            - 2.0 * jnp.square(velocity[2])
            - 0.05 * jnp.sum(jnp.square(spin[:2]))
            - jnp.sum(jnp.square(gravity[:2]))
            - 2e-4 * jnp.sum(jnp.square(data.actuator_force))
            - 0.01 * jnp.sum(jnp.square(action - last_action))
            - 0.1 * jnp.sum(jnp.square(bent))
            + 2.0 * jnp.sum(jnp.where(task.landed > 0, task.landed - 0.2, 0))
            + 0.5 * trot(data.geom_xpos[self._feet, 2] < FOOT_RADIUS + TOUCH)
            - 0.1 * task.dragged
            - 0.4 * jnp.sum(jnp.clip(task.stance_time - STANCE, 0, 0.5))
        )
        return self.control_dt * rate

    def failed(self, data: Data, task: Walk):
        upright = to_body(data.qpos[3:7], jnp.asarray([0.0, 0.0, -1.0], data.qpos.dtype))[2] < -0.5
        return ~upright | (data.qpos[2] < 0.15)

    def succeeded(self, task: Walk):
        speed = task.distance / jnp.maximum(task.counted, self.control_dt)
        return jnp.abs(speed - task.command) <= 0.2 * task.command


def to_body(quaternion: jax.Array, vector: jax.Array) -> jax.Array:
    """A world-frame vector (3,) in the frame of a body with orientation `quaternion` (4,), w first."""
    w, axis = quaternion[0], -quaternion[1:]
    twice = 2 * jnp.cross(axis, vector)
    return vector + w * twice + jnp.cross(axis, twice)


def trot(contact: jax.Array) -> jax.Array:
    """How much the feet (4,) in contact are those of a trot, 0 to 1: diagonal pairs together, and in turns.

    After the gait rewards of Isaac Lab's quadrupeds, without their clock.
    """
    front_right, front_left, rear_right, rear_left = contact
    together = (front_right == rear_left) & (front_left == rear_right)
    return jnp.asarray(together & (front_right != front_left), float)


def forward_speed(data: Data) -> jax.Array:
    """Speed (m/s) over ground along the robot's heading."""
    w, x, y, z = data.qpos[3:7]
    heading = jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return data.qvel[0] * jnp.cos(heading) + data.qvel[1] * jnp.sin(heading)

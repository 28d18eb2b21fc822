"""The seam between an environment and what computes its physics."""

from __future__ import annotations

import abc
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from simreal.actuators import limit_control
from simreal.errors import UserError
from simreal.world import World

_UNLIMITED = (-np.inf, np.inf)


@struct.dataclass
class Physics:
    """The integration state: all that must be carried from one control step to the next."""

    time: jax.Array  # () s
    qpos: jax.Array  # (nq,)
    qvel: jax.Array  # (nv,)
    act: jax.Array  # (na,)
    qacc_warmstart: jax.Array  # (nv,)


@struct.dataclass
class Data:
    """What an environment may read of the physics, current at `time`.

    `qpos`, `qvel` and `actuator_velocity` belong to this moment; `actuator_force` to the last physics step.
    The fields that the environment lists in `data_fields` are attributes too.
    """

    time: jax.Array  # () s
    qpos: jax.Array  # (nq,)
    qvel: jax.Array  # (nv,)
    actuator_force: jax.Array  # (nu,)
    actuator_velocity: jax.Array  # (nu,)
    fields: dict[str, jax.Array]

    def __getattr__(self, name: str) -> jax.Array:
        fields = self.__dict__.get("fields") or {}
        if name in fields:
            return fields[name]
        raise AttributeError(
            f"Data has no field {name!r}: add it to the environment's data_fields "
            f"(now: {', '.join(fields) or 'none'})"
        )


@struct.dataclass
class Inputs:
    """What acts on one world during one control step. None where no factor of the randomizer needs it."""

    controls: jax.Array  # (substeps, nu), or (1, nu) where all physics steps share one control
    limits: dict[str, jax.Array]
    """Arguments of `simreal.actuators.limit_control`; empty without torque-speed limits."""
    push: jax.Array | None = None  # (3,) N, on the pushed body, world frame
    period_scale: jax.Array | None = None  # () actual / nominal length of this control period


class Engine(abc.ABC):
    """Steps worlds of one model. Methods are pure, written for one world, and meant to be vmapped.

    Args:
        model: the nominal model; copied.
        varied: the model fields that a World carries.
        data_fields: what `Data` holds besides its own fields, names as in `MjData`.
        substeps: physics steps per control step.
        push_body: id of the body that pushes act on, or None.
        varies_period: whether `Inputs.period_scale` will be given.
        limits_force: whether `Inputs.limits` will be given.
    """

    name: str

    def __init__(
        self,
        model: mujoco.MjModel,
        varied: tuple[str, ...],
        data_fields: tuple[str, ...],
        substeps: int,
        push_body: int | None = None,
        varies_period: bool = False,
        limits_force: bool = False,
    ) -> None:
        self.model = mujoco.MjModel.__copy__(model)
        if limits_force:
            # A limited force may need a control outside ctrlrange, which MuJoCo would clamp back; `limited`
            # clamps before it limits.
            self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL)
        if model.nhistory > 0:
            delayed = np.flatnonzero(model.actuator_delay > 0)
            what = f"actuator {model.actuator(delayed[0]).name!r}" if delayed.size else "a sensor"
            raise UserError(
                f"the model gives {what} a delay, which mjx ignores and no World carries; remove it from the "
                "MJCF and use the factors actuator.delay(...) and sensor.delay(...)"
            )
        self.varied = varied
        self.data_fields = data_fields
        self.substeps = substeps
        self.push_body = push_body
        self.varies_period = varies_period
        joint = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
        joints = np.where(joint, model.actuator_trnid[:, 0], 0)
        self._qposadr = model.jnt_qposadr[joints] if model.njnt else joints
        self._dofadr = model.jnt_dofadr[joints] if model.njnt else joints
        self._gear = np.where(joint, model.actuator_gear[:, 0], 0.0)

    def limited(
        self, xp: Any, control: Any, physics: Any, gain: Any, bias: Any, limits: dict[str, Any]
    ) -> Any:
        """The control (..., nu) whose force stays inside the torque-speed curve, in NumPy or JAX.

        Args:
            xp: numpy or jax.numpy.
            control: what is commanded, (..., nu).
            physics: has `qpos` and `qvel`, (..., nq) and (..., nv).
            gain: (..., nu) and bias: (..., nu, 3), of the actuators.
            limits: from `simreal.actuators.Actuators.limits`.
        """
        clamped = self.model.actuator_ctrllimited.astype(bool)[:, None]
        low, high = np.where(clamped, self.model.actuator_ctrlrange, _UNLIMITED).T
        velocity = physics["qvel"][..., self._dofadr] * self._gear
        length = physics["qpos"][..., self._qposadr] * self._gear
        return limit_control(xp, xp.clip(control, low, high), velocity, length, gain, bias, limits)

    def initial(self, qpos: jax.Array, qvel: jax.Array) -> Physics:
        """The integration state at the start of an episode."""
        dtype = jnp.result_type(float)
        return Physics(
            time=jnp.zeros((), dtype),
            qpos=jnp.asarray(qpos, dtype),
            qvel=jnp.asarray(qvel, dtype),
            act=jnp.zeros((self.model.na,), dtype),
            qacc_warmstart=jnp.zeros((self.model.nv,), dtype),
        )

    @abc.abstractmethod
    def forward(self, world: World, physics: Physics) -> Data:
        """What can be read at a state, without moving it."""

    @abc.abstractmethod
    def step(self, world: World, physics: Physics, inputs: Inputs) -> tuple[Physics, Data]:
        """One control step: `substeps` physics steps. A world that blows up comes back not finite."""


@jax.custom_jvp
def refuse_gradient(x: jax.Array) -> jax.Array:
    """The identity; differentiating through it raises a UserError."""
    return x


@refuse_gradient.defjvp
def _refuse(primals: Any, tangents: Any) -> Any:
    raise UserError(
        "the mujoco engine has no gradients; "
        "use simreal.make(..., engine='mjx', solver_iterations=1) for them"
    )


@jax.custom_jvp
def refuse_reverse_gradient(x: jax.Array) -> jax.Array:
    """The identity; forward-mode derivatives pass, reverse-mode ones raise a UserError."""
    return x


@refuse_reverse_gradient.defjvp
def _refuse_reverse(primals: Any, tangents: Any) -> Any:
    def transpose(_: Any, cotangent: Any) -> Any:
        raise UserError(
            "reverse-mode gradients through mjx need a solver of one iteration; "
            "use simreal.make(..., engine='mjx', solver_iterations=1)"
        )

    (x,), (dx,) = primals, tangents
    return x, jax.custom_derivatives.linear_call(lambda _, t: t, transpose, (), dx)

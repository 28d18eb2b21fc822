"""MuJoCo's dynamics in JAX: accelerators and gradients."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from simreal.constants import C_ONLY
from simreal.engines.base import Data, Engine, Inputs, Physics, refuse_reverse_gradient
from simreal.quiet import import_mjx
from simreal.world import World

mjx = import_mjx()

_LIFTED = 1e-9
"""Least friction loss (N m) of a joint whose friction loss varies. MJX compiles a nominal zero away, and
takes a row of zero friction for an equality constraint, which locks the joint."""


class MjxEngine(Engine):
    """MJX, with the World's fields replaced in the model."""

    name = "mjx"

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        model = mujoco.MjModel.__copy__(self.model)
        if "dof_frictionloss" in self.varied:
            model.dof_frictionloss[:] = np.maximum(model.dof_frictionloss, _LIFTED)
        # The nominal shortcut of frames that coincide does not hold where a centre of mass varies.
        for name in ("body_sameframe", "geom_sameframe"):
            if name in self.varied:
                getattr(model, name)[:] = int(mujoco.mjtSameFrame.mjSAMEFRAME_NONE)
        self._mjx_model = jax.tree.map(jnp.asarray, mjx.put_model(model, impl="jax"))
        self._mjx_data = jax.tree.map(jnp.asarray, mjx.make_data(model, impl="jax"))
        self._replaced = tuple(name for name in self.varied if name not in C_ONLY)
        constrained = self._mjx_data._impl.efc_J.size > 0
        self._guard = constrained and self.model.opt.iterations > 1  # a while loop inside the solver

    def _load(self, world: World, physics: Physics) -> tuple[Any, Any]:
        fields = {name: world.model[name] for name in self._replaced}
        if "dof_frictionloss" in fields:
            fields["dof_frictionloss"] = jnp.maximum(fields["dof_frictionloss"], _LIFTED)
        model = self._mjx_model.tree_replace(fields)
        data = self._mjx_data.replace(
            time=physics.time,
            qpos=physics.qpos,
            qvel=physics.qvel,
            act=physics.act,
            qacc_warmstart=physics.qacc_warmstart,
        )
        return model, data

    def forward(self, world: World, physics: Physics) -> Data:
        model, data = self._load(world, physics)
        return self._read(self._current(model, data), physics)

    def step(self, world: World, physics: Physics, inputs: Inputs) -> tuple[Physics, Data]:
        model, data = self._load(world, physics)
        if inputs.period_scale is not None:
            model = model.tree_replace({"opt.timestep": model.opt.timestep * inputs.period_scale})
        if inputs.push is not None:
            force = jnp.where(np.arange(6) < 3, jnp.pad(inputs.push, (0, 3)), 0)
            on_body = (np.arange(self.model.nbody) == self.push_body)[:, None]
            data = data.replace(xfrc_applied=jnp.where(on_body, force, data.xfrc_applied))
        controls = jnp.broadcast_to(inputs.controls, (self.substeps, self.model.nu))

        def substep(data: Any, control: jax.Array) -> tuple[Any, None]:
            if inputs.limits:
                gain, bias = model.actuator_gainprm[:, 0], model.actuator_biasprm[:, :3]
                moving = {"qpos": data.qpos, "qvel": data.qvel}
                control = self.limited(jnp, control, moving, gain, bias, inputs.limits)
            return mjx.step(model, data.replace(ctrl=control)), None

        data, _ = jax.lax.scan(substep, data, controls)
        if self._guard:
            data = data.replace(
                qpos=refuse_reverse_gradient(data.qpos), qvel=refuse_reverse_gradient(data.qvel)
            )
        moved = Physics(data.time, data.qpos, data.qvel, data.act, data.qacc_warmstart)
        return moved, self._read(self._current(model, data), moved)

    def _current(self, model: Any, data: Any) -> Any:
        """Derived fields at the new state, as mj_step1 makes them, without collision and dynamics."""
        from mujoco.mjx._src import sensor, smooth

        data = smooth.kinematics(model, data)
        data = smooth.com_pos(model, data)
        data = smooth.camlight(model, data)
        data = smooth.tendon(model, data)
        data = smooth.transmission(model, data)
        velocity = data._impl.actuator_moment @ data.qvel
        data = data.tree_replace({"_impl.actuator_velocity": velocity})
        data = smooth.com_vel(model, data)
        if "sensordata" in self.data_fields:
            data = sensor.sensor_vel(model, sensor.sensor_pos(model, data))
        return data

    def _read(self, data: Any, physics: Physics) -> Data:
        return Data(
            time=physics.time,
            qpos=physics.qpos,
            qvel=physics.qvel,
            actuator_force=data.actuator_force,
            actuator_velocity=data._impl.actuator_velocity,
            fields={name: _get(data, name).reshape(self._shape(name)) for name in self.data_fields},
        )

    def _shape(self, name: str) -> tuple[int, ...]:
        # mujoco.batch keeps matrices flat, (nsite, 9); so do we on both engines.
        value = _get(self._mjx_data, name)
        return (value.shape[0], 9) if value.ndim == 3 and value.shape[1:] == (3, 3) else value.shape


def _get(data: Any, name: str) -> jax.Array:
    return getattr(data, name) if hasattr(data, name) else getattr(data._impl, name)

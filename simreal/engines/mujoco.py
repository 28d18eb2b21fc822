"""MuJoCo C behind a jitted program: one host call steps all worlds on all cores.

`jax.pure_callback` hands the whole batch to `mujoco.batch.Batch`, whatever nesting of `vmap` made it. The
function that runs on the host is pure: it sets every row's state before stepping. What it remembers between
calls is only which World each row's model fields were last written from, so that rows are rewritten when a
world changes and not at every step.
"""

from __future__ import annotations

import ctypes
import dataclasses
import functools
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
from mujoco import batch as mujoco_batch

from simreal.engines.base import Data, Engine, Inputs, Physics, refuse_gradient
from simreal.runs import cpu_affinity
from simreal.world import World

_STATE = ("time", "qpos", "qvel", "act", "qacc_warmstart")


class _Rows:
    """A Batch with the number of the World that each row's model fields were written from."""

    def __init__(self, engine: MujocoEngine, nsim: int) -> None:
        self.batch = mujoco_batch.Batch(engine.model, nsim, nthread=len(cpu_affinity()))
        self.numbers = np.zeros((nsim, 2), np.uint32)
        self.fresh = np.ones(nsim, bool)
        self.fields = {name: self.batch.expand(name) for name in engine.varied}
        self.state = {name: self.batch.bind(name) for name in (*_STATE, "ctrl")}
        self.outputs = {name: self.batch.bind(name) for name in engine.outputs}
        self.push = self.batch.bind("xfrc_applied") if engine.push_body is not None else None
        self.timestep = self.batch.expand("opt.timestep") if engine.varies_period else None

    def write_worlds(self, numbers: np.ndarray, fields: dict[str, np.ndarray]) -> None:
        changed = self.fresh | (numbers != self.numbers).any(axis=1)
        if not changed.any():
            return
        for name, view in self.fields.items():
            view[changed] = fields[name].reshape(view.shape)[changed]
        self.numbers[changed] = numbers[changed]
        self.fresh[:] = False


class MujocoEngine(Engine):
    """MuJoCo's C engine through `mujoco.batch`."""

    name = "mujoco"

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        _quiet_log()
        # A world that blows up shall come back not finite, not silently reset to qpos0.
        self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self.outputs = ("actuator_force", "actuator_velocity", *self.data_fields)
        self._idle: dict[int, list[_Rows]] = {}
        self._lock = threading.Lock()
        probe = mujoco_batch.Batch(self.model, 1, nthread=1)
        self._shapes = {name: probe.bind(name).shape[1:] for name in (*_STATE, *self.outputs)}

    def forward(self, world: World, physics: Physics) -> Data:
        out = self._call(self._host_forward, self.outputs, world, physics, None)
        return self._data(physics, out)

    def step(self, world: World, physics: Physics, inputs: Inputs) -> tuple[Physics, Data]:
        out = self._call(self._host_step, (*_STATE, *self.outputs), world, physics, inputs)
        moved = Physics(**{name: out[name] for name in _STATE})
        return moved, self._data(moved, out)

    def _data(self, physics: Physics, out: dict[str, jax.Array]) -> Data:
        return Data(
            time=physics.time,
            qpos=physics.qpos,
            qvel=physics.qvel,
            actuator_force=out["actuator_force"],
            actuator_velocity=out["actuator_velocity"],
            fields={name: out[name] for name in self.data_fields},
        )

    def _call(
        self,
        host: Callable[..., dict[str, np.ndarray]],
        names: tuple[str, ...],
        world: World,
        physics: Physics,
        inputs: Inputs | None,
    ) -> dict[str, jax.Array]:
        dtype = physics.qpos.dtype
        shapes = {name: jax.ShapeDtypeStruct(self._shapes[name], dtype) for name in names}
        physics = dataclasses.replace(physics, qpos=refuse_gradient(physics.qpos))
        model = {name: world.model[name] for name in self.varied}
        if inputs is not None:
            inputs = jax.tree.map(refuse_gradient, inputs)
        return jax.pure_callback(
            host, shapes, world.number, model, physics, inputs, vmap_method="broadcast_all"
        )

    # -- on the host: NumPy only, for a JAX call in here can deadlock ---------------------------------------

    def _host_forward(
        self, number: Any, model: dict, physics: Physics, inputs: None
    ) -> dict[str, np.ndarray]:
        with self._rows(number, model, physics) as (rows, lead, dtype):
            rows.state["ctrl"][:] = 0
            rows.batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)
            out = _collect(rows.outputs, lead, dtype)
            # No force has acted yet; the row still holds that of whatever it stepped last.
            return out | {"actuator_force": np.zeros_like(out["actuator_force"])}

    def _host_step(self, number: Any, model: dict, physics: Physics, inputs: Inputs) -> dict[str, np.ndarray]:
        with self._rows(number, model, physics) as (rows, lead, dtype):
            n = rows.numbers.shape[0]
            controls = np.asarray(inputs.controls)
            controls = controls.reshape(n, controls.shape[-2], -1)
            if rows.push is not None:
                push = 0.0 if inputs.push is None else np.asarray(inputs.push).reshape(n, 3)
                rows.push[:, self.push_body, :3] = push
            if rows.timestep is not None:
                scale = 1.0 if inputs.period_scale is None else np.asarray(inputs.period_scale).reshape(n)
                rows.timestep[:] = self.model.opt.timestep * scale
            limits = {k: np.asarray(v).reshape(n, -1) for k, v in inputs.limits.items()}
            self._advance(rows, controls, limits)
            return _collect({**{k: rows.state[k] for k in _STATE}, **rows.outputs}, lead, dtype)

    def _advance(self, rows: _Rows, controls: np.ndarray, limits: dict[str, np.ndarray]) -> None:
        ctrl, velocity_stage = rows.state["ctrl"], mujoco.mjtStage.mjSTAGE_VEL
        if controls.shape[1] == 1 and not limits:
            ctrl[:] = controls[:, 0]
            rows.batch.step(nstep=self.substeps, stage=velocity_stage)
            return
        for k in range(self.substeps):
            control = controls[:, min(k, controls.shape[1] - 1)]
            if limits:
                gain = rows.fields.get("actuator_gainprm", self.model.actuator_gainprm[None])[..., 0]
                bias = rows.fields.get("actuator_biasprm", self.model.actuator_biasprm[None])[..., :3]
                control = self.limited(np, control, rows.state, gain, bias, limits)
            ctrl[:] = control
            last = k == self.substeps - 1
            rows.batch.step(nstep=1, stage=velocity_stage if last else mujoco.mjtStage.mjSTAGE_NONE)

    @contextmanager
    def _rows(
        self, number: Any, model: dict, physics: Physics
    ) -> Iterator[tuple[_Rows, tuple[int, ...], Any]]:
        """A batch of the right size, its model rows and states written; not shared with another thread."""
        number = np.asarray(number)
        lead = number.shape[:-1]
        nsim = int(np.prod(lead, dtype=int))
        with self._lock:
            idle = self._idle.setdefault(nsim, [])
            rows = idle.pop() if idle else None
        if rows is None:
            rows = _Rows(self, nsim)
        try:
            rows.write_worlds(number.reshape(nsim, 2), {k: np.asarray(v) for k, v in model.items()})
            for name in _STATE:
                view = rows.state[name]
                view[:] = np.asarray(getattr(physics, name)).reshape(view.shape)
            yield rows, lead, np.asarray(physics.qpos).dtype
        finally:
            with self._lock:
                self._idle[nsim].append(rows)


def _collect(views: dict[str, np.ndarray], lead: tuple[int, ...], dtype: Any) -> dict[str, np.ndarray]:
    return {name: view.astype(dtype).reshape(lead + view.shape[1:]) for name, view in views.items()}


class _LogConfig(ctypes.Structure):
    """mjLogConfig, which the Python bindings have no setter for."""

    _fields_ = [
        ("logto_console", ctypes.c_bool),
        ("logto_file", ctypes.c_bool),
        ("logfile", ctypes.c_char * 1024),
        ("topics", ctypes.c_int),
    ]


@functools.cache
def _quiet_log() -> None:
    """Keeps MuJoCo from printing, and from writing MUJOCO_LOG.TXT, each time that a world blows up.

    simreal counts such worlds itself; with a thousand of them the engine's warnings are only noise.
    """
    library = ctypes.CDLL(str(next(Path(mujoco.__file__).parent.glob("libmujoco.*"))))
    library.mju_getLogConfig.restype = _LogConfig
    library.mju_setLogConfig.argtypes = [_LogConfig]
    config = library.mju_getLogConfig()
    config.logto_console = config.logto_file = False
    library.mju_setLogConfig(config)

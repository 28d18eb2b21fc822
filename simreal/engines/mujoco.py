"""MuJoCo C behind a jitted program: one host call steps all worlds on all cores.

`jax.pure_callback` hands the whole batch to `mujoco.batch.Batch`, whatever nesting of `vmap` made it. The
function that runs on the host is pure: it sets every row's state before stepping. What it remembers between
calls is only which World each row's model fields were last written from, so that rows are rewritten when a
world changes and not at every step.
"""

from __future__ import annotations

import ctypes
import functools
import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import batch as mujoco_batch

from simreal.engines.base import Data, Engine, Inputs, Physics, refuse_gradient
from simreal.runs import cpu_affinity
from simreal.world import Layout, World, pack, unpack

_STATE = ("time", "qpos", "qvel", "act", "qacc_warmstart")
_LIMIT = "limit "
"""Before the names of `Inputs.limits`, where all that a step is given lies together."""


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

    def write_worlds(self, numbers: np.ndarray, packed: np.ndarray, layout: Layout) -> None:
        """Writes the model fields of the rows whose World is not the one they were last written from."""
        (changed,) = np.nonzero(self.fresh | (numbers != self.numbers).any(axis=1))
        if not changed.size:
            return
        for name, value in unpack(packed[changed], layout).items():
            self.fields[name][changed] = value
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
        if not _has_constraints(self.model, self.varied):
            # Looking for them costs a sixth of a step of a small model.
            self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        if self.model.ntree <= 1:
            # All constraints of one tree are one island: looking for more costs a tenth of a Go2's step.
            self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
        self.outputs = ("actuator_force", "actuator_velocity", *self.data_fields)
        self._idle: dict[int, list[_Rows]] = {}
        self._lock = threading.Lock()
        probe = mujoco_batch.Batch(self.model, 1, nthread=1)
        self._shapes = {name: probe.bind(name).shape[1:] for name in (*_STATE, *self.outputs)}

    def forward(self, world: World, physics: Physics) -> Data:
        names = tuple(name for name in self.outputs if name != "actuator_force")
        out = self._call(self._host_forward, names, world, {}, physics)
        # No force has acted yet; the row still holds that of whatever it stepped last.
        none = jnp.zeros(self._shapes["actuator_force"], physics.qpos.dtype)
        return self._data(physics, out | {"actuator_force": none})

    def step(self, world: World, physics: Physics, inputs: Inputs) -> tuple[Physics, Data]:
        given = {"controls": inputs.controls}
        given |= {_LIMIT + name: value for name, value in inputs.limits.items()}
        if inputs.push is not None:
            given["push"] = inputs.push
        if inputs.period_scale is not None:
            given["period_scale"] = inputs.period_scale
        out = self._call(self._host_step, (*_STATE, *self.outputs), world, given, physics)
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
        host: Callable[[_Rows, dict[str, np.ndarray]], None],
        names: tuple[str, ...],
        world: World,
        given: dict[str, jax.Array],
        physics: Physics,
    ) -> dict[str, jax.Array]:
        """Calls `host` with all worlds, whose state is set; returns what it left under `names`.

        Each array that crosses to the host and back has its price, so few do: numbers are packed into one.
        """
        dtype = physics.qpos.dtype
        given = given | {name: getattr(physics, name) for name in _STATE}
        given = {name: jnp.asarray(value, dtype) for name, value in given.items()}
        layout_in = tuple((name, given[name].shape) for name in sorted(given))
        layout_out = tuple((name, self._shapes[name]) for name in names)
        size = sum(math.prod(shape) for _, shape in layout_out)
        call = functools.partial(self._host, host, world.layout, layout_in, names)
        packed = jax.pure_callback(
            call,
            jax.ShapeDtypeStruct((size,), dtype),
            world.number,
            world.packed,
            refuse_gradient(pack(given)),
            vmap_method="broadcast_all",
        )
        return unpack(packed, layout_out)

    # -- on the host: NumPy only, for a JAX call in here can deadlock ---------------------------------------

    def _host(
        self,
        host: Callable[[_Rows, dict[str, np.ndarray]], None],
        layout_world: Layout,
        layout_in: Layout,
        names: tuple[str, ...],
        number: Any,
        model: Any,
        packed: Any,
    ) -> np.ndarray:
        number, model, packed = np.asarray(number), np.asarray(model), np.asarray(packed)
        lead = number.shape[:-1]
        n = math.prod(lead)
        with self._rows(n) as rows:
            rows.write_worlds(number.reshape(n, 2), model.reshape(n, -1), layout_world)
            given = unpack(packed.reshape(n, -1), layout_in)
            for name in _STATE:
                rows.state[name][:] = given[name].reshape(rows.state[name].shape)
            host(rows, given)
            left = [(rows.state | rows.outputs)[name].reshape(n, -1) for name in names]
            with np.errstate(over="ignore"):  # a world that blew up is infinite in single precision
                flat = np.concatenate(left, axis=1, dtype=packed.dtype, casting="same_kind")
            return flat.reshape(*lead, -1)

    def _host_forward(self, rows: _Rows, given: dict[str, np.ndarray]) -> None:
        rows.state["ctrl"][:] = 0
        rows.batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)

    def _host_step(self, rows: _Rows, given: dict[str, np.ndarray]) -> None:
        if rows.push is not None:
            rows.push[:, self.push_body, :3] = given.get("push", 0.0)
        if rows.timestep is not None:
            rows.timestep[:] = self.model.opt.timestep * given.get("period_scale", 1.0)
        limits = {name.removeprefix(_LIMIT): v for name, v in given.items() if name.startswith(_LIMIT)}
        self._advance(rows, given["controls"], limits)

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
    def _rows(self, nsim: int) -> Iterator[_Rows]:
        """A batch of the right size; not shared with another thread."""
        with self._lock:
            idle = self._idle.setdefault(nsim, [])
            rows = idle.pop() if idle else None
        if rows is None:
            rows = _Rows(self, nsim)
        try:
            yield rows
        finally:
            with self._lock:
                self._idle[nsim].append(rows)


def _has_constraints(model: mujoco.MjModel, varied: tuple[str, ...]) -> bool:
    """Whether contacts, limits, equalities or dry friction can ever act in some World of a model."""
    can_collide = np.bitwise_or.reduce(model.geom_contype, initial=0) & np.bitwise_or.reduce(
        model.geom_conaffinity, initial=0
    )
    return bool(
        can_collide
        or model.npair
        or model.nflex
        or model.neq
        or model.jnt_limited.any()
        or model.tendon_limited.any()
        or model.dof_frictionloss.any()
        or model.tendon_frictionloss.any()
        or {"dof_frictionloss", "tendon_frictionloss"} & set(varied)
    )


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

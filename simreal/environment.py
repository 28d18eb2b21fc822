"""The environment: `reset` and `step`, once for every task.

One control step, in order:

    action in [-1, 1] -> control -> actuators -> engine (some physics steps) -> true Data
    Data -> task bookkeeping -> true readings -> sensors -> observation; reward, failure, success

A task author subclasses `Environment` and writes what stands under "what a task author writes"; the physics,
actuators, sensors and disturbances of each episode come from its World.
"""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from simreal import actuators as actuators_module
from simreal import disturbances
from simreal import sensors as sensors_module
from simreal.actuators import Actuators, ActuatorState
from simreal.engines import Data, Inputs, Physics, engine_class, resolve
from simreal.errors import UserError, nearest
from simreal.quantities import QUANTITIES, control_units, element_names
from simreal.randomizer import ParameterGroup, Randomizer, Ranges, WorldBuilder
from simreal.sensors import Sensors, SensorState
from simreal.world import World

Task = Any
"""Whatever a task carries through an episode: a target, a command, timers. A pytree of arrays."""

MAX_SPEED = 1e3
"""A generalised velocity beyond this (rad/s or m/s) counts as blown up."""
MAX_SPECIFIC_ENERGY = 1250.0
"""Kinetic energy per mass of the model beyond this (J/kg; all of it at 50 m/s) counts as blown up."""


@struct.dataclass
class State:
    """One world between two control steps; `obs`, `reward`, `done`, `metrics`, `info` as in Brax."""

    obs: jax.Array  # (observations,) what the policy sees
    privileged: jax.Array  # (privileged,) what only a critic may see: clean observation, true state, draws
    reward: jax.Array  # ()
    done: jax.Array  # () 1.0 at the end of an episode, else 0.0
    metrics: dict[str, jax.Array]
    """peak_torque (N m), saturated (share of actuators at their limit), power (W), action_rate (1/s)."""
    info: dict[str, jax.Array]
    """truncation (the time limit ended it), failed, diverged (the physics blew up), success: 1.0 or 0.0."""
    world: World
    physics: Physics
    task: Task
    actuator: ActuatorState
    sensor: SensorState
    action: jax.Array  # (actions,) the last action
    key: jax.Array  # (2,) uint32
    steps: jax.Array  # () int32, control steps since the start of the episode


class Environment(abc.ABC):
    """A task on a model, in worlds drawn from a randomizer.

    Args:
        engine: "mujoco", "mjx", or "auto".
        randomizer: what varies; default: the environment's training ranges. `Randomizer()` varies nothing.
        solver_iterations: overrides the model's solver iterations (1 makes reverse-mode gradients possible).
    """

    # -- what a task author writes -------------------------------------------------------------------------

    name: ClassVar[str]
    control_dt: ClassVar[float]  # s between two actions
    physics_dt: ClassVar[float]  # s between two physics steps
    episode_length: ClassVar[float]  # s
    data_fields: ClassVar[tuple[str, ...]] = ()
    """Fields of MuJoCo's MjData that are read, besides qpos, qvel, actuator_force and actuator_velocity."""
    readings: ClassVar[Mapping[str, tuple[int, str]]]
    """What sensors report: name -> (size, unit)."""
    observations: ClassVar[tuple[tuple[str, str], ...]]
    """Name and unit of each number that the policy sees, in order."""
    max_delay: ClassVar[float] = 0.1
    """Longest delay (s) of an actuator or sensor that a World may have; it sizes the buffers."""
    training: ClassVar[Randomizer]
    """The training ranges."""
    world_sets: ClassVar[tuple[Any, ...]] = ()
    """Named sets of worlds for the evaluator, see `simreal.worldsets`."""

    @abc.abstractmethod
    def model(self) -> mujoco.MjModel:
        """The nominal model; its timestep is set to `physics_dt`."""

    @abc.abstractmethod
    def start(self, key: jax.Array) -> tuple[jax.Array, jax.Array, Task]:
        """qpos (nq,), qvel (nv,) and task at the start of an episode."""

    @abc.abstractmethod
    def read(self, data: Data, task: Task) -> dict[str, jax.Array]:
        """What perfect sensors would report: each of `readings`, () or (size,)."""

    @abc.abstractmethod
    def observe(self, reading: Mapping[str, jax.Array], task: Task) -> jax.Array:
        """What the policy sees, from spoiled readings; `reading["last_action"]` (actions,) is exact."""

    @abc.abstractmethod
    def advance(self, task: Task, data: Data, action: jax.Array) -> Task:
        """The task after a control step: timers and counters."""

    @abc.abstractmethod
    def reward(self, data: Data, task: Task, action: jax.Array, last_action: jax.Array) -> jax.Array:
        """Reward of the step that led here, after `advance`."""

    @abc.abstractmethod
    def failed(self, data: Data, task: Task) -> jax.Array:
        """bool: the episode ends in failure."""

    @abc.abstractmethod
    def succeeded(self, task: Task) -> jax.Array:
        """bool, asked when the time limit is reached without failure."""

    def control(self, action: jax.Array) -> jax.Array:
        """Control (nu,) that an action in [-1, 1] asks for; affine. Default: the whole ctrlrange."""
        low, high = self.mj_model.actuator_ctrlrange.T
        centre, half = (jnp.asarray(x, action.dtype) for x in ((low + high) / 2, (high - low) / 2))
        return centre + half * action

    def privileged(self, data: Data, task: Task) -> jax.Array:
        """What a critic may see beyond the clean observation and the world's draws."""
        return jnp.zeros(0, data.qpos.dtype)

    def render_model(self) -> mujoco.MjModel:
        """The model for pictures; with visual meshes where training goes without them."""
        return self.mj_model

    def camera(self, model: mujoco.MjModel) -> Any:
        """The camera for pictures: a name, an MjvCamera, or None for the free camera."""
        return None

    def markers(self, task: Task) -> list[tuple[Any, float]]:
        """Spheres to draw for the task, (position, radius) in m: a target, for example. NumPy leaves."""
        return []

    # -- construction --------------------------------------------------------------------------------------

    def __init__(
        self,
        engine: str = "auto",
        randomizer: Randomizer | None = None,
        solver_iterations: int | None = None,
    ) -> None:
        self.mj_model = self.model()
        self.mj_model.opt.timestep = self.physics_dt
        if solver_iterations is not None:
            self.mj_model.opt.iterations = solver_iterations
        self.substeps = round(self.control_dt / self.physics_dt)
        self.episode_steps = round(self.episode_length / self.control_dt)
        self.action_size = self.mj_model.nu
        self._max_energy = MAX_SPECIFIC_ENERGY * float(self.mj_model.body_mass.sum())
        self.observation_size = len(self.observations)
        factors = self.training if randomizer is None else randomizer
        self.actuators = self._make_actuators(factors)
        self.sensors = self._make_sensors(factors)
        self.randomizer = WorldBuilder(factors, self.mj_model, self._parameter_groups(factors))
        self._check_factors()
        self.engine = engine_class(engine)(
            self.mj_model,
            varied=self.randomizer.model_fields,
            data_fields=self.data_fields,
            substeps=self.substeps,
            push_body=self._push_body(factors),
            varies_period="period_jitter" in self.actuators.effects,
            limits_force=bool(self.actuators.effects & {"no_load_speed", "thermal_limit"}),
        )
        self.engine_name = resolve(engine)
        # Inlined where a larger program calls them; what this saves is to trace them anew for each program.
        self._traced_reset = jax.jit(self._reset, inline=True)
        self._traced_step = jax.jit(self._step, inline=True)

    def _make_actuators(self, randomizer: Randomizer) -> Actuators:
        limited = self.mj_model.actuator_ctrllimited.astype(bool)[:, None]
        ctrlrange = np.where(limited, self.mj_model.actuator_ctrlrange, [[-np.inf, np.inf]])
        return Actuators(
            names=tuple(element_names(self.mj_model, "actuator")),
            ctrlrange=tuple((float(low), float(high)) for low, high in ctrlrange),
            physics_dt=self.physics_dt,
            substeps=self.substeps,
            effects=_effects(randomizer, "actuator", actuators_module.EFFECTS),
            max_delay=self.max_delay,
        )

    def _make_sensors(self, randomizer: Randomizer) -> Sensors:
        channels: list[str] = []
        for name, (size, _) in self.readings.items():
            channels += [name] if size == 1 else [f"{name}[{i}]" for i in range(size)]
        return Sensors(
            channels=tuple(channels),
            control_dt=self.control_dt,
            effects=_effects(randomizer, "sensor", sensors_module.EFFECTS),
            max_delay=self.max_delay,
        )

    def _parameter_groups(self, randomizer: Randomizer) -> dict[str, ParameterGroup]:
        bodies = element_names(self.mj_model, "body")
        reading_units = [unit for size, unit in self.readings.values() for _ in range(size)]
        pushed = any(f.target.group == "disturbance" for f in randomizer.factors.values())
        return {
            "actuator": ParameterGroup(
                self.actuators.names,
                jax.tree.map(np.asarray, self.actuators.nominal()),
                _resolve(actuators_module.UNITS, "control", control_units(self.mj_model)),
                actuators_module.POSITIVE,
            ),
            "sensor": ParameterGroup(
                self.sensors.channels,
                jax.tree.map(np.asarray, self.sensors.nominal()),
                _resolve(sensors_module.UNITS, "reading", reading_units),
            ),
            "disturbance": ParameterGroup(
                tuple(bodies),
                {k: np.asarray(v) for k, v in disturbances.PARAMETERS.items()} if pushed else {},
                {k: (unit,) * len(bodies) for k, unit in disturbances.UNITS.items()},
            ),
        }

    def _check_factors(self) -> None:
        """Refuses what a body, an actuator or a buffer cannot do."""
        model = self.mj_model
        undriven = model.actuator_trntype != int(mujoco.mjtTrn.mjTRN_JOINT)
        servo = model.actuator_biasprm[:, 1] != 0
        undriven_reason = "needs actuators that drive a joint directly, which {name!r} does not"
        refusals = {
            "body_com": (
                model.body_simple > 0,
                "cannot vary on {name!r}, whose centre of mass MuJoCo takes for its origin; "
                'add simple="false" to that body in the MJCF',
            ),
            "no_load_speed": (undriven, undriven_reason),
            "thermal_limit": (undriven, undriven_reason),
            "backlash": (~servo, "is play of a position command; {name!r} is no position actuator"),
            "force_limit": (
                model.actuator_forcelimited == 0,
                "needs a forcerange, which {name!r} has none of",
            ),
            "kp": (~servo, "is a position gain; {name!r} is no position actuator"),
            "kv": (model.actuator_biastype == 0, "is a velocity gain; {name!r} has none"),
            "joint_range": (model.jnt_limited == 0, "cannot vary on {name!r}, which has no range"),
            "deadband": (servo, "is for torque and speed commands; {name!r} is a position actuator"),
        }
        for factor, bound in self.randomizer.bound.items():
            quantity = bound.factor.target.quantity
            if quantity == "delay":
                self.check_delay(f"factor {factor!r}", bound.factor.distribution.support()[1])
            if quantity in refusals:
                refused, reason = refusals[quantity]
                element = QUANTITIES[quantity].element if quantity in QUANTITIES else "actuator"
                names = element_names(model, element)
                rows = np.flatnonzero(bound.mask & refused)
                if rows.size:
                    raise UserError(f"factor {factor!r}: {quantity} {reason.format(name=names[rows[0]])}")

    def check_delay(self, where: str, delay: float) -> None:
        """Raises UserError where a delay (s) is longer than the buffers hold."""
        if delay > self.max_delay + 1e-9:
            raise UserError(
                f"{where}: a delay of {delay:g} s does not fit into the buffers of {self.name}, which hold "
                f"{self.max_delay:g} s (max_delay)"
            )

    def _push_body(self, randomizer: Randomizer) -> int | None:
        patterns = {
            f.target.patterns[0] for f in randomizer.factors.values() if f.target.group == "disturbance"
        }
        if not patterns:
            return None
        names = element_names(self.mj_model, "body")
        found = [i for i, n in enumerate(names) if n in patterns]
        if len(patterns) > 1 or len(found) != 1:
            raise UserError(
                f"disturbance: pushes act on exactly one body, got {sorted(patterns)}; "
                f"{nearest(sorted(patterns)[0], [n for n in names if n])}"
            )
        return found[0]

    # -- reset and step: pure, for one world; vmap them ----------------------------------------------------

    def reset(self, key: jax.Array, world: World | None = None, ranges: Ranges | None = None) -> State:
        """The start of an episode in a fresh World, or in the one given.

        Args:
            key: (2,) uint32.
            world: this World instead of a drawn one.
            ranges: draw from these instead of the randomizer's (`env.randomizer.ranges` moved).
        """
        return self._traced_reset(key, world, ranges)

    def step(self, state: State, action: jax.Array) -> State:
        """One control step. An action is clipped to [-1, 1]; a state that is done steps on regardless."""
        return self._traced_step(state, action)

    # -- inside --------------------------------------------------------------------------------------------

    def _reset(self, key: jax.Array, world: World | None, ranges: Ranges | None) -> State:
        key, world_key, start_key, actuator_key, sensor_key = jax.random.split(key, 5)
        if world is None:
            world = self.randomizer.build(self.randomizer.sample(world_key, ranges), ranges)
        qpos, qvel, task = self.start(start_key)
        physics = self.engine.initial(qpos, qvel)
        now = world.at(physics.time)
        data = self.engine.forward(now, physics)
        action = jnp.zeros(self.action_size, physics.qpos.dtype)
        actuator = self.actuators.start(now.actuator, self.control(action), actuator_key)
        true_reading = self._flatten(self.read(data, task))
        reading, sensor = self.sensors.start(now.sensor, true_reading, sensor_key)
        zero = jnp.zeros((), physics.qpos.dtype)
        return State(
            obs=self._observe(reading, task, action),
            privileged=self._privileged(true_reading, data, task, action, world),
            reward=zero,
            done=zero,
            metrics=dict.fromkeys(("peak_torque", "saturated", "power", "action_rate"), zero),
            info=dict.fromkeys(("truncation", "failed", "diverged", "success"), zero),
            world=world,
            physics=physics,
            task=task,
            actuator=actuator,
            sensor=sensor,
            action=action,
            key=key,
            steps=jnp.zeros((), jnp.int32),
        )

    def _step(self, state: State, action: jax.Array) -> State:
        key, actuator_key, period_key, push_key, sensor_key = jax.random.split(state.key, 5)
        action = jnp.clip(action.astype(state.action.dtype), -1, 1)
        now = state.world.at(state.physics.time)

        controls, actuator = self.actuators.controls(
            now.actuator, state.actuator, self.control(action), actuator_key
        )
        pushes = now.disturbance
        inputs = Inputs(
            controls=controls,
            limits=self.actuators.limits(now.actuator, actuator, self._force_limit(now)),
            push=disturbances.push_force(pushes, self.control_dt, push_key) if pushes else None,
            period_scale=self.actuators.period_scale(now.actuator, period_key),
        )
        physics, data = self.engine.step(now, state.physics, inputs)
        actuator = self.actuators.after(now.actuator, actuator, data.actuator_force)

        task = self.advance(state.task, data, action)
        true_reading = self._flatten(self.read(data, task))
        reading, sensor = self.sensors.apply(now.sensor, state.sensor, true_reading, sensor_key)
        obs = self._observe(reading, task, action)
        privileged = self._privileged(true_reading, data, task, action, state.world)

        # A world that blew up ends its episode; NaN is sticky, so nothing of its new state is kept.
        fine = self._is_fine(physics)
        kept = (obs, privileged, physics, task, actuator, sensor)
        before = (state.obs, state.privileged, state.physics, state.task, state.actuator, state.sensor)
        obs, privileged, physics, task, actuator, sensor = jax.tree.map(
            lambda new, old: jnp.where(fine, new, old), kept, before
        )
        steps = state.steps + 1
        failed = fine & self.failed(data, task)
        truncation = fine & ~failed & (steps >= self.episode_steps)
        flags = {
            "truncation": truncation,
            "failed": failed,
            "diverged": ~fine,
            "success": truncation & self.succeeded(task),
        }
        reward = self.reward(data, task, action, state.action)
        return State(
            obs=obs,
            privileged=privileged,
            reward=jnp.where(fine, reward, 0).astype(state.reward.dtype),
            done=(failed | truncation | ~fine).astype(state.done.dtype),
            metrics=self._metrics(now, data, action, state.action, fine),
            info={name: flag.astype(state.done.dtype) for name, flag in flags.items()},
            world=state.world,
            physics=physics,
            task=task,
            actuator=actuator,
            sensor=sensor,
            action=action,
            key=key,
            steps=steps,
        )

    def _is_fine(self, physics: Physics) -> jax.Array:
        """bool: finite, and neither a velocity nor the kinetic energy is beyond belief.

        The energy is that of the nominal inertias in the model's reference pose, without their couplings.
        """
        slow = jnp.all(jnp.abs(physics.qvel) < MAX_SPEED)
        inertia = jnp.asarray(self.mj_model.dof_M0, physics.qvel.dtype)
        kinetic = 0.5 * jnp.sum(inertia * jnp.square(physics.qvel))
        return slow & (kinetic < self._max_energy) & jnp.all(jnp.isfinite(physics.qpos))

    def _force_limit(self, world: World) -> jax.Array:
        """(nu,) largest force of each actuator; infinite where nothing limits it."""
        model = self.mj_model
        limited = model.actuator_forcelimited.astype(bool)
        forcerange = world.model.get("actuator_forcerange", jnp.asarray(model.actuator_forcerange, float))
        direct = (model.actuator_biastype == 0) & model.actuator_ctrllimited.astype(bool)
        gain = world.model.get("actuator_gainprm", jnp.asarray(model.actuator_gainprm, float))[:, 0]
        by_control = jnp.abs(gain) * jnp.asarray(np.abs(model.actuator_ctrlrange).max(axis=1), gain.dtype)
        unlimited = jnp.where(direct, by_control, jnp.inf)
        return jnp.where(limited, forcerange[:, 1], unlimited)

    def _metrics(
        self, world: World, data: Data, action: jax.Array, last_action: jax.Array, fine: jax.Array
    ) -> dict[str, jax.Array]:
        force = jnp.abs(data.actuator_force)
        metrics = {
            "peak_torque": jnp.max(force, initial=0),
            "saturated": jnp.mean(force >= 0.99 * self._force_limit(world), dtype=force.dtype),
            "power": jnp.sum(jnp.abs(data.actuator_force * data.actuator_velocity)),
            "action_rate": jnp.mean(jnp.abs(action - last_action)) / self.control_dt,
        }
        return {name: jnp.where(fine, value, 0) for name, value in metrics.items()}

    def _flatten(self, reading: Mapping[str, jax.Array]) -> jax.Array:
        return jnp.concatenate([jnp.atleast_1d(reading[name]) for name in self.readings])

    def _observe(self, flat: jax.Array, task: Task, action: jax.Array) -> jax.Array:
        reading, offset = {}, 0
        for name, (size, _) in self.readings.items():
            reading[name] = flat[offset] if size == 1 else flat[offset : offset + size]
            offset += size
        return self.observe(reading | {"last_action": action}, task)

    def _privileged(
        self, true_reading: jax.Array, data: Data, task: Task, action: jax.Array, world: World
    ) -> jax.Array:
        clean = self._observe(true_reading, task, action)
        return jnp.concatenate([clean, self.privileged(data, task), world.normalized])


def _effects(
    randomizer: Randomizer, group: str, effects: Mapping[str, Mapping[str, float]]
) -> frozenset[str]:
    """The effects whose parameters some factor of the group targets."""
    targeted = {f.target.quantity for f in randomizer.factors.values() if f.target.group == group}
    return frozenset(effect for effect, parameters in effects.items() if targeted & parameters.keys())


def _resolve(units: Mapping[str, str], own: str, of_elements: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Units of parameters for each element, whose own unit takes the place of the word `own`."""
    return {k: tuple(unit.replace(own, other) for other in of_elements) for k, unit in units.items()}


__all__ = ["Data", "Environment", "State", "Task"]

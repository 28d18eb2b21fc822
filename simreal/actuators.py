"""What a real actuator makes of a command: noise, deadband, delay, lag, backlash, and force limits.

Everything here is for one world and pure; the rollout vmaps it. The static description is `Actuators`,
the parameters are arrays that belong to the World, the state belongs to the environment's State. All
arrays of one call share one float dtype, that of the command.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jax.typing import DTypeLike

from simreal.errors import UserError

EFFECTS: Mapping[str, Mapping[str, float]] = MappingProxyType(
    {
        # White noise: standard deviation, a new value every control step.
        "noise": {"noise": 0.0},
        # Ornstein-Uhlenbeck noise: stationary standard deviation; a time of inf holds one value per episode.
        "correlated_noise": {"correlated_noise": 0.0, "correlation_time": 0.1},
        # Half-width of the band about zero that does nothing; outside it the command is that much smaller.
        "deadband": {"deadband": 0.0},
        # Share of ctrlrange, about its centre, that can be reached.
        "saturation": {"saturation": 1.0},
        # Transport delay, at most max_delay.
        "delay": {"delay": 0.0},
        # Time constant of a first-order lag.
        "lag": {"lag": 0.0},
        # Full width of the play operator.
        "backlash": {"backlash": 0.0},
        # Speed at which no force is left in the direction of motion.
        "no_load_speed": {"no_load_speed": math.inf},
        # Continuous force, which never overheats; time constant of the winding's temperature; heat at the
        # start of the episode, where 0 is cold and 1 as warm as after a long time at thermal_limit.
        "thermal_limit": {"thermal_limit": math.inf, "thermal_time": 60.0, "initial_heat": 0.0},
        # Mean of an exponential extra length of each control period, as a share of it; one number per world.
        "period_jitter": {"period_jitter": 0.0},
    }
)
"""Effect -> its parameters, each with a value at which the effect does nothing."""

UNITS: Mapping[str, str] = MappingProxyType(
    {
        "noise": "control",  # the unit of the actuator's control
        "correlated_noise": "control",
        "correlation_time": "s",
        "deadband": "control",
        "saturation": "1",
        "delay": "s",
        "lag": "s",
        "backlash": "control",
        "no_load_speed": "rad/s",
        "thermal_limit": "N m",
        "thermal_time": "s",
        "initial_heat": "1",
        "period_jitter": "1",
    }
)

POSITIVE = frozenset({"no_load_speed", "thermal_limit"})
"""Parameters that a value of 0 makes meaningless."""

HOTTEST = 1.5
"""Heat at which a drive has folded its peak force back to the continuous one."""

LONGEST_PERIOD = 3.0
"""Longest jittered control period, in nominal periods: keeps the physics step stable."""

# One random stream per use, folded into the caller's key: no key serves two draws, and switching one effect
# on leaves the draws of the others as they were.
_NOISE, _CORRELATED_NOISE, _CORRELATED_START, _PERIOD = range(4)

_UNROLLED_SUBSTEPS = 10  # a longer loop is not unrolled: it compiles faster and runs slower


def check_effects(effects: frozenset[str], valid: Mapping[str, object], owner: str) -> None:
    """Raise UserError if `effects` holds a name that is not a key of `valid`."""
    if unknown := sorted(effects - valid.keys()):
        raise UserError(f"unknown {owner} effects {unknown}; valid effects: {', '.join(sorted(valid))}")


def delay_depth(max_delay: float, period: float) -> int:
    """Number of past periods that a delay line must remember to reach back `max_delay` seconds."""
    return math.ceil(max_delay / period - 1e-6)  # 0.14 / 0.02 is 7 periods, not 7.000000000000001


def delayed(history: Array, delay: Array, substeps: int = 1) -> Array:
    """A sampled signal `delay` physics steps ago, (substeps, n), interpolated between physics steps.

    `history` (depth + 1, n) holds one row per control period, newest first; each row is the value during the
    `substeps` physics steps of its period. `delay` (n,) is in physics steps; beyond the oldest row, that row
    holds.

    Seen from physics step k of the newest period, row p + 1 takes over from row p while the delay grows from
    k + p * substeps to one more. The weights are continuous in the delay: a delay of 0.02 s that float32
    makes 4.9999995 steps of 0.004 s is off by no more than that. No gather: 2 to 5 times faster on CPU.
    """
    depth = history.shape[0] - 1
    takeover = np.arange(substeps)[:, None] + substeps * np.arange(depth)[None, :]
    passed = jnp.clip(delay[None, None, :] - jnp.asarray(takeover, delay.dtype)[:, :, None], 0, 1)
    ends = jnp.ones_like(passed, shape=(substeps, 1, delay.shape[0]))
    weights = jnp.concatenate([ends, passed], axis=1) - jnp.concatenate([passed, 0 * ends], axis=1)
    return jnp.sum(weights * history[None], axis=1)


@struct.dataclass
class ActuatorState:
    """What the actuators of one world remember; parts whose effect is absent are None."""

    commands: Array | None = None  # (depth, nu) control unit: commands of past control periods, newest first
    correlated: Array | None = None  # (nu,) control unit: the correlated noise of the last control step
    lagged: Array | None = None  # (nu,) control unit: output of the lag
    played: Array | None = None  # (nu,) control unit: output of the backlash
    heat: Array | None = None  # (nu,) 1 is the steady state at thermal_limit


@dataclasses.dataclass(frozen=True)
class Actuators:
    """Static description of a model's actuators, from policy command to the control of each physics step.

    Order: noise, deadband, saturation, delay, lag, backlash; then, inside the engine (`limit_control`), the
    torque-speed limit with thermal derating. Delays and time constants count nominal periods: a jittered
    period stretches them with it.
    """

    names: tuple[str, ...]
    """Actuator names, nu of them."""
    ctrlrange: tuple[tuple[float, float], ...]
    """(low, high) of each actuator, control unit; (-inf, inf), which never saturates, if unlimited."""
    physics_dt: float
    """Physics step, s."""
    substeps: int
    """Physics steps per control period."""
    effects: frozenset[str] = frozenset()
    """Keys of EFFECTS that are simulated; the others cost nothing."""
    max_delay: float = 0.0
    """Longest delay that the delay line can hold, s; longer ones are cut to it."""

    def __post_init__(self) -> None:
        check_effects(self.effects, EFFECTS, "actuator")
        if len(self.ctrlrange) != len(self.names):
            raise UserError(f"{len(self.names)} actuators but {len(self.ctrlrange)} rows of ctrlrange")
        if self.substeps < 1 or self.physics_dt <= 0 or self.max_delay < 0:
            raise UserError(
                f"substeps {self.substeps}, physics_dt {self.physics_dt}, max_delay {self.max_delay}: "
                "valid are substeps >= 1, physics_dt > 0, max_delay >= 0"
            )

    @property
    def control_dt(self) -> float:
        """Control period, s."""
        return self.substeps * self.physics_dt

    def nominal(self, dtype: DTypeLike = float) -> dict[str, Array]:
        """Every parameter of `effects` at its value without effect: (nu,), `period_jitter` a scalar."""
        return {
            name: jnp.full(() if name == "period_jitter" else len(self.names), value, dtype)
            for effect in sorted(self.effects)
            for name, value in EFFECTS[effect].items()
        }

    def start(self, parameters: dict[str, Array], ctrl: Array, key: Array) -> ActuatorState:
        """State of actuators that have held `ctrl` (nu,), the start pose's control, for a long time."""
        correlated = None
        if "correlated_noise" in self.effects:
            draw = jax.random.normal(jax.random.fold_in(key, _CORRELATED_START), ctrl.shape, ctrl.dtype)
            correlated = parameters["correlated_noise"] * draw
        depth = math.ceil(delay_depth(self.max_delay, self.physics_dt) / self.substeps)
        return ActuatorState(
            commands=jnp.tile(ctrl, (depth, 1)) if "delay" in self.effects else None,
            correlated=correlated,
            lagged=ctrl if "lag" in self.effects else None,
            played=ctrl if "backlash" in self.effects else None,
            heat=parameters["initial_heat"] if "thermal_limit" in self.effects else None,
        )

    def controls(
        self, parameters: dict[str, Array], state: ActuatorState, ctrl: Array, key: Array
    ) -> tuple[Array, ActuatorState]:
        """Controls of one control period in which the policy commands `ctrl` (nu,), and the new state.

        (substeps, nu), or (1, nu) without delay, lag and backlash, when all physics steps share one control.
        """
        command = ctrl
        correlated, commands = state.correlated, state.commands
        if "noise" in self.effects:
            draw = jax.random.normal(jax.random.fold_in(key, _NOISE), ctrl.shape, ctrl.dtype)
            command = command + parameters["noise"] * draw
        if correlated is not None:
            draw = jax.random.normal(jax.random.fold_in(key, _CORRELATED_NOISE), ctrl.shape, ctrl.dtype)
            periods = self.control_dt / parameters["correlation_time"]
            fresh = parameters["correlated_noise"] * jnp.sqrt(-jnp.expm1(-2 * periods))
            correlated = jnp.exp(-periods) * correlated + fresh * draw
            command = command + correlated
        if "deadband" in self.effects:
            command = command - jnp.clip(command, -parameters["deadband"], parameters["deadband"])
        if "saturation" in self.effects:
            command = self._saturate(command, parameters["saturation"])
        controls = command[None]
        if commands is not None:
            history = jnp.concatenate([controls, commands])
            controls = delayed(history, parameters["delay"] / self.physics_dt, self.substeps)
            commands = history[:-1]
        controls, lagged, played = self._follow(parameters, state, controls)
        return controls, dataclasses.replace(
            state, commands=commands, correlated=correlated, lagged=lagged, played=played
        )

    def _saturate(self, command: Array, fraction: Array) -> Array:
        ctrlrange = np.asarray(self.ctrlrange)
        limited = np.isfinite(ctrlrange).all(axis=1)
        low, high = np.where(limited, ctrlrange.T, 0)
        centre = jnp.asarray((low + high) / 2, command.dtype)
        half = jnp.asarray((high - low) / 2, command.dtype)
        clipped = jnp.clip(command, centre - fraction * half, centre + fraction * half)
        return jnp.where(limited, clipped, command)

    def _follow(
        self, parameters: dict[str, Array], state: ActuatorState, controls: Array
    ) -> tuple[Array, Array | None, Array | None]:
        """Lag and backlash, whose output at one physics step depends on that at the one before."""
        if state.lagged is None and state.played is None:
            return controls, None, None
        if state.lagged is not None:
            tau = parameters["lag"]
            safe_tau = jnp.where(tau > 0, tau, 1)  # no NaN in the gradient at 0
            remaining = jnp.where(tau > 0, jnp.exp(-self.physics_dt / safe_tau), 0)
        if state.played is not None:
            slack = parameters["backlash"] / 2

        def substep(memory: tuple[Array | None, Array | None], control: Array) -> tuple[Any, Array]:
            lagged, played = memory
            if lagged is not None:
                control = lagged = control + remaining * (lagged - control)
            if played is not None:
                control = played = jnp.clip(played, control - slack, control + slack)
            return (lagged, played), control

        controls = jnp.broadcast_to(controls, (self.substeps, controls.shape[1]))
        unroll = self.substeps if self.substeps <= _UNROLLED_SUBSTEPS else 1
        memory, controls = jax.lax.scan(substep, (state.lagged, state.played), controls, unroll=unroll)
        return controls, *memory

    def after(self, parameters: dict[str, Array], state: ActuatorState, force: Array) -> ActuatorState:
        """State after a control period with actuator forces `force` (nu,): the winding warms or cools.

        First-order heat, dh/dt = ((force / thermal_limit)^2 - h) / thermal_time, solved exactly for a
        constant force: copper loss goes with the square of the current, and the current with the force.
        """
        if state.heat is None:
            return state
        steady = (force / parameters["thermal_limit"]) ** 2
        approach = -jnp.expm1(-self.control_dt / parameters["thermal_time"])
        return dataclasses.replace(state, heat=state.heat + approach * (steady - state.heat))

    def limits(self, parameters: dict[str, Array], state: ActuatorState, stall: Array) -> dict[str, Array]:
        """What `limit_control` needs in this control period, each (nu,); {} if nothing limits the force.

        `stall` (nu,) is the peak force at standstill, the nominal forcerange; inf where there is none. As in
        the I2t foldback of servo drives, a winding hotter than its continuous rating (heat 1) loses peak
        force linearly, down to `thermal_limit` at heat HOTTEST: what it can hold for ever is always left.
        """
        if not self.effects & {"no_load_speed", "thermal_limit"}:
            return {}
        peak = jnp.minimum(stall, jnp.finfo(stall.dtype).max)  # no inf - inf, no inf * 0
        limits = {"stall": peak}
        if state.heat is not None:
            folded = jnp.minimum(parameters["thermal_limit"], peak)
            limits["stall"] = peak - (peak - folded) * jnp.clip((state.heat - 1) / (HOTTEST - 1), 0, 1)
        if "no_load_speed" in self.effects:
            limits["no_load_speed"] = parameters["no_load_speed"]
        return limits

    def period_scale(self, parameters: dict[str, Array], key: Array) -> Array | None:
        """Length () of this control period in nominal periods: 1 + Exp(mean period_jitter), at most 3.

        The engine multiplies its timestep by it for this period; None, without the effect, leaves it alone.
        Source: the random step lengths of Peng et al. 2018 (0.04 s + Exp) and OpenAI 2018 (8 ms + Exp).
        """
        if "period_jitter" not in self.effects:
            return None
        jitter = parameters["period_jitter"]
        extra = jitter * jax.random.exponential(jax.random.fold_in(key, _PERIOD), (), jitter.dtype)
        return 1 + jnp.minimum(extra, LONGEST_PERIOD - 1)


def limit_control(
    xp: Any, control: Any, velocity: Any, length: Any, gain: Any, bias: Any, limits: Mapping[str, Any]
) -> Any:
    """The control closest to `control` whose force stays inside the torque-speed curve.

    Called by the engine before every physics step, with `xp` numpy on (B, nu) arrays or jax.numpy on (nu,).
    `velocity` and `length` are MuJoCo's actuator_velocity and actuator_length; the force is gain * control +
    bias[0] + bias[1] * length + bias[2] * velocity, with `gain` (..., nu) and `bias` (..., nu, 3). `limits`
    comes from `Actuators.limits`. A control that needs no limit, or has no gain, is returned as it is;
    another may lie outside ctrlrange.

    Along the motion the force falls linearly from `stall` at rest to zero at `no_load_speed`, the line of a
    DC motor at full voltage; against the motion (braking) all of `stall` is available.
    """
    if not limits:
        return control
    high = low = limits["stall"]
    if "no_load_speed" in limits:
        speed = velocity / limits["no_load_speed"]
        high = high * xp.clip(1 - speed, 0, 1)
        low = low * xp.clip(1 + speed, 0, 1)
    passive = bias[..., 0] + bias[..., 1] * length + bias[..., 2] * velocity
    force = gain * control + passive
    limited = xp.clip(force, -low, high)
    powerless = gain == 0
    unchanged = powerless | (limited == force)
    return xp.where(unchanged, control, (limited - passive) / xp.where(powerless, 1, gain))

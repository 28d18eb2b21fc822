"""What a real sensor makes of the truth: delay, scale, bias, drift, noise, quantisation, held readings.

Everything here is for one world and pure; the rollout vmaps it. The static description is `Sensors`, the
parameters are arrays that belong to the World, the state belongs to the environment's State. All arrays of
one call share one float dtype, that of the reading.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from types import MappingProxyType

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array
from jax.typing import DTypeLike

from simreal.actuators import check_effects, delay_depth, delayed
from simreal.errors import UserError

EFFECTS: Mapping[str, Mapping[str, float]] = MappingProxyType(
    {
        # White noise: standard deviation, a new value with every sample.
        "noise": {"noise": 0.0},
        # Constant over an episode.
        "bias": {"bias": 0.0},
        # Standard deviation of a random walk after one second.
        "drift": {"drift": 0.0},
        # The true value is multiplied by it.
        "scale": {"scale": 1.0},
        # Age of the reading, at most max_delay.
        "delay": {"delay": 0.0},
        # Samples per second; 0, or more than the control rate: one per control step.
        "rate": {"rate": 0.0},
        # Step between two neighbouring readings; 0: none.
        "quantization": {"quantization": 0.0},
        # Probability that a sample is lost.
        "dropout": {"dropout": 0.0},
        # Bursts of lost samples per second without one, and their mean length, at least control_dt.
        "burst_rate": {"burst_rate": 0.0, "burst_duration": 1.0},
    }
)
"""Effect -> its parameters, each with a value at which the effect does nothing."""

UNITS: Mapping[str, str] = MappingProxyType(
    {
        "noise": "reading",  # the unit of the channel's value
        "bias": "reading",
        "drift": "reading/sqrt(s)",
        "scale": "1",
        "delay": "s",
        "rate": "Hz",
        "quantization": "reading",
        "dropout": "1",
        "burst_rate": "1/s",
        "burst_duration": "s",
    }
)

# One random stream per use, folded into the caller's key: no key serves two draws, and switching one effect
# on leaves the draws of the others as they were.
_NOISE, _DRIFT, _PHASE, _DROPOUT, _BURST = range(5)


@struct.dataclass
class SensorState:
    """What the sensors of one world remember; parts whose effect is absent are None."""

    history: Array | None = None  # (depth, n) true readings of past control steps, newest first
    drift: Array | None = None  # (n,) channel unit: the random walk
    phase: Array | None = None  # (n,) in [0, 1): sampling periods since the last sample was due
    burst: Array | None = None  # (n,) bool: inside a burst of lost samples
    output: Array | None = None  # (n,) the last reading, which is held while no new sample arrives


@dataclasses.dataclass(frozen=True)
class Sensors:
    """Static description of the sensor channels of one environment, from true values to readings.

    Order: delay, scale, bias, drift, noise, quantisation; then the finished sample is held until the next one
    arrives (rate, dropout, bursts), noise and all, so that a slow sensor's noise cannot be averaged away.
    """

    channels: tuple[str, ...]
    """One name per scalar, n of them, e.g. "pole_angle", "joint_position[3]"."""
    control_dt: float
    """Control period, s: one reading each."""
    effects: frozenset[str] = frozenset()
    """Keys of EFFECTS that are simulated; the others cost nothing."""
    max_delay: float = 0.0
    """Longest delay that the delay line can hold, s; longer ones are cut to it."""

    def __post_init__(self) -> None:
        check_effects(self.effects, EFFECTS, "sensor")
        if self.control_dt <= 0 or self.max_delay < 0:
            raise UserError(
                f"control_dt {self.control_dt}, max_delay {self.max_delay}: "
                "valid are control_dt > 0, max_delay >= 0"
            )

    def nominal(self, dtype: DTypeLike = float) -> dict[str, Array]:
        """Every parameter of `effects`, (n,), at its value without effect."""
        return {
            name: jnp.full(len(self.channels), value, dtype)
            for effect in sorted(self.effects)
            for name, value in EFFECTS[effect].items()
        }

    def start(self, parameters: dict[str, Array], reading: Array, key: Array) -> tuple[Array, SensorState]:
        """First reading (n,) of an episode whose true values `reading` (n,) have stood still so far.

        Each channel's phase, the time since its last sample, is drawn uniformly; no burst is under way.
        """
        drift = jnp.zeros_like(reading) if "drift" in self.effects else None
        phase = None
        if "rate" in self.effects:
            phase = jax.random.uniform(jax.random.fold_in(key, _PHASE), reading.shape, reading.dtype)
        output = self._sample(parameters, drift, reading, key)
        depth = delay_depth(self.max_delay, self.control_dt)
        return output, SensorState(
            history=jnp.tile(reading, (depth, 1)) if "delay" in self.effects else None,
            drift=drift,
            phase=phase,
            burst=jnp.zeros(reading.shape, bool) if "burst_rate" in self.effects else None,
            output=output if self.effects & {"rate", "dropout", "burst_rate"} else None,
        )

    def apply(
        self, parameters: dict[str, Array], state: SensorState, reading: Array, key: Array
    ) -> tuple[Array, SensorState]:
        """Readings (n,) one control period later, when the true values are `reading` (n,)."""
        history, drift = state.history, state.drift
        if history is not None:
            recent = jnp.concatenate([reading[None], history])
            history = recent[:-1]
            reading = delayed(recent, parameters["delay"] / self.control_dt)[0]
        if drift is not None:
            draw = jax.random.normal(jax.random.fold_in(key, _DRIFT), reading.shape, reading.dtype)
            drift = drift + parameters["drift"] * math.sqrt(self.control_dt) * draw
        output = self._sample(parameters, drift, reading, key)
        if state.output is None:
            return output, SensorState(history=history, drift=drift)
        arrived, phase, burst = self._arrived(parameters, state, key)
        output = jnp.where(arrived, output, state.output)
        return output, SensorState(history=history, drift=drift, phase=phase, burst=burst, output=output)

    def _sample(self, parameters: dict[str, Array], drift: Array | None, reading: Array, key: Array) -> Array:
        """What the sensor would report now: scale, bias, drift, noise, quantisation."""
        if "scale" in self.effects:
            reading = reading * parameters["scale"]
        if "bias" in self.effects:
            reading = reading + parameters["bias"]
        if drift is not None:
            reading = reading + drift
        if "noise" in self.effects:
            draw = jax.random.normal(jax.random.fold_in(key, _NOISE), reading.shape, reading.dtype)
            reading = reading + parameters["noise"] * draw
        if "quantization" in self.effects:
            step = parameters["quantization"]
            safe_step = jnp.where(step > 0, step, 1)
            reading = jnp.where(step > 0, safe_step * jnp.round(reading / safe_step), reading)
        return reading

    def _arrived(
        self, parameters: dict[str, Array], state: SensorState, key: Array
    ) -> tuple[Array | bool, Array | None, Array | None]:
        """Whether a new sample of each channel arrives in this control step, (n,); the new phase and burst.

        The phase stays in [0, 1), so that its rounding does not grow with time: in float32 the sampling rate
        is off by less than 1e-7 of the control rate. Bursts are a two-state Markov chain (Gilbert 1960) that
        per step begins one with probability burst_rate * control_dt and ends one with control_dt /
        burst_duration.
        """
        arrived: Array | bool = True
        phase, burst = state.phase, state.burst
        if phase is not None:
            rate = parameters["rate"]
            phase = phase + jnp.where(rate > 0, rate * self.control_dt, 1)
            arrived = phase >= 1
            phase = phase - jnp.floor(phase)
        if "dropout" in self.effects:
            lost = parameters["dropout"]
            draw = jax.random.uniform(jax.random.fold_in(key, _DROPOUT), lost.shape, lost.dtype)
            arrived = arrived & (draw >= lost)
        if burst is not None:
            rate = parameters["burst_rate"]
            draw = jax.random.uniform(jax.random.fold_in(key, _BURST), rate.shape, rate.dtype)
            stays = draw >= self.control_dt / parameters["burst_duration"]
            begins = draw < rate * self.control_dt
            burst = jnp.where(burst, stays, begins)
            arrived = arrived & ~burst
        return arrived, phase, burst

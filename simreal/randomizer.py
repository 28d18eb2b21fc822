"""Named factors, and how their draws become a World.

`Randomizer` is written by hand, beside an environment, without a model at hand. Binding it to an
environment's model checks every name and range and gives a `WorldBuilder`, whose two steps are

    draws = builder.sample(key, ranges)     # from what
    world = builder.build(draws)            # what it means for the model, actuators, sensors

The structure is static; `builder.ranges` is a pytree of arrays that may be traced, moved or vmapped over.
"""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from simreal import world as world_module
from simreal.constants import derived_constants
from simreal.distributions import Distribution, LogUniform, Uniform
from simreal.errors import UserError, nearest
from simreal.factors import OPERATIONS, Factor, Target
from simreal.quantities import QUANTITIES, element_names, nominal_field
from simreal.world import World

Draws = Mapping[str, jax.Array]
Ranges = Mapping[str, Mapping[str, jax.Array]]

_IDENTITY = {"times": 1.0, "plus": 0.0}


class Randomizer:
    """Named factors: `Randomizer(pole_mass=physics.body_mass("pole").times(LogUniform(0.7, 1.4)), ...)`."""

    def __init__(self, **factors: Factor) -> None:
        for name, factor in factors.items():
            if not isinstance(factor, Factor):
                raise UserError(
                    f"factor {name!r} is {factor!r}; give it an operation and a distribution, "
                    f"for example physics.body_mass('pole').times(Uniform(0.8, 1.2))"
                )
        self.factors: dict[str, Factor] = dict(factors)

    def replace(self, **factors: Factor | None) -> Randomizer:
        """A copy with factors replaced, added, or (None) taken out."""
        merged = {**self.factors, **factors}
        return Randomizer(**{name: factor for name, factor in merged.items() if factor is not None})

    def with_ranges(self, ranges: Mapping[str, Sequence[float]], where: str = "randomizer") -> Randomizer:
        """A copy whose factors are drawn from [low, high] instead, uniform or log-uniform as they were."""
        changed: dict[str, Factor] = {}
        for name, limits in ranges.items():
            if name not in self.factors:
                raise UserError(f"{where}: unknown factor {name!r}; {nearest(name, self.factors)}")
            factor = self.factors[name]
            try:
                low, high = (float(x) for x in limits)
                kind = LogUniform if isinstance(factor.distribution, LogUniform) else Uniform
                distribution: Distribution = kind(low, high)
            except (TypeError, ValueError) as error:
                raise UserError(f"{where}.{name}: {error}; a range is [low, high]") from None
            changed[name] = replace(factor, distribution=distribution)
        return self.replace(**changed)

    @property
    def digest(self) -> str:
        """SHA-256 over names, targets, operations and distributions: equal digests draw the same worlds."""
        text = "\n".join(f"{name}={factor}" for name, factor in self.factors.items())
        return hashlib.sha256(text.encode()).hexdigest()

    def __repr__(self) -> str:
        body = "".join(f"    {name}={factor},\n" for name, factor in self.factors.items())
        return f"Randomizer(\n{body})"


def _tags(name: str, size: int) -> np.ndarray:
    """(size,) uint32 to fold into a key, one for each number that a factor draws."""
    return np.array(
        [
            int.from_bytes(hashlib.sha256(f"{name}[{i}]".encode()).digest()[:4], "little") & 0x7FFFFFFF
            for i in range(size)
        ],
        dtype=np.uint32,
    )


def _open_unit(key: jax.Array) -> jax.Array:
    """Uniform in (0, 1) without its ends, whose quantiles may be infinite."""
    dtype = jnp.result_type(float)
    return jax.random.uniform(key, (), dtype, minval=jnp.finfo(dtype).epsneg / 2, maxval=1)


@dataclass(frozen=True)
class Bound:
    """A factor with what it addresses resolved. `mask` runs over all rows of the addressed fields."""

    factor: Factor
    unit: str
    mask: np.ndarray  # (rows,) bool
    size: int
    """Number of draws: 1, or one per addressed element."""
    nominal: float | np.ndarray
    """The draw that changes nothing; NaN where no single draw does (`set` over unequal nominal values)."""
    lowest: float
    """Smallest draw that leaves every addressed value possible."""

    @property
    def shape(self) -> tuple[int, ...]:
        return (self.size,) if self.factor.independent else ()

    def change(self, draw: jax.Array) -> Callable[[jax.Array], jax.Array]:
        """The operation with this draw, on an array whose first axis runs over the rows."""
        operation = OPERATIONS[self.factor.operation]
        position = np.maximum(np.cumsum(self.mask) - 1, 0)

        def apply(values: jax.Array) -> jax.Array:
            spread = draw.astype(values.dtype)[position] if draw.ndim else draw.astype(values.dtype)
            changed = operation(values, spread)
            # A draw that is NaN leaves the nominal value. This asks the result: asking the draw makes the
            # compiler of JAX 0.9.2 die of a division by zero (SIGFPE).
            return jnp.where(self.mask & ~jnp.isnan(changed), changed, values)

        return apply


@dataclass(frozen=True)
class ParameterGroup:
    """Parameters of actuators, sensors or disturbances, whose elements bear these names."""

    elements: tuple[str, ...]
    nominal: Mapping[str, np.ndarray]
    """Parameter -> its value without effect, one per element or a scalar for all."""
    units: Mapping[str, Sequence[str]]
    """Parameter -> its unit for each element."""
    positive: frozenset[str] = frozenset()
    """Parameters that must stay above 0."""


class WorldBuilder:
    """A `Randomizer` bound to a model: samples draws and builds Worlds, both pure functions.

    Args:
        randomizer: the factors.
        model: the nominal MuJoCo model; never changed.
        groups: the parameter groups "actuator", "sensor" and "disturbance" of the environment.

    Raises:
        UserError: a name that addresses nothing, an operation that a quantity does not have, or a support
            that makes a value impossible.
    """

    def __init__(
        self, randomizer: Randomizer, model: mujoco.MjModel, groups: Mapping[str, ParameterGroup]
    ) -> None:
        self.randomizer = randomizer
        self.groups = groups
        self.bound = {name: self._bind(name, f, model) for name, f in randomizer.factors.items()}
        physics = [b.factor for b in self.bound.values() if b.factor.target.group == "physics"]
        varied = sorted({field for f in physics for field in QUANTITIES[f.target.quantity].fields})
        self._nominal = {name: nominal_field(model, name) for name in varied}
        self._check_combinations()
        self._derive = derived_constants(model, varied)
        self.events = tuple(name for name, b in self.bound.items() if b.factor.time is not None)
        self.model_fields = tuple(sorted(jax.eval_shape(lambda: self.build({}).model)))

    # -- draws ---------------------------------------------------------------------------------------------

    @property
    def factors(self) -> dict[str, Factor]:
        """The factors by name."""
        return self.randomizer.factors

    @property
    def draw_distributions(self) -> dict[str, Distribution]:
        """Everything that is drawn: each factor, and `<factor>_time` for each event."""
        out = {}
        for name, factor in self.factors.items():
            out[name] = factor.distribution
            if factor.time is not None:
                out[f"{name}_time"] = factor.time
        return out

    @property
    def ranges(self) -> dict[str, dict[str, jax.Array]]:
        """The distributions' parameters, a pytree of arrays."""
        return {name: d.parameters() for name, d in self.draw_distributions.items()}

    def draw_shape(self, name: str) -> tuple[int, ...]:
        """Shape of one draw: () or (elements,)."""
        return self.bound[name].shape if name in self.bound else ()

    def sample(self, key: jax.Array, ranges: Ranges | None = None) -> dict[str, jax.Array]:
        """One draw of every factor. A factor's draw does not depend on which other factors there are."""
        names = list(self.draw_distributions)
        if not names:
            return {}
        tags = np.concatenate([_tags(name, self._draw_size(name)) for name in names])
        keys = jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, tags)
        return self.from_unit(jax.vmap(_open_unit)(keys), ranges)

    def from_unit(self, u: jax.Array, ranges: Ranges | None = None) -> dict[str, jax.Array]:
        """The draws of a point of the open unit cube, (draws,): each distribution's quantile."""
        ranges = self.ranges if ranges is None else ranges
        draws, offset = {}, 0
        for name, distribution in self.draw_distributions.items():
            size = self._draw_size(name)
            part = u[offset : offset + size].reshape(self.draw_shape(name))
            draws[name] = distribution.quantile(part, ranges[name])
            offset += size
        return draws

    def _draw_size(self, name: str) -> int:
        return math.prod(self.draw_shape(name))

    def nominal_draws(self) -> dict[str, jax.Array]:
        """The draws that change nothing; events happen never."""
        draws = {n: jnp.broadcast_to(jnp.asarray(b.nominal, float), b.shape) for n, b in self.bound.items()}
        return draws | {f"{name}_time": jnp.asarray(jnp.inf, dtype=float) for name in self.events}

    def complete(self, draws: Mapping[str, Any]) -> dict[str, jax.Array]:
        """Draws with unnamed factors nominal, as arrays of their full shape.

        Raises:
            UserError: an unknown factor.
        """
        full = self.nominal_draws()
        for name, value in draws.items():
            if name not in full:
                raise UserError(f"unknown factor {name!r}; {nearest(name, full)}")
            full[name] = jnp.broadcast_to(jnp.asarray(value, dtype=float), full[name].shape)
            # An event that is given a value but no time has happened from the start.
            if name in self.events and f"{name}_time" not in draws:
                full[f"{name}_time"] = jnp.zeros((), dtype=float)
        return full

    def normalize(self, draws: Draws, ranges: Ranges | None = None) -> jax.Array:
        """All draws mapped to [-1, 1] by their ranges and concatenated, (draws,)."""
        ranges = self.ranges if ranges is None else ranges
        parts = [d.normalize(draws[n], ranges[n]).reshape(-1) for n, d in self.draw_distributions.items()]
        return jnp.nan_to_num(jnp.concatenate(parts)) if parts else jnp.zeros(0)

    # -- worlds --------------------------------------------------------------------------------------------

    def build(self, draws: Mapping[str, Any], ranges: Ranges | None = None) -> World:
        """The World of these draws; unnamed factors are nominal. Pure: jit and vmap it.

        Args:
            draws: factor -> value.
            ranges: what `World.normalized` is relative to; default: the randomizer's.
        """
        full = self.complete(draws)
        times = jnp.stack([full[f"{n}_time"] for n in self.events]) if self.events else jnp.zeros(0)
        order = jnp.argsort(jnp.argsort(times))
        if self.events:
            stages = jnp.arange(len(times) + 1)
            fields, parameters = jax.vmap(lambda stage: self._stage(full, stage > order))(stages)
            packed = jax.vmap(world_module.pack)(fields)
            number = jax.vmap(world_module.digest)(packed)
        else:
            fields, parameters = self._stage(full, order)
            packed = world_module.pack(fields)
            number = world_module.digest(packed)
        axes = number.ndim - 1
        return World(
            packed=packed,
            **parameters,
            draws=full,
            normalized=self.normalize(full, ranges),
            number=number,
            event_times=jnp.sort(times),
            variant=jnp.zeros((), jnp.int32),
            layout=tuple((name, fields[name].shape[axes:]) for name in sorted(fields)),
        )

    def _stage(
        self, draws: Draws, happened: jax.Array
    ) -> tuple[dict[str, jax.Array], dict[str, dict[str, jax.Array]]]:
        """Fields and parameters with the events `happened` (events,) applied."""
        fields = {name: jnp.asarray(value, dtype=float) for name, value in self._nominal.items()}
        parameters: dict[str, dict[str, jax.Array]] = {
            name: {k: jnp.asarray(v, dtype=float) for k, v in group.nominal.items()}
            for name, group in self.groups.items()
        }
        for name, bound in self.bound.items():
            draw = draws[name]
            if name in self.events:
                draw = jnp.where(happened[self.events.index(name)], draw, bound.nominal)
            target = bound.factor.target
            change = bound.change(draw)
            if target.group == "physics":
                fields |= QUANTITIES[target.quantity].apply(fields, change, dict(target.options))
            else:
                group = parameters[target.group]
                value = group[target.quantity]
                group[target.quantity] = change(value.reshape(-1)).reshape(value.shape)
        if fields:
            # Cameras and lights are only for pictures, which are drawn from a model that C has finished.
            derived = {k: v for k, v in self._derive(fields).items() if not k.startswith(("cam_", "light_"))}
            fields |= {k: v.astype(jnp.result_type(float)) for k, v in derived.items()}
        return fields, parameters

    # -- checks --------------------------------------------------------------------------------------------

    def _bind(self, name: str, factor: Factor, model: mujoco.MjModel) -> Bound:
        target, where = factor.target, f"factor {name!r} ({factor})"
        if target.group == "physics":
            if target.quantity not in QUANTITIES:
                raise UserError(f"{where}: unknown quantity; {nearest(target.quantity, QUANTITIES)}")
            quantity = QUANTITIES[target.quantity]
            names = element_names(model, quantity.element)
            units: Sequence[str] = (quantity.unit,) * len(names)
            lowest, strict, operations = quantity.lowest, quantity.strict, quantity.operations
            values = self._physical_values(model, target)
        else:
            group = self.groups[target.group]
            if target.quantity not in group.nominal:
                raise UserError(f"{where}: unknown quantity; {nearest(target.quantity, group.nominal)}")
            names, units, operations = list(group.elements), group.units[target.quantity], tuple(OPERATIONS)
            lowest = -math.inf if target.quantity == "bias" else 0.0
            strict = target.quantity in group.positive
            values = np.asarray(group.nominal[target.quantity]).reshape(-1)
            if values.size == 1 and len(names) != 1:
                names = ["*"]
        mask = np.array([target.matches(n) or n == "*" for n in names], dtype=bool)
        for pattern in target.patterns:
            if not any(replace(target, patterns=(pattern,)).matches(n) or n == "*" for n in names):
                raise UserError(
                    f"{where}: {pattern!r} addresses nothing; {nearest(pattern, _valid_names(names))}"
                )
        if factor.operation not in operations:
            raise UserError(f"{where}: cannot {factor.operation}; valid: {', '.join(operations)}")
        nominal = values[mask]
        _check_support(where, factor, nominal, lowest, strict)
        identity = _IDENTITY.get(factor.operation, _nominal_draw(nominal, factor.independent))
        size = float(np.max(np.abs(nominal), where=np.isfinite(nominal), initial=1e-3))
        least = lowest + (1e-3 * size if strict else 0.0)
        smallest = {"times": 1e-3, "plus": least - float(np.min(nominal)), "set": least}[factor.operation]
        addressed = dict.fromkeys(itertools.compress(units, mask))
        unit = "x" if factor.operation == "times" else " or ".join(addressed)
        return Bound(factor, unit, mask, int(mask.sum()), identity, smallest)

    def _check_combinations(self) -> None:
        """Raises UserError where factors that share a field make a value impossible together."""
        users: dict[str, list[str]] = {}
        for name, bound in self.bound.items():
            if bound.factor.target.group == "physics":
                users.setdefault(QUANTITIES[bound.factor.target.quantity].fields[0], []).append(name)
        shared = {field: names for field, names in users.items() if len(names) > 1}
        for field, names in shared.items():
            quantity = QUANTITIES[self.bound[names[0]].factor.target.quantity]
            if quantity.element == "actuator" or not math.isfinite(quantity.lowest):
                continue
            lowest = {n: self.bound[n].factor.distribution.support()[0] for n in names}
            fields = {name: jnp.asarray(value, dtype=float) for name, value in self._nominal.items()}
            for n in names:
                target = self.bound[n].factor.target
                change = self.bound[n].change(jnp.asarray(lowest[n], dtype=float))
                fields |= QUANTITIES[target.quantity].apply(fields, change, dict(target.options))
            mask = np.any([self.bound[n].mask for n in names], axis=0)
            values = np.asarray(fields[field])
            least = float(np.min(values[mask] if values.ndim == 1 else values[mask, 0]))
            if least < quantity.lowest or (quantity.strict and least <= quantity.lowest):
                raise UserError(f"factors {' and '.join(names)}: together they may make {field} {least:g}")

    @staticmethod
    def _physical_values(model: mujoco.MjModel, target: Target) -> np.ndarray:
        """The nominal value that the operation changes, one per row, for the support check."""
        quantity = QUANTITIES[target.quantity]
        options = dict(target.options)
        seen: list[np.ndarray] = []

        def record(values: jax.Array) -> jax.Array:
            seen.append(np.asarray(values))
            return values

        quantity.apply({f: jnp.asarray(nominal_field(model, f)) for f in quantity.fields}, record, options)
        return seen[0]


def _nominal_draw(nominal: np.ndarray, independent: bool) -> float | np.ndarray:
    """The draw of `set` that leaves the addressed values (n,) as they are."""
    if independent:
        return nominal
    return float(nominal[0]) if np.all(nominal == nominal[0]) else math.nan


def _valid_names(names: list[str]) -> list[str]:
    return list(dict.fromkeys(n.split("[")[0] for n in names if n))


def _check_support(where: str, factor: Factor, nominal: np.ndarray, lowest: float, strict: bool) -> None:
    """Raises UserError where some draw would make a value impossible."""
    low, high = factor.distribution.support()
    if factor.operation != "set" and np.all(np.isinf(nominal)):
        raise UserError(f"{where}: the nominal value is infinite, so only set changes it")
    earliest = factor.time.support()[0] if factor.time is not None else 0.0
    if earliest < 0:
        raise UserError(f"{where}: the event's time may be {earliest:g} s; it must be at least 0")
    if factor.operation == "times":
        extreme = min(float(np.min(nominal * low)), float(np.min(nominal * high)))
        if np.all(nominal == 0):
            raise UserError(f"{where}: the nominal value is 0, so scaling changes nothing; use plus or set")
    elif factor.operation == "plus":
        extreme = float(np.min(nominal)) + low
    else:
        extreme = low
    if extreme < lowest or (strict and extreme <= lowest):
        bound = f"{'above' if strict else 'at least'} {lowest:g}"
        raise UserError(f"{where}: the value may become {extreme:g}; it must be {bound}")

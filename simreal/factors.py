"""Factors: what varies, how it is applied to the nominal value, and from what it is drawn.

A `Target` addresses a quantity by the model's own names; `times`, `plus` and `set` make a `Factor` of it:

    physics.body_mass("pole").times(LogUniform(0.7, 1.4))

An operation always applies to the nominal value, so draws never compound over episodes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from typing import Literal

import jax
import jax.numpy as jnp

from simreal.distributions import Distribution

Operation = Literal["times", "plus", "set"]
Group = Literal["physics", "actuator", "sensor", "disturbance"]

OPERATIONS: dict[str, Callable[[jax.Array, jax.Array], jax.Array]] = {
    "times": lambda nominal, draw: nominal * draw,
    "plus": lambda nominal, draw: nominal + draw,
    "set": lambda nominal, draw: jnp.broadcast_to(draw, nominal.shape),
}


@dataclass(frozen=True)
class Target:
    """A quantity of some of the model's elements, addressed by name or shell-style pattern."""

    group: Group
    quantity: str
    patterns: tuple[str, ...] = ("*",)
    options: tuple[tuple[str, str | bool | int], ...] = ()

    def times(self, distribution: Distribution) -> Factor:
        """nominal * draw."""
        return Factor(self, "times", distribution)

    def plus(self, distribution: Distribution) -> Factor:
        """nominal + draw."""
        return Factor(self, "plus", distribution)

    def set(self, distribution: Distribution) -> Factor:
        """draw, whatever the nominal value."""
        return Factor(self, "set", distribution)

    def matches(self, name: str) -> bool:
        """Whether an element's name is addressed; a reading's bare name addresses all its channels."""
        bare = name.split("[")[0]
        return bool(name) and any(p in (name, bare) or fnmatchcase(name, p) for p in self.patterns)

    def __str__(self) -> str:
        arguments = [repr(p) for p in self.patterns] + [f"{k}={v!r}" for k, v in self.options]
        return f"{self.group}.{self.quantity}({', '.join(arguments)})"


@dataclass(frozen=True)
class Factor:
    """One thing that varies between worlds."""

    target: Target
    operation: Operation
    distribution: Distribution
    independent: bool = False
    """False: one draw for all addressed elements. True: one draw for each of them."""
    time: Distribution | None = field(default=None)
    """Drawn time (s) of the episode when the value jumps from nominal to the draw; None: from the start."""

    def each(self) -> Factor:
        """Draws a value of its own for each addressed element."""
        return replace(self, independent=True)

    def at(self, time: Distribution) -> Factor:
        """Makes it an event: the value is nominal until `time` (s), then jumps to the draw."""
        return replace(self, time=time)

    def __str__(self) -> str:
        text = f"{self.target}.{self.operation}({self.distribution})"
        if self.independent:
            text += ".each()"
        return text if self.time is None else f"{text}.at({self.time})"


def target(
    group: Group, quantity: str, patterns: tuple[str, ...] = ("*",), **options: str | bool | int
) -> Target:
    """Short form for the vocabularies in `simreal.randomizers`."""
    return Target(group, quantity, patterns or ("*",), tuple(sorted(options.items())))

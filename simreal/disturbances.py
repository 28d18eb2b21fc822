"""Pushes: forces on one body at random times."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import jax
import jax.numpy as jnp

PARAMETERS: Mapping[str, float] = MappingProxyType({"push_rate": 0.0, "push_impulse": 0.0})
"""Parameter -> its value without effect."""

UNITS: Mapping[str, str] = MappingProxyType({"push_rate": "1/s", "push_impulse": "N s"})


def push_force(parameters: Mapping[str, jax.Array], control_dt: float, key: jax.Array) -> jax.Array:
    """Force (3,) in N on the pushed body during one control step, world frame; zero between pushes.

    Pushes come as a Poisson process of `push_rate`; each gives `push_impulse` in a uniformly drawn horizontal
    direction, spread over one control step.
    """
    rate, impulse = parameters["push_rate"], parameters["push_impulse"]
    draw = jax.random.uniform(key, (2,), rate.dtype)
    pushed = draw[0] < -jnp.expm1(-rate * control_dt)
    angle = 2 * jnp.pi * draw[1]
    direction = jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)])
    return jnp.where(pushed, impulse / control_dt, 0) * direction

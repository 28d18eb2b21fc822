"""One episode's reality."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

Layout = tuple[tuple[str, tuple[int, ...]], ...]
"""Name and shape of each array in a packed one."""


@struct.dataclass
class World:
    """The values that make one world differ from the nominal one; a plain pytree.

    Where the randomizer has mid-episode events, `packed`, `actuator`, `sensor`, `disturbance` and `number`
    have a leading axis of stages (stage k: the k earliest events have happened) and `event_times` says when
    each stage after the first begins; `at` picks the stage. Without events there is no such axis.
    """

    packed: jax.Array
    """All of `model` in one array, which is cheaper to carry and to hand to the host than many."""
    actuator: dict[str, jax.Array]
    """Actuator effect parameter -> (nu,), see `simreal.actuators`."""
    sensor: dict[str, jax.Array]
    """Sensor effect parameter -> (channels,), see `simreal.sensors`."""
    disturbance: dict[str, jax.Array]
    """Disturbance parameter -> scalar, see `simreal.disturbances`."""
    draws: dict[str, jax.Array]
    """Factor -> raw draw, scalar or one per addressed element."""
    normalized: jax.Array
    """All draws mapped to [-1, 1] and concatenated: what a privileged critic sees."""
    number: jax.Array
    """(2,) uint32 digest of `model`: engines rewrite a row only when it changes."""
    event_times: jax.Array
    """(events,) s, sorted; empty without events."""
    variant: jax.Array
    """int32, room for a structural variant (another terrain or object); 0 today."""
    layout: Layout = struct.field(pytree_node=False)
    """Name and shape of each model field in `packed`, in order."""

    @property
    def model(self) -> dict[str, jax.Array]:
        """MuJoCo model field -> whole array, only the fields that vary and the constants derived from them.

        Leading axes of `packed` (worlds, stages) are kept.
        """
        return unpack(self.packed, self.layout)

    def at(self, time: jax.Array) -> World:
        """The world as it is at `time` (s) of the episode: events before it have happened."""
        if self.event_times.shape[-1] == 0:
            return self
        stage = jnp.sum(time >= self.event_times)
        varying = (self.packed, self.actuator, self.sensor, self.disturbance, self.number)
        packed, actuator, sensor, disturbance, number = jax.tree.map(lambda x: x[stage], varying)
        return dataclasses.replace(
            self,
            packed=packed,
            actuator=actuator,
            sensor=sensor,
            disturbance=disturbance,
            number=number,
            event_times=self.event_times[:0],
        )


def pack(arrays: Mapping[str, jax.Array]) -> jax.Array:
    """Arrays of one dtype as a flat one, in the order of their names."""
    flat = [arrays[name].reshape(-1) for name in sorted(arrays)]
    return jnp.concatenate(flat) if flat else jnp.zeros(0)


def unpack(packed: Any, layout: Layout) -> dict[str, Any]:
    """The arrays (..., *shape) that `pack` made `packed` (..., n) of; JAX or NumPy."""
    arrays, start = {}, 0
    for name, shape in layout:
        end = start + math.prod(shape)
        arrays[name] = packed[..., start:end].reshape(packed.shape[:-1] + shape)
        start = end
    return arrays


def digest(packed: jax.Array) -> jax.Array:
    """(2,) uint32 content hash of a flat float array: equal contents, equal digest.

    Two multiply-xor hashes of the bit patterns with different odd multipliers per element; unequal contents
    collide with probability of about 2**-64.
    """
    bits = jax.lax.bitcast_convert_type(packed, jnp.uint32).reshape(-1)
    index = np.arange(1, bits.size + 1, dtype=np.uint32)
    lanes = np.stack([index * np.uint32(0x9E3779B1), index * np.uint32(0x85EBCA77)])
    mixed = (bits[None] ^ lanes) * jnp.uint32(0xC2B2AE3D)
    mixed = (mixed ^ (mixed >> 15)) * jnp.uint32(0x27D4EB2F)
    return jnp.sum(mixed ^ (mixed >> 16), axis=1, dtype=jnp.uint32)

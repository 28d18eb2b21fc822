"""What a policy remembers between two observations: the same in training (JAX) and on a robot (NumPy)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

Memory = Any
"""() for a policy without memory, else a dict of arrays (..., n); all zeros at the start of an episode."""


@dataclass(frozen=True)
class Recollection:
    """How much a policy remembers.

    Args:
        observations: numbers in one observation.
        history: observations that are seen at a time, the newest one included.
        hidden: units of the recurrent layer; 0: there is none.
    """

    observations: int
    history: int = 1
    hidden: int = 0

    @property
    def size(self) -> int:
        """Numbers in what the policy's network is shown: `history` observations."""
        return self.history * self.observations

    def empty(self, xp: Any) -> Memory:
        """The memory at the start of an episode; `xp` is NumPy or jax.numpy."""
        if self.history == 1 and not self.hidden:
            return ()
        return {
            "used": xp.zeros((), "float32"),
            "past": xp.zeros((self.history - 1) * self.observations, "float32"),
            "hidden": xp.zeros(self.hidden, "float32"),
        }

    def see(self, xp: Any, memory: Memory, obs: Any) -> tuple[Any, Memory]:
        """What the network is shown (..., size), newest first, and the memory after it.

        Before an episode's first observation there was none: it stands in for those.
        """
        if not memory or self.history == 1:
            return obs, memory and memory | {"used": xp.ones_like(memory["used"])}
        first = xp.concatenate([obs] * (self.history - 1), axis=-1)
        past = xp.where(memory["used"][..., None] > 0, memory["past"], first)
        shown = xp.concatenate([obs, past], axis=-1)
        kept = shown[..., : (self.history - 1) * self.observations]
        return shown, memory | {"used": xp.ones_like(memory["used"]), "past": kept}


def gru(xp: Any, weights: Mapping[str, Any], hidden: Any, x: Any) -> Any:
    """One step of a gated recurrent unit (Cho et al. 2014), with the weights of Flax's `GRUCell`."""

    def dense(name: str, value: Any) -> Any:
        return value @ weights[f"gru_{name}_kernel"] + weights.get(f"gru_{name}_bias", 0)

    def sigmoid(value: Any) -> Any:
        return 1 / (1 + xp.exp(-value))

    reset = sigmoid(dense("ir", x) + dense("hr", hidden))
    update = sigmoid(dense("iz", x) + dense("hz", hidden))
    new = xp.tanh(dense("in", x) + reset * dense("hn", hidden))
    return (1 - update) * new + update * hidden

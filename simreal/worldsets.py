"""Named, fixed sets of worlds for the evaluator.

A set is written down beside its environment before anything is trained, is drawn from its own seed, and is
hashed, so that two evaluations of the same set met the same worlds. Sets that claim to lie outside the
training ranges are checked.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import jax
import numpy as np

from simreal.errors import UserError, nearest
from simreal.randomizer import WorldBuilder

Interval = tuple[float, float]


@dataclass(frozen=True)
class WorldSet:
    """A set of worlds, each a draw of every factor.

    `kind` says how worlds are made: "nominal" (nothing varies), "train" (fresh draws from the training
    ranges), "outside" (see `outside`), "fixed" (the draws in `fixed`, other factors nominal: a stand-in for a
    real unit).
    """

    name: str
    description: str
    kind: Literal["nominal", "train", "outside", "fixed"]
    outside: Mapping[str, Sequence[Interval]] = field(default_factory=dict)
    """factor -> intervals beyond its training range. World i has factor i mod (F + 1) outside and the others
    as in training; where that is F, all of them are outside at once."""
    fixed: Mapping[str, float | Sequence[float]] = field(default_factory=dict)

    @property
    def claims_outside(self) -> bool:
        """Whether each world is promised to lie outside the training range in at least one factor."""
        return self.kind in ("outside", "fixed")

    def draws(self, builder: WorldBuilder, worlds: int, seed: int) -> dict[str, np.ndarray]:
        """The raw draws: factor -> (worlds, ...). The same arguments give the same draws.

        Raises:
            UserError: a factor that the builder does not have.
        """
        for name in (*self.outside, *self.fixed):
            if name not in builder.draw_distributions:
                raise UserError(
                    f"set {self.name!r}: unknown factor {name!r}; {nearest(name, builder.draw_distributions)}"
                )
        base = jax.tree.map(np.asarray, builder.complete(self.fixed))
        draws = {name: np.repeat(value[None], worlds, axis=0) for name, value in base.items()}
        if self.kind in ("train", "outside"):
            key = jax.random.fold_in(jax.random.PRNGKey(seed), _tag(self.name))
            sampled = jax.jit(jax.vmap(builder.sample))(jax.random.split(key, worlds))
            draws = {name: np.array(value) for name, value in sampled.items()}
        if self.kind == "outside":
            self._move_outside(draws, worlds, seed)
        return draws

    def _move_outside(self, draws: dict[str, np.ndarray], worlds: int, seed: int) -> None:
        random = np.random.default_rng([seed, _tag(self.name)])
        factors = list(self.outside)
        turn = np.arange(worlds) % (len(factors) + 1)
        for i, name in enumerate(factors):
            intervals = np.asarray(self.outside[name], float)
            chosen = intervals[random.integers(len(intervals), size=worlds)]
            values = random.uniform(chosen[:, 0], chosen[:, 1])
            moved = (turn == i) | (turn == len(factors))
            shape = (-1,) + (1,) * (draws[name].ndim - 1)
            values = values.astype(draws[name].dtype).reshape(shape)
            draws[name] = np.where(moved.reshape(shape), values, draws[name])

    def check(self, builder: WorldBuilder) -> None:
        """Checks that what claims to lie outside the training ranges does.

        Raises:
            UserError: names the factor, its interval or value, and its training range.
        """
        ranges = {name: d.range() for name, d in builder.draw_distributions.items()}
        for name, intervals in self.outside.items():
            low, high = ranges[name]
            for start, end in intervals:
                if start <= high and end >= low:
                    raise UserError(
                        f"set {self.name!r}: {name} in [{start:g}, {end:g}] touches the training range "
                        f"[{low:g}, {high:g}]"
                    )
        if self.kind == "fixed":
            inside = {n: ranges[n] for n, v in self.fixed.items() if _within(v, ranges[n])}
            if len(inside) == len(self.fixed):
                raise UserError(f"set {self.name!r}: every factor lies inside its training range: {inside}")


def _within(value: float | Sequence[float], limits: Interval) -> bool:
    return bool(np.all((np.asarray(value) >= limits[0]) & (np.asarray(value) <= limits[1])))


def _tag(name: str) -> int:
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "little") & 0x7FFFFFFF


def digest(worldset: WorldSet, draws: Mapping[str, np.ndarray], seed: int) -> str:
    """SHA-256 over a set's definition, its draws, and the seed of its start states and noise."""
    content = hashlib.sha256(f"{worldset!r} {seed}".encode())
    for name in sorted(draws):
        content.update(name.encode())
        content.update(np.ascontiguousarray(draws[name], np.float32).tobytes())
    return content.hexdigest()


NOMINAL = WorldSet("nominal", "the model as it is written down", "nominal")
TRAIN = WorldSet("train", "fresh draws from the training ranges", "train")


def held_out(**outside: Sequence[Interval]) -> WorldSet:
    """The `held_out` set: each factor outside its training range in turn, and all together."""
    text = f"each of {len(outside)} factors outside its training range in turn, and all together"
    return WorldSet("held_out", text, "outside", outside=outside)


def stand_in(name: str, description: str, **draws: float | Sequence[float]) -> WorldSet:
    """A stand-in for a real unit: fixed draws, at least one of them outside its training range."""
    return WorldSet(name, description, "fixed", fixed=draws)

"""What a factor is drawn from.

A distribution has a static form (its class) and numeric parameters. The parameters travel as arrays in a
pytree, so that a curriculum can move them and a sweep can `vmap` over them without a new compile; every
method that runs inside a jitted program takes them as its argument `p`.
"""

from __future__ import annotations

import abc
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import betainc, ndtr, ndtri

Parameters = Mapping[str, jax.Array]

CENTRAL_MASS = 0.999
"""For a distribution without ends, this central share of it counts as its range."""


@dataclass(frozen=True)
class Distribution(abc.ABC):
    """A one-dimensional distribution. Subclasses are final."""

    def __post_init__(self) -> None:
        for field in fields(self):
            values = np.atleast_1d(np.asarray(getattr(self, field.name), dtype=float))
            if not np.all(np.isfinite(values)):
                raise ValueError(f"{self}: {field.name} is not finite")
        self._check()

    @abc.abstractmethod
    def _check(self) -> None:
        """Raises ValueError where the parameters make no distribution."""

    @property
    def continuous(self) -> bool:
        """Whether draws come from a continuum, so that two are never equal."""
        return True

    def parameters(self) -> dict[str, jax.Array]:
        """The numbers, as arrays: the pytree that a curriculum moves."""
        return {f.name: jnp.asarray(getattr(self, f.name), dtype=float) for f in fields(self)}

    @abc.abstractmethod
    def quantile(self, u: jax.Array, p: Parameters) -> jax.Array:
        """The draws that uniform numbers `u` in (0, 1) stand for: the inverse of the cumulative distribution.

        Drawing by quantiles makes all factors of a World from one call of the random generator, and any
        design of the unit cube (Sobol, Latin hypercube) usable as a set of worlds.
        """

    @abc.abstractmethod
    def normalize(self, x: jax.Array, p: Parameters) -> jax.Array:
        """Maps draws to [-1, 1], for a critic, a curriculum and the plots; 0 where the range is a point."""

    @abc.abstractmethod
    def support(self) -> tuple[float, float]:
        """Lowest and highest possible draw; infinite where the distribution has no end."""

    @abc.abstractmethod
    def cdf(self, x: np.ndarray) -> np.ndarray:
        """Cumulative distribution, NumPy, for tests and coverage checks."""

    def range(self) -> tuple[float, float]:
        """The support where it has ends, else the central 99.9 %."""
        low, high = self.support()
        if math.isfinite(low) and math.isfinite(high):
            return low, high
        return self._central()

    def _central(self) -> tuple[float, float]:
        raise NotImplementedError


def _scipy_stats() -> Any:
    from scipy import stats  # half a second to import, and only tests and coverage checks need it

    return stats


def _from_unit(x: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
    width = high - low
    position = (x - low) / jnp.where(width > 0, width, 1)
    return jnp.where(width > 0, jnp.clip(2 * position - 1, -1, 1), 0)


@dataclass(frozen=True)
class Uniform(Distribution):
    """Uniform on [low, high]."""

    low: float
    high: float

    def _check(self) -> None:
        if self.low > self.high:
            raise ValueError(f"low {self.low} is above high {self.high}")

    def quantile(self, u: jax.Array, p: Parameters) -> jax.Array:
        return p["low"] + (p["high"] - p["low"]) * u

    def normalize(self, x: jax.Array, p: Parameters) -> jax.Array:
        return _from_unit(x, p["low"], p["high"])

    def support(self) -> tuple[float, float]:
        return self.low, self.high

    def cdf(self, x: np.ndarray) -> np.ndarray:
        return _scipy_stats().uniform.cdf(x, self.low, self.high - self.low)


@dataclass(frozen=True)
class LogUniform(Distribution):
    """exp of a uniform draw on [log low, log high]; for scales (masses, damping, gains)."""

    low: float
    high: float

    def _check(self) -> None:
        if self.low > self.high:
            raise ValueError(f"low {self.low} is above high {self.high}")
        if self.low <= 0:
            raise ValueError(f"a log-uniform range must be above 0, got low {self.low}")

    def quantile(self, u: jax.Array, p: Parameters) -> jax.Array:
        low = jnp.log(p["low"])
        return jnp.exp(low + (jnp.log(p["high"]) - low) * u)

    def normalize(self, x: jax.Array, p: Parameters) -> jax.Array:
        low = p["low"]
        return _from_unit(jnp.log(jnp.maximum(x, low * 1e-6)), jnp.log(low), jnp.log(p["high"]))

    def support(self) -> tuple[float, float]:
        return self.low, self.high

    def cdf(self, x: np.ndarray) -> np.ndarray:
        return _scipy_stats().loguniform.cdf(x, self.low, self.high)


@dataclass(frozen=True)
class Normal(Distribution):
    """Normal with mean and standard deviation; no ends."""

    mean: float
    sd: float

    def _check(self) -> None:
        if self.sd < 0:
            raise ValueError(f"sd {self.sd} is negative")

    def quantile(self, u: jax.Array, p: Parameters) -> jax.Array:
        return p["mean"] + p["sd"] * ndtri(u)

    def normalize(self, x: jax.Array, p: Parameters) -> jax.Array:
        return _from_unit(x, p["mean"] - 3 * p["sd"], p["mean"] + 3 * p["sd"])

    def support(self) -> tuple[float, float]:
        if self.sd == 0:
            return self.mean, self.mean
        return -math.inf, math.inf

    def _central(self) -> tuple[float, float]:
        low, high = _scipy_stats().norm.interval(CENTRAL_MASS, self.mean, self.sd)
        return float(low), float(high)

    def cdf(self, x: np.ndarray) -> np.ndarray:
        return _scipy_stats().norm.cdf(x, self.mean, self.sd)


@dataclass(frozen=True)
class TruncatedNormal(Distribution):
    """Normal(mean, sd), drawn again until it lies in [low, high]."""

    mean: float
    sd: float
    low: float
    high: float

    def _check(self) -> None:
        if self.sd <= 0:
            raise ValueError(f"sd {self.sd} must be above 0")
        if self.low > self.high:
            raise ValueError(f"low {self.low} is above high {self.high}")

    def quantile(self, u: jax.Array, p: Parameters) -> jax.Array:
        low, high = ndtr((p["low"] - p["mean"]) / p["sd"]), ndtr((p["high"] - p["mean"]) / p["sd"])
        draw = p["mean"] + p["sd"] * ndtri(low + (high - low) * u)
        return jnp.clip(draw, p["low"], p["high"])

    def normalize(self, x: jax.Array, p: Parameters) -> jax.Array:
        return _from_unit(x, p["low"], p["high"])

    def support(self) -> tuple[float, float]:
        return self.low, self.high

    def cdf(self, x: np.ndarray) -> np.ndarray:
        low, high = (self.low - self.mean) / self.sd, (self.high - self.mean) / self.sd
        return _scipy_stats().truncnorm.cdf(x, low, high, self.mean, self.sd)


@dataclass(frozen=True)
class Beta(Distribution):
    """low + (high - low) * Beta(a, b)."""

    a: float
    b: float
    low: float = 0.0
    high: float = 1.0

    def _check(self) -> None:
        if self.a <= 0 or self.b <= 0:
            raise ValueError(f"a {self.a} and b {self.b} must be above 0")
        if self.low > self.high:
            raise ValueError(f"low {self.low} is above high {self.high}")

    def quantile(self, u: jax.Array, p: Parameters) -> jax.Array:
        def halve(_: int, bracket: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            low, high = bracket
            middle = (low + high) / 2
            below = betainc(p["a"], p["b"], middle) < u
            return jnp.where(below, middle, low), jnp.where(below, high, middle)

        bracket = (jnp.zeros_like(u), jnp.ones_like(u))
        low, high = jax.lax.fori_loop(0, 30, halve, bracket)
        return p["low"] + (p["high"] - p["low"]) * (low + high) / 2

    def normalize(self, x: jax.Array, p: Parameters) -> jax.Array:
        return _from_unit(x, p["low"], p["high"])

    def support(self) -> tuple[float, float]:
        return self.low, self.high

    def cdf(self, x: np.ndarray) -> np.ndarray:
        return _scipy_stats().beta.cdf(x, self.a, self.b, self.low, self.high - self.low)


@dataclass(frozen=True)
class Choice(Distribution):
    """One of `values`, with probability proportional to `weights` (equal without)."""

    values: Sequence[float]
    weights: Sequence[float] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", tuple(float(v) for v in self.values))
        weights = self.weights or (1.0,) * len(self.values)
        object.__setattr__(self, "weights", tuple(float(w) for w in weights))
        super().__post_init__()

    def _check(self) -> None:
        if not self.values:
            raise ValueError("no values to choose from")
        if len(self.weights) != len(self.values):
            raise ValueError(f"{len(self.values)} values but {len(self.weights)} weights")
        if min(self.weights) < 0 or sum(self.weights) <= 0:
            raise ValueError(f"weights {self.weights} must be at least 0 and not all 0")

    @property
    def continuous(self) -> bool:
        return False

    def quantile(self, u: jax.Array, p: Parameters) -> jax.Array:
        edges = jnp.cumsum(p["weights"]) / jnp.sum(p["weights"])
        index = jnp.sum(u[..., None] > edges.reshape((1,) * u.ndim + (-1,)), axis=-1)
        return p["values"][jnp.minimum(index, edges.shape[0] - 1)]

    def normalize(self, x: jax.Array, p: Parameters) -> jax.Array:
        return _from_unit(x, jnp.min(p["values"]), jnp.max(p["values"]))

    def support(self) -> tuple[float, float]:
        return min(self.values), max(self.values)

    def cdf(self, x: np.ndarray) -> np.ndarray:
        values, weights = np.asarray(self.values), np.asarray(self.weights) / sum(self.weights)
        return np.sum(weights * (values <= np.asarray(x)[..., None]), axis=-1)

"""Which values of a factor are worth evaluating."""

from __future__ import annotations

import math

import numpy as np

from simreal.distributions import Choice, LogUniform
from simreal.environment import Environment

BEYOND = 0.5
"""A factor's curve reaches this share of the training range's width beyond each end."""


def sweep_values(env: Environment, factor: str, points: int) -> np.ndarray:
    """`points` values of a factor, (points,), across its training range and beyond, as far as physics allows.

    They reach half a width beyond each end (in logarithms for a log-uniform factor), and at least to the ends
    of the environment's held-out intervals.
    """
    bound = env.randomizer.bound[factor]
    distribution = bound.factor.distribution
    if isinstance(distribution, Choice):
        return np.unique(np.asarray(distribution.values))
    low, high = distribution.range()
    logarithmic = isinstance(distribution, LogUniform)
    if logarithmic:
        low, high = math.log(low), math.log(high)
    width = high - low if high > low else max(abs(high), 1.0)
    low, high = low - BEYOND * width, high + BEYOND * width
    if logarithmic:
        low, high = math.exp(low), math.exp(high)
    for worldset in env.world_sets:
        for interval in worldset.outside.get(factor, ()):
            low, high = min(low, interval[0]), max(high, interval[1])
    low = max(low, bound.lowest)
    if bound.factor.target.quantity == "delay":
        high = min(high, env.max_delay)
    values = np.geomspace(low, high, points) if logarithmic else np.linspace(low, high, points)
    return values.astype(float)

"""What an evaluation measured, world by world, before any statistics."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

ENDINGS = ("time_limit", "failed", "diverged")


@dataclass(frozen=True)
class SetResult:
    """One named set of worlds, one episode in each."""

    name: str
    description: str
    claims_outside: bool
    """True where every world of the set lies outside the training ranges in at least one factor."""
    digest: str
    """SHA-256 of the set's definition and draws: equal digests are the same worlds."""
    draws: dict[str, np.ndarray]
    """factor -> (n, ...) raw draws."""
    episode_return: np.ndarray  # (n,)
    success: np.ndarray  # (n,) bool
    steps: np.ndarray  # (n,) control steps lived
    ended_by: np.ndarray  # (n,) index into ENDINGS
    hardware: dict[str, np.ndarray]
    """peak_torque (N m), saturated_share (0..1), power (W), action_rate (1/s): (n,) each."""


@dataclass(frozen=True)
class FactorCurve:
    """Success as one factor moves across and beyond its training range, the rest as in training."""

    factor: str
    unit: str
    values: np.ndarray  # (m,)
    episode_return: np.ndarray  # (m, n)
    success: np.ndarray  # (m, n) bool
    train_low: float
    train_high: float


@dataclass(frozen=True)
class HeatMap:
    """Success over a grid of two factors, the rest as in training."""

    factor_x: str
    factor_y: str
    values_x: np.ndarray  # (mx,)
    values_y: np.ndarray  # (my,)
    success: np.ndarray  # (mx, my, n) bool


@dataclass(frozen=True)
class Evaluation:
    """Everything that one `simreal evaluate` measured."""

    environment: str
    engine: str
    seed: int
    run: str
    sets: dict[str, SetResult]
    factors: dict[str, FactorCurve] = field(default_factory=dict)
    heat_map: HeatMap | None = None

"""Statistics against hand-computed values, published intervals and exact coverage."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from simreal.evaluation import statistics


@pytest.mark.parametrize("rate", [0.5, 0.9, 0.99])
def test_wilson_interval_covers_the_true_rate(rate: float) -> None:
    worlds = 256
    successes = np.arange(worlds + 1)
    intervals = [statistics.success_rate(np.arange(worlds) < count) for count in successes]
    covers = np.array([each.low <= rate <= each.high for each in intervals])
    coverage = stats.binom.pmf(successes, worlds, rate)[covers].sum()  # exact: sums over every outcome
    assert 0.93 < coverage < 0.98


def test_rate_at_the_edges() -> None:
    always, never = statistics.success_rate(np.ones(100)), statistics.success_rate(np.zeros(100))
    assert (always.value, always.high) == (1.0, pytest.approx(1.0))
    assert always.low == pytest.approx(0.96301, abs=1e-5)  # 1 / (1 + z^2 / n)
    assert (never.value, never.low) == (0.0, pytest.approx(0.0))
    assert never.high == pytest.approx(1.0 - 0.96301, abs=1e-5)
    one = statistics.success_rate([True])
    assert one.value == 1.0
    assert one.low == pytest.approx(0.20654, abs=1e-5)
    assert statistics.success_rate([]) == statistics.Estimate(None)


def test_interquartile_mean_by_hand() -> None:
    assert statistics.interquartile_mean([100.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, -50.0]) == pytest.approx(3.5)
    assert statistics.interquartile_mean([9.0, 1.0, 2.0]) == pytest.approx(4.0)  # nothing to cut from three


def test_cvar_by_hand() -> None:
    assert statistics.cvar(np.arange(20.0)) == pytest.approx(0.5)  # the worst two of twenty
    # 1.5 worlds: the worst one whole, the next by half.
    assert statistics.cvar([*range(10, 23), -2.0, 4.0]) == pytest.approx((-2.0 + 0.5 * 4.0) / 1.5)
    assert statistics.cvar([7.0]) == 7.0
    rows = np.array([np.arange(20.0), np.arange(20.0) + 5.0])
    np.testing.assert_allclose(statistics.cvar(rows, axis=-1), [0.5, 5.5])
    np.testing.assert_allclose(statistics.cvar(rows.T, axis=0), [0.5, 5.5])


@pytest.mark.parametrize("name", ["mean", "interquartile_mean", "cvar"])
def test_bootstrap_covers_the_truth(name: str) -> None:
    draws = np.random.default_rng(0)
    statistic = getattr(statistics, name)
    truth = float(statistic(-draws.exponential(size=1_000_000)))
    covered = 0
    for repetition in range(150):
        estimate = statistics.bootstrap(-draws.exponential(size=256), statistic, seed=repetition)
        covered += estimate.low <= truth <= estimate.high
    assert 0.87 <= covered / 150 <= 0.99


def test_bootstrap_repeats_from_its_seed() -> None:
    values = np.random.default_rng(1).normal(size=64)
    first = statistics.bootstrap(values, statistics.cvar, seed=3)
    assert first == statistics.bootstrap(values, statistics.cvar, seed=3)
    assert first != statistics.bootstrap(values, statistics.cvar, seed=4)


@pytest.mark.filterwarnings("error")
def test_bootstrap_edge_cases() -> None:
    mean = statistics.mean
    assert statistics.bootstrap([], mean, 0) == statistics.Estimate(None)
    assert statistics.bootstrap([np.nan, np.inf], mean, 0) == statistics.Estimate(None)
    assert statistics.bootstrap([2.0], mean, 0) == statistics.Estimate(2.0)
    assert statistics.bootstrap([2.0] * 9, mean, 0) == statistics.Estimate(2.0, 2.0, 2.0)
    one_odd = statistics.bootstrap([0.0] * 255 + [1.0], statistics.interquartile_mean, 0)
    assert one_odd.value == 0.0
    assert one_odd.low == one_odd.high == 0.0


def test_a_world_without_a_return_counts_as_the_worst() -> None:
    np.testing.assert_array_equal(
        statistics.finite_returns([3.0, np.nan, 1.0, -np.inf]), [3.0, 1.0, 1.0, 1.0]
    )


def test_difference_of_independent_rates_as_published() -> None:
    """Newcombe 1998, table II (a): 56/70 - 48/80, method 10."""
    difference = statistics.success_difference(np.arange(70) < 56, np.arange(80) < 48, paired=False)
    assert difference.value == pytest.approx(0.2)
    assert difference.ci95 == pytest.approx([0.0524, 0.3339], abs=1e-4)
    assert difference.excludes_zero


def test_pairing_narrows_the_interval_and_still_covers() -> None:
    draws = np.random.default_rng(2)
    true_difference, covered, narrower = 0.05, 0, 0
    for _ in range(400):
        difficulty = draws.random(256)
        first, second = difficulty < 0.9, difficulty < 0.85
        paired = statistics.success_difference(first, second, paired=True)
        covered += paired.low <= true_difference <= paired.high
        independent = statistics.success_difference(first, second, paired=False)
        narrower += paired.high - paired.low < independent.high - independent.low
    assert covered / 400 > 0.92
    assert narrower / 400 > 0.99


def test_equal_policies_do_not_differ() -> None:
    success = np.arange(256) < 200
    difference = statistics.success_difference(success, success, paired=True)
    assert difference.value == 0.0
    assert not difference.excludes_zero
    returns = np.linspace(0.0, 1.0, 256)
    assert statistics.return_difference(returns, returns, seed=0) == statistics.Estimate(0.0, 0.0, 0.0)


def test_paired_returns_cancel_what_the_worlds_share() -> None:
    draws = np.random.default_rng(3)
    worlds = draws.normal(scale=100.0, size=256)
    gain = statistics.return_difference(worlds + 2.0 + draws.normal(size=256), worlds, seed=0)
    assert gain.excludes_zero
    assert gain.low < 2.0 < gain.high
    assert gain.high - gain.low < 0.5


@pytest.mark.parametrize("function", ["success_difference", "return_difference"])
def test_pairs_of_unequal_length_are_refused(function: str) -> None:
    with pytest.raises(ValueError, match="same worlds, got 3 and 2"):
        getattr(statistics, function)([1, 0, 1], [1, 0], True)


def test_seed_interval_is_students() -> None:
    estimate = statistics.seed_interval([0.81, 0.86, 0.90, 0.79, 0.84])
    margin = 2.776445 * np.std([0.81, 0.86, 0.90, 0.79, 0.84], ddof=1) / np.sqrt(5)
    assert estimate.value == pytest.approx(0.84)
    assert estimate.ci95 == pytest.approx([0.84 - margin, 0.84 + margin], abs=1e-6)


def test_seed_interval_edge_cases() -> None:
    assert statistics.seed_interval([0.5]) == statistics.Estimate(0.5)
    assert statistics.seed_interval([]) == statistics.Estimate(None)
    assert statistics.seed_interval([0.5, np.nan, 0.6]) == statistics.Estimate(None)
    assert not statistics.seed_interval([0.5, np.nan]).excludes_zero


def test_paired_seeds() -> None:
    difference = statistics.paired_seed_interval([0.9, 0.8, 0.95], [0.6, 0.52, 0.66])
    assert difference.value == pytest.approx(0.29)
    assert difference.excludes_zero
    assert not statistics.paired_seed_interval([0.9, 0.8], [0.8, 0.9]).excludes_zero
    with pytest.raises(ValueError, match="got 3 and 2"):
        statistics.paired_seed_interval([1.0, 1.0, 1.0], [0.0, 0.0])

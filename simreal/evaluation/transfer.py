"""`transfer.json`: what an evaluation found, as numbers that a program can gate on."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from simreal.evaluation import statistics
from simreal.evaluation.results import ENDINGS, Evaluation, FactorCurve, SetResult
from simreal.evaluation.statistics import Estimate

SCHEMA = 1
TRAIN = "train"
"""The set that every gap is measured from."""


def transfer(evaluation: Evaluation) -> dict[str, Any]:
    """The content of `transfer.json`. Every number is finite or None.

    `success.rate` and `gap.value` are shares of 1. `gap.value` is the success rate on the `train` set minus
    the rate on this set: positive where the policy loses something in the transfer, None without a `train`
    set. `hardware` gives mean and maximum over the worlds, `ended_by` shares of the episodes.
    """
    train = evaluation.sets.get(TRAIN)
    return {
        "schema": SCHEMA,
        "engine": evaluation.engine,
        "seed": evaluation.seed,
        "sets": {name: _set(result, train, evaluation.seed) for name, result in evaluation.sets.items()},
        "factors": {name: _curve(curve) for name, curve in evaluation.factors.items()},
    }


def compare(first: Evaluation, second: Evaluation, labels: tuple[str, str]) -> dict[str, Any]:
    """Two policies on the sets that both were evaluated on: `first` minus `second`, set by set.

    Differences are paired where the set digests agree, so that world i is the same world for both. `labels`
    name the two in tables and sentences, for example ("randomised training", "nominal training").
    """
    rows = {}
    for name, a in first.sets.items():
        b = second.sets.get(name)
        if b is None:
            continue
        paired = _same_worlds(a, b)
        rows[name] = {
            "paired": paired,
            "claims_outside": a.claims_outside,
            "success": [_success(a), _success(b)],
            "success_difference": _interval(statistics.success_difference(a.success, b.success, paired)),
            "return": [_mean(statistics.finite_returns(result.episode_return)) for result in (a, b)],
            "return_difference": _interval(
                statistics.return_difference(a.episode_return, b.episode_return, first.seed)
                if paired
                else Estimate(None)
            ),
        }
    return {"labels": list(labels), "runs": [first.run, second.run], "sets": rows}


def write_transfer(content: dict[str, Any], path: Path) -> Path:
    """Write `transfer.json`; ValueError for a NaN or an infinity, which are not JSON."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return path


def terminal_table(content: dict[str, Any]) -> str:
    """The sets of `transfer.json` as aligned plain text, the same on a terminal and in a pipe."""
    header = ("set", "worlds", "success %", "return", "IQM", "CVaR10", "worst", "gap, points")
    rows = [header]
    for name, row in content["sets"].items():
        returns, success, gap = row["return"], row["success"], row["gap"]
        rows.append(
            (
                name,
                str(row["worlds"]),
                with_interval(success["rate"], success["ci95"], percent),
                with_interval(returns["mean"], returns["mean_ci95"], number),
                number(returns["iqm"]),
                number(returns["cvar10"]),
                number(returns["worst"]),
                "-" if name == TRAIN else with_interval(gap["value"], gap["ci95"], percent),
            )
        )
    widths = [max(len(row[column]) for row in rows) for column in range(len(header))]
    left_aligned = (0, 2, 3, 7)
    lines = [
        "  ".join(
            cell.ljust(width) if column in left_aligned else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]
    lines.insert(1, "  ".join("-" * width for width in widths))
    note = "[low, high]: 95 % intervals over worlds. Gap: success on train minus success on the set."
    return "\n".join([*lines, note])


def number(value: float | None) -> str:
    """A return or a physical quantity, to three or four significant digits."""
    if value is None:
        return "-"
    size = abs(value)
    if size and size < 0.995:
        return f"{value:.3g}"
    return f"{value:.{0 if size >= 999.5 else 1 if size >= 9.95 else 2}f}"


def percent(value: float | None) -> str:
    """A share of 1 as a percentage, without the sign for percent; never a negative zero."""
    return "-" if value is None else f"{round(100.0 * value, 1) + 0.0:.1f}"


def with_interval(value: float | None, ci95: list[float] | None, form: Callable[[float | None], str]) -> str:
    """`value [low, high]`, or the value alone where there is no interval."""
    return form(value) if ci95 is None else f"{form(value)} [{form(ci95[0])}, {form(ci95[1])}]"


def _set(result: SetResult, train: SetResult | None, seed: int) -> dict[str, Any]:
    returns = statistics.finite_returns(result.episode_return)
    mean = statistics.bootstrap(returns, statistics.mean, seed)
    iqm = statistics.bootstrap(returns, statistics.interquartile_mean, seed)
    cvar10 = statistics.bootstrap(returns, statistics.cvar, seed)
    return {
        "worlds": len(result.success),
        "digest": result.digest,
        "return": {
            "mean": mean.value,
            "mean_ci95": mean.ci95,
            "iqm": iqm.value,
            "iqm_ci95": iqm.ci95,
            "cvar10": cvar10.value,
            "cvar10_ci95": cvar10.ci95,
            "worst": float(returns.min()) if returns.size else None,
        },
        "success": _success(result),
        "gap": _interval(_gap(result, train)),
        "hardware": {
            name: {"mean": _mean(values), "max": _number(np.max(values, initial=-math.inf))}
            for name, values in result.hardware.items()
        },
        "ended_by": {
            ending: _mean(np.asarray(result.ended_by) == index) for index, ending in enumerate(ENDINGS)
        },
    }


def _gap(result: SetResult, train: SetResult | None) -> Estimate:
    if train is None:
        return Estimate(None)
    if result is train:
        return Estimate(0.0, 0.0, 0.0)
    return statistics.success_difference(train.success, result.success, _same_worlds(train, result))


def _curve(curve: FactorCurve) -> list[dict[str, Any]]:
    points = zip(curve.values, curve.episode_return, curve.success, strict=True)
    return [
        {
            "value": _number(value),
            "return": _mean(statistics.finite_returns(returns)),
            "success": statistics.success_rate(success).value,
        }
        for value, returns, success in points
    ]


def _same_worlds(a: SetResult, b: SetResult) -> bool:
    return a.digest == b.digest and len(a.success) == len(b.success)


def _success(result: SetResult) -> dict[str, Any]:
    rate = statistics.success_rate(result.success)
    return {"rate": rate.value, "ci95": rate.ci95}


def _interval(estimate: Estimate) -> dict[str, Any]:
    return {"value": estimate.value, "ci95": estimate.ci95}


def _number(value: ArrayLike) -> float | None:
    plain = float(np.asarray(value, np.float64))
    return plain if math.isfinite(plain) else None


def _mean(values: ArrayLike) -> float | None:
    """Mean of the finite values; None when there is none."""
    numbers = np.asarray(values, np.float64)
    finite = numbers[np.isfinite(numbers)]
    return float(finite.mean()) if finite.size else None

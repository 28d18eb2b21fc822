"""`--require 'held_out.success>=0.9'`: gates that `transfer.json` has to pass."""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any

from simreal.errors import UserError, nearest_first

OPERATORS: dict[str, Callable[[float, float], bool]] = {
    ">=": operator.ge,
    "<=": operator.le,
    "==": operator.eq,
    ">": operator.gt,
    "<": operator.lt,
}

METRICS: dict[str, tuple[str, str, str | None]] = {
    "success": ("success", "rate", "ci95"),
    "return": ("return", "mean", "mean_ci95"),
    "iqm": ("return", "iqm", "iqm_ci95"),
    "cvar10": ("return", "cvar10", "cvar10_ci95"),
    "worst": ("return", "worst", None),
    "gap": ("gap", "value", "ci95"),
}
"""metric -> section of the set in `transfer.json`, key of the value, key of its interval."""

BOUNDS = {"low": 0, "high": 1}
EXAMPLE = "held_out.success>=0.9"
PATHS = (
    *METRICS,
    *(f"{name}.{bound}" for name, (_, _, ci95) in METRICS.items() if ci95 for bound in BOUNDS),
)
_FORM = re.compile(r"\s*(?P<path>[^\s<>=]+)\s*(?P<operator>>=|<=|==|>|<)\s*(?P<number>[^\s<>=]+)\s*")


@dataclass(frozen=True)
class Requirement:
    """`set.metric[.bound] operator threshold`, as in `held_out.success.low>=0.9`."""

    text: str
    set: str
    metric: str
    bound: str | None
    operator: str
    threshold: float

    def measured(self, transfer: dict[str, Any]) -> float | None:
        """The number that is compared; None where the evaluation has none, such as a bound of one world."""
        section, value, ci95 = METRICS[self.metric]
        numbers = transfer["sets"][self.set][section]
        if self.bound is None:
            return numbers[value]
        interval = numbers[ci95]
        return None if interval is None else interval[BOUNDS[self.bound]]


def parse_requirement(text: str, sets: Collection[str] | None = None) -> Requirement:
    """Read one `--require`. With `sets`, the names that will be evaluated, an unknown set is refused too.

    Raises UserError for anything that is not a requirement.
    """
    match = _FORM.fullmatch(text)
    if match is None:
        raise UserError(
            f"--require '{text}': expected SET.METRIC, one of {' '.join(OPERATORS)}, "
            f"and a number, as in '{EXAMPLE}'"
        )
    name, _, path = match["path"].partition(".")
    if not path:
        raise UserError(f"--require '{text}': '{name}' names no metric, as '{name}.success' would")
    if path not in PATHS:
        raise UserError(f"--require '{text}': no metric '{path}'; {nearest_first(path, PATHS)}")
    if sets is not None:
        _check_set(text, name, sets)
    metric, _, bound = path.partition(".")
    threshold = _number(text, match["number"])
    if metric in ("success", "gap") and abs(threshold) > 1.0:
        raise UserError(
            f"--require '{text}': {metric} is a share between {'0' if metric == 'success' else '-1'} and 1, "
            f"so write {threshold / 100.0:g} for {threshold:g} %"
        )
    return Requirement(text.strip(), name, metric, bound or None, match["operator"], threshold)


def check(requirements: Sequence[Requirement], transfer: dict[str, Any]) -> list[str]:
    """One line, with the measured value, for each requirement that does not hold.

    Raises UserError for a set that was not evaluated.
    """
    failures = []
    for requirement in requirements:
        _check_set(requirement.text, requirement.set, transfer["sets"])
        value = requirement.measured(transfer)
        if value is None:
            failures.append(f"{requirement.text} cannot be judged: the evaluation gives no such number")
        elif not OPERATORS[requirement.operator](value, requirement.threshold):
            failures.append(f"{requirement.text} does not hold: measured {value:.4g}")
    return failures


def _check_set(text: str, name: str, sets: Collection[str]) -> None:
    if name not in sets:
        raise UserError(f"--require '{text}': no set '{name}'; {nearest_first(name, sets)}")


def _number(text: str, written: str) -> float:
    try:
        threshold = float(written)
    except ValueError:
        threshold = math.nan
    if not math.isfinite(threshold):
        raise UserError(f"--require '{text}': '{written}' is not a number, as in '{EXAMPLE}'")
    return threshold

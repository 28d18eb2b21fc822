"""One line that says where training stands."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Mapping
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.text import Text

RECENT = 10
"""Epochs that the speed, and so the time left, is averaged over."""


class Progress:
    """Shows the newest row of metrics: in place on a terminal, now and then as a plain line in a pipe.

    Args:
        total: environment steps of the whole run.
        every: seconds between two lines in a pipe.
        console: where to; default: standard output.
    """

    def __init__(self, total: int, every: float = 30.0, console: Console | None = None) -> None:
        self.console = console or Console(highlight=False, soft_wrap=True)
        self.total = total
        self.every = every
        self._last_line = -math.inf
        self._quarantined = 0.0
        self._recent: deque[tuple[int, float]] = deque(maxlen=RECENT + 1)
        self._live = Live(console=self.console, auto_refresh=False) if self.console.is_terminal else None

    def __enter__(self) -> Progress:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def say(self, line: str) -> None:
        """A line of its own, which stays."""
        self.console.print(line, markup=False)

    def show(self, row: Mapping[str, Any], last: bool = False) -> None:
        """The newest row of metrics; the `last` one is always printed."""
        self._recent.append((row["step"], row["wall_seconds"]))
        line = self._line(row)
        if self._live is not None:
            self._live.update(Text(line, no_wrap=True, overflow="ellipsis"), refresh=True)
        elif last or time.monotonic() - self._last_line >= self.every:
            self.say(line)
            self._last_line = time.monotonic()

    def _line(self, row: Mapping[str, Any]) -> str:
        line = (
            f"{_count(row['step'])} of {_count(self.total)} steps   "
            f"return {number(row['episode_return'])}   success {percent(row['success_rate'])}"
        )
        self._quarantined += row.get("quarantined") or 0
        if self._quarantined:
            line += f"   quarantined {self._quarantined:.0f}"
        (first_step, began), (step, now) = self._recent[0], self._recent[-1]
        if step == first_step or now <= began:  # the first epoch's own speed is that of the compiler
            return line
        speed = (step - first_step) / (now - began)
        left = max(self.total - step, 0) / speed
        return f"{line}   {speed:,.0f} steps/s   {_duration(left)} left"


def _count(steps: int) -> str:
    return f"{steps / 1e6:.2f} M" if steps >= 1e5 else f"{steps:,}"


def number(value: float | None) -> str:
    """Four digits, or - where it is not known."""
    return "-" if value is None or math.isnan(value) else f"{value:.4g}"


def percent(value: float | None) -> str:
    """A share in percent, or - where it is not known."""
    return "-" if value is None or math.isnan(value) else f"{100 * value:.0f} %"


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"

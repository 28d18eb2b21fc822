"""`report.html` while a run trains: one page, no scripts, that reloads itself and draws the metrics so far.

`simreal evaluate` puts the full report in its place.
"""

from __future__ import annotations

import html
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from simreal.progress import number, percent
from simreal.runs import write_text

EVERY = 10.0
"""Seconds between two versions of the page, and between two reloads in the browser."""
CURVES = (
    ("episode_return", "return", None),
    ("success_rate", "success of the mean action", (0.0, 1.0)),
    ("exploring_success_rate", "success while exploring", (0.0, 1.0)),
    ("value_loss", "value loss", None),
    ("kl", "divergence per update", None),
    ("learning_rate", "learning rate", None),
    ("action_noise", "action noise", None),
    ("steps_per_second", "steps per second", None),
)
"""Name in metrics.jsonl, title, and the axis where it is fixed."""
WIDTH, HEIGHT, MARGIN = 360, 150, 8
POINTS = 400
"""Most points of a curve; of longer runs every n-th row is drawn."""
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1180px; margin: 2em auto; padding: 0 1em;
       color: #1f2937; background: #fff; }
h1 { font-size: 1.3em; margin-bottom: 0; } p { margin: .2em 0; color: #4b5563; }
main { display: grid; grid-template-columns: repeat(auto-fill, minmax(360px, 1fr)); gap: 1.2em; }
figure { margin: 0; } figcaption { font-size: .9em; } svg { width: 100%; background: #f3f4f6; }
polyline { fill: none; stroke: #0072b2; stroke-width: 1.5; } text { font-size: 10px; fill: #6b7280; }
@media (prefers-color-scheme: dark) { body { background: #111827; color: #e5e7eb; } p { color: #9ca3af; }
  svg { background: #1f2937; } polyline { stroke: #56b4e9; } text { fill: #9ca3af; } }
"""


class LivePage:
    """Writes the page now and then.

    Args:
        file: the page.
        title: what trains.
        total: environment steps of the whole run.
    """

    def __init__(self, file: Path, title: str, total: int) -> None:
        self.file = file
        self.title = title
        self.total = total
        self._written = -math.inf

    def show(self, rows: Sequence[Mapping[str, Any]], done: bool = False) -> None:
        """Writes the rows so far, if the last time is long enough ago or the run is over."""
        if rows and (done or time.monotonic() - self._written >= EVERY):
            self._written = time.monotonic()
            write_text(self.file, page(self.title, rows, self.total, done))


def page(title: str, rows: Sequence[Mapping[str, Any]], total: int, done: bool) -> str:
    """The page as text."""
    last = rows[-1]
    step, seconds = last["step"], last["wall_seconds"]
    began = rows[0]
    speed = (step - began["step"]) / max(seconds - began["wall_seconds"], 1e-9) if len(rows) > 1 else 0.0
    left = f", about {_minutes((total - step) / speed)} left" if speed and not done else ""
    state = ("finished" if step >= total else "ended") if done else f"training, reloads every {EVERY:g} s"
    reload = "" if done else f'<meta http-equiv="refresh" content="{EVERY:g}">'
    facts = (
        f"{state}: {step:,} of {total:,} steps in {_minutes(seconds)}{left}; "
        f"return {number(last['episode_return'])}, success {percent(last['success_rate'])}"
    )
    if quarantined := sum(row.get("quarantined") or 0 for row in rows):
        facts += f"; {quarantined:.0f} worlds in quarantine"
    shown = rows[:: max(1, len(rows) // POINTS)]
    figures = "\n".join(
        _figure(caption, [(row["step"], row.get(name)) for row in shown], limits)
        for name, caption, limits in CURVES
    )
    after = "<p>The full report comes with <code>simreal evaluate</code>.</p>"
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">{reload}\n'
        f"<title>{html.escape(title)}</title><style>{STYLE}</style></head>\n"
        f"<body><h1>{html.escape(title)}</h1><p>{facts}</p>{after}\n<main>\n{figures}\n</main></body></html>\n"
    )


def _figure(
    caption: str, points: Sequence[tuple[float, float | None]], limits: tuple[float, float] | None
) -> str:
    known = [(x, y) for x, y in points if y is not None and math.isfinite(y)]
    head = f'<figure><figcaption>{html.escape(caption)}</figcaption><svg viewBox="0 0 {WIDTH} {HEIGHT}">'
    if not known:
        return f'{head}<text x="{WIDTH / 2}" y="{HEIGHT / 2}">nothing yet</text></svg></figure>'
    low, high = limits or (min(y for _, y in known), max(y for _, y in known))
    first, last = points[0][0], points[-1][0]

    def place(x: float, y: float) -> str:
        across = MARGIN + (WIDTH - 2 * MARGIN) * (x - first) / ((last - first) or 1)
        up = HEIGHT - MARGIN - (HEIGHT - 2 * MARGIN) * (y - low) / ((high - low) or 1)
        return f"{across:.1f},{up:.1f}"

    line = " ".join(place(x, y) for x, y in known)
    marks = f'<text x="2" y="10">{number(high)}</text><text x="2" y="{HEIGHT - 2}">{number(low)}</text>'
    return f'{head}<polyline points="{line}"/>{marks}</svg></figure>'


def _minutes(seconds: float) -> str:
    return f"{seconds / 60:.1f} min" if seconds >= 60 else f"{seconds:.0f} s"

"""`report.html`: one self-contained page that says how the policy transfers, and shows why to believe it."""

from __future__ import annotations

import base64
import json
import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from simreal.evaluation import plots, statistics
from simreal.evaluation.results import ENDINGS, Evaluation, FactorCurve
from simreal.evaluation.transfer import TRAIN, number, percent, with_interval

HELD_OUT = "held_out"
WORST_WORLDS = 5
TEMPLATE = Path(__file__).with_name("report_template.html")
MEDIA_TYPES = {".mp4": "video/mp4", ".gif": "image/gif", ".webp": "image/webp", ".png": "image/png"}
HARDWARE = {
    "peak_torque": ("peak torque", "N m", 1.0),
    "saturated_share": ("time saturated", "%", 100.0),
    "power": ("mean power", "W", 1.0),
    "action_rate": ("action rate", "1/s", 1.0),
}
"""quantity -> heading, unit, factor from the stored number."""
ENDING_WORDS = {"time_limit": "time limit", "failed": "failed", "diverged": "simulation diverged"}


def write_report(
    folder: Path,
    evaluation: Evaluation,
    transfer: dict[str, Any],
    metrics_rows: list[dict[str, Any]],
    manifest: dict[str, Any],
    config_text: str,
    command: str,
    video: Path | None = None,
    comparison: dict[str, Any] | None = None,
) -> Path:
    """Write `plots/*.png` and `report.html` into the run folder; returns the page's path.

    `transfer` is the content of `transfer.json` for this evaluation, `command` the command line that made
    it. `video` (mp4, webp, gif or animated png) is copied into the page. `comparison`, made by
    `transfer.compare`, puts a second policy on the same sets beside this one.
    """
    import jinja2

    folder = Path(folder)
    pictures = plots.write_plots(evaluation, metrics_rows, folder / "plots")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"percent": percent, "number": number, "interval": with_interval}
    page = environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        evaluation=evaluation,
        transfer=transfer,
        verdict=verdict(evaluation, transfer),
        caveats=caveats(evaluation, transfer),
        worst=worst_worlds(evaluation),
        hardware=[(name, *HARDWARE.get(name, (name, "", 1.0))) for name in _hardware_names(transfer)],
        endings=[(name, ENDING_WORDS[name]) for name in ENDINGS],
        pictures={name: _data_uri(path) for name, path in pictures.items()},
        video=None if video is None else _data_uri(Path(video)),
        comparison=comparison,
        comparison_words=[] if comparison is None else comparison_words(comparison),
        commands=_commands(evaluation, manifest, command),
        manifest={key: _plain(value) for key, value in manifest.items()},
        config_text=config_text,
    )
    path = folder / "report.html"
    path.write_text(page, encoding="utf-8")
    return path


def verdict(evaluation: Evaluation, transfer: dict[str, Any]) -> str:
    """The result in one paragraph of plain words."""
    sets = transfer["sets"]
    sentences = []
    if TRAIN in sets:
        sentences.append(
            f"In {sets[TRAIN]['worlds']} fresh worlds from the training ranges the policy succeeds in "
            f"{_rate_words(sets[TRAIN])}."
        )
    if HELD_OUT in sets:
        sentences.append(
            f"In {sets[HELD_OUT]['worlds']} held-out worlds, which it never trained on, it succeeds in "
            f"{_rate_words(sets[HELD_OUT])}{_gap_words(sets[HELD_OUT]['gap'])}."
        )
    others = {name: row for name, row in sets.items() if name != TRAIN and row["success"]["rate"] is not None}
    if others:
        # The weakest set is also the one of the largest gap: every gap is measured from the same rate.
        weakest = min(others, key=lambda name: others[name]["success"]["rate"])
        if others[weakest]["success"]["rate"] == 1.0:
            sentences.append("No other set shows a failure.")
        elif weakest == HELD_OUT:
            sentences.append("No other set is weaker.")
        else:
            words = f"{_rate_words(others[weakest])}{_gap_words(others[weakest]['gap'])}"
            sentences.append(f"The weakest set is {weakest}, with {words}.")
    sentences.append(_sensitivity_words(evaluation))
    return " ".join(sentence for sentence in sentences if sentence)


def caveats(evaluation: Evaluation, transfer: dict[str, Any]) -> list[str]:
    """What a careful reader should hold against the numbers, taken from the numbers."""
    sets = transfer["sets"]
    notes = [
        "Every number comes from simulation; none was measured on a robot.",
        "The intervals say how well this one policy is known from the worlds it was tried in. Another "
        "training seed gives another policy: compare training methods over several seeds.",
    ]
    train = sets.get(TRAIN, {}).get("success", {}).get("rate")
    if train is not None and train < 0.8:
        notes.append(
            f"The policy solves only {percent(train)} % of its training worlds, so a small gap says little."
        )
    widths = {
        name: row["success"]["ci95"][1] - row["success"]["ci95"][0]
        for name, row in sets.items()
        if row["success"]["ci95"] is not None
    }
    wide = [name for name, width in widths.items() if width > 0.1]
    if wide:
        widest = max(wide, key=lambda name: widths[name])
        notes.append(
            f"The success rate is known to no better than 10 points on {_listed(wide)}: on {widest}, "
            f"{sets[widest]['worlds']} worlds leave {percent(widths[widest])} points between the ends of "
            "the interval, which four times the worlds would halve."
        )
    perfect = [name for name, row in sets.items() if row["success"]["rate"] == 1.0]
    if perfect:
        low = min(sets[name]["success"]["ci95"][0] for name in perfect)
        notes.append(
            f"No failure was seen on {_listed(perfect)}. That is compatible with a true rate as low as "
            f"{percent(low)} %."
        )
    diverged = [name for name, row in sets.items() if (row["ended_by"].get("diverged") or 0.0) > 0.0]
    if diverged:
        notes.append(
            f"The simulation itself diverged in some worlds of {_listed(diverged)}. They count as failures, "
            f"and as the set's worst return where none was recorded, but say little about a robot."
        )
    few = [name for name, row in sets.items() if row["worlds"] < 100]
    if few:
        notes.append(f"With under 100 worlds ({_listed(few)}) the interval of CVaR10 is too narrow.")
    if HELD_OUT in sets and (sets[HELD_OUT]["gap"]["value"] or 0.0) < 0.0:
        notes.append("The held-out worlds came out no harder than the training worlds for this policy.")
    return notes


def comparison_words(comparison: dict[str, Any]) -> list[str]:
    """Where the first policy beats the second, where it does not, and where nothing can be said."""
    first, second = comparison["labels"]
    groups: dict[str, list[str]] = {"more": [], "less": [], "open": []}
    for name, row in comparison["sets"].items():
        difference = row["success_difference"]
        if difference["ci95"] is None:
            continue
        low, high = difference["ci95"]
        group = "more" if low > 0.0 else "less" if high < 0.0 else "open"
        groups[group].append(f"{name} ({_points(difference)})")
    heads = {
        "more": f"{first} succeeds more often than {second} on",
        "less": f"{first} succeeds less often than {second} on",
        "open": "The difference is not distinguishable from zero on",
    }
    sentences = [f"{heads[group]} {_listed(names)}." for group, names in groups.items() if names]
    missing = [
        name
        for name, row in comparison["sets"].items()
        if row["claims_outside"] and (row["success_difference"]["ci95"] or [0.0])[0] <= 0.0
    ]
    if missing:
        sentences.append(
            f"Expected outside the training ranges, but not shown here: a benefit on {_listed(missing)}."
        )
    return [sentence[0].upper() + sentence[1:] for sentence in sentences]


def worst_worlds(evaluation: Evaluation) -> dict[str, Any] | None:
    """The held-out worlds of lowest return, with their draws; the weakest set's without a held-out set."""
    if not evaluation.sets:
        return None
    sets = evaluation.sets
    weakest = min(sets.values(), key=lambda each: float(np.mean(each.success)) if len(each.success) else 1.0)
    result = sets.get(HELD_OUT, weakest)
    returns = statistics.finite_returns(result.episode_return)
    worlds = np.argsort(returns, kind="stable")[:WORST_WORLDS].tolist()
    factors = []
    for name, draws in result.draws.items():
        curve = evaluation.factors.get(name)
        cells = [(_draw(draws[world]), _is_outside(draws[world], curve)) for world in worlds]
        factors.append({"name": name, "unit": curve.unit if curve else "", "cells": cells, "curve": curve})
    return {
        "set": result.name,
        "worlds": worlds,
        "returns": [float(returns[world]) for world in worlds],
        "success": [bool(result.success[world]) for world in worlds],
        "ended_by": [ENDING_WORDS[ENDINGS[int(result.ended_by[world])]] for world in worlds],
        "factors": factors,
    }


def _sensitivity_words(evaluation: Evaluation) -> str:
    """The factor that, moved alone beyond its training range, costs most."""
    drops = [drop for curve in evaluation.factors.values() for drop in _drops(curve)]
    if not drops:
        return ""
    fall, inside, value, outside, curve = max(drops, key=lambda drop: drop[0])
    if fall < 0.05:
        return "No single factor, moved alone beyond its training range, shows a loss of 5 points or more."
    unit = f" {curve.unit}" if curve.unit else ""
    return (
        f"Moved alone, {curve.factor} costs most: {percent(inside)} % success inside its training range, "
        f"{percent(outside)} % at {value:.3g}{unit}."
    )


def _drops(curve: FactorCurve) -> Iterator[tuple[float, float, float, float, FactorCurve]]:
    """For each value outside: loss of success that the data assure, rate inside, the value, rate there."""
    values = np.asarray(curve.values, float)
    within = (values >= curve.train_low) & (values <= curve.train_high)
    inside = np.asarray(curve.success, bool)[within].ravel()
    for value, success in zip(values[~within], np.asarray(curve.success, bool)[~within], strict=True):
        loss = statistics.success_difference(inside, success, paired=False)
        if loss.low is not None:
            yield loss.low, float(inside.mean()), float(value), float(success.mean()), curve


def _rate_words(row: Mapping[str, Any]) -> str:
    rate, ci95 = row["success"]["rate"], row["success"]["ci95"]
    if rate is None:
        return "an unknown share"
    return f"{percent(rate)} % (95 % interval {percent(ci95[0])} to {percent(ci95[1])} %)"


def _gap_words(gap: Mapping[str, Any]) -> str:
    """How far a set lies from the training worlds, as the end of a sentence."""
    if gap["value"] is None:
        return ""
    low, high = gap["ci95"]
    if low <= 0.0 <= high:
        return ", which the data do not tell apart from the training worlds"
    ends = sorted((abs(low), abs(high)))
    side = "below" if gap["value"] > 0.0 else "above"
    return (
        f", {percent(abs(gap['value']))} points {side} the training worlds "
        f"({percent(ends[0])} to {percent(ends[1])})"
    )


def _points(difference: Mapping[str, Any]) -> str:
    low, high = difference["ci95"]
    return f"{percent(difference['value'])} points, {percent(low)} to {percent(high)}"


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _hardware_names(transfer: dict[str, Any]) -> list[str]:
    return list(dict.fromkeys(name for row in transfer["sets"].values() for name in row["hardware"]))


def _draw(draw: Any) -> str:
    values = np.ravel(np.asarray(draw, float))
    if values.size <= 4:
        return ", ".join(f"{value:.3g}" for value in values)
    return f"{values.min():.3g} … {values.max():.3g}"


def _is_outside(draw: Any, curve: FactorCurve | None) -> bool:
    values = np.asarray(draw, float)
    return curve is not None and bool(np.any((values < curve.train_low) | (values > curve.train_high)))


def _commands(evaluation: Evaluation, manifest: Mapping[str, Any], command: str) -> list[tuple[str, str]]:
    run = shlex.quote(evaluation.run or ".")
    rows = [
        ("the policy", str(manifest.get("command", "simreal train config.yaml --out RUN"))),
        ("every number and picture on this page", command),
    ]
    rows += [(f"the set {name} alone", f"simreal evaluate {run} --sets {name}") for name in evaluation.sets]
    return rows


def _plain(value: Any) -> str:
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value if isinstance(value, str) else json.dumps(value, default=str)


def _data_uri(path: Path) -> str:
    media_type = MEDIA_TYPES.get(path.suffix.lower(), "image/png")
    return f"data:{media_type};base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"

"""The figures of a report, as PNG files. Colours after Okabe and Ito (2008), safe for the colour-blind."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from simreal.evaluation import statistics
from simreal.evaluation.results import Evaluation, FactorCurve, HeatMap, SetResult

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch
    from matplotlib.ticker import Formatter, Locator

BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#6B7280"
SHADE = "#DCE9F5"
STYLE: Any = {
    "font.size": 9.5,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelcolor": "#374151",
    "axes.edgecolor": "#9CA3AF",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": "#E5E7EB",
    "grid.linewidth": 0.8,
    "xtick.color": "#4B5563",
    "ytick.color": "#4B5563",
    "lines.linewidth": 1.8,
    "legend.frameon": False,
    "text.parse_math": False,  # a factor may be named with a dollar sign
    "figure.dpi": 100,
    "savefig.dpi": 160,
    "savefig.bbox": "tight",
    "figure.constrained_layout.use": True,
}


def write_plots(
    evaluation: Evaluation, metrics_rows: Sequence[Mapping[str, Any]], folder: Path
) -> dict[str, Path]:
    """Write every figure that the data allow into `folder`; returns name -> PNG.

    Names: `training`, `success`, `returns`, `factors`, `factor_<NAME>` for each factor, `heat_map`.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    written: dict[str, Path] = {}
    if metrics_rows:
        written["training"] = training_curve(metrics_rows, folder / "training.png")
    if evaluation.sets:
        written["success"] = success_by_set(evaluation, folder / "success.png")
        written["returns"] = return_distribution(evaluation, folder / "returns.png")
    if evaluation.factors:
        written["factors"] = factor_curves(list(evaluation.factors.values()), folder / "factors.png")
        for name, curve in evaluation.factors.items():
            path = folder / f"factor_{_file_name(name)}.png"
            written[f"factor_{name}"] = factor_curves([curve], path)
    if evaluation.heat_map is not None:
        written["heat_map"] = heat_map(evaluation.heat_map, evaluation.factors, folder / "heat_map.png")
    return written


def training_curve(rows: Sequence[Mapping[str, Any]], path: Path) -> Path:
    """Return and success against environment steps, wall time along the top."""
    steps, wall = _column(rows, "step"), _column(rows, "wall_seconds")
    with _figure(path, 1, 2, size=(9.0, 3.1)) as (_, axes):
        for ax, key, title, colour, scale in (
            (axes[0], "episode_return", "Episode return", BLUE, 1.0),
            (axes[1], "success_rate", "Success, %", GREEN, 100.0),
        ):
            values = scale * _column(rows, key)
            shown = np.isfinite(values) & np.isfinite(steps)
            marker = "o" if shown.sum() < 2 else None
            ax.plot(steps[shown], values[shown], color=colour, marker=marker)
            ax.set(title=title, xlabel="environment steps")
            ax.xaxis.set_major_formatter(_engineering())
            if np.isfinite(steps).any():
                ax.set_xlim(0.0, max(float(np.nanmax(steps)), 1.0))
            _wall_time_axis(ax, steps, wall)
        axes[1].set_ylim(-3.0, 103.0)
    return path


def success_by_set(evaluation: Evaluation, path: Path) -> Path:
    """Success rate of every set with its Wilson interval."""
    results = list(evaluation.sets.values())
    with _figure(path, size=(8.0, 0.9 + 0.42 * len(results))) as (_, (ax,)):
        for row, result in enumerate(results):
            rate = statistics.success_rate(result.success)
            if rate.value is None or rate.low is None or rate.high is None:
                continue
            value, low, high = 100.0 * rate.value, 100.0 * rate.low, 100.0 * rate.high
            colour, marker = _set_style(result)
            ax.plot([low, high], [row, row], color=colour, linewidth=5, alpha=0.28, solid_capstyle="round")
            ax.plot(value, row, color=colour, marker=marker, markersize=7.5)
            ax.annotate(
                f"{value:.1f} %", (1.0, row), (6, 0), ax.get_yaxis_transform(), "offset points", va="center"
            )
        ax.set(xlim=(-2.0, 102.0), xlabel="success, % of worlds, with 95 % interval")
        _rows_of_sets(ax, results)
        _set_legend(ax, results)
    return path


def return_distribution(evaluation: Evaluation, path: Path) -> Path:
    """Every world's return, set by set: quartiles as a box, worlds as points."""
    results = list(evaluation.sets.values())
    spread = np.random.default_rng(0)
    with _figure(path, size=(8.0, 0.9 + 0.5 * len(results))) as (_, (ax,)):
        for row, result in enumerate(results):
            returns = statistics.finite_returns(result.episode_return)
            colour, _ = _set_style(result)
            height = row + spread.uniform(-0.26, 0.26, returns.size)
            ax.plot(returns, height, ".", color=colour, markersize=3.5, alpha=0.30, markeredgewidth=0)
            if returns.size:
                ax.boxplot(
                    returns,
                    positions=[row],
                    orientation="horizontal",
                    widths=0.52,
                    showfliers=False,
                    whis=(10, 90),
                    boxprops={"color": "#1F2937"},
                    medianprops={"color": "#1F2937", "linewidth": 2.2},
                    whiskerprops={"color": "#1F2937"},
                    capprops={"color": "#1F2937"},
                )
        ax.set(xlabel="episode return (box: quartiles and median, whiskers: 10 to 90 %)")
        _rows_of_sets(ax, results)
        _set_legend(ax, results)
    return path


def factor_curves(curves: Sequence[FactorCurve], path: Path) -> Path:
    """Success across and beyond each factor's training range, one small panel per factor."""
    columns = min(3, len(curves))
    rows = math.ceil(len(curves) / columns)
    size = (5.2, 3.4) if len(curves) == 1 else (3.3 * columns, 2.35 * rows)
    with _figure(path, rows, columns, size=size) as (figure, axes):
        for ax, curve in zip(axes, curves, strict=False):
            _factor_curve(ax, curve)
        for ax in axes[len(curves) :]:
            ax.set_axis_off()
        for ax in axes[: len(curves) : columns]:
            ax.set_ylabel("success, %")
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8.5)
    return path


def heat_map(heat: HeatMap, curves: Mapping[str, FactorCurve], path: Path) -> Path:
    """Success over two factors; the training box is outlined where both factors have a curve."""
    rates = 100.0 * np.asarray(heat.success, float).mean(axis=-1).T  # (my, mx)
    with _figure(path, size=(6.2, 4.6)) as (figure, (ax,)):
        image = ax.imshow(rates, origin="lower", aspect="auto", cmap="cividis", vmin=0.0, vmax=100.0)
        ax.grid(visible=False)
        if max(rates.shape) <= 12:
            for (y, x), rate in np.ndenumerate(rates):
                ink = "black" if rate > 55.0 else "white"
                ax.text(x, y, f"{rate:.0f}", ha="center", va="center", color=ink, fontsize=8, zorder=3)
        edges = []
        for axis, factor, values in (
            (ax.xaxis, heat.factor_x, heat.values_x),
            (ax.yaxis, heat.factor_y, heat.values_y),
        ):
            curve = curves.get(factor)
            axis.set_label_text(factor if curve is None else _with_unit(factor, curve.unit))
            ticks = range(0, len(values), math.ceil(len(values) / 10))
            axis.set_ticks(ticks, [f"{values[tick]:.3g}" for tick in ticks], fontsize=8.5)
            if curve is not None:
                edges.append(_range_in_cells(curve, np.asarray(values, float)))
        if len(edges) == 2:
            (left, right), (bottom, top) = edges
            for colour, width in (("white", 5.0), (ORANGE, 2.2)):
                ax.add_patch(_box(left, right, bottom, top, colour, width))
            ax.set_title("Success, %, with the training ranges outlined")
        else:
            ax.set_title("Success, %")
        figure.colorbar(image, ax=ax, label="success, %").outline.set_visible(False)
    return path


def _factor_curve(ax: Axes, curve: FactorCurve) -> None:
    values = np.asarray(curve.values, float)
    rates = [statistics.success_rate(success) for success in curve.success]
    rate, low, high = (
        np.array([100.0 * (number if number is not None else math.nan) for number in column])
        for column in zip(*((each.value, each.low, each.high) for each in rates), strict=True)
    )
    logarithmic = _is_logarithmic(values)
    if logarithmic:
        ax.set_xscale("log")
        ax.xaxis.set_major_locator(_log_ticks(values))
        ax.xaxis.set_major_formatter("{x:g}")
        ax.minorticks_off()
    ax.set_xlim(float(values.min()), float(values.max()) if np.ptp(values) else float(values.min()) + 1.0)
    inside = np.clip([curve.train_low, curve.train_high], *ax.get_xlim())
    ax.axvspan(*inside, color=SHADE, linewidth=0, zorder=0, label="training range")
    for edge in inside:
        ax.axvline(edge, color=GREY, linewidth=0.9, linestyle=(0, (3, 2)), zorder=1)
    ax.fill_between(values, low, high, color=BLUE, alpha=0.22, linewidth=0, label="95 % interval")
    ax.plot(values, rate, color=BLUE, marker="o", markersize=3.5, clip_on=False, label="success")
    ax.set(title=curve.factor, xlabel=curve.unit or "no unit", ylim=(-3.0, 103.0))


def _is_logarithmic(values: NDArray[np.floating]) -> bool:
    """Whether the values are spaced by ratio, as a log-uniform factor's are."""
    if len(values) < 3 or values.min() <= 0.0 or values.max() < 3.0 * values.min():
        return False
    steps, ratios = np.diff(values), np.diff(np.log(values))
    return bool(np.std(ratios) / np.mean(ratios) < np.std(steps) / np.mean(steps))


def _range_in_cells(curve: FactorCurve, values: NDArray[np.floating]) -> tuple[float, float]:
    """The training range in cell coordinates, where cell i is centred on values[i]."""
    edges = np.concatenate(([-0.5], np.arange(len(values) - 1) + 0.5, [len(values) - 0.5]))
    middles = (values[:-1] + values[1:]) / 2.0
    first, last = 2.0 * values[0] - middles[0], 2.0 * values[-1] - middles[-1]
    bounds = np.concatenate(([first], middles, [last]))
    low, high = np.interp([curve.train_low, curve.train_high], bounds, edges)
    return float(low), float(high)


def _box(left: float, right: float, bottom: float, top: float, colour: str, width: float) -> Patch:
    from matplotlib.patches import Rectangle

    look: Any = {"fill": False, "edgecolor": colour, "linewidth": width, "clip_on": False}
    return Rectangle((left, bottom), right - left, top - bottom, **look)


def _set_style(result: SetResult) -> tuple[str, str]:
    return (ORANGE, "D") if result.claims_outside else (BLUE, "o")


def _rows_of_sets(ax: Axes, results: Sequence[SetResult]) -> None:
    ax.set_yticks(range(len(results)), [f"{each.name}  ({len(each.success)})" for each in results])
    ax.set_ylim(len(results) - 0.5, -0.5)
    ax.grid(visible=False, axis="y")
    ax.tick_params(axis="y", length=0)


def _set_legend(ax: Axes, results: Sequence[SetResult]) -> None:
    meanings = {False: "inside the training ranges", True: "outside in at least one factor"}
    for outside in sorted({each.claims_outside for each in results}):
        example = next(each for each in results if each.claims_outside == outside)
        colour, marker = _set_style(example)
        ax.plot([], [], color=colour, marker=marker, linestyle="none", label=meanings[outside])
    ax.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, fontsize=8.5, borderaxespad=0.2)


def _wall_time_axis(ax: Axes, steps: NDArray[np.floating], wall: NDArray[np.floating]) -> None:
    known = np.isfinite(steps) & np.isfinite(wall)
    if known.sum() < 2:
        return
    longest = float(wall[known].max())
    unit, seconds = ("min", 60.0) if longest >= 120.0 else ("s", 1.0)
    from matplotlib.ticker import MaxNLocator

    locator = MaxNLocator(5, steps=[1, 2, 2.5, 5, 10])
    ticks = [each for each in locator.tick_values(0.0, longest / seconds) if each * seconds <= longest]
    top = ax.twiny()
    top.set_xlim(ax.get_xlim())
    order = np.argsort(wall[known])
    positions = np.interp(np.array(ticks) * seconds, wall[known][order], steps[known][order])
    top.set_xticks(positions, [f"{tick:g}" for tick in ticks], fontsize=8)
    top.set_xlabel(f"wall time, {unit}", fontsize=8)
    top.grid(visible=False)
    top.spines["top"].set_visible(True)


def _log_ticks(values: NDArray[np.floating]) -> Locator:
    from matplotlib.ticker import LogLocator

    decades = math.log10(float(values.max() / values.min()))
    return LogLocator(subs=(1.0, 2.0, 5.0) if decades <= 2.0 else (1.0,))


def _engineering() -> Formatter:
    from matplotlib.ticker import EngFormatter

    return EngFormatter(sep="")


def _column(rows: Sequence[Mapping[str, Any]], key: str) -> NDArray[np.float64]:
    return np.array([math.nan if row.get(key) is None else float(row[key]) for row in rows], np.float64)


def _with_unit(factor: str, unit: str) -> str:
    return f"{factor}, {unit}" if unit else factor


def _file_name(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.-]+", "_", name)


@contextmanager
def _figure(
    path: Path, rows: int = 1, columns: int = 1, *, size: tuple[float, float]
) -> Iterator[tuple[Figure, list[Any]]]:
    """A figure in the project's style, saved to `path` at the end. Needs no display and no pyplot state."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        figure = Figure(figsize=size)
        FigureCanvasAgg(figure)
        axes = figure.subplots(rows, columns, squeeze=False).ravel().tolist()
        yield figure, axes
        figure.savefig(path)

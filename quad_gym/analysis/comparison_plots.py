"""Figures that compare controllers: errors over time, learning curves, intervals, paths.

Each curve has its own color and line style.
"""

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.analysis import plots

Floats = NDArray[np.float64]

_STYLES: tuple[dict[str, Any], ...] = (
    {"color": plots.GREY, "linestyle": (0, (1, 1.2))},
    {"color": plots.VERMILLION, "linestyle": "solid"},
    {"color": plots.ORANGE, "linestyle": (0, (5, 2))},
    {"color": plots.BLUE, "linestyle": "solid"},
    {"color": plots.GREEN, "linestyle": (0, (3, 1, 1, 1))},
    {"color": "#CC79A7", "linestyle": (0, (5, 1))},
    {"color": "#56B4E9", "linestyle": (0, (2, 1))},
)
"""Colors and dash patterns of the curves, in order."""

_AT_HEIGHT: dict[str, Any] = {
    "xycoords": ("axes fraction", "data"),
    "textcoords": "offset points",
}
"""Coordinates of a remark at the left end of a horizontal line."""

_LEVELS = ((0, (4, 3)), (0, (1, 1.5)), (0, (6, 2, 1, 2)))  #: dash patterns of horizontal lines


@plots.house_style()
def error_over_time_figure(
    recorded: Mapping[str, Mapping[str, Floats]], bound: float, title: str = ""
) -> Any:
    """Figure of errors over time by label: median over episodes, and a band from 5 to 95 %.

    If episodes crashed, the share of the others is drawn below.

    Args:
        recorded: Arrays of `quad_gym.experiments.flown.PathRecorder` by label.
        bound: Error of an episode from its crash on [m].
        title: Title.
    """
    crashes = any(each["not_crashed"][-1] < 1.0 for each in recorded.values())
    rows = {"height_ratios": (3.0, 1.0), "sharex": True} if crashes else {}
    size = (7.0, 5.0 if crashes else 3.8)
    figure, grid = plots.panels(1 + crashes, 1, size, title, **rows)
    axes, end = grid[0, 0], max(each["time"][-1] for each in recorded.values())
    for k, (label, each) in enumerate(recorded.items()):
        style = _STYLES[k % len(_STYLES)]
        time = np.append(each["time"], end)  # the last values stay
        low, middle, high = np.pad(each["percentiles"], ((0, 0), (0, 1)), "edge")
        axes.fill_between(time, low, high, color=style["color"], alpha=0.15, linewidth=0)
        axes.plot(time, middle, label=label, **style)
        if crashes:
            grid[1, 0].plot(time, 100.0 * np.pad(each["not_crashed"], (0, 1), "edge"), **style)
    plots.logarithmic(axes)
    axes.set_xlim(0.0, end)
    axes.set_ylabel("position error [m]\nmedian, 5 to 95 % of episodes")
    if crashes:
        axes.axhline(bound, color=plots.GREY, linewidth=0.8)
        axes.annotate("crashed", (0.01, bound), (0, -3), va="top", color=plots.GREY, **_AT_HEIGHT)
        grid[1, 0].set(ylabel="not crashed [%]", ylim=(-3.0, 103.0))
    grid[-1, 0].set_xlabel("time [s]")
    _legend_below(figure, axes)
    return figure


@plots.house_style()
def learning_figure(
    curves: Mapping[str, Sequence[tuple[Floats, Floats]]],
    levels: Mapping[str, float],
    title: str = "",
    *,
    score: str = "mean position error [m]",
    linear: bool = False,
    tests: Mapping[str, float] | None = None,
) -> Any:
    """Figure of scores during training by label: a thin line per seed, a bold one for the median.

    Curves are training steps (k,) and scores (k,) of each seed; the median ends with the shortest
    one. Levels are horizontal lines to compare with. `tests` has the score of each label in the
    test on the estimate, which is drawn behind the end of the training: validation during training
    uses the observation of the training, and scores of different observations do not compare.
    """
    figure, ((axes,),) = plots.panels(1, 1, (7.0, 4.0), title)
    for k, (label, seeds) in enumerate(curves.items(), start=1):
        style = _STYLES[k % len(_STYLES)]
        for steps, scores in seeds:
            axes.plot(steps / 1e6, scores, color=style["color"], alpha=0.35, linewidth=0.8)
        shortest = min(len(steps) for steps, _ in seeds)
        middle = np.median([scores[:shortest] for _, scores in seeds], axis=0)
        axes.plot(seeds[0][0][:shortest] / 1e6, middle, linewidth=2.0, label=label, **style)
        if tests:
            end = 1.04 * max(steps[-1] for steps, _ in seeds) / 1e6
            words = "test on the estimate" if k == len(curves) else "_"
            dot: dict[str, Any] = {"markeredgecolor": plots.INK, "linestyle": "none"}
            axes.plot(end, tests[label], "o", color=style["color"], label=words, **dot)
    for k, (label, level) in enumerate(levels.items()):
        dashes = _LEVELS[k % len(_LEVELS)]
        axes.axhline(level, color=plots.INK, linewidth=1.0, linestyle=dashes, label=label)
    if not linear:
        plots.logarithmic(axes)
    axes.set_xlim(left=0.0)
    axes.set(xlabel="training [million steps]", ylabel=score)
    _legend_below(figure, axes)
    return figure


@plots.house_style()
def intervals_figure(
    values: Mapping[str, Mapping[str, tuple[float, tuple[float, float] | None]]],
    unit: str,
    title: str = "",
) -> Any:
    """Figure of values with intervals: a line for each row, and a color for each column.

    Args:
        values: Value and interval, or None, by row and column.
        unit: Label of the values.
        title: Title.
    """
    columns = list(next(iter(values.values())))
    figure, ((axes,),) = plots.panels(1, 1, (7.0, 1.4 + 0.5 * len(values)), title)
    for k, column in enumerate(columns):
        color, height = _STYLES[3 - 2 * (k % 2)]["color"], 0.3 * (k - 0.5 * (len(columns) - 1))
        for row, (value, interval) in enumerate(each[column] for each in values.values()):
            label = column if row == 0 else "_"
            if interval is not None:
                axes.plot(interval, [row + height] * 2, color=color, linewidth=2.0, alpha=0.6)
            axes.plot(value, row + height, "o", color=color, label=label)
    axes.set_yticks(range(len(values)), values)
    axes.set_ylim(len(values) - 0.5, -0.5)
    axes.set_xlabel(unit)
    _legend_below(figure, axes)
    return figure


@plots.house_style()
def paths_figure(traces: Mapping[str, plots.Trace], title: str = "") -> Any:
    """Figure of the paths of flights from above, by label, side by side on a common scale."""
    columns = 2 if len(traces) == 4 else min(len(traces), 3)
    rows = -(-len(traces) // columns)
    figure, grid = plots.panels(rows, columns, (3.6 * columns, 3.7 * rows))
    figure.suptitle(title)
    shown = grid.ravel()[: len(traces)]
    for axes, (label, trace) in zip(shown, traces.items(), strict=True):
        plots.draw_path(axes, trace, legend=False)
        axes.set_title(textwrap.fill(label, 32))
    for spare in grid.ravel()[len(traces) :]:
        spare.remove()
    for axis in ("x", "y"):
        limits = np.array([getattr(axes, f"get_{axis}lim")() for axes in shown])
        for axes in shown:
            getattr(axes, f"set_{axis}lim")(limits[:, 0].min(), limits[:, 1].max())
    handles, labels = shown[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2 * min(columns, 2))
    return figure


def _legend_below(figure: Any, axes: Any) -> None:
    """Add a legend below the axes, with as many columns as fit."""
    handles, labels = axes.get_legend_handles_labels()
    fitting = int(15.0 * figure.get_figwidth() / (max(map(len, labels)) + 6))
    most = 2 if len(labels) == 4 else 3
    figure.legend(handles, labels, loc="outside lower center", ncols=min(max(1, fitting), most))

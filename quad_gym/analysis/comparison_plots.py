"""Figures that compare controllers: errors over time, learning curves, matrices, paths.

Each curve has its own color and line style.
"""

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

_LEVELS = ((0, (4, 3)), (0, (1, 1.5)), (0, (6, 2, 1, 2)))  #: dash patterns of horizontal lines


@plots.house_style()
def error_over_time_figure(curves: Mapping[str, tuple[Floats, Floats]], title: str = "") -> Any:
    """Figure of errors over time by label: median over episodes, and a band from 5 to 95 %.

    Curves are times (k,) [s], and the 5th, 50th and 95th percentile of the errors, (3, k) [m].
    """
    figure, ((axes,),) = plots.panels(1, 1, (7.0, 3.8), title)
    for k, (label, (time, (low, middle, high))) in enumerate(curves.items()):
        style = _STYLES[k % len(_STYLES)]
        axes.fill_between(time, low, high, color=style["color"], alpha=0.15, linewidth=0)
        axes.plot(time, middle, label=label, **style)
    plots.logarithmic(axes)
    axes.set_xlim(0.0, max(time[-1] for time, _ in curves.values()))
    axes.set(xlabel="time [s]", ylabel="position error [m]\nmedian, 5 to 95 % of episodes")
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
) -> Any:
    """Figure of scores during training by label: a thin line per seed, a bold one for the median.

    Curves are training steps (k,) and scores (k,) of each seed; the median ends with the shortest
    one. Levels are horizontal lines to compare with.
    """
    figure, ((axes,),) = plots.panels(1, 1, (7.0, 4.0), title)
    for k, (label, seeds) in enumerate(curves.items(), start=1):
        style = _STYLES[k % len(_STYLES)]
        for steps, scores in seeds:
            axes.plot(steps / 1e6, scores, color=style["color"], alpha=0.35, linewidth=0.8)
        shortest = min(len(steps) for steps, _ in seeds)
        middle = np.median([scores[:shortest] for _, scores in seeds], axis=0)
        axes.plot(seeds[0][0][:shortest] / 1e6, middle, linewidth=2.0, label=label, **style)
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
def matrix_figure(
    values: Floats,
    cells: Sequence[Sequence[str]],
    rows: Sequence[str],
    columns: Sequence[str],
    title: str = "",
) -> Any:
    """Table of texts whose cells are colored by values (rows, columns), on a logarithmic scale."""
    size = (2.6 + 2.1 * len(columns), 1.2 + 0.55 * len(rows))
    figure, ((axes,),) = plots.panels(1, 1, size, title)
    shades = np.log10(values)
    axes.imshow(shades, cmap="cividis_r", aspect="auto", alpha=0.75)
    middle = 0.5 * (np.nanmin(shades) + np.nanmax(shades))
    for (i, j), shade in np.ndenumerate(shades):
        color = "white" if shade > middle else plots.INK
        axes.text(j, i, cells[i][j], ha="center", va="center", color=color)
    axes.set_xticks(range(len(columns)), columns)
    axes.set_yticks(range(len(rows)), rows)
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    axes.grid(False)
    axes.spines[:].set_visible(False)
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
        axes.set_title(label)
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

"""Figures that compare controllers: errors over time, learning curves, matrices, paths.

As in `plots`, no window opens and the palette is by Okabe and Ito. Each curve also has its own line
style.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.analysis.plots import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    VERMILLION,
    Trace,
    draw_path,
    house_style,
    one_picture,
    path_handles,
    plain_numbers,
)

Floats = NDArray[np.float64]

_STYLES = (
    (GREY, (0, (1, 1.2))),
    (VERMILLION, "solid"),
    (ORANGE, (0, (5, 2))),
    (BLUE, "solid"),
    (GREEN, (0, (3, 1, 1, 1))),
    ("#CC79A7", (0, (5, 1))),
    ("#56B4E9", (0, (2, 1))),
)
"""Colors and dash patterns of the curves, in order."""


def error_over_time_figure(curves: Mapping[str, tuple[Floats, Floats]], title: str = "") -> Any:
    """Make a figure of errors over time: median over episodes, and a band from 5 to 95 %.

    Args:
        curves: For each label, times (k,) [s] and the 5th, 50th and 95th percentile of the errors,
            (3, k) [m]; NaN: not flown.
        title: Title of the figure.

    Returns:
        matplotlib Figure.
    """
    with house_style():
        figure, axes = one_picture((7.0, 3.8), title)
        for (label, (time, (low, middle, high))), (color, dashes) in zip(
            curves.items(), line_styles(len(curves)), strict=True
        ):
            axes.fill_between(time, low, high, color=color, alpha=0.15, linewidth=0)
            axes.plot(time, middle, color=color, linestyle=dashes, label=label)
        axes.set_yscale("log")
        plain_numbers(axes.yaxis)
        axes.set_xlim(0.0, max(time[-1] for time, _ in curves.values()))
        axes.set_xlabel("time [s]")
        axes.set_ylabel("position error [m]\nmedian, 5 to 95 % of episodes")
        legend_below(figure, axes)
    return figure


def draw_seeds(axes: Any, seeds: Sequence[tuple[Floats, Floats]], **style: Any) -> None:
    """Draw one thin line per seed, and a bold line for their median.

    Args:
        axes: matplotlib Axes.
        seeds: Abscissae (k,) and values (k,) of each seed; the median ends with the shortest curve.
        style: Style of the median, keywords of matplotlib's `plot`: color, linestyle, label.
    """
    for x, y in seeds:
        axes.plot(x, y, color=style["color"], alpha=0.35, linewidth=0.8)
    shortest = min(len(x) for x, _ in seeds)
    middle = np.median([y[:shortest] for _, y in seeds], axis=0)
    axes.plot(seeds[0][0][:shortest], middle, linewidth=2.0, **style)


def learning_figure(
    curves: Mapping[str, Sequence[tuple[Floats, Floats]]],
    levels: Mapping[str, float],
    title: str = "",
    *,
    score: str = "mean position error [m]",
    logarithmic: bool = True,
) -> Any:
    """Make a figure of scores during training: a thin line per seed, a bold one for the median.

    Args:
        curves: Training steps (k,) and scores (k,) of each seed, by label.
        levels: Horizontal lines for comparison, by label.
        title: Title of the figure.
        score: Label of the ordinate.
        logarithmic: True for a logarithmic ordinate.

    Returns:
        matplotlib Figure.
    """
    with house_style():
        figure, axes = one_picture((7.0, 4.0), title)
        for (label, seeds), (color, dashes) in zip(
            curves.items(), line_styles(len(curves), skip=1), strict=True
        ):
            in_millions = [(steps / 1e6, scores) for steps, scores in seeds]
            draw_seeds(axes, in_millions, color=color, linestyle=dashes, label=label)
        for k, (label, level) in enumerate(levels.items()):
            dashes = [(0, (4, 3)), (0, (1, 1.5)), (0, (6, 2, 1, 2))][k % 3]
            axes.axhline(level, color=INK, linewidth=1.0, linestyle=dashes, label=label)
        if logarithmic:
            axes.set_yscale("log")
            plain_numbers(axes.yaxis)
        axes.set_xlim(left=0.0)
        axes.set_xlabel("training [million steps]")
        axes.set_ylabel(score)
        legend_below(figure, axes)
    return figure


def matrix_figure(
    values: Floats,
    cells: Sequence[Sequence[str]],
    rows: Sequence[str],
    columns: Sequence[str],
    title: str = "",
) -> Any:
    """Make a heat map: a table whose cells are colored by value, on a logarithmic scale.

    Args:
        values: Values, (rows, columns) [m]; NaN: not measured.
        cells: Text of each cell.
        rows: Headings of the rows.
        columns: Headings of the columns.
        title: Title of the figure.

    Returns:
        matplotlib Figure.
    """
    with house_style():
        figure, axes = one_picture((2.6 + 2.1 * len(columns), 1.2 + 0.55 * len(rows)), title)
        shades = np.log10(values)
        axes.imshow(shades, cmap="cividis_r", aspect="auto", alpha=0.75)
        middle = 0.5 * (np.nanmin(shades) + np.nanmax(shades))
        for i, line in enumerate(cells):
            for j, text in enumerate(line):
                dark = shades[i, j] > middle
                axes.text(j, i, text, ha="center", va="center", color="white" if dark else INK)
        axes.set_xticks(range(len(columns)), columns)
        axes.set_yticks(range(len(rows)), rows)
        axes.xaxis.tick_top()
        axes.tick_params(length=0)
        axes.grid(False)
        for spine in axes.spines.values():
            spine.set_visible(False)
    return figure


def paths_figure(traces: Mapping[str, Trace], title: str = "") -> Any:
    """Make a figure of paths from above, side by side on a common scale.

    Args:
        traces: Flights, by label.
        title: Title of the figure.

    Returns:
        matplotlib Figure.
    """
    with house_style():
        from matplotlib.figure import Figure

        columns = 2 if len(traces) == 4 else min(len(traces), 3)
        rows = -(-len(traces) // columns)
        figure = Figure(figsize=(3.6 * columns, 3.7 * rows), layout="constrained")
        figure.suptitle(title)
        for k, (label, trace) in enumerate(traces.items()):
            axes: Any = figure.add_subplot(rows, columns, k + 1)
            draw_path(axes, trace, legend=False)
            axes.set_title(label)
        for axis in ("x", "y"):
            limits = np.array([getattr(a, f"get_{axis}lim")() for a in figure.axes])
            for a in figure.axes:
                getattr(a, f"set_{axis}lim")(limits[:, 0].min(), limits[:, 1].max())
        handles = path_handles(next(iter(traces.values())))
        figure.legend(handles=handles, loc="outside lower center", ncols=2 * min(columns, 2))
    return figure


def legend_below(figure: Any, axes: Any) -> None:
    """Add a legend below the axes, with as many columns as fit."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    handles, labels = axes.get_legend_handles_labels()
    renderer = FigureCanvasAgg(figure).get_renderer()
    for ncols in (2, 1) if len(labels) == 4 else (3, 2, 1):
        legend = figure.legend(handles, labels, loc="outside lower center", ncols=ncols)
        if ncols == 1 or legend.get_window_extent(renderer).width < figure.bbox.width:
            return
        legend.remove()


def line_styles(count: int, *, skip: int = 0) -> list[tuple[str, Any]]:
    """Distinct colors and dash patterns for curves, without the first `skip` of them."""
    return [_STYLES[(k + skip) % len(_STYLES)] for k in range(count)]

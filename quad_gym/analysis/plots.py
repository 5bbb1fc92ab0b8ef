"""Figures of flights and comparisons of controllers: paths, errors, learning curves.

Each function `draw_*` draws on a matplotlib Axes, so that drawings can be combined; each function
`*_figure` makes a figure. Figures are made without pyplot: no window opens, no figure needs to be
closed, and no display is required. The palette is by Okabe and Ito, which people with a color
vision deficiency can distinguish.
"""

import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.params import checks as check

# --------------------------------------------------------------------------------------------------
# Figures of flights: path from above, height, and error over time.
# --------------------------------------------------------------------------------------------------

BLUE, VERMILLION, GREEN, ORANGE = "#0072B2", "#D55E00", "#009E73", "#E69F00"
"""Colors of the actual path, of the heading, and of further curves."""
INK, GREY, PALE = "#222222", "#767676", "#DDDDDD"
"""Colors of text and the reference, of axes, and of the grid."""

_STYLE = Path(__file__).with_name("house.mplstyle")

_REFERENCE: dict[str, Any] = {"color": INK, "linestyle": (0, (4, 3)), "linewidth": 1.0}
_REST: dict[str, Any] = {"marker": "+", "markersize": 9.0, "linestyle": "none", "zorder": 4}
_START: dict[str, Any] = {
    "color": BLUE,
    "marker": "o",
    "markersize": 7.0,
    "markeredgewidth": 1.8,
    "markerfacecolor": "white",
    "linestyle": "none",
    "zorder": 5,
}

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Trace:
    """One flight at n instants."""

    time: Floats
    """Time since the start, (n,) [s]"""
    position: Floats
    """True position of the center of mass, (n, 3) in I [m]"""
    heading: Floats
    """Horizontal components of the body x axis, (n, 2) in I [-]"""
    reference: Floats
    """Position of the reference, (n, 3) in I [m]"""
    error: Floats
    """Distance of the true position from the reference, (n,) [m]"""


@dataclass(frozen=True)
class Band:
    """Range of an error over many flights at n instants."""

    low: Floats
    """Lower ends, (n,) [m]"""
    high: Floats
    """Upper ends, (n,) [m]"""
    label: str
    """Description of the range, for the legend"""


def require_matplotlib() -> None:
    """Check that matplotlib is installed, or raise an ImportError."""
    check.package("matplotlib.figure", "A figure", "plot")


@contextmanager
def house_style() -> Iterator[None]:
    """Context, or decorator, in which figures are drawn and saved in the project's style."""
    require_matplotlib()
    import matplotlib

    with matplotlib.rc_context(fname=_STYLE):
        yield


def panels(
    rows: int, columns: int, size: tuple[float, float], title: str = "", **options: Any
) -> tuple[Any, NDArray[Any]]:
    """Make a matplotlib Figure of a size [inch] with axes, (rows, columns).

    `options` are further options of `Figure.subplots`.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    if rows * columns == 1:
        axes[0, 0].set_title(title)
    elif title:
        figure.suptitle(title, x=0.01, ha="left", fontsize=11.0)
    return figure, axes


def draw_path(axes: Any, trace: Trace, *, tick_every: float = 0.5, legend: bool = True) -> None:
    """Draw a flight from above, with a tick for the heading every `tick_every` seconds.

    Both axes have the same scale.
    """
    from matplotlib.collections import LineCollection

    both = np.concatenate([trace.position, trace.reference])[:, :2]
    low, high = both.min(axis=0), both.max(axis=0)
    extent, t = float(max(high - low)), trace.time
    chosen = slice(None, None, max(1, round(tick_every / (t[1] - t[0]))) if t.size > 1 else 1)
    here, x_B = trace.position[chosen, :2], trace.heading[chosen]
    tips = here + 0.075 * extent * x_B / np.linalg.norm(x_B, axis=1, keepdims=True)
    rests = float(np.ptp(trace.reference[:, :2], axis=0).max()) < 1e-6
    axes.plot(*trace.position[:, :2].T, color=BLUE, linewidth=2.2, label="actual path")
    axes.plot(
        *trace.reference[:, :2].T, label="reference", **{**_REFERENCE, **(_REST if rests else {})}
    )
    ticks: dict[str, Any] = {"colors": VERMILLION, "linewidths": 1.3, "zorder": 1.9}
    words = f"body x axis every {tick_every:g} s"
    axes.add_collection(LineCollection(list(np.stack([here, tips], axis=1)), label=words, **ticks))
    axes.plot(*trace.position[0, :2], label="start", **_START)
    margin = 0.09 * extent
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - margin, high[1] + margin)
    axes.set(aspect="equal", xlabel="x, east [m]", ylabel="y, north [m]")
    if legend:
        axes.legend(loc="best")


def draw_height(axes: Any, trace: Trace) -> None:
    """Draw height over time, with the reference."""
    axes.plot(trace.time, trace.position[:, 2], color=BLUE, linewidth=2.2, label="actual height")
    axes.plot(trace.time, trace.reference[:, 2], label="reference", **_REFERENCE)
    start = (trace.time[0], trace.position[0, 2])
    axes.plot(*start, label="start", clip_on=False, **_START)
    axes.set_xlim(trace.time[0] - 0.01 * np.ptp(trace.time), trace.time[-1])
    axes.set(xlabel="time [s]", ylabel="height z [m]")
    axes.legend(loc="lower right")


def draw_error(
    axes: Any,
    trace: Trace,
    band: Band | None = None,
    *,
    label: str = "one flight",
    limits: tuple[float, float] | None = None,
) -> None:
    """Draw the distance from the reference over time, on a logarithmic scale.

    Args:
        axes: matplotlib Axes.
        trace: Flight.
        band: Range over many flights, drawn behind the curve.
        label: Name of the flight in the legend.
        limits: Lowest and highest error shown [m], to compare figures; None: chosen by matplotlib.
    """
    axes.plot(trace.time, trace.error, color=BLUE, linewidth=1.1, label=label)
    if band is not None:
        # the edge keeps a band without width visible
        alike = np.allclose(band.low, band.high, equal_nan=True)
        area: dict[str, Any] = {"color": ORANGE, "alpha": 0.45, "linewidth": 6.0 if alike else 0.0}
        axes.fill_between(trace.time, band.low, band.high, label=band.label, **area)
    axes.set_xlim(trace.time[0], trace.time[-1])
    axes.set_ylim(limits or error_limits([trace], [band] if band else []))
    axes.grid(True, which="minor", axis="y", linewidth=0.3)
    axes.set(xlabel="time [s]", ylabel="position error [m]")
    logarithmic(axes)
    axes.legend(loc="upper right")


def error_limits(traces: Sequence[Trace], bands: Sequence[Band]) -> tuple[float, float]:
    """Common limits of the logarithmic error axes of several figures [m].

    The lowest percent of the errors is left out, because flights may pass through their reference.
    """
    errors = [trace.error for trace in traces]
    low = min(float(np.nanpercentile(x, 1.0)) for x in (*errors, *(b.low for b in bands)))
    high = max(float(np.nanmax(x)) for x in (*errors, *(band.high for band in bands)))
    return 0.8 * max(low, 1e-4 * high), 1.5 * high


@house_style()
def flight_figure(
    draw: Callable[..., None], trace: Trace, *args: Any, title: str = "", **options: Any
) -> Any:
    """Make a matplotlib Figure with a flight, drawn by `draw_path`, `draw_height` or `draw_error`.

    It receives all further arguments and options.
    """
    size = (5.0, 5.0) if draw is draw_path else (6.0, 3.4)
    figure, ((axes,),) = panels(1, 1, size, title)
    draw(axes, trace, *args, **options)
    return figure


@house_style()
def overview_figure(
    trace: Trace,
    errors: Mapping[str, tuple[Trace, Band | None]],
    *,
    title: str = "",
    label: str = "one flight",
) -> Any:
    """Make an overview of a flight: path, height, and errors over time on a common scale.

    Args:
        trace: Flight whose path and height are drawn.
        errors: Flight and band of each plot of errors, by its title.
        title: Title of the path.
        label: Name of a flight in the legends.
    """
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    pairs = list(errors.values())
    limits = error_limits([one for one, _ in pairs], [band for _, band in pairs if band])
    layout = ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.06)
    figure = Figure(figsize=(9.6, 1.75 * (1 + len(errors))), layout=layout)
    grid = figure.add_gridspec(1 + len(errors), 2, width_ratios=(1.15, 1.0))
    path = figure.add_subplot(grid[:, 0], title=title)
    draw_path(path, trace)
    draw_height(figure.add_subplot(grid[0, 1], title="Height"), trace)
    for row, (name, (one, band)) in enumerate(errors.items(), start=1):
        axes = figure.add_subplot(grid[row, 1], title=name)
        draw_error(axes, one, band, label=label, limits=limits)
    return figure


@house_style()
def save_figure(figure: Any, stem: Path | str) -> list[Path]:
    """Write a figure as PNG and SVG; equal figures give bitwise identical files.

    `stem` is the path without file extension; returns the paths of the two files.
    """
    files = {Path(f"{stem}.png"): {"Software": None}, Path(f"{stem}.svg"): {"Date": None}}
    for file, metadata in files.items():
        figure.savefig(file, metadata=metadata)
        figure.set_layout_engine(None)  # the second file keeps the layout of the first
    return list(files)


def logarithmic(axes: Any, **options: Any) -> None:
    """Scale the ordinate logarithmically, labeled with numbers such as 0.1, not powers of ten."""
    from matplotlib.ticker import LogLocator

    axes.set_yscale("log", **options)
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("")


# --------------------------------------------------------------------------------------------------
# Figures that compare controllers: errors over time, learning curves, intervals, paths.
#
# Each curve has its own color and line style.
# --------------------------------------------------------------------------------------------------

_STYLES: tuple[dict[str, Any], ...] = (
    {"color": GREY, "linestyle": (0, (1, 1.2))},
    {"color": VERMILLION, "linestyle": "solid"},
    {"color": ORANGE, "linestyle": (0, (5, 2))},
    {"color": BLUE, "linestyle": "solid"},
    {"color": GREEN, "linestyle": (0, (3, 1, 1, 1))},
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


@house_style()
def error_over_time_figure(
    recorded: Mapping[str, Mapping[str, Floats]], bound: float, title: str = ""
) -> Any:
    """Figure of errors over time by label: median over episodes, and a band from 5 to 95 %.

    If episodes crashed, the share of the others is drawn below.

    Args:
        recorded: Arrays of `quad_gym.experiments.PathRecorder` by label.
        bound: Error of an episode from its crash on [m].
        title: Title.
    """
    crashes = any(each["not_crashed"][-1] < 1.0 for each in recorded.values())
    rows = {"height_ratios": (3.0, 1.0), "sharex": True} if crashes else {}
    size = (7.0, 5.0 if crashes else 3.8)
    figure, grid = panels(1 + crashes, 1, size, title, **rows)
    axes, end = grid[0, 0], max(each["time"][-1] for each in recorded.values())
    for k, (label, each) in enumerate(recorded.items()):
        style = _STYLES[k % len(_STYLES)]
        time = np.append(each["time"], end)  # the last values stay
        low, middle, high = np.pad(each["percentiles"], ((0, 0), (0, 1)), "edge")
        axes.fill_between(time, low, high, color=style["color"], alpha=0.15, linewidth=0)
        axes.plot(time, middle, label=label, **style)
        if crashes:
            grid[1, 0].plot(time, 100.0 * np.pad(each["not_crashed"], (0, 1), "edge"), **style)
    logarithmic(axes)
    axes.set_xlim(0.0, end)
    axes.set_ylabel("position error [m]\nmedian, 5 to 95 % of episodes")
    if crashes:
        axes.axhline(bound, color=GREY, linewidth=0.8)
        axes.annotate("crashed", (0.01, bound), (0, -3), va="top", color=GREY, **_AT_HEIGHT)
        grid[1, 0].set(ylabel="not crashed [%]", ylim=(-3.0, 103.0))
    grid[-1, 0].set_xlabel("time [s]")
    _legend_below(figure, axes)
    return figure


@house_style()
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
    figure, ((axes,),) = panels(1, 1, (7.0, 4.0), title)
    dot: dict[str, Any] = {"markeredgecolor": INK, "linestyle": "none"}
    for k, (label, seeds) in enumerate(curves.items(), start=1):
        style = _STYLES[k % len(_STYLES)]
        for steps, scores in seeds:
            axes.plot(steps / 1e6, scores, color=style["color"], alpha=0.35, linewidth=0.8)
        shortest = min(len(steps) for steps, _ in seeds)
        middle = np.median([scores[:shortest] for _, scores in seeds], axis=0)
        axes.plot(seeds[0][0][:shortest] / 1e6, middle, linewidth=2.0, label=label, **style)
        if tests:
            end = 1.04 * max(steps[-1] for steps, _ in seeds) / 1e6
            axes.plot(end, tests[label], "o", color=style["color"], label="_", **dot)
    if tests:  # the dots have the colors of the lines; their explanation has none
        axes.plot([], [], "o", color="none", label="dots: test on the estimate", **dot)
    for k, (label, level) in enumerate(levels.items()):
        dashes = _LEVELS[k % len(_LEVELS)]
        axes.axhline(level, color=INK, linewidth=1.0, linestyle=dashes, label=label)
    if not linear:
        logarithmic(axes)
    axes.set_xlim(left=0.0)
    axes.set(xlabel="training [million steps]", ylabel=score)
    _legend_below(figure, axes)
    return figure


@house_style()
def intervals_figure(
    values: Mapping[str, Mapping[str, tuple[float, tuple[float, float] | None]]],
    unit: str,
    title: str = "",
) -> Any:
    """Figure of values with intervals: a line for each row, and a color for each column.

    Args:
        values: Value and its 95 % interval, or None, by row and column.
        unit: Label of the values.
        title: Title.
    """
    columns = list(next(iter(values.values())))
    figure, ((axes,),) = panels(1, 1, (7.0, 1.4 + 0.5 * len(values)), title)
    for k, column in enumerate(columns):
        color, height = _STYLES[3 - 2 * (k % 2)]["color"], 0.3 * (k - 0.5 * (len(columns) - 1))
        for row, (value, interval) in enumerate(each[column] for each in values.values()):
            label = column if row == 0 else "_"
            if interval is not None:
                axes.plot(interval, [row + height] * 2, color=color, linewidth=2.0, alpha=0.6)
            axes.plot(value, row + height, "o", color=color, label=label)
    if any(interval is not None for row in values.values() for _, interval in row.values()):
        axes.plot([], [], color="0.5", linewidth=2.0, label="95 % interval")
    axes.set_yticks(range(len(values)), values)
    axes.set_ylim(len(values) - 0.5, -0.5)
    axes.set_xlabel(unit)
    _legend_below(figure, axes)
    return figure


@house_style()
def paths_figure(traces: Mapping[str, Trace], title: str = "") -> Any:
    """Figure of the paths of flights from above, by label, side by side on a common scale."""
    columns = 2 if len(traces) == 4 else min(len(traces), 3)
    rows = -(-len(traces) // columns)
    figure, grid = panels(rows, columns, (3.6 * columns, 3.7 * rows))
    figure.suptitle(title)
    shown = grid.ravel()[: len(traces)]
    for axes, (label, trace) in zip(shown, traces.items(), strict=True):
        draw_path(axes, trace, legend=False)
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

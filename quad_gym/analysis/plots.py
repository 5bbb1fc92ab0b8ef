"""Figures of flights: path from above, height, and error over time.

Each function `draw_*` draws on a matplotlib Axes, so that drawings can be combined; each function
`*_figure` makes a figure. Figures are made without pyplot: no window opens, no figure needs to be
closed, and no display is required. The palette is by Okabe and Ito, which people with a color
vision deficiency can distinguish.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.params import checks as check

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
    axes.set_yscale("log", **options)
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("")

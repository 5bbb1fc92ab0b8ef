"""Figures of flights: path from above, height, and error over time.

Each function `draw_*` draws on a matplotlib Axes, so that drawings can be combined; each function
`*_figure` makes a figure. Figures are made without pyplot: no window opens, no figure needs to be
closed, and no display is required. The palette is by Okabe and Ito, which people with a color
vision deficiency can distinguish.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.params import checks as check

BLUE, VERMILLION, GREEN, ORANGE = "#0072B2", "#D55E00", "#009E73", "#E69F00"
"""Colors of the path flown, of the heading, and of further curves."""
INK, GREY, PALE = "#222222", "#767676", "#DDDDDD"
"""Colors of text and the reference, of axes, and of the grid."""

_STYLE = {
    "font.size": 9.0,
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "text.color": INK,
    "axes.titlesize": 10.0,
    "axes.titlelocation": "left",
    "axes.titlepad": 9.0,
    "axes.labelcolor": INK,
    "axes.edgecolor": GREY,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": PALE,
    "grid.linewidth": 0.6,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.frameon": True,
    "legend.edgecolor": "none",
    "legend.framealpha": 0.85,
    "legend.fancybox": False,
    "legend.fontsize": 8.5,
    "legend.handlelength": 1.8,
    "lines.linewidth": 1.6,
    "lines.solid_capstyle": "round",
    "figure.dpi": 100.0,
    "savefig.dpi": 200.0,
    "svg.hashsalt": "quad_gym",
}

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


@dataclass(frozen=True, kw_only=True)
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


@dataclass(frozen=True, kw_only=True)
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
    """Context in which figures are drawn and saved in the project's style."""
    require_matplotlib()
    import matplotlib

    with matplotlib.rc_context(_STYLE):
        yield


def heading_ticks(
    time: ArrayLike, position: ArrayLike, heading: ArrayLike, *, every: float, length: float
) -> Floats:
    """Ticks along a path in the direction of the body x axis, seen from above.

    Args:
        time: Increasing times, (n,) [s].
        position: Positions, (n, 2) or (n, 3) in I [m]; only x and y are used.
        heading: Horizontal components of the body x axis, (n, 2) in I, of any length.
        every: Time between ticks [s]; the first one is at the start.
        length: Length of a tick [m].

    Returns:
        Both ends of each tick, (m, 2, 2), x and y in I [m].
    """
    t, here = np.asarray(time, np.float64), np.asarray(position, np.float64)[:, :2]
    direction = np.asarray(heading, np.float64)
    # half an instant of tolerance, so that rounding of times loses no tick
    grace = 0.5 * (t[1] - t[0]) if t.size > 1 else 0.0
    wanted = t[0] + every * np.arange(1 + int((t[-1] - t[0] + grace) / every))
    chosen = np.minimum(np.searchsorted(t, wanted - grace), t.size - 1)
    unit = direction[chosen] / np.linalg.norm(direction[chosen], axis=1, keepdims=True)
    return np.stack([here[chosen], here[chosen] + length * unit], axis=1)


def draw_path(axes: Any, trace: Trace, *, tick_every: float = 0.5, legend: bool = True) -> None:
    """Draw a flight from above, with ticks for the heading; both axes have the same scale.

    Args:
        axes: matplotlib Axes.
        trace: Flight.
        tick_every: Time between heading ticks [s].
        legend: True to add a legend.
    """
    from matplotlib.collections import LineCollection

    both = np.concatenate([trace.position, trace.reference])[:, :2]
    low, high = both.min(axis=0), both.max(axis=0)
    extent = float(max(high - low))
    ticks = heading_ticks(
        trace.time, trace.position, trace.heading, every=tick_every, length=0.075 * extent
    )
    axes.add_collection(LineCollection(list(ticks), colors=VERMILLION, linewidths=1.3))
    axes.plot(*trace.position[:, :2].T, color=BLUE, linewidth=2.2)
    axes.plot(*trace.reference[:, :2].T, **_reference_style(trace))
    axes.plot(*trace.position[0, :2], **_START)
    margin = 0.09 * extent
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - margin, high[1] + margin)
    axes.set_aspect("equal")
    axes.set_xlabel("x, east [m]")
    axes.set_ylabel("y, north [m]")
    if legend:
        axes.legend(handles=path_handles(trace, tick_every=tick_every), loc="best")


def path_handles(trace: Trace, *, tick_every: float = 0.5) -> list[Any]:
    """Handles for a legend of `draw_path`.

    Args:
        trace: Flight.
        tick_every: Time between heading ticks [s].
    """
    return [
        _line("flown", BLUE, width=2.2),
        _sample("reference", _reference_style(trace)),
        _line(f"body x axis every {tick_every:g} s", VERMILLION, width=1.3),
        _sample("start", _START),
    ]


def _reference_style(trace: Trace) -> dict[str, Any]:
    """Style of a reference from above: a line, or a marker if the reference does not move."""
    rests = float(np.ptp(trace.reference[:, :2], axis=0).max()) < 1e-6
    return {**_REFERENCE, **(_REST if rests else {})}


def draw_height(axes: Any, trace: Trace) -> None:
    """Draw height over time, with the reference.

    Args:
        axes: matplotlib Axes.
        trace: Flight.
    """
    axes.plot(trace.time, trace.position[:, 2], color=BLUE, linewidth=2.2)
    axes.plot(trace.time, trace.reference[:, 2], **_REFERENCE)
    axes.plot(trace.time[0], trace.position[0, 2], **_START, clip_on=False)
    axes.set_xlim(trace.time[0] - 0.01 * np.ptp(trace.time), trace.time[-1])
    axes.set_xlabel("time [s]")
    axes.set_ylabel("height z [m]")
    axes.legend(
        handles=[
            _line("flown", BLUE, width=2.2),
            _sample("reference", _REFERENCE),
            _sample("start", _START),
        ],
        loc="lower right",
    )


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
    handles = [_line(label, BLUE, width=1.1)]
    if band is not None:
        axes.fill_between(trace.time, band.low, band.high, color=ORANGE, alpha=0.45, linewidth=0)
        if np.allclose(band.low, band.high, equal_nan=True):
            # a band without width would be invisible
            axes.plot(trace.time, band.high, color=ORANGE, alpha=0.45, linewidth=6.0)
        handles.append(_patch(band.label, ORANGE))
    axes.plot(trace.time, trace.error, color=BLUE, linewidth=1.1)
    axes.set_yscale("log")
    axes.set_xlim(trace.time[0], trace.time[-1])
    axes.set_ylim(limits or error_limits([trace], [band] if band else []))
    plain_numbers(axes.yaxis)
    axes.grid(True, which="minor", axis="y", linewidth=0.3)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("position error [m]")
    axes.legend(handles=handles, loc="upper right")


def error_limits(traces: list[Trace], bands: list[Band]) -> tuple[float, float]:
    """Common limits of the logarithmic error axes of several figures [m].

    The lowest percent of the errors is left out, because flights may pass through their reference.
    """
    curves = [trace.error for trace in traces] + [band.low for band in bands]
    low = min(float(np.nanpercentile(curve, 1.0)) for curve in curves)
    tops = [trace.error for trace in traces] + [band.high for band in bands]
    high = max(float(np.nanmax(curve)) for curve in tops)
    return 0.8 * max(low, 1e-4 * high), 1.5 * high


def path_figure(trace: Trace, title: str = "") -> Any:
    """Make a matplotlib Figure with `draw_path`."""
    with house_style():
        figure, axes = one_picture((5.0, 5.0), title)
        draw_path(axes, trace)
    return figure


def height_figure(trace: Trace, title: str = "") -> Any:
    """Make a matplotlib Figure with `draw_height`."""
    with house_style():
        figure, axes = one_picture((6.0, 3.4), title)
        draw_height(axes, trace)
    return figure


def error_figure(
    trace: Trace,
    band: Band | None = None,
    title: str = "",
    *,
    label: str = "one flight",
    limits: tuple[float, float] | None = None,
) -> Any:
    """Make a matplotlib Figure with `draw_error`."""
    with house_style():
        figure, axes = one_picture((6.0, 3.4), title)
        draw_error(axes, trace, band, label=label, limits=limits)
    return figure


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

    Returns:
        matplotlib Figure.
    """
    pairs = list(errors.values())
    limits = error_limits([one for one, _ in pairs], [band for _, band in pairs if band])
    with house_style():
        from matplotlib.figure import Figure
        from matplotlib.layout_engine import ConstrainedLayoutEngine

        rows = 1 + len(errors)
        layout = ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.06)
        figure = Figure(figsize=(9.6, 1.75 * rows), layout=layout)
        grid = figure.add_gridspec(rows, 2, width_ratios=(1.15, 1.0))
        axes = figure.add_subplot(grid[:, 0])
        draw_path(axes, trace)
        axes.set_title(title)
        axes = figure.add_subplot(grid[0, 1])
        draw_height(axes, trace)
        axes.set_title("Height")
        for row, (name, (one, band)) in enumerate(errors.items(), start=1):
            axes = figure.add_subplot(grid[row, 1])
            draw_error(axes, one, band, label=label, limits=limits)
            axes.set_title(name)
    return figure


def save_figure(figure: Any, stem: Path | str) -> list[Path]:
    """Write a figure as PNG and SVG; equal figures give bitwise identical files.

    Args:
        figure: matplotlib Figure.
        stem: Path without file extension.

    Returns:
        Paths of the two files.
    """
    files = [Path(f"{stem}.{ending}") for ending in ("png", "svg")]
    with house_style():
        for file in files:
            metadata = {"Date": None} if file.suffix == ".svg" else {"Software": None}
            figure.savefig(file, metadata=metadata)
    return files


def plain_numbers(axis: Any) -> None:
    """Label a logarithmic axis with numbers such as 0.1 instead of powers of ten."""
    from matplotlib.ticker import FuncFormatter, NullFormatter

    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def one_picture(size: tuple[float, float], title: str) -> tuple[Any, Any]:
    """Make a matplotlib Figure with one Axes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    axes = figure.add_subplot()
    axes.set_title(title)
    return figure, axes


def _line(label: str, color: str, *, width: float) -> Any:
    return _sample(label, {"color": color, "linewidth": width})


def _sample(label: str, style: dict[str, Any]) -> Any:
    from matplotlib.lines import Line2D

    return Line2D([], [], label=label, **style)


def _patch(label: str, color: str) -> Any:
    from matplotlib.patches import Patch

    return Patch(facecolor=color, alpha=0.45, label=label)

"""Figures of filter consistency: NEES and NIS, errors and standard deviations, autocorrelation."""

from typing import Any

import numpy as np

from quad_gym.analysis import plots
from quad_gym.analysis.consistency import (
    BAND_FLIGHTS,
    NEGLIGIBLE_CORRELATION,
    PARTS,
    Floats,
    MeanSquare,
    Whiteness,
)

_UNITS = {
    "position": ("mm", 1e3),
    "velocity": ("mm/s", 1e3),
    "attitude": ("mrad", 1e3),
    "accel_bias": ("mm/s²", 1e3),
    "gyro_bias": ("deg/h", np.degrees(3600.0)),
}
_TOLERANCE = f"tolerance (gray): 95 % band of a mean over at most {BAND_FLIGHTS:,} flights"


def _grid(count: int, title: str, label: str = "time [s]") -> tuple[Any, Any]:
    """Make a figure with `count` axes, three in a row; four are two by two."""
    columns = 2 if count == 4 else 3
    rows = -(-count // columns)
    figure, grid = plots.panels(rows, columns, (10.0, 0.6 + 2.1 * rows), title)
    for spare in grid.ravel()[count:]:
        spare.set_visible(False)
    for axes in grid.ravel()[max(0, count - columns) : count]:
        axes.set_xlabel(label)
    return figure, grid.ravel()[:count]


def _title(name: str) -> str:
    return "whole state" if name == "state" else name.replace("_", " ")


def draw_mean_square(axes: Any, part: MeanSquare, settle: float = 0.0) -> None:
    """Draw a mean square over time with its band; the title states the share of instants inside.

    Instants before `settle` [s] are left out of the numbers in the title.
    """
    axes.fill_between(part.time, part.low, part.high, color=plots.PALE, linewidth=0.0)
    axes.axhline(part.dimension, color=plots.GREY, linewidth=0.8)
    axes.plot(part.time, part.mean, color=plots.BLUE, linewidth=1.2)
    if settle > 0.0:
        axes.axvline(settle, color=plots.VERMILLION, linewidth=0.8, linestyle=":")
    counted = part.since(settle)
    inside = f"{100 * counted.share_inside:.0f} % within ±{100 * counted.tolerance:.2g} %"
    axes.set_title(f"{_title(part.name)}: {counted.overall:.2f}, {inside}")
    reach = 3.0 * (part.high - part.low).max()
    gaps = np.abs(counted.mean - part.dimension)
    limit = max(reach, 1.15 * float(np.percentile(gaps, 98.0)))  # regardless of outliers
    axes.set_ylim(max(0.0, part.dimension - limit), part.dimension + limit)
    axes.set_xlim(0.0, part.time[-1])


@plots.house_style()
def mean_square_figure(
    quantity: str, parts: dict[str, MeanSquare], title: str, settle: float = 0.0
) -> Any:
    """Figure of the means of "NEES" of the state's parts, or "NIS" of the sensors, over time."""
    text = f"{title}\nMean {quantity} over flights (blue), and {_TOLERANCE}"
    figure, axes = _grid(len(parts), text)
    for axis, part in zip(axes, parts.values(), strict=True):
        draw_mean_square(axis, part, settle)
    return figure


@plots.house_style()
def errors_figure(time: Floats, errors: Floats, sigmas: Floats, title: str) -> Any:
    """Figure of root mean square errors and standard deviations of the filter, (t, 15) each."""
    what = "Error (blue), standard deviation of the filter (dashed)"
    text = f"{title}\n{what}; root mean square over flights"
    blocks = {name: part for name, part in PARTS.items() if name in _UNITS}
    figure, axes = _grid(len(blocks), text)
    for axis, (name, part) in zip(axes, blocks.items(), strict=True):
        unit, factor = _UNITS[name]
        for values, color, dashes in ((errors, plots.BLUE, "-"), (sigmas, plots.INK, (0, (4, 3)))):
            size = factor * np.sqrt((values[:, part] ** 2).sum(axis=1))
            axis.plot(time, size, color=color, linestyle=dashes, linewidth=1.3)
        axis.set_title(f"{_title(name)} [{unit}]")
        plots.logarithmic(axis, subs=(2.0, 5.0))
        axis.yaxis.set_minor_formatter("{x:g}")
        axis.tick_params(axis="y", which="minor", labelsize=7.0)
        axis.set_xlim(0.0, time[-1])
    return figure


@plots.house_style()
def whiteness_figure(found: dict[str, Whiteness], title: str) -> Any:
    """Figure of the autocorrelation of each sensor's innovations, with the band of white noise."""
    text = f"{title}\nAutocorrelation of innovations, with the 95 % band of white noise (gray)"
    figure, axes = _grid(len(found), text, "lag [measurements]")
    for axis, part in zip(axes, found.values(), strict=True):
        lags = np.arange(1, part.correlation.size + 1)
        axis.fill_between(lags, -part.band, part.band, color=plots.PALE, linewidth=0.0)
        axis.axhline(0.0, color=plots.GREY, linewidth=0.8)
        axis.vlines(lags, 0.0, part.correlation, color=plots.BLUE, linewidth=1.6)
        axis.plot(
            lags, part.correlation, color=plots.BLUE, marker="o", markersize=3.0, linestyle="none"
        )
        limit = 1.2 * max(2.5 * NEGLIGIBLE_CORRELATION, np.abs(part.correlation).max())
        axis.set_ylim(-limit, limit)
        axis.set_title(f"{_title(part.name)}: largest {part.largest:+.3f}")
    return figure

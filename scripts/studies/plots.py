"""Figures of a study: the same episode, flown by several policies.

An episode is a mapping of its "time" [s], of its "ending" in words, and of traces from
`scripts.studies.traces.TRACES`, (t,) each, which are NaN after its end. Figures take episodes by
the label of the policy.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.analysis import plots

Floats = NDArray[np.float64]
RESET_RATIO = 3.0  #: growth of the standard deviation in one step that only a reset explains
Episode = Mapping[str, Any]


@plots.house_style()
def glance_figure(episodes: Mapping[str, Episode], half_view: float) -> Any:
    """Figure of the headings of policies, with estimation and tracking errors.

    The camera's horizontal field of view is twice `half_view` [rad].
    """
    figure, grid = _grid(episodes, 5.4, height_ratios=(1.0, 1.15))
    for (above, below), episode in zip(grid.T, episodes.values(), strict=True):
        time, error = episode["time"], episode["position_error"]
        _draw_angles(above, episode, math.degrees(half_view))
        _draw_uncertainty(below, episode)
        below.plot(time, error, color=plots.VERMILLION, label="tracking error")
        _mark_end(below, time, error, episode["ending"])
    grid[0, 0].set_ylabel("body x axis, from the\ndirection of the markers [deg]")
    _finish(grid, episodes, "position_error")
    return figure


@plots.house_style()
def pace_figure(episodes: Mapping[str, Episode]) -> Any:
    """Figure of the speeds of policies, with estimation errors and 3 sigma."""
    figure, grid = _grid(episodes, 4.6)
    for (above, below), episode in zip(grid.T, episodes.values(), strict=True):
        time = episode["time"]
        above.plot(time, episode["speed"], color=plots.BLUE, label="speed")
        _draw_uncertainty(below, episode)
        failed = np.nan_to_num(episode.get("outage", np.zeros_like(time))) > 0
        for axes, label in ((above, "no GNSS"), (below, "_")):
            style: dict[str, Any] = {"color": plots.GREY, "alpha": 0.2, "linewidth": 0}
            for first, last in outages(failed):
                axes.axvspan(time[first], time[last], label=label, **style)
                label = "_"  # one entry of the legend for all outages
        _mark_end(below, time, episode["speed"], episode["ending"])
    grid[0, 0].set_ylabel("speed [m/s]")
    grid[0, 0].set_ylim(bottom=0.0)
    _finish(grid, episodes, "speed")
    return figure


def outages(failed: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last index of each run of true values (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], failed, [False]]).astype(np.int8)))
    return [(int(first), int(end) - 1) for first, end in edges.reshape(-1, 2)]


def _grid(episodes: Mapping[str, Episode], height: float, **options: Any) -> tuple[Any, Any]:
    """Make a figure with two axes for each episode, (2, episodes)."""
    size = (4.3 * len(episodes), height)
    figure, grid = plots.panels(2, len(episodes), size, sharex=True, sharey="row", **options)
    for axes, label in zip(grid[0], episodes, strict=True):
        axes.set_title(label)
    return figure, grid


def _finish(grid: Any, episodes: Mapping[str, Episode], column: str) -> None:
    """Set limits beyond the last end of a trace, labels, and legends."""
    last = max(_end_of(e["time"], e[column]) for e in episodes.values())
    grid[0, 0].set_xlim(0.0, 1.02 * last)
    grid[1, 0].set_ylabel("error, 3 sigma [m]")
    for row in grid:
        row[0].yaxis.set_tick_params(labelleft=True)
        row[-1].legend(
            *row[0].get_legend_handles_labels(), loc="upper left", bbox_to_anchor=(1.0, 1.0)
        )


def _draw_angles(axes: Any, episode: Episode, half_view: float) -> None:
    """Draw the direction of body x and the desired heading, relative to the features [deg]."""
    view: dict[str, Any] = {"color": plots.ORANGE, "alpha": 0.25, "linewidth": 0}
    axes.axhspan(-half_view, half_view, label="markers in view", **view)
    time, off = episode["time"], np.degrees(episode["off_wall"])
    rewarded = _unbroken(off - np.degrees(episode["off_reward"]))
    axes.plot(time, rewarded, color=plots.GREY, linestyle=(0, (4, 3)), label="rewarded heading")
    axes.plot(time, _unbroken(off), color=plots.BLUE, label="body x axis")
    axes.set_ylim(-180.0, 180.0)
    axes.set_yticks([-180, -90, 0, 90, 180])


def _draw_uncertainty(axes: Any, episode: Episode) -> None:
    """Draw the filter's standard deviation and the estimation error."""
    time, bound = episode["time"], 3.0 * episode["sigma"]
    area: dict[str, Any] = {"facecolor": plots.GREEN, "alpha": 0.2, "linewidth": 0}
    axes.fill_between(time, 1e-3, bound, label="filter: 3 sigma", **area)
    axes.plot(time, bound, color=plots.GREEN, linewidth=0.8, label="_")
    with np.errstate(invalid="ignore"):
        resets = time[1:][bound[1:] > RESET_RATIO * bound[:-1]]
    if resets.size:
        at_top: dict[str, Any] = {"transform": axes.get_xaxis_transform(), "clip_on": False}
        mark: dict[str, Any] = {"linestyle": "none", "color": plots.INK, "markersize": 5.0}
        axes.plot(resets, np.full(resets.size, 1.03), "v", label="filter reset", **mark, **at_top)
    axes.plot(time, episode["estimation_error"], color=plots.GREEN, label="estimation error")
    axes.set_yscale("log")
    axes.set_ylim(3e-3, 10.0)
    axes.set_xlabel("time [s]")


def _mark_end(axes: Any, time: Floats, values: Floats, what: str) -> None:
    """Draw a line where an episode has ended early, with the reason next to it."""
    if np.isfinite(values).all():
        return
    end = _end_of(time, values)
    axes.axvline(end, color=plots.INK, linewidth=1.0)
    early = end < 0.5 * float(time[-1])  # then there is room to the right of the line
    style: dict[str, Any] = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points"}
    words = axes.annotate(what, (end, 0.03), (4 if early else -4, 0), color=plots.INK, **style)
    words.set_horizontalalignment("left" if early else "right")
    words.set_in_layout(False)  # a long reason does not push the panels apart


def _end_of(time: Floats, values: Floats) -> float:
    """Time at which a trace ends, the first without a value, or the last [s]."""
    over = ~np.isfinite(values)
    return float(time[int(np.argmax(over))] if over.any() else time[-1])


def _unbroken(degrees: Floats) -> Floats:
    """Wrap angles to (-180, 180], with a gap (NaN) at each jump."""
    wrapped = (degrees + 180.0) % 360.0 - 180.0
    jumps = np.abs(np.diff(wrapped, append=wrapped[-1:])) > 180.0
    return np.where(jumps, np.nan, wrapped)

"""Figures of a study: the same episode, flown by several policies.

An episode is a mapping of its "time" [s] and of traces from `quad_gym.experiments.flown.TRACES`,
(t,) each, which are NaN after its end.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.analysis.plots import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PALE,
    VERMILLION,
    house_style,
)

Floats = NDArray[np.float64]
Episode = Mapping[str, Floats]


def glance_figure(episodes: Mapping[str, Episode], half_view: float) -> Any:
    """Make a figure of policies' headings in one episode, with estimation and tracking errors.

    Args:
        episodes: Episodes, by label of the policy.
        half_view: Half of the camera's horizontal field of view [rad].

    Returns:
        matplotlib Figure.
    """
    with house_style():
        figure, grid = _grid(episodes, 5.4, height_ratios=(1.0, 1.15))
        for (above, below), episode in zip(grid.T, episodes.values(), strict=True):
            _draw_angles(above, episode, half_view)
            _draw_errors(below, episode)
        grid[0, 0].set_ylabel("body x, from the direction\nof the features [deg]")
        _finish(grid, episodes, "position_error")
    return figure


def pace_figure(episodes: Mapping[str, Episode]) -> Any:
    """Make a figure of the speeds of policies in one episode, with estimation errors and 3 sigma.

    Args:
        episodes: Episodes, by label of the policy.

    Returns:
        matplotlib Figure.
    """
    with house_style():
        figure, grid = _grid(episodes, 4.6)
        for (above, below), episode in zip(grid.T, episodes.values(), strict=True):
            above.plot(episode["time"], episode["speed"], color=BLUE, label="speed")
            _draw_knowledge(below, episode)
            failing = np.nan_to_num(episode.get("outage", np.zeros(0))) > 0
            if failing.any():
                failed = episode["time"][failing]
                for axes in (above, below):
                    axes.axvspan(
                        *(failed[0], failed[-1]), color=GREY, alpha=0.2, linewidth=0,
                        label="no GNSS" if axes is above else "_",
                    )  # fmt: skip
            _mark_end(below, episode["time"], episode["speed"], "end")
        grid[0, 0].set_ylabel("[m/s]")
        grid[0, 0].set_ylim(bottom=0.0)
        _finish(grid, episodes, "speed")
    return figure


def _grid(episodes: Mapping[str, Episode], height: float, **options: Any) -> tuple[Any, Any]:
    """Make a figure with two axes for each episode, (2, episodes)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.3 * len(episodes), height), layout="constrained")
    grid = figure.subplots(2, len(episodes), sharex=True, sharey="row", squeeze=False, **options)
    for axes, label in zip(grid[0], episodes, strict=True):
        axes.set_title(label)
    return figure, grid


def _finish(grid: Any, episodes: Mapping[str, Episode], column: str) -> None:
    """Set limits up to the last end of a trace, labels, and legends."""
    last = max(float(e["time"][np.isfinite(e[column])][-1]) for e in episodes.values())
    grid[0, 0].set_xlim(0.0, last)
    grid[1, 0].set_ylabel("[m]")
    for axes in grid[:, 0]:
        axes.yaxis.set_tick_params(labelleft=True)
    for row in grid:
        handles, labels = row[0].get_legend_handles_labels()
        row[-1].legend(handles, labels, loc="upper left", bbox_to_anchor=(1.0, 1.0))


def _draw_angles(axes: Any, episode: Episode, half_view: float) -> None:
    """Draw the direction of body x and the desired heading, relative to the features."""
    span = math.degrees(half_view)
    axes.axhspan(-span, span, color=ORANGE, alpha=0.25, linewidth=0, label="markers in view")
    wanted = _unbroken(np.degrees(episode["off_wall"] - episode["off_reward"]))
    axes.plot(episode["time"], wanted, color=GREY, linestyle=(0, (4, 3)), label="rewarded")
    axes.plot(
        episode["time"], _unbroken(np.degrees(episode["off_wall"])), color=BLUE, label="body x"
    )
    axes.set_ylim(-180.0, 180.0)
    axes.set_yticks([-180, -90, 0, 90, 180])


def _draw_errors(axes: Any, episode: Episode) -> None:
    """Draw the filter's standard deviation, the estimation error, and the tracking error."""
    _draw_knowledge(axes, episode)
    axes.plot(
        episode["time"], episode["position_error"], color=VERMILLION, label="error of the position"
    )
    _mark_end(axes, episode["time"], episode["position_error"], "crash")


def _draw_knowledge(axes: Any, episode: Episode) -> None:
    """Draw the filter's standard deviation and the estimation error."""
    axes.plot(episode["time"], 3.0 * episode["sigma"], color=PALE, label="_")
    axes.fill_between(
        episode["time"], 1e-3, 3.0 * episode["sigma"], color=GREEN, alpha=0.2, linewidth=0,
        label="filter: 3 sigma",
    )  # fmt: skip
    axes.plot(
        episode["time"], episode["estimation_error"], color=GREEN, label="error of the estimate"
    )
    axes.set_yscale("log")
    axes.set_ylim(3e-3, 10.0)
    axes.set_xlabel("time [s]")


def _mark_end(axes: Any, time: Floats, values: Floats, what: str) -> None:
    """Draw a line where an episode has ended early."""
    over = ~np.isfinite(values)
    if over.any():
        end = time[int(np.argmax(over))]
        axes.axvline(end, color=INK, linewidth=1.0)
        axes.annotate(
            what, (end, 0.03), xytext=(4, 0), textcoords="offset points",
            xycoords=("data", "axes fraction"), color=INK,
        )  # fmt: skip


def _unbroken(degrees: Floats) -> Floats:
    """Wrap angles to (-180, 180], with a gap (NaN) at each jump."""
    wrapped = (degrees + 180.0) % 360.0 - 180.0
    jumps = np.abs(np.diff(wrapped, append=wrapped[-1:])) > 180.0
    return np.where(jumps, np.nan, wrapped)

"""Figures of a study: single episodes of several policies."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

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


class Glance(NamedTuple):
    """Heading and errors of one policy in one episode of LookAround, (t,) each."""

    time: Floats
    """Time since the start [s]"""
    off_wall: Floats
    """Angle of body x from the direction of the features [rad]"""
    off_reward: Floats
    """Angle of body x from the desired heading [rad]"""
    sigma: Floats
    """Largest standard deviation of the position according to the filter [m]"""
    estimation_error: Floats
    """Distance between estimated and true position [m]"""
    position_error: Floats
    """Distance of the true position from the reference [m]"""


class Pace(NamedTuple):
    """Speed and errors of one policy in one episode of a race, (t,) each."""

    time: Floats
    """Time since the start [s]"""
    speed: Floats
    """True speed [m/s]"""
    sigma: Floats
    """Largest standard deviation of the position according to the filter [m]"""
    estimation_error: Floats
    """Distance between estimated and true position [m]"""
    outage: Floats | None = None
    """GNSS outage: 1 while GNSS fails, else 0; None: no outage"""


def glance_figure(episodes: Mapping[str, Glance], half_view: float) -> Any:
    """Make a figure of policies' headings in one episode, with estimation and tracking errors.

    Args:
        episodes: Episodes, by label of the policy.
        half_view: Half of the camera's horizontal field of view [rad].

    Returns:
        matplotlib Figure.
    """
    with house_style():
        from matplotlib.figure import Figure

        figure = Figure(figsize=(4.3 * len(episodes), 5.4), layout="constrained")
        grid = figure.subplots(
            2, len(episodes), sharex=True, sharey="row", squeeze=False, height_ratios=(1.0, 1.15)
        )
        for column, (label, episode) in enumerate(episodes.items()):
            _draw_angles(grid[0, column], episode, half_view)
            _draw_errors(grid[1, column], episode)
            grid[0, column].set_title(label)
        last = max(float(e.time[np.isfinite(e.position_error)][-1]) for e in episodes.values())
        grid[0, 0].set_xlim(0.0, last)
        grid[0, 0].set_ylabel("body x, from the direction\nof the features [deg]")
        grid[1, 0].set_ylabel("[m]")
        for axes in grid[:, 0]:
            axes.yaxis.set_tick_params(labelleft=True)
        for row in grid:
            handles, labels = row[0].get_legend_handles_labels()
            row[-1].legend(handles, labels, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def pace_figure(episodes: Mapping[str, Pace]) -> Any:
    """Make a figure of the speeds of policies in one episode, with estimation errors and 3 sigma.

    Args:
        episodes: Episodes, by label of the policy.

    Returns:
        matplotlib Figure.
    """
    with house_style():
        from matplotlib.figure import Figure

        figure = Figure(figsize=(4.3 * len(episodes), 4.6), layout="constrained")
        grid = figure.subplots(2, len(episodes), sharex=True, sharey="row", squeeze=False)
        for column, (label, episode) in enumerate(episodes.items()):
            above, below = grid[:, column]
            above.set_title(label)
            above.plot(episode.time, episode.speed, color=BLUE, label="speed")
            _draw_knowledge(below, episode)
            out = episode.outage
            if out is not None and np.nansum(out) > 0:
                failed = episode.time[np.nan_to_num(out) > 0]
                for axes in (above, below):
                    axes.axvspan(
                        *(failed[0], failed[-1]), color=GREY, alpha=0.2, linewidth=0,
                        label="no GNSS" if axes is above else "_",
                    )  # fmt: skip
            _mark_end(below, episode.time, episode.speed, "end")
        grid[0, 0].set_ylabel("[m/s]")
        grid[1, 0].set_ylabel("[m]")
        grid[0, 0].set_ylim(bottom=0.0)
        last = max(float(e.time[np.isfinite(e.speed)][-1]) for e in episodes.values())
        grid[0, 0].set_xlim(0.0, last)
        for row in grid:
            row[0].yaxis.set_tick_params(labelleft=True)
            handles, labels = row[0].get_legend_handles_labels()
            row[-1].legend(handles, labels, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def _draw_angles(axes: Any, episode: Glance, half_view: float) -> None:
    """Draw the direction of body x and the desired heading, relative to the features."""
    span = math.degrees(half_view)
    axes.axhspan(-span, span, color=ORANGE, alpha=0.25, linewidth=0, label="markers in view")
    wanted = _unbroken(np.degrees(episode.off_wall - episode.off_reward))
    axes.plot(episode.time, wanted, color=GREY, linestyle=(0, (4, 3)), label="rewarded")
    axes.plot(episode.time, _unbroken(np.degrees(episode.off_wall)), color=BLUE, label="body x")
    axes.set_ylim(-180.0, 180.0)
    axes.set_yticks([-180, -90, 0, 90, 180])


def _draw_errors(axes: Any, episode: Glance) -> None:
    """Draw the filter's standard deviation, the estimation error, and the tracking error."""
    _draw_knowledge(axes, episode)
    axes.plot(episode.time, episode.position_error, color=VERMILLION, label="error of the position")
    _mark_end(axes, episode.time, episode.position_error, "crash")


def _draw_knowledge(axes: Any, episode: Glance | Pace) -> None:
    """Draw the filter's standard deviation and the estimation error."""
    axes.plot(episode.time, 3.0 * episode.sigma, color=PALE, label="_")
    axes.fill_between(
        episode.time, 1e-3, 3.0 * episode.sigma, color=GREEN, alpha=0.2, linewidth=0,
        label="filter: 3 sigma",
    )  # fmt: skip
    axes.plot(episode.time, episode.estimation_error, color=GREEN, label="error of the estimate")
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

"""Figures of replayed logs and of calibrations: estimates, innovations, numbers."""

import math
from typing import Any

import numpy as np

from quad_gym.analysis.metrics import chi_square_quantile
from quad_gym.analysis.plots import BLUE, GREEN, GREY, ORANGE, PALE, VERMILLION, house_style, panels
from quad_gym.logs.calibrating.calibration import Calibration
from quad_gym.logs.replaying.results import InnovationSeries, Replay, by_sensor
from quad_gym.params.sensor_table import AID_PARAMS
from quad_gym.rotations import dcm_to_euler, quaternion_to_dcm

_MAX_POINTS = 4000  #: points of a curve
_AXES = (BLUE, ORANGE, GREEN)
_SENSORS = {
    "gnss_position": "positions",
    "gnss_velocity": "velocities",
    "gnss_baseline": "baselines",
    "features": "features",
    **{name: name.replace("_", " ") for name in AID_PARAMS},
}


def draw_states(axes: Any, result: Replay, name: str) -> None:
    """Draw "position", "velocity" or "attitude", with bands of two standard deviations."""
    some = slice(None, None, 1 + len(result) // _MAX_POINTS)
    time, sigmas = result.time[some], result.sigma[some]
    first, unit = {"position": (0, "m"), "velocity": (3, "m/s"), "attitude": (6, "deg")}[name]
    labels, scale = ("east", "north", "up"), 1.0
    if name == "attitude":
        values = dcm_to_euler(quaternion_to_dcm(result.quaternion[some]))
        labels, scale = ("roll", "pitch", "yaw"), 180.0 / np.pi
        values[1:][np.abs(np.diff(values, axis=0)) > np.pi] = np.nan  # no line across the figure
    else:
        values = getattr(result, name)[some]
    for i, (label, color) in enumerate(zip(labels, _AXES, strict=True)):
        curve, sigma = scale * values[:, i], scale * sigmas[:, first + i]
        band = (curve - 2.0 * sigma, curve + 2.0 * sigma)
        axes.fill_between(time, *band, color=color, alpha=0.2, linewidth=0.0)
        axes.plot(time, curve, color=color, linewidth=1.1, label=label)
    low, high = scale * np.nanmin(values), scale * np.nanmax(values)
    margin = 0.1 * max(high - low, 1e-3)
    axes.set_ylim(low - margin, high + margin)
    axes.set_title(f"{name} [{unit}], with two standard deviations")
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.2, ncols=3)


def draw_nis(axes: Any, measured: InnovationSeries, title: str) -> None:
    """Draw the NIS per degree of freedom (DOF), rejected measurements, and the 99 % quantile."""
    freedoms = measured.innovation.shape[1]
    bound = chi_square_quantile(freedoms, 0.99) / freedoms
    nis, known = measured.nis / freedoms, np.isfinite(measured.nis)
    taken, left_out = known & ~measured.gated, known & measured.gated
    top = 1.1 * max(1.3 * bound, nis[taken].max(initial=0.0))
    axes.axhspan(0.0, bound, color=PALE, linewidth=0.0)
    dots: dict[str, Any] = {"linestyle": "none", "color": BLUE, "marker": ".", "markersize": 2.5}
    axes.plot(measured.time[taken], nis[taken], **dots)
    # values beyond the limits are drawn at the edge
    high = np.minimum(nis[left_out], 0.97 * top)
    axes.plot(measured.time[left_out], high, "x", color=VERMILLION, markersize=5.0)
    mean = f"NIS/DOF {nis[known].mean():.2f}, " if known.any() else ""
    axes.set_title(f"{title}: {mean}{left_out.sum()} rejected")
    axes.set_ylim(0.0, top)


@house_style()
def replay_figure(result: Replay, title: str) -> Any:
    """Make a figure of position, velocity and attitude of a replay, and the NIS of each sensor."""
    from matplotlib.figure import Figure

    kinds = sensors_of(result)
    rows = 3 + -(-len(kinds) // 2)
    figure = Figure(figsize=(9.0, 0.6 + 1.9 * rows), layout="constrained")
    figure.suptitle(title, x=0.01, ha="left", fontsize=11.0)
    grid = figure.add_gridspec(rows, 2)
    for row, name in enumerate(("position", "velocity", "attitude")):
        draw_states(figure.add_subplot(grid[row, :]), result, name)
    for k, (name, measured) in enumerate(kinds.items()):
        draw_nis(figure.add_subplot(grid[3 + k // 2, k % 2]), measured, _SENSORS[name])
    for axes in figure.axes:
        axes.set_xlim(result.time[0], result.time[-1])
    for axes in figure.axes[-min(2, len(kinds)) :]:
        axes.set_xlabel("time [s]")
    return figure


def sensors_of(result: Replay) -> dict[str, InnovationSeries]:
    """Innovations by sensor; the innovations of all features are combined."""
    kinds = by_sensor(result.measured)
    return {name: kinds[name] for name in _SENSORS if name in kinds}


@house_style()
def numbers_figure(calibration: Calibration) -> Any:
    """Make a figure of the numbers with their intervals, in units of their prior values."""
    scaled = [found for found in calibration.numbers if found.number.positive]
    title = "parameters relative to the initial suite, with 95 % intervals"
    figure, ((axes,),) = panels(1, 1, (8.0, 0.8 + 0.28 * len(scaled)), title)
    for row, found in enumerate(reversed(scaled)):
        low, value, high = (n / found.prior for n in (found.low, found.value, found.high))
        color = BLUE if found.determined else GREY
        axes.plot([low, high], [row, row], color=color, linewidth=2.0)
        axes.plot([value], [row], "o", color=color, markersize=5.0)
    axes.axvline(1.0, color=ORANGE, linewidth=1.0)
    axes.set_xscale("log")
    axes.set_yticks(range(len(scaled)), [found.number.name for found in reversed(scaled)])
    return figure


@house_style()
def innovations_figure(calibration: Calibration) -> Any:
    """Make a figure of the NIS of each sensor before and after."""
    validations = {"before": calibration.before, "after": calibration.after}
    names = list(sensors_of(calibration.after.replay))
    figure, grid = panels(len(names), 2, (9.0, 0.6 + 1.9 * len(names)), sharex="col")
    for column, (label, validation) in zip(grid.T, validations.items(), strict=True):
        kinds = sensors_of(validation.replay)
        for axes, name in zip(column, names, strict=True):
            if name in kinds:
                draw_nis(axes, kinds[name], f"{name.replace('_', ' ')}, {label}")
            if math.isfinite(calibration.split):
                axes.axvline(calibration.split, color=GREY, linewidth=1.0, linestyle=":")
        column[0].set_xlim(validation.replay.time[0], validation.replay.time[-1])
        column[-1].set_xlabel("time [s]; dotted: start of the validation part")
    return figure

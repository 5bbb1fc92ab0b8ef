"""Figures of a calibration: numbers before and after, and innovations of the validation part."""

import math
from typing import Any

from quad_gym.analysis.plots import BLUE, GREY, ORANGE, house_style, panels
from quad_gym.analysis.replay_plots import draw_nis, sensors_of
from quad_gym.estimation.calibration import Calibration


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

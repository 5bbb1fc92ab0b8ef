"""Figures of a calibration: numbers before and after, and innovations of the validation part."""

from typing import Any

from quad_gym.analysis.plots import BLUE, GREY, ORANGE, require_matplotlib
from quad_gym.analysis.replay_plots import draw_nis, sensors_of
from quad_gym.estimation.calibration import Calibration

BEFORE, AFTER = ORANGE, BLUE


def numbers_figure(calibration: Calibration) -> Any:
    """Make a figure of the numbers with their intervals, in units of their prior values.

    Raises:
        ImportError: If matplotlib is not installed.
    """
    require_matplotlib()
    from matplotlib.figure import Figure

    scaled = [found for found in calibration.numbers if found.number.positive]
    figure = Figure(figsize=(8.0, 0.8 + 0.28 * len(scaled)), layout="constrained")
    axes = figure.add_subplot()
    for row, found in enumerate(reversed(scaled)):
        low, value, high = (n / found.prior for n in (found.low, found.value, found.high))
        color = AFTER if found.determined else GREY
        axes.plot([low, high], [row, row], color=color, linewidth=2.0)
        axes.plot([value], [row], "o", color=color, markersize=5.0)
    axes.axvline(1.0, color=BEFORE, linewidth=1.0)
    axes.set_xscale("log")
    axes.set_yticks(range(len(scaled)), [found.number.name for found in reversed(scaled)])
    axes.set_title("numbers relative to the suite before, with 95 % intervals", loc="left")
    return figure


def innovations_figure(calibration: Calibration) -> Any:
    """Make a figure of the NIS of each sensor before and after.

    Raises:
        ImportError: If matplotlib is not installed.
    """
    require_matplotlib()
    from matplotlib.figure import Figure

    columns = [("before", calibration.before), ("after", calibration.after)]
    names = list(sensors_of(calibration.after.replay))
    figure = Figure(figsize=(9.0, 0.6 + 1.9 * len(names)), layout="constrained")
    grid = figure.add_gridspec(len(names), 2)
    for column, (label, validation) in enumerate(columns):
        kinds = sensors_of(validation.replay)
        for row, name in enumerate(names):
            axes = figure.add_subplot(grid[row, column])
            if name in kinds:
                draw_nis(axes, kinds[name], f"{name.replace('_', ' ')}, {label}")
            axes.axvline(calibration.split, color=GREY, linewidth=1.0, linestyle=":")
            axes.set_xlim(validation.replay.time[0], validation.replay.time[-1])
            axes.tick_params(colors=GREY)
            if row == len(names) - 1:
                axes.set_xlabel("time [s]; dotted: start of the validation part")
    return figure

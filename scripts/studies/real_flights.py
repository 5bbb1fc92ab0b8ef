"""Predict logged flights of a Crazyflie in closed loop, and compare with the logs.

    python -m scripts.studies.real_flights LOGS... --sensors mine.toml --fitted 5

Logs are tables of NanoBench (arXiv:2603.09908). Thrust and drag are fitted to the first ones. A
simulated vehicle with the Crazyflie's PID and filter then flies the logged setpoints of all of
them, with the logged voltage of the battery, the sensors of the suite, and thrusts of each rotor as
they vary between the fitted flights. Prints a table, and writes it with a figure. Intervals hold 90
% of the draws, widened by the errors of prediction in the fitted flights.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import spearmanr, t
from tyro.conf import Positional

from quad_gym import sensor_suite, vehicle_params
from quad_gym.analysis import plots
from quad_gym.analysis.reports import (
    columns_of,
    require_writable,
    text_table,
    write_csv,
    write_json,
)
from quad_gym.commands import options
from scripts.studies.closed_loop import Flown, LoggedFlight, fit_body, fly, read_flight, rms

FACTOR = 1.3  #: ratio of predicted and logged errors that counts as right


@dataclass(frozen=True)
class RealFlightsArgs:
    """Options of the study."""

    logs: Positional[tuple[Path, ...]]
    """tables of flights"""
    fitted: int = 5
    """number of logs, from the first, to which thrust and drag are fitted"""
    sensors: str = "mocap"
    """suite, by name or file (.toml)"""
    draws: int = 16
    """simulated flights of each log"""
    seed: int = 0
    """seed of the first simulated flight"""
    onboard: bool = True
    """fly on the estimate of the Crazyflie's own filter; otherwise of the suite's filter"""
    output: Path = Path("results/real_flights")
    """folder"""


def row_of(log: LoggedFlight, flown: Flown, fitted: bool) -> dict[str, Any]:
    """Return the row of a flight in the table; errors are root mean squares [m]."""
    rows = log.judged
    errors = rms((log.setpoint - flown.position)[:, rows])
    low, middle, high = np.nanpercentile(errors, [5.0, 50.0, 95.0])
    return {
        "flight": log.name,
        "fitted": fitted,
        "crashed": log.crashed,
        "clock": log.clock,
        "logged": float(rms((log.setpoint - log.position)[rows])),
        "predicted": float(middle),
        "low": float(low),
        "high": float(high),
        "crashes": int(np.isnan(flown.position[:, :-200]).any(axis=(1, 2)).sum()),
        "command": float(log.commands[rows].mean()),
        "predicted_command": float(np.nanmean(flown.commands[:, rows])),
        "estimation": float(rms((log.estimate - log.position)[rows])),
        "predicted_estimation": float(
            np.nanmedian(rms((flown.estimate - flown.position)[:, rows]))
        ),
    }


def widen(table: list[dict[str, Any]]) -> None:
    """Widen the intervals by the errors of the fitted flights, as 90 % of Student's t."""
    fitted = [row for row in table if row["fitted"]]
    errors = [np.log(row["predicted"] / row["logged"]) for row in fitted]
    factor = np.exp(t.ppf(0.95, len(fitted)) * np.sqrt(np.mean(np.square(errors))))
    for row in table:
        row["low"], row["high"] = row["low"] / factor, row["high"] * factor


def summary_of(table: list[dict[str, Any]]) -> dict[str, float]:
    """Return how well errors are predicted."""
    logged, predicted = (np.array([row[key] for row in table]) for key in ("logged", "predicted"))
    within = np.abs(np.log(predicted / logged)) < np.log(FACTOR)
    return {
        "flights": len(table),
        "within_factor": float(within.mean()),
        "rank_correlation": float(spearmanr(logged, predicted)[0]),
        "in_interval": float(np.mean([row["low"] < row["logged"] < row["high"] for row in table])),
    }


@plots.house_style()
def prediction_figure(table: list[dict[str, Any]]) -> Any:
    """Figure of predicted over logged tracking errors, with intervals and the factor."""
    figure, ((axes,),) = plots.panels(1, 1, (5.2, 4.6))
    ends = np.array([0.2, 1.0])
    axes.plot(ends, ends, color=plots.INK, linewidth=0.8)
    band: dict[str, Any] = {"color": plots.PALE, "zorder": 0, "linewidth": 0}
    axes.fill_between(ends, ends / FACTOR, ends * FACTOR, label=f"a factor of {FACTOR}", **band)
    for kind, color in ((True, plots.GREY), (False, plots.BLUE)):
        some = [row for row in table if row["fitted"] == kind]
        x, y, low, high = (
            np.array([row[key] for row in some]) for key in ("logged", "predicted", "low", "high")
        )
        label = "used for the fit" if kind else "not used for the fit"
        style: dict[str, Any] = {
            "fmt": "o",
            "markersize": 4.5,
            "color": color,
            "label": label,
            "elinewidth": 1.0,
        }
        axes.errorbar(x, y, yerr=[y - low, high - y], **style)
    for row in table:
        if row["crashed"]:
            place = row["logged"], row["predicted"]
            axes.annotate("crashes", place, (5, -10), textcoords="offset points")
    axes.set(xscale="log", yscale="log", xlim=ends, ylim=(0.2, 1.5))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_ticks([0.2, 0.3, 0.5, 1.0])
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("")
    axes.set_xlim(ends)
    axes.set(xlabel="logged tracking error [m]", ylabel="predicted tracking error [m]")
    axes.legend(loc="lower right")
    return figure


def main(args: RealFlightsArgs) -> None:
    """Fit, fly, compare."""
    with options.usage_errors():
        plots.require_matplotlib()
        options.require_at_least(args, fitted=2, draws=1, seed=0)
        require_writable("--output", args.output)
        logs, suite = [read_flight(file) for file in args.logs], sensor_suite(args.sensors)
        body = fit_body(logs[: args.fitted], vehicle_params("crazyflie"))
    print(f"Thrust carries the weight at {body.vehicle.hover_voltage:.3f} V.")
    results: dict[str, Any] = {}
    common: dict[str, Any] = {"draws": args.draws, "seed": args.seed, "onboard": args.onboard}
    flown = fly(logs, suite, *body, **common)
    pairs = enumerate(zip(logs, flown, strict=True))
    table = [row_of(log, one, k < args.fitted) for k, (log, one) in pairs]
    widen(table)
    for name, some in (("all", table), ("others", table[args.fitted :])):
        if len(some) > 2:
            results[name] = summary_of(some)
            print(name, *(f"{key} {value:.3g}" for key, value in results[name].items()), sep="; ")
    cells = [
        [f"{value:.3f}" if isinstance(value, float) else str(value) for value in row.values()]
        for row in table
    ]
    print(text_table({"": list(table[0])}, cells))
    write_csv(args.output / "flights.csv", columns_of(table))
    write_json(args.output / "results.json", {**results, "configuration": args, "body": body})
    plots.save_figure(prediction_figure(table), args.output / "prediction")


if __name__ == "__main__":
    program = "python -m scripts.studies.real_flights"
    with options.quiet_end():
        main(options.parse(RealFlightsArgs, prog=program, description=__doc__))

"""Filters on the same flights: errors, consistency, time, and control by their estimates.

Each filter gets the measurements of the same random trajectories, flown on the true state; errors
count from `SETTLE` on. Then the circle is flown by PD control on each estimate, without faults and
with preset ones: a flight is lost if it crashes or its estimate is ever farther than `ASTRAY` from
the truth.
"""

import math
import sys
import time
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from baselines.pd import PDPolicy
from quad_gym.analysis.consistency import ASTRAY, PARTS, InnovationRecorder, endless, flight_errors
from quad_gym.analysis.metrics import in_brackets, mean_interval, nees, rate_over_trainings
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.commands import benchmark
from quad_gym.envs.config import TASK_DEFAULTS
from quad_gym.evaluation import roll_out
from quad_gym.faults import possible
from quad_gym.params.suites import sensor_suite
from quad_gym.records import Source
from scripts.benchmarks.posterior_bound import posterior_bound
from scripts.benchmarks.scope import Scope
from scripts.consistency.recovered import MOTION

BUILT_IN = ("ukf", "ekf")
FAULTS = ("none", "gnss_outage", "gnss_outliers", "wrong_associations")
DURATION, SETTLE, EVERY = 10.0, 5.0, 0.1
"""Length of flights, time from which errors count, and time between two evaluations [s]."""
QUANTITIES = ("position", "velocity", "attitude")
HEADINGS = ("none", "GNSS outage", "GNSS outliers", "wrong features")
"""Headings of the columns of `FAULTS`."""

Floats = NDArray[np.float64]


def time_filters(scope: Scope) -> list[benchmark.Row]:
    """Fly every filter with every suite, and compute the bound of each suite."""
    rows = []
    for suite in scope.suites:
        bound = posterior_bound(
            flights_on_truth(suite, "ukf", scope),
            seeds=range(scope.batch),
            duration=length_of(scope),
            settle=SETTLE,
            every=EVERY,
        )
        rows.append(EMPTY | {"suite": suite, "name": "bound"})
        rows[-1] |= {f"{part}_rmse": [bound[part]] for part in QUANTITIES}
        for estimator in (*BUILT_IN, *scope.estimators):
            began = time.perf_counter()
            row = EMPTY | {"suite": suite, "name": name_of(estimator)}
            try:
                row |= on_truth(suite, estimator, scope) | on_estimate(suite, estimator, scope)
                for part in QUANTITIES:
                    row[f"{part}_ratio"] = row[f"{part}_rmse"][0] / bound[part]
            except ValueError as error:  # an estimate or a covariance that is invalid
                row["failed"] = str(error)
            rows.append(row)
            seconds = time.perf_counter() - began
            print(f"  {suite}, {row['name']}: {seconds:.0f} s", file=sys.stderr, flush=True)
    return rows


EMPTY: benchmark.Row = {
    **{f"{part}_rmse": None for part in QUANTITIES},
    **{f"{part}_ratio": None for part in QUANTITIES},
    **dict.fromkeys(("nees", "nis", "seconds", "tracking", "failed")),
    "lost": {},
}
"""Quantities of a filter and suite. Lists are a mean and the ends of its 95 % interval."""


def name_of(estimator: str) -> str:
    """Name of a filter in tables."""
    return estimator.upper() if estimator in BUILT_IN else estimator.rpartition(":")[2]


def length_of(scope: Scope) -> float:
    """Length of the flights on the true state [s]."""
    return SETTLE + 2.0 * EVERY if scope.quick else DURATION


def flights_on_truth(suite: str, estimator: str, scope: Scope) -> FlightBatch:
    """Random trajectories flown on the true state, with a filter that observes them."""
    built_in, sensors = estimator in BUILT_IN, sensor_suite(suite)
    if built_in:
        sensors = sensors.replace(estimator=sensors.estimator.replace(kind=estimator))
    return FlightBatch(
        scope.batch,
        sensors=sensors,
        task=endless(TASK_DEFAULTS["random_trajectory"]),
        gains="tuned",
        source=Source.TRUTH,
        run_filter=True,
        innovations=built_in,
        threads=1,
        estimator=None if built_in else estimator,
    )


def on_truth(suite: str, estimator: str, scope: Scope) -> benchmark.Row:
    """Errors, consistency and time of a filter."""
    batch, stop = flights_on_truth(suite, estimator, scope), length_of(scope)
    batch.reset(seeds=range(scope.batch))
    dt, stride = batch.sensors.imu.dt, round(EVERY / batch.sensors.imu.dt)
    innovations = InnovationRecorder(batch, [SETTLE, stop]) if batch.innovations else None
    errors, squares, seconds = [], [], 0.0
    for tick in range(1, round(stop / dt) + 1):
        began = time.perf_counter()
        batch.step()
        seconds += time.perf_counter() - began
        if tick * dt <= SETTLE:
            continue
        if innovations is not None:
            innovations.add(batch, tick * dt)
        if tick % stride == 0:
            error, P = flight_errors(batch), batch.covariance()
            errors.append(error)
            squares.append(nees(error[:, MOTION], P[:, MOTION, MOTION]) / MOTION.stop)
    row: benchmark.Row = {"seconds": seconds / tick / scope.batch}
    mean_squares = np.square(errors).mean(axis=0)  # over time
    for part in QUANTITIES:
        found = with_interval(mean_squares[:, PARTS[part]].mean(axis=1))
        row[f"{part}_rmse"] = [math.sqrt(max(value, 0.0)) for value in found]
    consistency = np.mean(squares, axis=0)
    if np.isfinite(consistency).all():
        row["nees"] = with_interval(consistency)
    if innovations is not None:
        ratios = [part.overall / part.dimension for part in innovations.nis().values()]
        row["nis"] = float(np.mean(ratios))
    return row


def on_estimate(suite: str, estimator: str, scope: Scope) -> benchmark.Row:
    """Circles flown on the estimate: the tracking error, and the shares of lost flights."""
    row: benchmark.Row = {"lost": {}}
    for fault in FAULTS:
        if not possible(fault, sensor_suite(suite)):
            continue
        env = gymnasium.make_vec(
            "QuadGym/Circle-v0",
            num_envs=scope.batch,
            sensors=suite,
            estimator=estimator,
            faults=None if fault == "none" else fault,
            threads=1,
            max_episode_steps=10 if scope.quick else None,
        )
        farthest = np.zeros(scope.batch)

        def watch(step: int, batch: Any, flying: Any, farthest: Floats = farthest) -> None:
            farthest[flying] = np.maximum(farthest, batch.result("estimation_error"))[flying]

        episodes = roll_out(PDPolicy(env, gains="tuned"), env, watch=watch)
        lost = episodes.crashed | ~(farthest < ASTRAY)
        row["lost"][fault] = list(rate_over_trainings([lost.mean()], scope.batch))
        if fault == "none":
            row["tracking"] = with_interval(episodes.mean_error)
    return row


def with_interval(values: Floats) -> list[float]:
    """Mean and the ends of its 95 % interval."""
    return [float(values.mean()), *mean_interval(values)]


def _mean(key: str, form: str, scale: float = 1.0) -> benchmark.CellText:
    """Column of a mean, with its interval where there is one."""

    def cell(row: benchmark.Row) -> str:
        value = row[key]
        return "-" if value is None else in_brackets(value[0], value[1:] or None, form, scale)

    return cell


def _lost(fault: str) -> benchmark.CellText:
    """Column of the share of lost flights."""
    return lambda row: f"{row['lost'][fault][0]:.0%}" if fault in row["lost"] else "-"


def _failures(rows: list[benchmark.Row]) -> str:
    """Sentences about filters that failed."""
    failed = [row for row in rows if row["failed"]]
    return "".join(f"\n{row['suite']}, {row['name']}: {row['failed']}" for row in failed)


SECTION = benchmark.Section(
    time_filters,
    {
        "": {"suite": benchmark.column("suite"), "filter": benchmark.NAME},
        "RMSE after 5 s": {
            "position [mm]": _mean("position_rmse", ".1f", 1e3),
            "velocity [mm/s]": _mean("velocity_rmse", ".1f", 1e3),
            "attitude [mrad]": _mean("attitude_rmse", ".2f", 1e3),
        },
        "over the bound": {part: benchmark.column(f"{part}_ratio", ".2f") for part in QUANTITIES},
        "per degree of freedom": {
            "NEES": _mean("nees", ".2f"),
            "NIS": benchmark.column("nis", ".2f"),
        },
        "a tick": {"us": benchmark.column("seconds", ",.1f", 1e6)},
        "circle": {"error [mm]": _mean("tracking", ".0f", 1e3)},
        "lost with fault": {
            heading: _lost(fault) for heading, fault in zip(HEADINGS, FAULTS, strict=True)
        },
    },
    _failures,
)

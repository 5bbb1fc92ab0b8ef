"""The filter's part of the benchmark: a cycle in lanes, alone, in plain NumPy and in filterpy."""

import sys
from typing import Any

import numpy as np

import quad_gym
from quad_gym.analysis.reports import text_table
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.commands.benchmark.peers import (
    Measured,
    alone_cycles,
    filterpy_cycles,
    plain_cycles,
)
from quad_gym.commands.benchmark.stages import Staged, hovering
from quad_gym.commands.benchmark.timing import Effort, Row, Timing, measure, percent, report
from quad_gym.kernels.compiling import Stage
from quad_gym.records import FEATURE_SLICE, FLIGHT_BLOCK, WIDTH, aligned_zeros


def record_one(batch: FlightBatch, flight: int, ticks: int) -> list[Measured]:
    """What one flight measures in the coming ticks."""
    recorded = []
    for _ in range(ticks):
        names = ("gyro", "accel", "gnss_position", "gnss_baseline", "pixels")
        gyro, accel, position, baseline, pixels = (batch.record(name)[flight] for name in names)
        features = int(batch.record("block_valid")[flight, FEATURE_SLICE].sum())
        recorded.append(Measured(gyro, accel, position, baseline, pixels[:features]))
        batch.step()
    return recorded


def time_filter(count: int, effort: Effort, recorded_ticks: int) -> list[Row]:
    """Cycles of update and prediction on one core, in lanes, alone and elsewhere.

    Args:
        count: Flights in a batch.
        effort: How long to measure.
        recorded_ticks: Length of the flight that a filter alone and those elsewhere estimate.
    """
    rows: list[Row] = []
    with_camera = quad_gym.sensor_suite("lab")
    for measurements, sensors in ((6, with_camera.replace(camera=None)), (12, with_camera)):
        features = (measurements - 6) // 3
        batch = hovering(count, sensors=sensors)
        seen = batch.record("block_valid")[:, FEATURE_SLICE].sum(axis=1)
        seeing = np.flatnonzero(seen == features)
        blocks = aligned_zeros(count // WIDTH, FLIGHT_BLOCK)
        for name in FLIGHT_BLOCK.names or ():  # the flights that see all features, over and over
            values = batch.record(name)[np.resize(seeing, count)]
            lanes = values.reshape(-1, WIDTH, *values.shape[1:])
            blocks[name] = np.moveaxis(lanes, 1, -1)
        update, predict = Staged(batch, Stage.UPDATE, features), Staged(batch, Stage.PREDICT)

        def in_lanes(blocks: Any = blocks, update: Any = update, predict: Any = predict) -> None:
            update(blocks)
            predict(blocks)

        def add(name: str, timing: Timing, n: int = measurements) -> None:
            what = {"kind": name, "measurements": n, "suite": "lab"}
            rows.append(report(f"{name}, {n} measurements, lab", timing, **what))

        start = blocks.copy()

        def again(blocks: Any = blocks, start: Any = start) -> None:
            blocks[:] = start

        add("lanes", measure(in_lanes, effort, again).per(count))
        recorded = record_one(batch, int(seeing[0]), recorded_ticks)
        recorded = [now for now in recorded if len(now.pixels) == features]
        for name, make in (
            ("UnscentedKalmanFilter", alone_cycles),
            ("plain NumPy", plain_cycles),
            ("filterpy", filterpy_cycles),
        ):
            run = make(sensors, recorded)
            if run is None:
                print(f"  {name}: not installed", file=sys.stderr)
            else:
                add(name, measure(run, effort).per(len(recorded)))
    for row in rows:
        lanes_row = next(
            r for r in rows if r["kind"] == "lanes" and r["measurements"] == row["measurements"]
        )
        row["times_lanes"] = row["seconds"] / lanes_row["seconds"]
    return rows


def filter_table(rows: list[Row]) -> str:
    """The filter's figures."""
    cells = [
        (r["name"], f"{1e6 * r['seconds']:,.2f}", percent(r["spread"]), f"{r['times_lanes']:,.1f}")
        for r in rows
    ]
    return text_table({"UKF cycle, one core": ["filter", "us", "spread", "x lanes"]}, cells)

"""Cycles of the filter: in lanes, for one vehicle, in plain NumPy, and in filterpy."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

import quad_gym
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.commands import benchmark
from quad_gym.commands.benchmark import hovering
from quad_gym.kernels.stages import Stage
from quad_gym.records import FEATURE_SLICE, WIDTH, aligned_zeros
from quad_gym.rotations import quaternion_to_dcm
from scripts.benchmarks.peers import Estimate, MeasuredTick, peers
from scripts.benchmarks.scope import Scope
from scripts.benchmarks.stages import Staged


def record_one(batch: FlightBatch, flight: int, ticks: int) -> list[MeasuredTick]:
    """Measurements of one flight in the next ticks."""
    recorded = []
    for _ in range(ticks):
        names = ("gyro", "accel", "gnss_position", "gnss_baseline", "pixels")
        gyro, accel, position, baseline, pixels = (batch.record(name)[flight] for name in names)
        features = int(batch.record("block_valid")[flight, FEATURE_SLICE].sum())
        truth = Estimate(batch.record("r")[flight], quaternion_to_dcm(batch.record("q")[flight]))
        recorded.append(MeasuredTick(gyro, accel, position, baseline, pixels[:features], truth))
        batch.step()
    return recorded


def repeated(batch: FlightBatch, flights: NDArray[np.intp], count: int) -> NDArray[Any]:
    """Blocks of `count` flights: the given ones of a batch, again and again."""
    blocks = aligned_zeros(count // WIDTH, batch._room.dtype)
    for name in blocks.dtype.names or ():
        values = batch.record(name)[np.resize(flights, count)]
        blocks[name] = np.moveaxis(values.reshape(-1, WIDTH, *values.shape[1:]), 1, -1)
    return blocks


def time_filter(scope: Scope) -> list[benchmark.Row]:
    """Time cycles of update and prediction on one core.

    A run of a filter for one vehicle starts it, too. Making the filter is not timed.
    """
    rows: list[benchmark.Row] = []
    count, effort, recorded_ticks = scope.batch, scope.effort, 5 if scope.quick else 40
    with_camera = quad_gym.sensor_suite("lab")
    for measurements, sensors in ((6, with_camera.replace(camera=None)), (12, with_camera)):
        features = (measurements - 6) // 3
        batch = hovering(count, sensors=sensors)
        seen = batch.record("block_valid")[:, FEATURE_SLICE].sum(axis=1)
        seeing = np.flatnonzero(seen == features)
        blocks = repeated(batch, seeing, count)
        update, predict = Staged(batch, Stage.UPDATE), Staged(batch, Stage.PREDICT)

        def in_lanes(blocks: Any = blocks, update: Any = update, predict: Any = predict) -> None:
            update(blocks)
            predict(blocks)

        def add(name: str, timed: benchmark.Timing, n: int = measurements) -> None:
            what = {"kind": name, "measurements": n, "suite": "lab"}
            rows.append(benchmark.report(f"{name}, {n} measurements, lab", timed, **what))

        start = blocks.copy()

        def again(blocks: Any = blocks, start: Any = start) -> None:
            blocks[:] = start

        add("lanes", benchmark.measure(in_lanes, effort, again).per(count))
        recorded = record_one(batch, int(seeing[0]), recorded_ticks)
        recorded = [now for now in recorded if len(now.pixels) == features]
        for name, run in peers(sensors, recorded).items():
            add(name, benchmark.measure(run, effort).per(len(recorded)))
    of_lanes = {row["measurements"]: row["seconds"] for row in rows if row["kind"] == "lanes"}
    for row in rows:
        row["times_lanes"] = row["seconds"] / of_lanes[row["measurements"]]
    return rows


SECTION = benchmark.Section(
    time_filter,
    {
        "UKF cycle, one core": {
            "filter": benchmark.NAME,
            "us": benchmark.column("seconds", ",.2f", 1e6),
            "spread": benchmark.SPREAD,
            "x lanes": benchmark.column("times_lanes", ",.1f"),
        }
    },
)

"""Flights of a suite in the precision of this process: `python -m tests.precision_flights`.

It prints one JSON object: the precision, the mean NEES by part and the mean squared innovations by
sensor, failures, and a digest of the last states. Control acts on the truth, so that both
precisions fly the same trajectories with the same noise, up to rounding.
"""

import hashlib
import json
import sys

import numpy as np

from quad_gym import sensor_suite
from quad_gym.analysis.consistency import InnovationRecorder, NeesRecorder, endless
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.envs.config import TASK_DEFAULTS
from quad_gym.records import PRECISION, Source

_EVERY = 20  #: ticks between two recorded estimates


def measured(suite, kind, flights, seconds):
    """Fly random trajectories from a cold start; return the numbers that the module prints."""
    sensors = sensor_suite(suite)
    sensors = sensors.replace(estimator=sensors.estimator.replace(kind=kind))
    batch = FlightBatch(
        flights,
        sensors=sensors,
        task=endless(TASK_DEFAULTS["random_trajectory"]),
        gains="tuned",
        filter_start="cold",
        source=Source.TRUTH,
        run_filter=True,
        innovations=True,
        threads=1,
    )
    batch.reset(seeds=range(flights))
    dt = sensors.imu.dt
    steps = round(seconds / dt)
    squares = NeesRecorder()
    innovations = InnovationRecorder(batch, dt * _EVERY * np.arange(steps // _EVERY + 1), 0.0)
    for k in range(1, steps + 1):
        batch.step()
        innovations.add(batch, k * dt)
        if k % _EVERY == 0:
            squares.add(batch, k * dt)
    digest = hashlib.sha256()
    for name in ("r", "v", "r_hat", "v_hat", "R_hat", "P", "filter_status"):
        digest.update(batch.record(name).tobytes())
    return {
        "precision": PRECISION,
        "nees": {name: float(part.overall) for name, part in squares.nees().items()},
        "nis": {name: float(part.overall) for name, part in innovations.nis().items()},
        "failures": int(batch.record("update_failures").sum()),
        "failed_predictions": int(batch.record("prediction_failures").sum()),
        "r_hat": batch.record("r_hat").tolist(),
        "digest": digest.hexdigest(),
    }


if __name__ == "__main__":
    name, kind, flights, seconds = sys.argv[1:]
    print(json.dumps(measured(name, kind, int(flights), float(seconds))))

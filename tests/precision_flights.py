"""Flights in the precision of this process: `python -m tests.precision_flights FLIGHTS SECONDS`.

It prints one JSON object: for each case the mean NEES by part and the mean squared innovations by
sensor, failures, and a digest of the last states. Control acts on the truth, so that both
precisions fly the same trajectories with the same noise, up to rounding.
"""

import hashlib
import json
import sys

import numpy as np

from quad_gym import GroundParams, WorldParams, sensor_suite, vehicle_params
from quad_gym.analysis.consistency import InnovationRecorder, NeesRecorder, endless
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.envs.config import TASK_DEFAULTS
from quad_gym.faults import AccelBiasStep, GyroBiasStep
from quad_gym.params.suites import ALL_SUITES
from quad_gym.records import PRECISION, Source

_EVERY = 20  #: ticks between two recorded estimates


def cases():
    """Return arguments of batches by name: each suite with both filters, starts and faults."""
    found = {
        f"{suite}, {kind}": (suite, kind, {}) for suite in ALL_SUITES for kind in ("ukf", "ekf")
    }
    for kind in ("ukf", "ekf"):  # in front of its wall, as it has no other sensor
        found[f"one_wall, {kind}"] = ("one_wall", kind, {"start": "hover"})
    for suite in ("rtk", "consumer", "crazyflie"):
        found[f"{suite}, warm"] = (suite, "ukf", {"filter_start": "warm"})
    found["consumer, from the ground"] = ("consumer", "ukf", {"start": "ground"})
    on_feet = {"start": "ground", "world": WorldParams(ground=GroundParams())}
    found["rtk, on feet"] = ("rtk", "ukf", on_feet)
    for fault in ("gnss_outage", "gnss_jump", "gnss_outliers", "imu_bias_step"):
        found[f"rtk, {fault}"] = ("rtk", "ukf", {"faults": fault})
    for suite, fault in (("rtk", GyroBiasStep(size=0.2)), ("consumer", AccelBiasStep(size=3.0))):
        found[f"{suite}, resets"] = (suite, "ukf", {"faults": fault.replace(start=5.0)})
    return found


def measured(suite, kind, flights, seconds, start=None, **options):
    """Fly random trajectories, by default from a cold start; return the numbers of a case."""
    sensors = sensor_suite(suite)
    sensors = sensors.replace(estimator=sensors.estimator.replace(kind=kind))
    small = sensors.optical_flow is not None or sensors.uwb_range is not None
    task = endless(TASK_DEFAULTS["random_trajectory" if start is None else "hover"])
    batch = FlightBatch(
        flights,
        vehicle=vehicle_params("crazyflie" if small else "lab"),
        sensors=sensors,
        task=task if start is None else task.replace(start=start),
        gains="tuned",
        source=Source.TRUTH,
        run_filter=True,
        innovations=True,
        threads=1,
        **{"filter_start": "cold"} | options,
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
    R = batch.record("R_hat")
    return {
        "nees": {name: float(part.overall) for name, part in squares.nees().items()},
        "nis": {name: float(part.overall) for name, part in innovations.nis().items()},
        "failures": int(batch.record("update_failures").sum()),
        "failed_predictions": int(batch.record("prediction_failures").sum()),
        "resets": batch.record("resets").sum(axis=0).tolist(),
        "from_rotations": float(np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max()),
        "r_hat": batch.record("r_hat").tolist(),
        "digest": digest.hexdigest(),
    }


if __name__ == "__main__":
    flights, seconds, *names = sys.argv[1:]
    chosen = {name: case for name, case in cases().items() if name in names or not names}
    results = {"precision": PRECISION}
    for name, (suite, kind, options) in chosen.items():
        results[name] = measured(suite, kind, int(flights), float(seconds), **options)
    print(json.dumps(results))

"""Effects of gate and resets on flights: harm without a fault, slow drifts, and long flights.

    python -m tests.statistical.protection

Prints rms errors of positions with a gate and without one, where noise and delays are not as
assumed; errors of a replay whose receiver drifts off; the mean NEES of ten minutes.
"""

import argparse
import warnings
from dataclasses import fields

import numpy as np

from quad_gym import Trajectory
from quad_gym.estimation import read_log, replay
from quad_gym.logs.replaying.rules import changes
from quad_gym.params.sensor_table import SENSOR_PARAMS
from quad_gym.params.suites import ALL_SUITES, sensor_suite
from tests.field_flights import fly, nees, state_errors, steps
from tests.many_logs import logs_of
from tests.statistical.verdicts import position_errors, rows, start_of
from tests.unit.test_resets import drifting_receiver

SETTLED, EVERY = 5.0, 0.25  #: first evaluation, and time between two [s]
SENSORS = tuple(SENSOR_PARAMS)
NOISE = ("position_sigma_I", "baseline_sigma", "velocity_sigma", "pixel_sigma", "noise_sigma")
IMU_NOISE = ("accel_noise_density", "gyro_noise_density", "accel_vibration", "gyro_vibration")


def scaled(part, names, factor):
    """Parameters of a sensor with some of them multiplied."""
    given = {name: getattr(part, name) for name in names if name in {f.name for f in fields(part)}}
    return part.replace(
        **{k: (factor * np.array(v)).tolist() for k, v in given.items() if v is not None}
    )


def changed(suite, change):
    """A suite with a change of each of its sensors but the IMU."""
    parts = {name: getattr(suite, name) for name in SENSORS}
    return suite.replace(**{k: change(part) for k, part in parts.items() if part is not None})


CONDITIONS = {
    "as assumed": lambda suite: suite,
    "noise x 2": lambda suite: changed(suite, lambda part: scaled(part, NOISE, 2.0)),
    "noise / 3": lambda suite: changed(suite, lambda part: scaled(part, NOISE, 1.0 / 3.0)),
    "IMU noise x 3": lambda suite: suite.replace(imu=scaled(suite.imu, IMU_NOISE, 3.0)),
}
"""True sensors, by condition."""


def rms(suite, true, count, seconds):
    """Root mean square of the position's error [m]."""
    batch, squares = fly(suite, count, true_sensors=true), []
    steps(batch, SETTLED)
    while len(squares) * EVERY < seconds - SETTLED:
        squares.append(np.square(state_errors(batch)[:, :3]).sum(axis=1))
        steps(batch, EVERY)
    return float(np.sqrt(np.mean(squares)))


def late_rms(suite, flights):
    """Root mean square of the position's error [m] with stamps that are 50 ms late."""
    squares = []
    for log, truth in flights:
        late = 0.05 * ~rows(log, "gyro")
        table = log | {"time": log["time"] + late, "received": log["received"] + late}
        order = np.argsort(table["received"], kind="stable")
        table = {column: values[order] for column, values in table.items()}
        found = replay(table, sensors=suite, start=start_of(suite, truth))
        error = position_errors(found, truth)
        squares.append(np.square(error[found.time > SETTLED]).mean())
    return float(np.sqrt(np.mean(squares)))


def harm(name, count, seconds):
    """Print rms errors with a gate and without."""
    suite = sensor_suite(name)
    bare = suite.replace(estimator=suite.estimator.replace(false_alarm_probability=0.0))
    for condition, change in CONDITIONS.items():
        pair = [rms(s, change(suite), count, seconds) for s in (suite, bare)]
        print(f"{name}, {condition}:", text_of(*pair), flush=True)
    if suite.optical_flow is None:
        flights = list(logs_of(name, max(count // 4, 1), seconds))
        pair = [late_rms(s, flights) for s in (suite, bare)]
        print(f"{name}, 50 ms late, replay:", text_of(*pair), flush=True)


def text_of(gated, free):
    """Both errors, and their ratio."""
    return f"{gated:.3f} m, {free:.3f} m, {gated / free:.2f}"


def drifts():
    """Print errors of replays, and how far their velocities depart from the IMU's in 2 s."""
    for rate in (0.0, 1.0, 2.0, 4.0):
        log, drifting = drifting_receiver(rate)
        right, result = replay(log, sensors="field"), replay(drifting, sensors="field")
        error = np.linalg.norm(result.position - right.position, axis=1)
        during = (result.time >= 70.0) & (result.time < 90.0)
        found = {c.quantity: c.ratio for c in changes(read_log(drifting), result, 60.0)[0]}
        print(
            f"{rate:g} m/s: {error[during].max():.1f} m, later {error.max():.1f} m, "
            f"{found['velocity']:.1f} sigma, flagged {result.diverged[during].mean():.0%} then "
            f"{result.diverged[result.time >= 90.0].mean():.0%}",
            *result.problems,
            sep="\n    ",
            flush=True,
        )


def consistent_flights():
    """Yield names, suites and keywords of `fly`: all suites, and what makes some consistent."""
    for name in ALL_SUITES:
        yield name, sensor_suite(name), {"vehicle": "crazyflie"} if name == "crazyflie" else {}
    lab, stale = sensor_suite("lab"), sensor_suite("stale")
    predicted = lab.estimator.replace(bearing_noise_at="predicted")
    yield "lab, noise at the predicted direction", lab.replace(estimator=predicted), {}
    prompt = {name: getattr(stale, name).replace(latency=0.0) for name in ("gnss", "camera")}
    yield "stale, prompt sensors", stale, {"true_sensors": stale.replace(**prompt)}
    points = [(2.0, 0.0, 1.5), (0.0, 2.0, 2.0), (-2.0, 0.0, 1.2), (0.0, -2.0, 1.8)]
    facing = Trajectory.through(
        points, max_speed=2.0, max_acceleration=2.5, closed=True, look_at=(-8.0, 0.0)
    )
    keywords = {"task": "trajectory", "trajectory": facing}
    yield "one_wall, facing it", sensor_suite("one_wall"), keywords


def long_flights(name, suite, count, **keywords):
    """Print the mean NEES of each minute, and the median."""
    batch, found = fly(suite, count, **keywords), []
    for _ in range(200):
        steps(batch, 3.0)
        found.append(nees(batch))
    minutes = np.mean(found, axis=1).reshape(10, 20).mean(axis=1)
    print(
        f"{name}: NEES {np.mean(found):.2f}, median {np.median(found):.1f}; by minute",
        minutes.round(1),
        flush=True,
    )


def main():
    """Print the chosen tables."""
    tables = ("harm", "drift", "long")
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("tables", nargs="*", default=tables, choices=(*tables, tables))
    parser.add_argument("--flights", type=int, default=20)
    parser.add_argument("--only", default="", help="part of the name of long flights")
    parser.add_argument("--seconds", type=float, default=20.0)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    gated = [n for n in ALL_SUITES if sensor_suite(n).estimator.false_alarm_probability]
    if "harm" in args.tables:
        for name in gated:
            harm(name, args.flights, args.seconds)
    if "long" in args.tables:
        for name, suite, keywords in consistent_flights():
            if args.only in name:
                long_flights(name, suite, args.flights, **keywords)
    if "drift" in args.tables:
        drifts()


if __name__ == "__main__":
    main()

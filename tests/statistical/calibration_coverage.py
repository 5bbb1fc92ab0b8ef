"""Coverage of calibrated intervals on simulated logs with randomly drawn sensor numbers.

    python -m tests.statistical.calibration_coverage --logs 0 20 --output /tmp/coverage

Each log is a random trajectory with the sensors of a suite. The noise is drawn from 0.8 to several
times the suite's noise; delays of time stamps, the magnetic field and the mounting of the IMU also
differ from the suite. The calibration starts from the suite. Each log takes about a minute and has
a file of results, so ranges can be run separately. A run prints the table of all files.
"""

import argparse
import json
import math
import time
from pathlib import Path

import numpy as np

import quad_gym
from quad_gym.estimation import calibrate, read_log
from quad_gym.logs.calibrating.calibration import _prior_of
from quad_gym.logs.calibrating.search import numbers_in
from quad_gym.params.sensor_table import SENSOR_PARAMS
from quad_gym.rotations import euler_to_dcm, quaternion_to_dcm
from tests.logged_flights import Recorded, flown

SUITES = (
    "consumer",
    "rtk",
    "field",
    "stale",
    "indoor",
    "standard",
    "consumer",
    "rtk",
    "field",
    "lab",
)
SECONDS = {"standard": 26.0, "lab": 26.0}
LONG = 50.0
SPREADS = {
    "declination": 0.2,
    "inclination": 0.1,
    "log_rotation": 0.04,
    "primary_antenna_B": 0.05,
    **dict.fromkeys(SENSOR_PARAMS, 0.05),
    "gnss": 0.2,
    "magnetometer": 0.08,
    "barometer": 0.1,
}
"""Standard deviations of numbers of either sign; the means are the suite's numbers."""
GROUPS = {
    "log_delays": "delays",
    "log_rotation": "mounting of the IMU",
    "imu.accel_noise": "noise of the IMU",
    "imu.gyro_noise": "noise of the IMU",
    "imu": "bias spreads of the IMU",
    "gnss.drift": "GNSS: drift",
    "gnss.primary": "lever arm",
    "gnss": "GNSS: white noise",
    "barometer": "barometer",
    "camera": "camera",
    "magnetometer.noise": "magnetometer: noise, hard iron",
    "magnetometer.hard": "magnetometer: noise, hard iron",
    "magnetometer": "magnetometer: field",
}
"""Rows of the table by the beginnings of names."""


def drawn(prior, log, rng):
    """Return drawn numbers of a vehicle, by name, and its suite."""
    suite, true = prior, {}
    for number in numbers_in(prior, log, delays=True, rotation=True):
        before = number.of(prior)
        if number.positive:
            low = -0.2 if number.ends(before)[0] > -1.0 else -1.0
            value = before * math.exp(rng.uniform(low, max(0.3, min(0.8 * number.spread, 1.5))))
            if number.field == "strength":
                value = before * math.exp(0.1 * rng.normal())
        else:
            value = before + SPREADS[number.field] * rng.normal()
        true[number.name] = value
        suite = number.put(suite, value)
    return true, suite


def as_logged(table, suite):
    """Return the table of a log with the clock delays and the IMU mounting of a suite."""
    R = euler_to_dcm(suite.log_rotation).T  # from B to the axes of the IMU
    table = {name: column.copy() for name, column in table.items()}
    for name in ("gyro", "accel"):
        names = [f"{name}_{axis}" for axis in "xyz"]
        turned = np.column_stack([table[n] for n in names]) @ R.T
        table.update(zip(names, turned.T, strict=True))
    first = {"gnss": "gnss_east", "camera": "pixel_0_u", "magnetometer": "magnetometer_x"}
    for sensor, delay in vars(suite.log_delays).items():
        names = [n for n in table if n.startswith(first.get(sensor, sensor).split("_")[0])]
        rows = np.zeros(len(table["time"]), bool)
        for n in names:
            rows |= np.isfinite(table[n])
        table["time"] = table["time"] + delay * rows
    table["received"] = np.maximum(table["received"], table["time"])
    order = np.argsort(table["received"], kind="stable")
    return {name: column[order] for name, column in table.items()}


def simulated(index):
    """Return a table, the true numbers, the suite without them and the start."""
    name, rng = SUITES[index % len(SUITES)], np.random.default_rng(100 + index)
    base = quad_gym.sensor_suite(name)
    if base.camera is not None and base.gnss is not None:
        base = base.replace(camera=None)
    seconds = SECONDS.get(name, LONG)
    log = read_log(Recorded(flown(base, 1.0), base, lost=0.0, jitter=0.0).table())
    prior = _prior_of(base, log, rotation=True)
    if base.magnetometer is not None:  # the field of the suite, not the field measured in 1 s
        own = base.magnetometer
        compass = prior.magnetometer.replace(strength=own.strength, inclination=own.inclination)
        prior = prior.replace(magnetometer=compass)
    true, suite = drawn(prior, log, rng)
    free = {"out_of_bounds": 1e3, "min_height": -1e3, "max_tilt": math.pi}
    flight = flown(suite, seconds, seed=index, task="random_trajectory", **free)
    table = Recorded(flight, suite, seed=index, lost=0.0, jitter=0.0).table()
    table = as_logged(table, suite)
    start = {}
    if base.gnss is None:
        x_I = quaternion_to_dcm(flight["quaternion"][0])[0]
        start = {"position": flight["position"][0], "heading": math.atan2(x_I[1], x_I[0])}
    return table, true, base, start


def run(index):
    """Return the results of one log."""
    began = time.process_time()
    table, true, base, start = simulated(index)
    flown_in = time.process_time() - began
    found = calibrate(table, sensors=base, start=start, rotation=True)
    numbers = {
        n.number.name: (true[n.number.name], n.prior, n.value, n.low, n.high, n.determined)
        for n in found.numbers
    }
    nis = {
        name: (fit.measurements, fit.freedoms, fit.mean_nis)
        for name, fit in found.after.sensors.items()
    }
    took = time.process_time() - began - flown_in
    return {"suite": SUITES[index % len(SUITES)], "numbers": numbers, "nis": nis, "seconds": took}


def group_of(name):
    """Return the row of a number in the table."""
    return next(row for start, row in GROUPS.items() if name.startswith(start))


def table_of(folder):
    """Return the lines of a table of all results."""
    results = [json.loads(file.read_text()) for file in sorted(folder.glob("*.json"))]
    inside, lines = {}, []
    nis = {}
    for result in results:
        for name, (true, _, _, low, high, determined) in result["numbers"].items():
            inside.setdefault(group_of(name), []).append((low <= true <= high, determined))
        for name, (count, d, mean) in result["nis"].items():
            nis.setdefault(name, []).append((count * d, mean))
    lines += ["| numbers | in their intervals | of the determined ones |", "|---|---:|---:|"]
    inside["all"] = [row for rows in inside.values() for row in rows]
    for name, rows in inside.items():
        within, known = np.array(rows).T
        lines.append(
            f"| {name} | {within.sum()} of {len(rows)} | {within[known].sum()} of {known.sum()} |"
        )
    lines += ["", "| sensor | NIS / degrees of freedom | range over logs |", "|---|---:|---:|"]
    for name, rows in nis.items():
        freedoms, means = np.array(rows).T
        pooled = (freedoms * means).sum() / freedoms.sum()
        lines.append(f"| {name} | {pooled:.2f} | {means.min():.2f} to {means.max():.2f} |")
    alone = [np.array(list(result["nis"].values())) for result in results]
    means = np.array([np.average(nis[:, 2], weights=nis[:, 0] * nis[:, 1]) for nis in alone])
    lines += [
        "",
        f"All sensors of a log: {means.min():.2f} to {means.max():.2f}; "
        f"{(np.abs(means - 1.0) <= 0.1).sum()} logs within 10 % of one.",
    ]
    took = [result["seconds"] for result in results]
    lines += [
        "",
        f"{len(results)} logs, {np.mean(took):.0f} s each on average, {max(took):.0f} s at most.",
    ]
    return lines


def main():
    """Run the logs that have no results yet, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--logs", type=int, nargs=2, default=(0, 20))
    parser.add_argument("--output", type=Path, default=Path("/tmp/coverage"))
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    for index in range(*args.logs):
        file = args.output / f"{index:02d}.json"
        if not file.exists():
            result = run(index)
            file.write_text(json.dumps(result))
    print("\n".join(table_of(args.output)))


if __name__ == "__main__":
    main()

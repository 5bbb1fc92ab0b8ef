"""Logs of many simulated flights at once, with the motion as truth."""

import numpy as np

from quad_gym.params.suites import sensor_suite
from tests.field_flights import fly

_QUANTITIES = {
    "gyro": "gyro",
    "accel": "accel",
    "gnss_enu": "gnss_position",
    "gnss_velocity_enu": "gnss_velocity",
    "gnss_baseline_enu": "gnss_baseline",
    "pixels": "pixels",
    "barometer": "barometer",
    "magnetometer": "magnetometer",
}
"""Columns of a log by the quantities of flights."""
_SENSORS = {
    "gnss": "gnss",
    "pixels": "camera",
    "barometer": "barometer",
    "magnetometer": "magnetometer",
}


def logs_of(name, count, seconds, seed=0, task="random_trajectory", start="ground", **keywords):
    """Return logs of flights from the ground under PD control on their estimates, and their motion.

    A log is a table as for `read_log`, with each measurement in its own row, and `received`. The
    truth has arrays of time, position, velocity, quaternion and biases of the IMU.
    """
    suite = sensor_suite(name)
    batch = fly(suite, count, task=task, seed=seed, start=start, **keywords)
    names = [n for n in _QUANTITIES if _sensor(n) is None or getattr(suite, _sensor(n))]
    truth = ("position", "velocity", "quaternion", "accel_bias", "gyro_bias")
    kept = {n: [] for n in (*names, *truth)}
    for k in range(round(seconds * suite.imu.rate) + 1):
        if k:
            batch.step()
        for n in names:
            kept[n].append(batch.read(_QUANTITIES[n]))
        for n in truth:
            kept[n].append(batch.read(n))
    values = {n: np.array(v) for n, v in kept.items()}
    time = np.arange(len(values["gyro"])) * suite.imu.dt
    for i in range(count):
        one = {n: values[n][:, i] for n in names}
        yield _table(suite, time, one), {"time": time, **{n: values[n][:, i] for n in truth}}


def _sensor(column):
    return next((s for start, s in _SENSORS.items() if column.startswith(start)), None)


def _table(suite, time, values):
    """Return a table whose rows are in the order of arrival."""
    parts = []
    inertial = {n: values[n][1:] for n in ("gyro", "accel")}
    parts.append({"time": time[1:], "received": time[1:], **inertial})
    for sensor in ("gnss", "camera", "barometer", "magnetometer"):
        columns = {n: v for n, v in values.items() if _sensor(n) == sensor}
        if not columns:
            continue
        flat = np.column_stack([v.reshape(len(time), -1) for v in columns.values()])
        rows = np.flatnonzero(np.isfinite(flat).any(axis=1))
        late = np.where(rows > 0, getattr(suite, sensor).latency, 0.0)  # the first ones have none
        part = {n: v[rows] for n, v in columns.items()}
        parts.append({"time": time[rows] - late, "received": time[rows], **part})
    return joined(parts)


def joined(parts):
    """Return one table of several, in the order of arrival."""
    names = dict.fromkeys(name for part in parts for name in part)
    shapes = {n: next(p[n].shape[1:] for p in parts if n in p) for n in names}
    table = {
        n: np.concatenate([p.get(n, np.full((len(p["time"]), *shapes[n]), np.nan)) for p in parts])
        for n in names
    }
    order = np.argsort(table["received"], kind="stable")
    return {name: column[order] for name, column in table.items()}

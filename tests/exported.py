"""Outputs of exported filters, and logs that are hard for them."""

import math
import subprocess

import numpy as np

from quad_gym.records import REAL
from tests.logged_flights import Recorded, flown


def estimates(*command):
    return parsed(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def parsed(printed):
    names, *rows = printed.split()
    return names.split(","), np.array([[float(x) for x in row.split(",")] for row in rows])


def as_printed(result):
    """Columns of a replay (n, columns), rounded to the precision of the process, but not times."""
    columns = np.array(list(result.columns().values()))
    columns[1:] = columns[1:].astype(REAL)
    return columns.T


def hard_log(suite):
    """Return a table that begins in motion, and its start.

    The gyro jumps, so that states are reset; each 25th measurement is an outlier; all sensors but
    the IMU pause for 0.7 s.
    """
    flight = flown(suite, 8.0)
    table = Recorded(flight, suite).table()
    late = table["received"] > 1.5
    table = {k: v[late].copy() for k, v in table.items() if np.isfinite(v).any()}
    time, own = table["time"], ("time", "received", "gyro", "accel", "motor")
    table["gyro_x"][time > 4.0] += 0.15
    for name in (name for name in table if not name.startswith(own)):
        table[name][(time > 5.5) & (time < 6.2)] = np.nan
        rows = np.flatnonzero(np.isfinite(table[name]))[10::25]
        if len(rows):
            table[name][rows] += 30.0 * np.nanstd(table[name])
    row = round(1.5 * suite.imu.rate)
    w, x, y, z = flight["quaternion"][row]
    start = {"heading": math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))}
    if suite.gnss is None:
        start["position"] = tuple(flight["position"][row])
    return table, start

"""Convert published flights to tables that `quad-gym replay` and `quad-gym calibrate` read.

    python real_flights.py FOLDER flight.csv

FOLDER holds either flight of:

- `IMU_1.csv` and `GT.csv` of "Quadrotor Dead Reckoning with Multiple Inertial Sensors" (D. Hurwitz
  and I. Klein, 2023, CC BY 4.0, github.com/ansfl): an Xsens DOT IMU at 120 Hz, and RTK positions at
  10 Hz with a separate clock. The heading at the first position is printed, for `--heading`.
- `IMU.txt`, `GPS.txt`, `MAG.txt` and `NTUN.txt` of InertialNav (P. Riseborough, 2014,
  BSD-3-Clause): logs of ArduPilot, with times of arrival. Measurements keep them as time stamps;
  `quad-gym calibrate` finds the delays.

Both are examples for your own data: a list of rows, each with a time of arrival and measurements.
"""

import csv
import sys
from pathlib import Path

import numpy as np

AXES = "xyz"


def rtk_flight(folder):
    """Rows (time, values) of an RTK flight, and its first heading from east toward north [rad]."""
    imu = np.loadtxt(folder / "IMU_1.csv", delimiter=",", skiprows=1)
    truth = np.loadtxt(folder / "GT.csv", delimiter=",", skiprows=1)
    rows = []
    for row in imu:  # time, angles of the sensor's filter, m/s^2, deg/s; forward, left, up
        rows.append((row[0], vector("accel", row[4:7]) | vector("gyro", np.radians(row[7:10]))))
    for row in truth:
        north, east, down = row[7:10]
        rows.append((row[0], {"gnss_east": east, "gnss_north": north, "gnss_up": -down}))
    return rows, np.radians(90.0 - truth[0, 3])


def ardupilot_flight(folder):
    """Rows (time, values) of a flight in the tables of InertialNav."""
    imu, gps, compass, air = (
        np.loadtxt(folder / f"{name}.txt") for name in ("IMU", "GPS", "MAG", "NTUN")
    )
    flu = np.array([1.0, -1.0, -1.0])  # from forward, right, down
    rows = []
    for row in imu:
        rows.append((row[0], vector("gyro", flu * row[2:5]) | vector("accel", flu * row[5:8])))
    fresh = np.diff(gps[:, 0], prepend=-1.0) > 0.0
    for row in gps[fresh & (gps[:, 1] > 2.0)]:
        course = np.radians(row[11])
        velocity = [row[10] * np.sin(course), row[10] * np.cos(course), -row[12]]
        names = ("gnss_velocity_east", "gnss_velocity_north", "gnss_velocity_up")
        place = {"gnss_lat": row[6], "gnss_lon": row[7], "gnss_alt": row[8]}
        rows.append((row[0], place | dict(zip(names, velocity, strict=True))))
    for row in compass:  # milligauss
        rows.append((row[0], vector("magnetometer", 1e-7 * flu * (row[2:5] - row[5:8]))))
    for row in air:
        rows.append((row[0], {"barometer": row[8]}))
    return [(1e-3 * time, values) for time, values in rows]


def vector(name, values):
    """Return three columns."""
    return {f"{name}_{axis}": value for axis, value in zip(AXES, values, strict=True)}


def table(rows):
    """Return the columns of rows in the order of time; NaN where there is no measurement."""
    rows = sorted(rows, key=lambda row: row[0])
    names = dict.fromkeys(name for _, values in rows for name in values)
    columns = {name: np.array([values.get(name, np.nan) for _, values in rows]) for name in names}
    return {"time": np.array([time for time, _ in rows])} | columns


def main(folder, file):
    """Convert a folder to a CSV file."""
    folder = Path(folder)
    if (folder / "GT.csv").is_file():
        rows, heading = rtk_flight(folder)
        print(f"--heading {np.degrees(heading):.1f}")
    else:
        rows = ardupilot_flight(folder)
    columns = table(rows)
    with Path(file).open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(columns)
        for row in zip(*columns.values(), strict=True):
            writer.writerow(["" if np.isnan(value) else f"{value:.12g}" for value in row])


if __name__ == "__main__":
    main(*sys.argv[1:])

"""Calibrations on part of a real flight, or on another flight, validated on the rest.

    python -m tests.statistical.real_flights --ardupilot FOLDER --rtk FOLDER FOLDER FOLDER
    python -m tests.statistical.real_flights --suite nano/suite.toml --crazyflie FILE ...

The script prints the tables of docs/calibration.md, in about five minutes. The folders are as
published, see docs/examples/real_flights.py. The files are tables of NanoBench (arXiv:2603.09908).
"""

import argparse
import sys
from pathlib import Path

import numpy as np

import quad_gym
from quad_gym.estimation import calibrate, read_log, replay
from quad_gym.logs.calibrating.likelihood import validate
from quad_gym.logs.formats.tables import csv_columns
from quad_gym.rotations import dcm_to_euler, quaternion_to_dcm

sys.path.append(str(Path(__file__).parents[2] / "docs" / "examples"))
import real_flights

MAP = Path(real_flights.__file__).with_name("nanobench.toml")
SETTLED = 60.0  #: time from which the attitude is compared [s]
MOVING = 10.0  #: time from which fixes are left out, as the filter starts in motion [s]
START, LOW = 5.0, 0.3  #: time after the start [s] and height [m] from which errors count


def attitude_errors(result, folder):
    """Return medians of differences of roll, pitch and yaw from the autopilot, and RMS about."""
    autopilot = np.loadtxt(folder / "ATT.txt")
    time = 1e-3 * autopilot[:, 0]
    rows = np.clip(np.searchsorted(result.time, time), 0, len(result.time) - 1)
    R = quaternion_to_dcm(result.quaternion)[rows]  # from I (east, north, up) to forward, left, up
    roll = np.arctan2(R[:, 1, 2], R[:, 2, 2])
    pitch = np.arcsin(R[:, 0, 2])  # nose up
    yaw = np.arctan2(R[:, 0, 0], R[:, 0, 1])  # from north toward east
    found = np.degrees(np.column_stack([roll, pitch, yaw]))
    errors, medians = [], []
    for angle, other in zip(found.T, autopilot[:, 2:5].T, strict=True):
        error = (angle - other + 180.0) % 360.0 - 180.0
        error = error[(time > time[0] + SETTLED) & (time <= result.time[-1])]
        medians.append(np.median(error))
        error = (error - medians[-1] + 180.0) % 360.0 - 180.0
        errors.append(np.sqrt((error**2).mean()))
    return np.array(medians), np.array(errors)


def fit_texts(validation):
    """Yield texts that describe a validation."""
    for name, fit in validation.sensors.items():
        yield f"{name} {fit.mean_nis:.2f}, rejected {100.0 * fit.rejected:.1f} %"
    if validation.held_out_error is not None:
        level, up = validation.held_out_error
        ratios = ", ".join(f"{ratio:.1f}" for ratio in validation.held_out_ratios)
        yield f"left out {level:.2f} m, {up:.2f} m up, NIS / 3 {validation.held_out_nis:.2f}"
        yield f"ratios {ratios}"


def hobby_vehicle(folder):
    """Print the results of `consumer`, the calibrated suite and `field` for the flight."""
    log = read_log(real_flights.table(real_flights.ardupilot_flight(folder)))
    found = calibrate(log, sensors="consumer")
    for number in found.numbers:
        interval = f"[{number.low:.3g}, {number.high:.3g}]" if number.determined else "-"
        print(f"  {number.number.name} {number.value:.3g} {interval}")
    first = float(log.imu.time[0]) + SETTLED
    field = validate(log, quad_gym.sensor_suite("field"), None, first)
    for name, seen in (("consumer", found.before), ("calibrated", found.after), ("field", field)):
        medians, errors = attitude_errors(seen.replay, folder)
        angles = f"roll, pitch, yaw {errors.round(2)} deg about {medians.round(2)} deg"
        print(name, *fit_texts(seen), angles, sep="; ")


def survey_vehicle(folders):
    """Print clock offsets, and predictions with the numbers of each flight."""
    flights = {}
    for folder in folders:
        rows, heading = real_flights.rtk_flight(folder)
        log = read_log(real_flights.table(rows))
        start = {"heading": heading, "heading_sigma": 0.1}
        found = calibrate(log, sensors="rtk", start=start, share=0.9)
        (offset,) = (n for n in found.numbers if n.number.name == "log_delays.gnss")
        print(f"{folder.name}: {offset.value:.3f} s [{offset.low:.3f}, {offset.high:.3f}]")
        flights[folder.name] = log, start, found.suite
        try:
            half = calibrate(log, sensors="rtk", start=start).after
        except ValueError as error:
            print(f"  first half: {error}")
        else:
            print("  first half -> second half", *fit_texts(half), sep="; ")
    for source, (_, _, suite) in flights.items():
        for name, (log, start, own) in flights.items():
            seen = validate(
                log, suite.replace(log_delays=own.log_delays), start, log.imu.time[0] + MOVING
            )
            print(f"{source} -> {name}", *fit_texts(seen), sep="; ")


def laboratory_vehicle(suite, files):
    """Print errors of replays against motion capture, before and after the descent."""
    squares = {"in the air": [], "until the motors stop": []}
    for file in files:
        table = csv_columns(file)
        result = replay(file, sensors=suite, columns=MAP, reported_noise=False)
        true, own, velocity = (
            np.column_stack([np.interp(result.time + late, table["t"], table[n]) for n in names])
            for late, names in (
                (suite.log_delays.gnss, ("px", "py", "pz")),
                (0.0, [f"est_stateEstimate_{axis}" for axis in "xyz"]),
                (suite.log_delays.gnss, ("vx", "vy", "vz")),
            )
        )
        rows = np.searchsorted(table["t"], result.time + suite.log_delays.gnss)
        q = np.column_stack([table[f"q{axis}"] for axis in "wxyz"])[np.minimum(rows, len(rows) - 1)]
        R_BI = quaternion_to_dcm(result.quaternion)
        angles = np.degrees(dcm_to_euler(R_BI)[:, :2] - dcm_to_euler(quaternion_to_dcm(q))[:, :2])
        antenna = result.position + np.array(suite.gnss.primary_antenna_B) @ R_BI
        errors = np.column_stack([antenna - true, own - true])
        scaled = ((result.velocity - velocity) / result.sigma[:, 3:6]) ** 2
        running = np.column_stack([table[f"motor_motor_m{k}"] for k in range(1, 5)]).all(axis=1)
        ends = result.time[np.flatnonzero(true[:, 2] > LOW)[-1]], table["t"][running][-1]
        fixes = result.measured["gnss_position"]
        texts = []
        for name, end in zip(squares, ends, strict=True):
            some = (result.time > result.time[0] + START) & (result.time <= end)
            known = (fixes.time > fixes.time[0] + START) & (fixes.time <= end)
            if not result.problems:
                squares[name].append(scaled[some].mean(axis=0))
            position, onboard = (
                100.0 * np.sqrt((errors[some, k : k + 3] ** 2).sum(axis=1).mean()) for k in (0, 3)
            )
            tilt = np.sqrt((angles[some] ** 2).mean(axis=0)).round(1)
            texts.append(
                f"{name} NIS / 3 {np.nanmean(fixes.nis[known]) / 3.0:.2f}, {position:.1f} cm, "
                f"velocity {scaled[some].mean(axis=0).round(1)}, roll, pitch {tilt} deg, onboard "
                f"{onboard:.1f} cm"
            )
        share = 100.0 * fixes.rejected.mean()
        print(file.name, *texts, f"rejected {share:.1f} %", result.verdict, sep="; ")
    for name, some in squares.items():
        print(f"{name}, velocity, mean of {len(some)}: {np.mean(some, axis=0).round(2)}")


def main():
    """Print the tables of the given folders."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--ardupilot", type=Path)
    parser.add_argument("--rtk", type=Path, nargs="*", default=())
    parser.add_argument("--crazyflie", type=Path, nargs="*", default=())
    parser.add_argument("--suite", default="mocap")
    args = parser.parse_args()
    if args.ardupilot is not None:
        hobby_vehicle(args.ardupilot)
    survey_vehicle(args.rtk)
    if args.crazyflie:
        laboratory_vehicle(quad_gym.sensor_suite(args.suite), args.crazyflie)


if __name__ == "__main__":
    main()

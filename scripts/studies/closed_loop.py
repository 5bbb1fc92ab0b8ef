"""Logged flights in closed loop: a simulated vehicle follows the setpoints of a log."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.signal import savgol_filter

from baselines.crazyflie_pid import CrazyfliePID
from quad_gym import SensorSuite, Uniform, VehicleParams, WorldParams, sensor_suite
from quad_gym.logs.formats.tables import csv_columns
from quad_gym.params.vehicle import GRAVITY
from quad_gym.rotations import quaternion_to_dcm
from scripts.studies.onboard_filter import OnboardFilter

Floats = NDArray[np.float64]

RATE = 500.0  #: rate of the firmware's loops of attitude and body rates [Hz]
FULL = 65535.0  #: largest command of a motor
COLUMNS = {
    "time": ("t",),
    "setpoint": ("sp_ctrltarget_x", "sp_ctrltarget_y", "sp_ctrltarget_z"),
    "yaw": ("sp_ctrltarget_yaw",),
    "position": ("px", "py", "pz"),
    "estimate": ("est_stateEstimate_x", "est_stateEstimate_y", "est_stateEstimate_z"),
    "commands": ("motor_motor_m1", "motor_motor_m4", "motor_motor_m3", "motor_motor_m2"),
    "battery": ("pwr_pm_vbat",),
    "accel": ("imu_acc_x", "imu_acc_y", "imu_acc_z"),
    "velocity": ("vx", "vy", "vz"),
    "quaternion": tuple(f"att_stateEstimate_q{axis}" for axis in "wxyz"),
}
"""Columns of NanoBench (arXiv:2603.09908): yaw in degrees, specific force in g, motors in the order
of this package."""
IMU = sensor_suite("crazyflie").imu.replace(gyro_bias_sigma=1e-4)
"""The IMU of the vehicle in the loop: a suite from logs has model errors in its noise as well. The
firmware subtracts the mean of the gyro at rest."""
CRASH = 10.0  #: specific force that no flight of a small quadrotor has [g]
SPAN, LATEST = 25, 0.2
"""Rows over which accelerations are averaged, and largest difference of clocks [s]."""


@dataclass(frozen=True, eq=False)
class LoggedFlight:
    """Commands and measurements in n rows, from the start of the motors until the landing."""

    name: str
    time: Floats  #: since the start of the motors, (n,) [s]
    setpoint: Floats  #: (n, 3) from the place of the start [m]
    yaw: Floats  #: (n,) [rad]
    position: Floats  #: by motion capture, (n, 3) from the place of the start [m]
    estimate: Floats  #: of the vehicle itself, (n, 3) from the place of the start [m]
    commands: Floats  #: of the motors, (n, 4) from 0 to 1
    battery: Floats  #: (n,) [V]
    accel: Floats  #: specific force, (n, 3) in B [m/s^2]
    velocity_B: Floats  #: by motion capture, (n, 3) in B [m/s]
    clock: float  #: time by which stamps of motion capture are late, against the vehicle's [s]
    crashed: bool

    @property
    def judged(self) -> Any:
        """Rows (n,) after the take-off: once the setpoint has reached its usual height."""
        height = self.setpoint[:, 2]
        return np.maximum.accumulate(height > 0.95 * np.median(height))


def read_flight(file: Path) -> LoggedFlight:
    """Read a table of NanoBench, until the landing or a crash.

    Raises:
        ValueError: If a column is missing, or the motors do not run.
        OSError: If there is no such file.
    """
    table = csv_columns(file)
    missing = [name for names in COLUMNS.values() for name in names if name not in table]
    if missing:
        raise ValueError(f"{file.name} must have a column {missing[0]}")
    parts = {key: np.column_stack([table[n] for n in names]) for key, names in COLUMNS.items()}
    running = (parts["commands"] > 0.0).all(axis=1)
    if running.sum() < 100:
        raise ValueError(f"{file.name} must have a hundred rows with running motors")
    first, height = int(np.argmax(running)), parts["setpoint"][:, 2]
    last = int(np.flatnonzero(height > 0.8 * np.median(height[running]))[-1])
    hits = np.linalg.norm(parts["accel"][first:last], axis=1) > CRASH
    crashed = bool(hits.any())
    rows = slice(first, first + int(np.argmax(hits)) if crashed else last)
    time = parts["time"][:, 0]
    R_BI, accel = quaternion_to_dcm(parts["quaternion"]), GRAVITY * parts["accel"]
    felt = np.einsum("nji,nj->ni", R_BI, accel) - [0.0, 0.0, GRAVITY]
    late = _late(time[rows], parts["position"][rows], felt[rows])
    for name in ("position", "velocity"):  # as the vehicle's clock has them
        moved = [np.interp(time + late, time, axis) for axis in parts[name].T]
        parts[name] = np.column_stack(moved)
    place = parts["position"][:first].mean(axis=0)
    return LoggedFlight(
        name=file.name.split(".")[0],
        time=time[rows] - time[first],
        setpoint=parts["setpoint"][rows] - place,
        yaw=np.radians(parts["yaw"][rows, 0]),
        position=parts["position"][rows] - place,
        estimate=parts["estimate"][rows] - place,
        commands=np.clip(parts["commands"][rows] / FULL, 0.0, 1.0),
        battery=parts["battery"][rows, 0],
        accel=accel[rows],
        velocity_B=np.einsum("nij,nj->ni", R_BI, parts["velocity"])[rows],
        clock=late,
        crashed=crashed,
    )


def _late(time: Floats, position: Floats, accel: Floats) -> float:
    """Return the delay [s] of positions (n, 3) after accelerations (n, 3) in I, by correlation."""
    dt = float(np.median(np.diff(time)))
    moved = savgol_filter(position, SPAN, 3, deriv=2, delta=dt, axis=0)
    felt, most = savgol_filter(accel, SPAN, 3, axis=0), round(LATEST / dt)
    scores, felt = [], felt[most:-most] - felt[most:-most].mean(axis=0)
    for late in range(2 * most + 1):
        other = moved[late : late + len(felt)]
        other = other - other.mean(axis=0)
        scores.append((felt * other).sum() / (np.linalg.norm(felt) * np.linalg.norm(other)))
    k = int(np.clip(np.argmax(scores), 1, 2 * most - 1))
    bend, slope, _ = np.polyfit([-1.0, 0.0, 1.0], scores[k - 1 : k + 2], 2)
    return dt * (k - most - 0.5 * slope / bend)


class Body(NamedTuple):
    """A vehicle by its logs, and the spread of its rotors from flight to flight."""

    vehicle: VehicleParams
    world: WorldParams
    randomization: dict[str, Any]


def fit_body(logs: Sequence[LoggedFlight], known: VehicleParams) -> Body:
    """Fit thrust of each rotor and drag to flights, each by itself; all else stays as in `known`.

    The rotors have equal forces in the mean, as their torques balance.
    """
    rotors, drags = [], []
    for log in logs:
        rows = log.judged
        battery = uniform_filter1d(log.battery, 20)[:, np.newaxis]
        squares = ((log.commands * battery) ** 2)[rows].mean(axis=0)
        speed, accel = log.velocity_B[rows], log.accel[rows]
        rotors.append(accel[:, 2].mean() / (4.0 * squares))
        drags.append([-np.polyfit(speed[:, k], accel[:, k], 1)[0] for k in (0, 1)])
    thrust = np.array(rotors)
    mean, drag = thrust.mean(), np.mean(drags, axis=0)
    spread = thrust.std(axis=0, ddof=1) * math.sqrt(1.0 + 1.0 / len(logs)) / mean
    middle, reach = thrust.mean(axis=0) / mean, math.sqrt(3.0) * spread  # of a uniform distribution
    return Body(
        known.replace(
            thrust_coefficient=mean * known.mass / known.motor_speed_per_volt**2,
            drag_coefficient=0.0,
        ),
        WorldParams(linear_drag_B=(*(known.mass * drag), 0.0)),
        {"rotor_efficiency": [Uniform(m - r, m + r) for m, r in zip(middle, reach, strict=True)]},
    )


class Flown(NamedTuple):
    """Simulated flights of one log, at its n rows; NaN after a crash."""

    position: Floats  #: (draws, n, 3) from the place of the start [m]
    estimate: Floats  #: of the filter, (draws, n, 3) [m]
    commands: Floats  #: of the motors, (draws, n, 4) from 0 to 1


def fly(
    logs: Sequence[LoggedFlight],
    suite: SensorSuite,
    vehicle: VehicleParams,
    world: WorldParams,
    randomization: Any = None,
    draws: int = 16,
    seed: int = 0,
    onboard: bool = True,
) -> list[Flown]:
    """Fly the setpoints of logs with the Crazyflie's PID, from the ground, on the estimate.

    The controller knows the voltage of the battery as it was logged. The estimate is that of the
    Crazyflie's filter, or else the suite's.
    """
    seconds = max(float(log.time[-1]) for log in logs)
    keywords: dict[str, Any] = {
        "vehicle": vehicle,
        "world": world,
        "randomization": randomization,
        **({"estimator": OnboardFilter()} if onboard else {"filter_start": "warm"}),
        "sensors": suite.replace(imu=suite.imu.replace(rate=RATE)),
        "true_sensors": suite.replace(imu=IMU.replace(rate=RATE)),
        "action": "motor",
        "layout": "absolute",
        "control_rate": RATE,
        "start": "ground",
        "radius": 1e-6,
        "out_of_bounds": 100.0,
        "duration": seconds + 1.0,
    }
    env: Any = gymnasium.make_vec("QuadGym/Hover-v0", len(logs) * draws, **keywords)
    policy, batch = CrazyfliePID(env), env.unwrapped.flights.batch
    of_log = np.repeat(np.arange(len(logs)), draws)
    clock = np.arange(round(RATE * seconds) + 1) / RATE
    rows = np.array([np.searchsorted(log.time, clock, side="right") - 1 for log in logs])
    found = [
        Flown(*(np.full((draws, len(log.time), k), np.nan) for k in (3, 3, 4))) for log in logs
    ]
    shown = {field.name: field.slice for field in env.unwrapped.flights.table}
    observation, _ = env.reset(seed=seed, options={"yaw": 0.0})
    begin, state, flying = batch.read("position"), None, np.ones(len(of_log), bool)
    for time, now in zip(clock, rows.T, strict=True):
        setpoint, yaw, battery = (
            np.array([getattr(log, name)[k] for log, k in zip(logs, now, strict=True)])[of_log]
            for name in ("setpoint", "yaw", "battery")
        )
        observation[:, shown["reference_position"]] = setpoint + begin
        observation[:, shown["reference_heading"]] = _headings(yaw)
        policy.battery = battery[:, np.newaxis]
        action, state = policy.predict(observation, state)
        volts = vehicle.hover_voltage * (1.0 + action)
        values = batch.read("position") - begin, batch.read("estimated_position") - begin
        for k, (log, one) in enumerate(zip(logs, found, strict=True)):
            row, mine = now[k], flying & (of_log == k)
            if time <= log.time[-1]:
                for part, value in zip(one, (*values, volts / policy.battery), strict=True):
                    part[mine[of_log == k], row] = value[mine]
        observation, _, terminated, truncated, _ = env.step(action)
        flying &= ~(terminated | truncated)
    return found


def _headings(yaw: Floats) -> Floats:
    """Directions (n, 3) of angles (n,) [rad]."""
    return np.stack([np.cos(yaw), np.sin(yaw), 0.0 * yaw], axis=1)


def rms(errors: Floats) -> Floats:
    """Root mean squares of the lengths of vectors (..., n, 3), without NaN."""
    return np.sqrt(np.nanmean((errors**2).sum(axis=-1), axis=-1))

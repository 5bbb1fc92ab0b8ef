"""The study of logged flights, on a made-up log whose vehicle is known."""

import csv
import math
from types import SimpleNamespace

import numpy as np
import pytest

from quad_gym import sensor_suite, vehicle_params
from quad_gym.batch.memory import State
from quad_gym.rotations import euler_to_dcm
from scripts.studies.closed_loop import COLUMNS, FULL, fit_body, fly, read_flight, rms
from scripts.studies.onboard_filter import OnboardFilter
from scripts.studies.real_flights import RealFlightsArgs, main

THRUST, DRAG, LATE, WAIT = 0.29, 0.4, 0.05, 1.0


def write_flight(file, thrust=THRUST, seconds=6.0):
    """Write a log at height 1 m on a level figure of eight, without turns."""
    t = np.arange(0.0, seconds, 0.01)
    rng = np.random.default_rng(0)

    def path(t):
        s = np.clip(t - WAIT, 0.0, None)
        x, y = 0.2 * (1.0 - np.cos(2.0 * s)), 0.15 * np.sin(3.0 * s) - 0.45 * s * np.exp(-s)
        return np.stack([x, y, 0.0 * t], axis=1)

    place = path(t)
    velocity = np.gradient(place, 0.01, axis=0)
    accel = np.gradient(velocity, 0.01, axis=0)
    battery = 3.8 - 0.01 * t
    # small tilts of the vehicle make the accelerations; drag acts on it
    up = accel + DRAG * velocity * [1.0, 1.0, 0.0] + [0.0, 0.0, 9.8]
    pitch, roll = up[:, 0] / 9.8, -up[:, 1] / 9.8
    quaternion = np.stack([1.0 + 0.0 * t, 0.5 * roll, 0.5 * pitch, 0.0 * t], axis=1)
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    volts = math.sqrt(9.8 / (4.0 * thrust))
    commands = np.repeat((volts / battery * FULL)[:, np.newaxis], 4, axis=1)
    commands[t < 0.5] = 0.0
    # in B, only drag is felt across the thrust
    felt = np.stack([-DRAG * velocity[:, 0], -DRAG * velocity[:, 1], 9.8 + 0.0 * t], axis=1)
    values = {
        "time": t[:, np.newaxis] + 1e4,
        "setpoint": path(t + 0.3) + np.array([0.0, 0.0, 1.0]),
        "yaw": np.zeros((len(t), 1)),
        "position": path(t - LATE) + 1e-5 * rng.normal(size=(len(t), 3)),
        "estimate": place,
        "commands": commands,
        "battery": battery[:, np.newaxis],
        "accel": felt / 9.8,
        "velocity": np.gradient(path(t - LATE), 0.01, axis=0),
        "quaternion": quaternion,
    }
    table = {
        n: v for key, names in COLUMNS.items() for n, v in zip(names, values[key].T, strict=True)
    }
    with file.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(table)
        writer.writerows(zip(*table.values(), strict=True))
    return file


def test_clock_thrust_and_drag_are_those_of_the_log(tmp_path):
    logs = [
        read_flight(write_flight(tmp_path / f"{k}.csv", THRUST * factor))
        for k, factor in enumerate((0.97, 1.03))
    ]
    assert [log.clock for log in logs] == pytest.approx([LATE] * 2, abs=0.004)
    assert rms(logs[0].position - logs[0].estimate) < 2e-3
    vehicle = vehicle_params("crazyflie")
    body = fit_body(logs, vehicle)
    assert body.vehicle.hover_voltage == pytest.approx(math.sqrt(9.8 / 4.0 / THRUST), rel=2e-3)
    drag = np.array(body.world.linear_drag_B) / vehicle.mass
    np.testing.assert_allclose(drag, (DRAG, DRAG, 0.0), rtol=0.03, atol=1e-12)


def test_flight_without_motors_is_refused(tmp_path):
    file = write_flight(tmp_path / "still.csv", seconds=0.4)
    with pytest.raises(
        ValueError, match=r"still\.csv must have a hundred rows with running motors"
    ):
        read_flight(file)


def test_simulated_vehicle_reaches_the_setpoints(tmp_path):
    log = read_flight(write_flight(tmp_path / "one.csv"))
    body = fit_body([log, log], vehicle_params("crazyflie"))
    (flown,) = fly([log], sensor_suite("mocap"), *body, draws=2)
    late = log.time > 3.5
    assert np.isfinite(flown.position[:, late][:, :-5]).all()
    assert (np.nanmax(np.abs((flown.position - log.setpoint)[:, late]), axis=1) < 0.35).all()


def test_onboard_filter_mistakes_drag_for_velocity_as_its_linear_model_does():
    """A vehicle that drag holds at 1 m/s tilts by drag over gravity, and feels no acceleration."""
    tilt, dt, fixes = DRAG / 9.8, 0.01, 30
    found = OnboardFilter()
    found.state = State(1, found.state)
    found.state.lock(False)
    found.state.v, found.state.R = [[1.0, 0.0, 0.0]], euler_to_dcm(np.array([[0.0, tilt, 0.0]]))
    # position, velocity and tilt; the latter accelerates it by 9.8 m/s^2 per rad
    x, P = np.array([0.0, 1.0, tilt]), 1e-4 * np.eye(3)
    F = np.array([[1.0, dt, 0.0], [0.0, 1.0, 9.8 * dt], [0.0, 0.0, 1.0]])
    Q, H = 1e-3 * dt * np.diag([0.0, 0.5**2, 0.1**2]), np.array([1.0, 0.0, 0.0])
    gnss = SimpleNamespace(primary_antenna_B=(0.0, 0.0, 0.0))
    common = {
        "dt": dt,
        "gyro": np.zeros((1, 3)),
        "accel": np.array([[0.0, 0.0, 9.8]]),
        "sensors": SimpleNamespace(gnss=gnss),
        "vehicle": SimpleNamespace(gravity=9.8),
    }
    for k in range(1, fixes + 1):
        fix = SimpleNamespace(new=np.array([True]), value=np.array([[k * dt, 0.0, 0.0]]))
        estimate = found.update(SimpleNamespace(gnss_position=fix, **common))
        x, P = F @ x, F @ P @ F.T + Q
        K = P @ H / (H @ P @ H + 0.01**2)
        x, P = x + K * (k * dt - H @ x), P - np.outer(K, H @ P)
    np.testing.assert_allclose(estimate["velocity"][0, 0], x[1], atol=5e-3)
    np.testing.assert_allclose(-estimate["R_BI"][0, 0, 2], x[2], atol=1e-3)
    assert x[1] > 1.02  # faster than it is
    assert x[2] < 0.9 * tilt  # and more level


def test_study_writes_table_and_figure(tmp_path, capsys):
    files = [write_flight(tmp_path / f"{k}.csv", seconds=3.0 + 0.3 * k) for k in range(3)]
    main(RealFlightsArgs(tuple(files), fitted=2, draws=2, output=tmp_path / "out"))
    assert "rank_correlation" in capsys.readouterr().out
    written = {file.name for file in (tmp_path / "out").iterdir()}
    assert written >= {"flights.csv", "results.json", "prediction.png"}

"""A change of any parameter changes the data that kernels read."""

import dataclasses
import math

import pytest

import quad_gym
from quad_gym import FlightBatch, TaskParams, WorldParams
from quad_gym.records import Control

RTK = quad_gym.sensor_suite("rtk")
SENSORS = RTK.replace(
    gnss=RTK.gnss.replace(latency=0.05, drift_sigma_I=(0.1, 0.1, 0.1), drift_tau=60.0),
    barometer=quad_gym.BarometerParams(latency=0.02),
    magnetometer=quad_gym.MagnetometerParams(latency=0.02),
)
WORLD = WorldParams(
    gust_wind_speed=3.0,
    ground=quad_gym.GroundParams(),
    ground_height=-0.2,
    ground_effect=True,
    battery=quad_gym.BatteryParams(),
    obstacles=(
        quad_gym.Wall(center_I=(9.0, 0.0, 1.0)),
        quad_gym.Cylinder(center_I=(9.0, 5.0, 1.0)),
    ),
    geofence=((-50.0, -50.0, -50.0), (50.0, 50.0, 50.0)),
)
TASK = TaskParams(start="hover")

ELSEWHERE = {
    "estimator.gravity": "of a filter without flights, as its docstring says",
    "estimator.ground_height": "of a filter without flights, too",
    "initial_pose.position_sigma": "of suites without GNSS",
}
"""Parameters with an effect elsewhere."""


def packed(**keywords):
    """Return all parameter data of a batch that kernels read."""
    batch = FlightBatch(1, **{"sensors": SENSORS, "task": TASK, "world": WORLD} | keywords)
    paths = [array.tobytes() for array in batch._paths]
    return [batch._model.tobytes(), batch._world.tobytes(), batch._settings.tobytes(), *paths]


def changed(value):
    """Return other values of a parameter; the first may be invalid."""
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, int):
        return [value + 1, value + 2]
    if isinstance(value, float):
        return [1.01 * value + 1e-4, 0.5 * value, 0.3] if math.isfinite(value) else [3.0]
    if value is None:
        return [0.3, 0.05, (0.1, 0.1, 0.1)]
    if isinstance(value, tuple) and value and isinstance(value[0], float):
        return [tuple(1.01 * x + 1e-5 for x in value), tuple(0.5 * x for x in value)]
    return []  # a choice, or a group of parameters


def in_suite(part):
    return lambda new: {"sensors": SENSORS.replace(**{part: new})}


GROUPS = {
    **{
        part: (getattr(SENSORS, part), in_suite(part))
        for part in ("imu", "gnss", "camera", "estimator", "noisy", "initial_pose")
    },
    **{part: (getattr(SENSORS, part), in_suite(part)) for part in ("barometer", "magnetometer")},
    "vehicle": (quad_gym.vehicle_params("lab"), lambda new: {"vehicle": new}),
    "gains": (quad_gym.pd_gains("lab"), lambda new: {"gains": new}),
    "action_params": (
        quad_gym.ActionParams(),
        lambda new: {"action_params": new, "control": Control.VELOCITY, "control_rate": 50.0},
    ),
    "task": (TaskParams(start="mixed"), lambda new: {"task": new, "world": "calm"}),
    "reward_params": (
        quad_gym.RewardParams(),
        lambda new: {
            "task": TaskParams(
                kind="waypoints" if (new.progress, new.gate_passed) != (1.0, 1.0) else "hover",
                start="hover",
                reward_params=new,
            ),
            "world": "calm",
        },
    ),
    "world": (WORLD, lambda new: {"world": new}),
    "ground": (WORLD.ground, lambda new: {"world": WORLD.replace(ground=new)}),
    "battery": (WORLD.battery, lambda new: {"world": WORLD.replace(battery=new)}),
    "wall": (
        WORLD.obstacles[0],
        lambda new: {"world": WORLD.replace(obstacles=(new, WORLD.obstacles[1]))},
    ),
    "cylinder": (
        WORLD.obstacles[1],
        lambda new: {"world": WORLD.replace(obstacles=(WORLD.obstacles[0], new))},
    ),
}


@pytest.mark.parametrize("group", GROUPS)
def test_change_of_any_parameter_changes_kernel_data(group):
    params, keywords = GROUPS[group]
    before, without, tried = packed(**keywords(params)), [], 0
    for field in dataclasses.fields(params):
        verdicts = []
        present = getattr(params, field.name)
        for value in (value for value in changed(present) if value != present):
            try:
                verdicts.append(packed(**keywords(params.replace(**{field.name: value}))) != before)
            except ValueError:
                continue
        tried += bool(verdicts)
        if verdicts and not any(verdicts):
            without.append(f"{group}.{field.name}")
    assert tried >= 1
    assert without == [name for name in ELSEWHERE if name.startswith(f"{group}.")]

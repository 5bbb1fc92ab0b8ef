"""Cost of each option, relative to a tick with all options off."""

import sys
import time
from collections.abc import Callable
from typing import Any

import quad_gym
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.envs.flights import TASK_DEFAULTS
from quad_gym.experiments.benchmark import timing
from quad_gym.params.suites import SUITES
from quad_gym.records import Control
from scripts.benchmarks.scope import Scope

LAB = quad_gym.sensor_suite("lab")
OFF = "everything off"


def _lab(sensor: str, **changes: Any) -> dict[str, Any]:
    """Keyword of a batch: the suite "lab" with one sensor, or the filter, changed."""
    return {"sensors": LAB.replace(**{sensor: getattr(LAB, sensor).replace(**changes)})}


def _late(name: str, latency: float) -> dict[str, Any]:
    """Keyword of a batch: a suite with GNSS and camera delayed by a latency [s]."""
    suite = quad_gym.sensor_suite(name)
    assert suite.gnss is not None
    assert suite.camera is not None
    gnss, camera = suite.gnss.replace(latency=latency), suite.camera.replace(latency=latency)
    return {"sensors": suite.replace(gnss=gnss, camera=camera)}


def _world(**changes: Any) -> dict[str, Any]:
    """Keyword of a batch: another world."""
    return {"world": quad_gym.WorldParams(**changes)}


OPTIONS: dict[str, dict[str, Any]] = {
    OFF: {},
    "extended Kalman filter": _lab("estimator", kind="ekf"),
    "averaged IMU samples": {
        "sensors": LAB.replace(
            imu=LAB.imu.replace(samples="average"),
            estimator=LAB.estimator.replace(integration="midpoint"),
        )
    },
    "midpoint integration": _lab("estimator", integration="midpoint"),
    "covariance turns at its reset": _lab("estimator", attitude_reset=True),
    "pixel noise of a pinhole camera": _lab("estimator", bearing_noise_at="pinhole"),
    "images in steps at the start": _lab("estimator", recursive_update_threshold=0.01),
    "innovations kept": {"innovations": True},
    "gate": _lab("estimator", false_alarm_probability=1e-4),
    "measurements 10 ms late": _late("lab", 0.01),
    "thrust and rates, commanded": {"control": Control.CTBR},
    "thrust and rates, commanded and late": {"control": Control.CTBR, "action_delay": 1.0},
    "IMU with errors of scale and alignment": _lab(
        "imu", accel_scale_sigma=0.002, accel_misalignment_sigma=0.002
    ),
    "IMU vibrates": _lab("imu", accel_vibration=0.1, gyro_vibration=0.005),
    "constant heading error": _lab("gnss", heading_error_sigma=0.01),
    "camera's range, blur and ground": _lab(
        "camera", max_range=13.0, exposure=0.003, ground_hides=True
    ),
    "wind and rotor drag": _world(wind_I=(4.0, 0.0, 0.0), linear_drag_B=(0.4, 0.3, 0.0)),
    "gusts": _world(gust_wind_speed=4.0),
    "ground effect": _world(ground_effect=True),
    "battery": _world(battery=quad_gym.BatteryParams()),
    "world breeze": {"world": "breeze"},
    "all faults": {"faults": "all"},
    "mass drawn for each episode": {
        "randomization": {"mass": quad_gym.Uniform(0.9, 1.1, relative=True)}
    },
    **{f"suite {name}": {"sensors": name} for name in SUITES if name != "lab"},
    **{
        f"suite {name}, simplified": {"sensors": quad_gym.sensor_suite(name).simplified()}
        for name in ("rtk", "consumer", "indoor")
    },
    "suite rtk, prompt": _late("rtk", 0.0),
}
"""Keywords of `FlightBatch` for each option; the suite is "lab" unless given."""

STARTS: dict[str, dict[str, Any]] = {
    "reset of a flight, cold start": {"filter_start": "cold"},
    "reset of a flight, warm start": {"filter_start": "warm"},
}
"""Keywords of `FlightBatch` for resets."""

TICKS = 10
"""Ticks in a turn: so few that flights with and without an option still see the same features, and
that some turns are undisturbed."""


def time_options(scope: Scope) -> list[timing.Row]:
    """Time a tick of a flight with each option, and a reset with each start, on one core."""
    count, effort = scope.batch, scope.effort
    task = TASK_DEFAULTS["hover"].replace(duration=0.0)
    turns: dict[str, Callable[[], float]] = {}
    for name, options in {**OPTIONS, **STARTS}.items():
        options = {"sensors": "lab", **options}
        if options.get("control", Control.PD) is Control.PD:
            options["gains"] = "tuned"
        batch = FlightBatch(count, task=task, threads=1, **options)
        batch.reset(seeds=range(count))
        for _ in range(50):  # past the start, where images are processed in steps
            batch.step()
        turns[name] = _turn_of(batch, batch.step if name in OPTIONS else batch.reset)
    number = max(2, round(effort.repeats * effort.seconds / (TICKS * count * turns[OFF]())))
    print(f"  {number} turns", file=sys.stderr, flush=True)
    timings = dict(zip(turns, timing.by_turns(turns.values(), number), strict=True))
    off = timings[OFF].best
    return [
        timing.report(name, timed, times_off=timed.best / off, suite=_suite_of(name))
        for name, timed in timings.items()
    ]


def _suite_of(name: str) -> str:
    """Name of the suite of an option."""
    return name.split(",")[0].removeprefix("suite ") if name.startswith("suite ") else "lab"


def _turn_of(batch: FlightBatch, job: Callable[[], Any]) -> Callable[[], float]:
    """Function that does the job `TICKS` times from the present state, and returns its time [s]."""
    start = batch.snapshot()

    def turn() -> float:
        batch.restore(start)
        began = time.perf_counter()
        for _ in range(TICKS):
            job()
        return (time.perf_counter() - began) / (TICKS * batch.count)

    return turn


SECTION = timing.Section(
    time_options,
    {
        "One flight's tick with one option on, one core": {
            "option": timing.NAME,
            "suite": timing.column("suite"),
            "us": timing.column("seconds", ".3f", 1e6),
            "spread": timing.SPREAD,
            "x off": timing.column("times_off", ".2f"),
        }
    },
)

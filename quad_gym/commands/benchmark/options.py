"""The options' part of the benchmark: what each costs, over a tick with all of them off.

Batches take turns, so that other load on the machine slows all of them alike.
"""

import sys
import time
from collections.abc import Callable
from typing import Any

import quad_gym
from quad_gym.analysis.reports import text_table
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.commands.benchmark.timing import Effort, Row, by_turns, percent, report
from quad_gym.envs.configuration import TASK_DEFAULTS
from quad_gym.params.suites import SUITES
from quad_gym.records import Control

LAB = quad_gym.sensor_suite("lab")
OFF = "everything off"


def filter_form(**changes: Any) -> dict[str, Any]:
    """The laboratory's suite with another form of the filter, as a keyword of a batch."""
    return {"sensors": LAB.replace(estimator=LAB.estimator.replace(**changes))}


def in_a_world(**changes: Any) -> dict[str, Any]:
    """Another world, as a keyword of a batch."""
    return {"world": quad_gym.WorldParams(**changes)}


def arriving_late(name: str, gnss: float, camera: float) -> dict[str, Any]:
    """A suite whose measurements reach the filter late [s], as a keyword of a batch."""
    suite = quad_gym.sensor_suite(name)
    assert suite.gnss is not None
    assert suite.camera is not None
    gnss_late, camera_late = (
        suite.gnss.replace(latency=gnss),
        suite.camera.replace(latency=camera),
    )
    return {"sensors": suite.replace(gnss=gnss_late, camera=camera_late)}


def lab_sensor(part: str, **changes: Any) -> dict[str, Any]:
    """The laboratory's suite with one sensor changed, as a keyword of a batch."""
    return {"sensors": LAB.replace(**{part: getattr(LAB, part).replace(**changes)})}


OPTIONS: dict[str, dict[str, Any]] = {
    OFF: {},
    "extended Kalman filter": filter_form(kind="ekf"),
    "averaged IMU samples": {
        "sensors": LAB.replace(
            imu=LAB.imu.replace(samples="average"),
            estimator=LAB.estimator.replace(integration="midpoint"),
        )
    },
    "midpoint integration": filter_form(integration="midpoint"),
    "covariance turns at its reset": filter_form(attitude_reset=True),
    "pixel noise of a pinhole camera": filter_form(bearing_noise_at="pinhole"),
    "images in steps at the start": filter_form(recursive_update_threshold=0.01),
    "innovations kept": {"innovations": True},
    "gate": filter_form(false_alarm_probability=1e-4),
    "measurements 10 ms late": arriving_late("lab", gnss=0.01, camera=0.01),
    "thrust and rates, commanded": {"control": Control.CTBR},
    "thrust and rates, commanded and late": {"control": Control.CTBR, "action_delay": 1.0},
    "IMU errs in scale and alignment": lab_sensor(
        "imu", accel_scale_sigma=0.002, accel_misalignment_sigma=0.002
    ),
    "IMU vibrates": lab_sensor("imu", accel_vibration=0.1, gyro_vibration=0.005),
    "constant heading error": lab_sensor("gnss", heading_error_sigma=0.01),
    "camera's range, blur and ground": lab_sensor(
        "camera", max_range=13.0, exposure=0.003, ground_hides=True
    ),
    "wind and rotor drag": in_a_world(wind_I=(4.0, 0.0, 0.0), linear_drag_B=(0.4, 0.3, 0.0)),
    "gusts": in_a_world(gust_wind_speed=4.0),
    "ground effect": in_a_world(ground_effect=True),
    "battery": in_a_world(battery=quad_gym.BatteryParams()),
    "world breeze": {"world": "breeze"},
    "all faults": {"faults": "all"},
    "mass drawn anew each episode": {
        "randomization": {"mass": quad_gym.Uniform(0.9, 1.1, relative=True)}
    },
    **{f"suite {name}": {"sensors": name} for name in SUITES if name != "lab"},
    **{
        f"suite {name}, simplified": {"sensors": quad_gym.sensor_suite(name).simplified()}
        for name in ("rtk", "consumer", "indoor")
    },
    "suite rtk, prompt": arriving_late("rtk", gnss=0.0, camera=0.0),
}
"""What is switched on, as keywords of `FlightBatch`; without a suite, it is the laboratory's."""

STARTS: dict[str, dict[str, Any]] = {
    "reset of a flight, cold start": {"filter_start": "cold"},
    "reset of a flight, warm start": {"filter_start": "warm"},
}
"""Likewise, of what is timed at its reset."""


TICKS = 10
"""Ticks in a turn: so few that flights with and without an option still see the same features, and
that some turns pass undisturbed."""


def time_options(count: int, effort: Effort) -> list[Row]:
    """A tick of a flight with each option, and a reset with each start, on one core."""
    task = TASK_DEFAULTS["hover"].replace(duration=0.0)
    turns: dict[str, Callable[[], float]] = {}
    for name, options in {**OPTIONS, **STARTS}.items():
        options = {"sensors": "lab", **options}
        if options.get("control", Control.PD) is Control.PD:
            options["gains"] = "tuned"
        batch = FlightBatch(count, task=task, threads=1, **options)
        batch.reset(seeds=range(count))
        for _ in range(50):  # the start, where images are processed in steps, is not what counts
            batch.step()
        turns[name] = turn_of(batch, batch.step if name in OPTIONS else batch.reset)
    number = max(2, round(effort.repeats * effort.seconds / (TICKS * count * turns[OFF]())))

    def say(turn: int) -> None:
        if turn % 20 == 0:
            print(f"  turn {turn + 1} of {number}", file=sys.stderr, flush=True)

    timings = dict(zip(turns, by_turns(turns.values(), number, say), strict=True))
    off = timings[OFF].best
    return [
        report(name, timing, times_off=timing.best / off, suite=suite_of(name))
        for name, timing in timings.items()
    ]


def suite_of(name: str) -> str:
    """The suite that the flights of an option measure with, whose filter the option may change."""
    return name.split(",")[0].removeprefix("suite ") if name.startswith("suite ") else "lab"


def turn_of(batch: FlightBatch, job: Callable[[], Any]) -> Callable[[], float]:
    """A function that does the job `TICKS` times from here on, and returns seconds a flight."""
    start = batch.snapshot()

    def turn() -> float:
        batch.restore(start)
        began = time.perf_counter()
        for _ in range(TICKS):
            job()
        return (time.perf_counter() - began) / (TICKS * batch.count)

    return turn


def options_table(rows: list[Row]) -> str:
    """The options' figures."""
    cells = [
        (
            r["name"],
            r["suite"],
            f"{1e6 * r['seconds']:.3f}",
            percent(r["spread"]),
            f"{r['times_off']:.2f}",
        )
        for r in rows
    ]
    heading = "One flight's tick with one option on, one core"
    return text_table({heading: ["option", "suite", "us", "spread", "x off"]}, cells)

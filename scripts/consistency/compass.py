"""Consistency and tilt of filters whose compass is wrong from the start.

Two suites fly two tasks, controlled by the truth. The NEES per state at the end is 1 if the filter
is consistent. In a column of its own are the flights that do not use the compass at the end any
more. Filters without a compass, whose first heading is unknown, fly the same seeds for comparison:
they have no fault to detect.

Errors of the attitude are rotation vectors: Euler angles of an unknown heading are not linear in
it.
"""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from quad_gym.analysis.consistency import flight_errors
from quad_gym.analysis.metrics import STATE_DIMENSION, nees
from quad_gym.commands.consistency import Case, CaseFlights
from quad_gym.faults import MagnetometerDisturbance
from quad_gym.params.suites import SensorSuite, sensor_suite
from quad_gym.records import Control, Source
from quad_gym.rotations import quaternion_to_dcm
from scripts.consistency.tables import CaseResults, case_table

MOST_NEES = 1.3  #: NEES per state above which a filter is inconsistent
LARGE = math.radians(10.0)  #: tilt that counts as large [rad]
EVERY = 0.1  #: time between two looks at the tilt [s]
UNKNOWN = math.pi / math.sqrt(3.0)  #: standard deviation of an unknown heading [rad]
COMPASSES = {
    "turned by 60 degrees": MagnetometerDisturbance(how="turned", angle=math.radians(60.0)),
    "reversed": MagnetometerDisturbance(how="turned", angle=math.pi),
    "near iron, 20 µT": MagnetometerDisturbance(how="iron", iron=20e-6),
    "none": None,
}
COLUMNS = {
    "nees": "NEES per state",
    "standard_error": "its standard error",
    "in_use": "compass in use [%]",
    "without": "NEES where it is not",
    "tilted": "tilt off by more than 10 degrees [%]",
    "worst_tilt": "largest tilt error [deg]",
}


def without_compass(suite: SensorSuite) -> SensorSuite:
    """A suite without its compass, whose filter begins with an unknown heading."""
    pose = suite.initial_pose.replace(heading_sigma=UNKNOWN)
    return suite.replace(magnetometer=None, initial_pose=pose)


def cases() -> Iterator[Case]:
    """Both suites on both tasks, with each wrong compass and without one."""
    flown: dict[str, Any] = {"control": Control.PD, "source": Source.TRUTH, "run_filter": True}
    for name in ("consumer", "field"):
        suite = sensor_suite(name)
        for task in ("circle", "random_trajectory"):
            for compass, fault in COMPASSES.items():
                label = f"{name}, {task.replace('_', ' ')}, {compass}"
                if fault is None:
                    yield Case(label, without_compass(suite), task, keywords=flown)
                else:
                    yield Case(label, suite, task, keywords=flown | {"faults": (fault,)})


def measure(case: Case, flights: CaseFlights) -> dict[str, Any]:
    """Fly a case: values by column, and the configuration."""
    batch = case.batch(flights.count, flights.threads)
    batch.reset(seeds=flights.seeds)
    stride, tilt = round(EVERY * batch.sensors.imu.rate), np.zeros(batch.count)
    for _ in range(round(flights.duration / EVERY)):
        for _ in range(stride):
            batch.step()
        R_BI, R_hat = quaternion_to_dcm(batch.record("q")), batch.record("R_hat")
        apart = np.linalg.norm(R_BI[:, :, 2] - R_hat[:, :, 2], axis=1)
        tilt = np.maximum(tilt, 2.0 * np.arcsin(0.5 * apart))
    squares = nees(flight_errors(batch, rotation_vector=True), batch.covariance())
    squares = squares / STATE_DIMENSION
    values = {
        "nees": float(squares.mean()),
        "standard_error": float(squares.std() / math.sqrt(batch.count)),
        "tilted": 100.0 * float((tilt > LARGE).mean()),
        "worst_tilt": math.degrees(tilt.max()),
    }
    if "faults" in case.keywords:
        out = batch.record("compass_out") > 0.0
        values["in_use"] = 100.0 * float((~out).mean())
        values["without"] = float(squares[out].mean()) if out.any() else math.nan
    return {
        "values": values,
        "misses": ["nees"] if values["nees"] > MOST_NEES else [],
        "expected": case.expected,
        "filters_failed": int((batch.record("filter_status") != 0).sum()),
        "sensors": batch.sensors,
        "task": batch.task,
        "faults": batch.faults,
    }


def table_of(cells: CaseResults, flights: CaseFlights) -> str:
    """Format the table in Markdown."""
    lines = case_table("suite, task, compass", COLUMNS, cells, "{:.2f}".format)
    head = f"{flights.count} flights of {flights.duration:g} s each, controlled by the truth."
    end = f"**Bold**: a NEES above {MOST_NEES:g}."
    return "\n".join([head, "", *lines, "", end]) + "\n"

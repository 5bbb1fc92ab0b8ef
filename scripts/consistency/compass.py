"""Consistency and tilt of filters whose compass is wrong from the start.

    python -m scripts.consistency.compass

prints, for two suites and two tasks, the mean NEES per state `AFTER` the start, with its standard
error, and in how many flights the tilt was ever off by more than `LARGE`. The flights are
controlled by the truth. A filter without a compass, whose first heading is unknown, flies the same
seeds for comparison: it has no fault to detect.

Errors of the attitude are rotation vectors: Euler angles of an unknown heading are not linear in
it.
"""

import argparse
import math
from dataclasses import dataclass

import numpy as np

from quad_gym.analysis.consistency import FIELDS, endless
from quad_gym.analysis.metrics import STATE_DIMENSION, nees, state_error
from quad_gym.analysis.reports import markdown_table
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.envs.config import TASK_DEFAULTS
from quad_gym.faults import MagnetometerDisturbance
from quad_gym.params.suites import SensorSuite, sensor_suite
from quad_gym.records import Control, Source
from quad_gym.rotations import quaternion_to_dcm

AFTER = 10.0  #: time at which the NEES is evaluated [s]
LARGE = math.radians(10.0)  #: tilt that counts as large [rad]
EVERY = 0.1  #: time between two looks at the tilt [s]
UNKNOWN = math.pi / math.sqrt(3.0)  #: standard deviation of an unknown heading [rad]
COMPASSES = {
    "turned by 60 degrees": MagnetometerDisturbance(how="turned", angle=math.radians(60.0)),
    "reversed": MagnetometerDisturbance(how="turned", angle=math.pi),
    "near iron, 20 µT": MagnetometerDisturbance(how="iron", iron=20e-6),
    "none": None,
}
HEADS = ["suite, task", "compass", "NEES per state", "tilt off by more than 10 degrees [%]",
         "largest tilt error [deg]"]  # fmt: skip


@dataclass(frozen=True)
class Found:
    """Results of the flights of one row."""

    nees: float
    """mean NEES per state"""
    uncertainty: float
    """standard error of the mean"""
    share: float
    """share of flights with a large error of the tilt"""
    worst: float
    """largest error of the tilt [rad]"""


def follow(batch: FlightBatch, seeds: range) -> Found:
    """Fly, and compare the filter with the truth."""
    batch.reset(seeds=seeds)
    stride, tilt = round(EVERY * batch.sensors.imu.rate), np.zeros(batch.count)
    for _ in range(round(AFTER / EVERY)):
        for _ in range(stride):
            batch.step()
        R_BI, R_hat = quaternion_to_dcm(batch.record("q")), batch.record("R_hat")
        apart = np.linalg.norm(R_BI[:, :, 2] - R_hat[:, :, 2], axis=1)
        tilt = np.maximum(tilt, 2.0 * np.arcsin(0.5 * apart))
    truth = {name: batch.record(field) for name, field in FIELDS.items()} | {"R_BI": R_BI}
    estimate = {name: batch.record(f"{field}_hat") for name, field in FIELDS.items()}
    errors = state_error(truth, estimate | {"R_BI": R_hat}, rotation_vector=True)
    found = nees(errors, batch.covariance()) / STATE_DIMENSION
    return Found(
        nees=float(found.mean()),
        uncertainty=float(found.std() / math.sqrt(batch.count)),
        share=float((tilt > LARGE).mean()),
        worst=float(tilt.max()),
    )


def without_compass(suite: SensorSuite) -> SensorSuite:
    """A suite without its compass, whose filter begins with an unknown heading."""
    pose = suite.initial_pose.replace(heading_sigma=UNKNOWN)
    return suite.replace(magnetometer=None, initial_pose=pose)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--episodes", type=int, default=256, help="number of flights of each row")
    args, rows = parser.parse_args(), []
    for name in ("consumer", "field"):
        for task in ("circle", "random_trajectory"):
            for compass, fault in COMPASSES.items():
                suite = sensor_suite(name)
                batch = FlightBatch(
                    args.episodes,
                    sensors=without_compass(suite) if fault is None else suite,
                    task=endless(TASK_DEFAULTS[task]),
                    gains="tuned",
                    control=Control.PD,
                    source=Source.TRUTH,
                    run_filter=True,
                    innovations=True,
                    faults=fault,
                )
                found = follow(batch, range(args.episodes))
                mean = f"{found.nees:.2f} ± {found.uncertainty:.2f}"
                share, worst = f"{100.0 * found.share:.1f}", f"{math.degrees(found.worst):.1f}"
                rows.append([f"`{name}`, {task.replace('_', ' ')}", compass, mean, share, worst])
    print(markdown_table(HEADS, rows, texts=2))


if __name__ == "__main__":
    main()

"""Columns of the record of a flight."""

from typing import Any, NamedTuple

import numpy as np

from quad_gym.batch.quantities import QUANTITIES


class Column(NamedTuple):
    """One quantity of a flight."""

    name: str
    shape: tuple[int, ...]  #: shape of one row; FEATURES stands for the camera's number of features
    unit: str
    frame: str  #: I: inertial (east, north, up), B: body, C: image; "-": none
    meaning: str


FEATURES = -1

# fmt: off
_ROWS: tuple[str | Column, ...] = (
    "time",
    # the truth
    *("position", "velocity", "quaternion", "body_rates", "rotor_speeds", "accel_bias", "gyro_bias"),
    *("disturbance", "wind", "faults"),
    # the filter
    *("estimated_position", "estimated_velocity", "estimated_quaternion"),
    *("estimated_accel_bias", "estimated_gyro_bias"),
    Column("covariance", (15, 15), "mixed", "mixed", "the filter's covariance of position, velocity, attitude error, accelerometer and gyro bias"),
    *("filter_status", "filter_diverged"),
    Column("nees", (), "-", "-", "normalized estimation error squared; 15 on average if the filter is consistent"),
    *("nis", "nis_dimension"),
    # the state that the controller observed
    *("observed_position", "observed_quaternion"),
    # the latest measurements since the previous row
    *("gyro", "accel", "gnss_position", "gnss_baseline", "gnss_velocity"),
    Column("gnss_decision", (3,), "-", "-", "gate decisions on position, baseline and velocity, see `GateDecision`; 0: no gate"),
    "pixels",
    Column("feature_decision", (FEATURES,), "-", "-", "gate decision on each feature, see `GateDecision`"),
    # the task: the action and the reward of the step that led to this row
    *("action", "reference_position", "gates_passed", "reward"),
    *("position_error", "estimation_error"),
)
# fmt: on


def _column(row: str | Column) -> Column:
    """Return a column, which may be a quantity of flights."""
    if isinstance(row, Column):
        return row
    quantity = QUANTITIES[row]
    shape = tuple(FEATURES if isinstance(size, str) else size for size in quantity.shape)
    unit = "0 or 1" if quantity.kind is bool else quantity.unit
    return Column(row, shape, unit, quantity.frame, quantity.meaning)


COLUMNS = tuple(map(_column, _ROWS))  #: columns of a flight, in order

READ = tuple(row for row in _ROWS if isinstance(row, str) and row != "reference_position")
"""Columns that are quantities of a batch, copied unchanged."""

WITH_FILTER = (
    *(name for name in READ if QUANTITIES[name].filtered),
    *("covariance", "nees", "gnss_decision", "feature_decision"),
)
"""Columns that are NaN if no filter, and so no sensor, runs."""


def row_dtype(features: int) -> np.dtype[Any]:
    """Return the data type of a row for a number of features."""
    return np.dtype(
        [(c.name, "f8", tuple(features if n == FEATURES else n for n in c.shape)) for c in COLUMNS]
    )

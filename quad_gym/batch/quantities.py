"""Quantities of flights by their public names, and where the records of flights have them.

Records and kernels have the symbols of the report (`r`, `v_hat`, `b_a`). A `Flight`, the view of a
task, the estimators and `FlightBatch.read` have words, the same everywhere. `QUANTITIES` is the
only table of both.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_gym.batch.memory import FlightMemory
from quad_gym.packing import blocks_of
from quad_gym.params import checks as check
from quad_gym.params.aids import ReadingDefinition
from quad_gym.params.sensor_table import DRIFTING, READINGS, SENSOR_PARAMS
from quad_gym.records import (
    BLOCKS_OF,
    HEADING_ALONG,
    HEADING_VELOCITY,
)
from quad_gym.rotations import dcm_to_quaternion, quaternion_to_dcm

Floats = NDArray[np.float64]
Flights = NDArray[np.intp] | None
Computed = Callable[[FlightMemory, Flights], NDArray[Any]]


class Quantity(NamedTuple):
    """One quantity of a batch of flights."""

    of: str | Computed  #: the field of the records, or a function that computes it
    shape: tuple[int | str, ...]  #: for one flight; a word: as many as there are of these
    unit: str
    frame: str  #: I: inertial (east, north, up), B: body, C: image; "-": none
    meaning: str
    kind: type = float
    filtered: bool = False  #: True if only flights have it in which a filter, and so sensors, run
    builtin: bool = False  #: True if only the built-in filter has it: NaN with a user's estimator


def read(batch: FlightMemory, name: str, flights: Flights) -> NDArray[Any]:
    """A quantity of flights as a new array (n, ...); see `FlightBatch.read`."""
    quantity = QUANTITIES.get(name) if isinstance(name, str) else None
    if quantity is None:
        drawn = batch.randomization.names
        known = (*QUANTITIES, *drawn)
        meant = check.did_you_mean(name, known) or f": one of {', '.join(known)}"
        raise ValueError(f"name must be a quantity of flights, got {name!r}{meant}")
    if quantity.filtered and not batch.run_filter:
        raise ValueError(f"{name} needs a filter, and none runs in these flights")
    of = quantity.of
    values = batch.record(of, flights) if isinstance(of, str) else of(batch, flights)
    if quantity.builtin and batch.configuration.estimator is not None:
        return np.full_like(values, np.nan)
    if quantity.kind is bool:
        return np.asarray(values > 0.0)
    return values if quantity.kind is float else values.astype(np.int64)


# ---- what follows from the records ------------------------------------------------------------


def _of_rows(turn: Callable[[Floats], Floats], values: Floats, shape: tuple[int, ...]) -> Floats:
    """Attitudes in another form, NaN where a flight has none or has left the finite numbers."""
    flat = values.reshape(len(values), math.prod(values.shape[1:]))
    good = np.isfinite(flat).all(axis=1) & flat.any(axis=1)
    found = np.full((len(values), *shape), np.nan)
    if good.any():
        found[good] = turn(values[good])
    return found


def _quaternions(field: str) -> Computed:
    """Quaternions of a field of matrices."""
    return lambda batch, flights: _of_rows(dcm_to_quaternion, batch.record(field, flights), (4,))


def _true_R_BI(batch: FlightMemory, flights: Flights) -> Floats:
    return _of_rows(quaternion_to_dcm, batch.record("q", flights), (3, 3))


def _time(batch: FlightMemory, flights: Flights) -> Floats:
    return np.asarray(batch.record("tick", flights) * batch.sensors.imu.dt)


def _estimated_rates(batch: FlightMemory, flights: Flights) -> Floats:
    if batch.configuration.estimator is not None:
        return batch.record("w_hat", flights)
    return np.asarray(batch.record("w_meas", flights) - batch.record("b_g_hat", flights))


def _first(field: str, count: Callable[[FlightMemory], int]) -> Computed:
    """Rows of a field that are in use."""
    return lambda batch, flights: np.ascontiguousarray(
        batch.record(field, flights)[:, : count(batch)]
    )


def _obstacle_distance(batch: FlightMemory, flights: Flights) -> Floats:
    found = batch.record("obstacle_distance", flights)
    return found if batch.world.obstacles else np.full_like(found, np.inf)


def _features(batch: FlightMemory, flights: Flights) -> Floats:
    places = batch.feature_places()
    return np.array(places if flights is None else places[flights])


def _reference(which: int) -> Computed:
    """Position, velocity, acceleration or heading of the reference at the present instant."""

    def of(batch: FlightMemory, flights: Flights) -> Floats:
        if batch.task.kind == "trajectory":
            return batch.record(f"path_{'rvax'[which]}", flights)
        return _series(batch, flights)[which]

    return of


def _series(batch: FlightMemory, flights: Flights) -> tuple[Floats, Floats, Floats, Floats]:
    """(r*, v*, a*, x*) of a reference that is a finite Fourier series, (n, 3) each."""
    cosines, sines = batch.record("ref_cos", flights), batch.record("ref_sin", flights)
    rate = batch.record("ref_omega", flights)[:, np.newaxis] * np.arange(1, 1 + cosines.shape[1])
    angle, rate = rate * _time(batch, flights)[:, np.newaxis], rate[..., np.newaxis]
    c, s = np.cos(angle)[..., np.newaxis], np.sin(angle)[..., np.newaxis]
    swing = cosines * c + sines * s
    r_ref = batch.record("ref_center", flights) + swing.sum(axis=1)
    v_ref = (rate * (sines * c - cosines * s)).sum(axis=1)
    a_ref = -(rate**2 * swing).sum(axis=1)
    point = batch.record("ref_heading_point", flights)
    rule = batch.record("ref_heading_rule", flights)[:, np.newaxis]
    along = np.where(rule == HEADING_VELOCITY, v_ref, point - r_ref)
    level = np.where(rule == HEADING_ALONG, point, along) * (1.0, 1.0, 0.0)
    length = np.linalg.norm(level, axis=1, keepdims=True)
    x_ref = np.where(length > 1e-30, level / np.maximum(length, 1e-30), (1.0, 0.0, 0.0))
    return r_ref, v_ref, a_ref, x_ref


def _measured(batch: FlightMemory, flights: Flights) -> NDArray[np.bool_]:
    """A mask of blocks measured since the last step, or at the start of the episode."""
    fresh = batch.record("block_fresh", flights) + batch.record("block_valid", flights)
    return np.asarray(fresh > 0.0)


def _read(reading: ReadingDefinition) -> Computed:
    """The last measurement of a reading, vectors turned from G to I."""

    def of(batch: FlightMemory, flights: Flights) -> Floats:
        count, first = batch.sensors.blocks_of(reading.name), BLOCKS_OF[reading.name].start
        if reading.block == "" and count == 0:  # no such sensor
            count = reading.most_blocks
        blocks = slice(first, first + count)
        found = batch.record("measurement", flights)[:, blocks, : reading.length]
        if reading.in_G:
            x, y, z = found[:, 0].T  # each sum in one order, in batches of any size
            turned = [row[0] * x + row[1] * y + row[2] * z for row in batch.R_IG]
            found = np.stack(turned, axis=1)[:, np.newaxis]
        found = np.where(_measured(batch, flights)[:, blocks, np.newaxis], found, np.nan)
        several = (count,) * (reading.most_blocks > 1)
        return found.reshape(len(found), *several, *(reading.length,) * (reading.length > 1))

    return of


def _of_reading(reading: ReadingDefinition) -> Quantity:
    about = (reading.unit, reading.frame, reading.meaning)
    return Quantity(_read(reading), reading.dimensions, *about, filtered=True)


def _of_drift(sensor: str, estimated: bool = False) -> Quantity:
    """The drift of a sensor, of its first reading, or the filter's estimate."""
    reading = SENSOR_PARAMS[sensor].readings(sensor)[0]
    about = (reading.length,), reading.unit, reading.frame
    if not estimated:
        return Quantity("drift", *about, f"time-correlated error of `{reading.name}`")
    meaning = f"the filter's estimate of `{sensor}_drift`"
    return Quantity("drift_hat", *about, meaning, filtered=True, builtin=True)


# fmt: off
QUANTITIES = {
    "time": Quantity(_time, (), "s", "-", "time since the start of the episode"),
    "step": Quantity("step", (), "-", "-", "control steps since the start of the episode", int),
    # the truth
    "position": Quantity("r", (3,), "m", "I", "true position of the center of mass"),
    "velocity": Quantity("v", (3,), "m/s", "I", "true velocity of the center of mass"),
    "quaternion": Quantity("q", (4,), "-", "B to I", "true attitude, unit quaternion (w, x, y, z)"),
    "R_BI": Quantity(_true_R_BI, (3, 3), "-", "I to B", "true attitude, v_B = R_BI v_I"),
    "body_rates": Quantity("w", (3,), "rad/s", "B", "true body rates"),
    "rotor_speeds": Quantity("rotor_speeds", (4,), "rad/s", "-", "true speeds of the four rotors"),
    "accel_bias": Quantity("b_a", (3,), "m/s^2", "B", "true bias of the accelerometer"),
    "gyro_bias": Quantity("b_g", (3,), "rad/s", "B", "true bias of the gyro"),
    **{f"{name}_drift": _of_drift(name) for name in DRIFTING},
    "disturbance": Quantity("disturbance", (3,), "N", "I", "external force on the body"),
    "wind": Quantity("wind", (3,), "m/s", "I", "velocity of the air"),
    "faults": Quantity("faults", (), "bits", "-", "active at the present instant: the sum of 2^`FaultKind`", int),
    # the filter's estimate
    "estimated_position": Quantity("r_hat", (3,), "m", "I", "the filter's estimate of `position`", filtered=True),
    "estimated_velocity": Quantity("v_hat", (3,), "m/s", "I", "the filter's estimate of `velocity`", filtered=True),
    "estimated_quaternion": Quantity(_quaternions("R_hat"), (4,), "-", "B to I", "the filter's estimate of `quaternion`", filtered=True),
    "estimated_R_BI": Quantity("R_hat", (3, 3), "-", "I to B", "the filter's estimate of `R_BI`", filtered=True),
    "estimated_body_rates": Quantity(_estimated_rates, (3,), "rad/s", "B", "measured rates minus the estimated bias", filtered=True),
    "estimated_accel_bias": Quantity("b_a_hat", (3,), "m/s^2", "B", "the filter's estimate of `accel_bias`", filtered=True),
    "estimated_gyro_bias": Quantity("b_g_hat", (3,), "rad/s", "B", "the filter's estimate of `gyro_bias`", filtered=True),
    **{f"estimated_{name}_drift": _of_drift(name, estimated=True) for name in DRIFTING},
    "filter_status": Quantity("filter_status", (), "bits", "-", "numerical failures of the filter so far, see `FilterStatus`", int),
    "filter_diverged": Quantity("diverged", (), "-", "-", "the filter flags itself as diverged: the covariance does not explain the last innovations (filters with an innovation gate, or with `faults`, `truncate_when_diverged` or `innovations`)", bool),
    "nis": Quantity("nis", (), "-", "-", "normalized innovation squared of the last update; NaN: it was done in steps", filtered=True, builtin=True),
    "nis_dimension": Quantity("nis_dimension", (), "-", "-", "degrees of freedom of the measurements in the last update: a direction has two", int, filtered=True),
    # the state that the controller observes: the truth, the estimate, or the truth with noise
    "observed_position": Quantity("r_seen", (3,), "m", "I", "position from the controller's source"),
    "observed_velocity": Quantity("v_seen", (3,), "m/s", "I", "velocity from the controller's source"),
    "observed_quaternion": Quantity(_quaternions("R_seen"), (4,), "-", "B to I", "attitude from the controller's source"),
    "observed_R_BI": Quantity("R_seen", (3, 3), "-", "I to B", "attitude from the controller's source"),
    "observed_body_rates": Quantity("w_seen", (3,), "rad/s", "B", "angular rate from the controller's source"),
    # the last measurements since the last step, NaN where there was none
    "gyro": Quantity("gyro", (3,), "rad/s", "B", "angular rate", filtered=True),
    "accel": Quantity("accel", (3,), "m/s^2", "B", "specific force", filtered=True),
    **{name: _of_reading(reading) for name, reading in READINGS.items()},
    # the task
    "action": Quantity("action", (4,), "-", "-", "the present action, in [-1, 1]"),
    "last_action": Quantity("last_action", (4,), "-", "-", "the action before it"),
    "reference_position": Quantity(_reference(0), (3,), "m", "I", "position of the reference; on a course, the next gate"),
    "reference_velocity": Quantity(_reference(1), (3,), "m/s", "I", "velocity of the reference"),
    "reference_acceleration": Quantity(_reference(2), (3,), "m/s^2", "I", "acceleration of the reference"),
    "reference_heading": Quantity(_reference(3), (3,), "-", "I", "horizontal direction in which body x is to point"),
    "gates": Quantity(_first("gates", lambda b: b.task.gate_count * (b.task.kind == "waypoints")), ("gates", 3), "m", "I", "centers of the course's gates, in order"),
    "gates_passed": Quantity("gate_next", (), "-", "-", "gates passed in this episode", int),
    "reward": Quantity("reward", (), "-", "-", "reward of the last step"),
    "terminated": Quantity("terminated", (), "-", "-", "the last step ended the episode by a crash or at the goal", bool),
    "truncated": Quantity("truncated", (), "-", "-", "the last step ended the episode by its time limit or a failed filter", bool),
    "ending": Quantity("ending", (), "-", "-", "why the episode ended, see `Ending`", int),
    "position_error": Quantity("position_error", (), "m", "-", "distance of the true position from the reference"),
    "estimation_error": Quantity("estimation_error", (), "m", "-", "distance of the observed from the true position"),
    # the surroundings
    "features": Quantity(_features, ("features", 3), "m", "I", "features of the camera, in the filter's map of this episode"),
    "obstacles": Quantity(_first("obstacle_center", lambda b: len(b.world.obstacles)), ("obstacles", 3), "m", "I", "centers of the world's obstacles in this episode, in the order given"),
    "obstacle_distance": Quantity(_obstacle_distance, (), "m", "-", "from the nearest obstacle's surface, negative inside, infinite without obstacles"),
    "on_ground": Quantity("footing", (), "-", "-", "a foot touches the ground, in a world whose ground supports vehicles", bool),
}
"""Every quantity that `FlightBatch.read` returns, by its name."""
# fmt: on


def innovations_of(batch: FlightMemory) -> dict[str, NDArray[Any]]:
    """Return the last innovations of all flights, block by block.

    The blocks are position, baseline, velocity and features, followed by those of the suite's other
    sensors, in the order of `SensorTable`.

    Returns:
        Arrays (n, blocks, ...): "measured" (True if measured since the last step); "innovation" and
        "sigma" (its standard deviation predicted by the filter), three numbers each, of which a
        direction uses two; "nis"; "gate", see `quad_gym.records.GateDecision`; "rejections" in this
        episode. NaN: not measured yet.
    """
    blocks = list(blocks_of(batch.sensors))
    fields = ("block_fresh", "innovation", "innovation_sigma", "block_nis", "gate", "rejections")
    fresh, innovation, sigma, nis, gate, rejections = (batch.record(f)[:, blocks] for f in fields)
    return {
        "measured": fresh > 0.0,
        "innovation": innovation,
        "sigma": sigma,
        "nis": nis,
        "gate": gate.astype(np.int64),
        "rejections": rejections.astype(np.int64),
    }

"""Warm starts: the covariance that a filter has reached before a flight begins.

Before any real take-off the filter has been running for a while. Its covariance then depends on the
sensors and hardly on the flight, so it is computed once per configuration: flights hover where the
task begins, each with its own noise, and every episode begins with the mean of their covariances,
rotated to a common heading.
"""

import functools
import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.packing.aids import slow_states
from quad_gym.packing.configuration import FlightConfiguration
from quad_gym.params import portable
from quad_gym.params.gnss import MIN_DRIFT, GnssParams
from quad_gym.params.sensors import SensorSuite
from quad_gym.params.task import TaskParams
from quad_gym.params.vehicle import VehicleParams
from quad_gym.params.world import WorldParams
from quad_gym.records import MAX_STATES, WARM_DRAWS, Autoreset, Control, Source
from quad_gym.rotations import dcm_to_euler, quaternion_to_dcm

WARM_UP = 10.0
"""Time for which a filter has been running at a warm start [s]: several correlation times of its
velocity and attitude, as between switching a vehicle on and its take-off."""

FLIGHTS = 8  #: flights whose covariances are averaged

LOST = 0.35
"""Attitude error above which a filter has diverged, whatever its covariance [rad]: the linear model
is wrong by half its square. Overconfidence alone is no reason to refuse a warm start."""

Floats = NDArray[np.float64]


def pack_warm_start(settings: Any, make: Callable[..., Any], c: FlightConfiguration) -> None:
    """Fill the fields of a warm start in a SETTINGS record; `make` makes a `FlightBatch`."""
    height, ground = c.world.ground_height, c.world.ground
    P = converged_covariance(
        make,
        vehicle=c.vehicle,
        sensors=c.sensors,
        task=c.task,
        world=WorldParams(ground_height=height),
        standing=0.0 if ground is None else height - ground.feet_B[0][2],
        substeps=c.substeps,
    )
    W = root_with_truth(P, c.sensors)
    settings["warm"] = True
    states, draws = W.shape
    settings["warm_root"][:states, :draws] = W
    settings["warm_covariance"][:states, :states] = portable.product(W, W.T)
    if c.flown_sensors.gnss is not None:
        settings["warm_drift_sigma"] = drift_sigma(c.flown_sensors.gnss)


@functools.lru_cache(maxsize=64)
def converged_covariance(
    make: Callable[..., Any],
    *,
    vehicle: VehicleParams,
    sensors: SensorSuite,
    task: TaskParams,
    world: WorldParams,
    standing: float,
    substeps: int,
) -> Floats:
    """Return the mean covariance that filters reach from a cold start in `WARM_UP` of hovering.

    It is that of a vehicle that looks east, in the order r, v, e, b_a, b_g and then the slow errors
    of sensors. Filters that fail or diverge on the way are refused, as without a known heading.
    """
    with warnings.catch_warnings():  # that the start is vague, as errors are drawn from P itself
        warnings.simplefilter("ignore", UserWarning)
        batch = make(
            FLIGHTS,
            vehicle=vehicle,
            sensors=sensors,
            task=task.replace(start="hover"),
            world=world,
            source=Source.TRUTH,
            control=Control.VELOCITY,
            control_rate=sensors.imu.rate / round(WARM_UP * sensors.imu.rate),
            substeps=substeps,
            run_filter=True,
            autoreset=Autoreset.DISABLED,
            threads=1,
        )
    batch.reset(seeds=range(FLIGHTS))
    if task.start == "ground":
        r = batch.record("r")
        r[:, 2] = standing
        batch.reset(seeds=range(FLIGHTS), position=r, velocity=np.zeros((FLIGHTS, 3)))
    batch.step(np.zeros((FLIGHTS, 4)))  # one step, as long as the whole
    if batch.record("filter_status").any():
        raise ValueError(
            f"filter_start must be 'cold' for these sensors: the filter fails within {WARM_UP:g} s "
            "of hovering"
        )
    R_error = quaternion_to_dcm(batch.record("q")) @ batch.record("R_hat").transpose(0, 2, 1)
    angle = float(np.abs(dcm_to_euler(R_error)).max())
    if angle > LOST:
        raise ValueError(
            f"filter_start must be 'cold' for these sensors: after {WARM_UP:g} s of hovering the "
            f"attitude is wrong by {math.degrees(angle):.0f} degrees. Does anything observe the "
            "heading, such as a level baseline or the heading of `initial_pose`?"
        )
    states = 15 + len(slow_states(sensors).errors)
    factors = np.zeros((batch.count, MAX_STATES, MAX_STATES))
    factors[:, :15, :15], factors[:, 15:] = batch.record("L"), batch.record("L_slow")
    mean = np.zeros((states, states))
    for q, L in zip(batch.record("q"), factors, strict=True):
        root = portable.product(_turned_east(q, sensors).T[:states, :states], L[:states, :states])
        mean += portable.product(root, root.T) / FLIGHTS
    return mean


def _turned_east(q: Floats, sensors: SensorSuite) -> Floats:
    """Return the rotation (24, 24) of quantities in I from a vehicle that looks east to this one.

    Three time-correlated errors of an aiding sensor are in B, such as hard iron. Their correlation
    with the heading error depends on the direction of the field, so they are kept as seen from I.
    """
    w, x, y, z = map(float, q)
    forward = (w * w + x * x - y * y - z * z, 2.0 * (x * y + w * z))
    c, s = (component / portable.norm(forward) for component in forward)
    turn, level, states = np.eye(MAX_STATES), np.eye(3), slow_states(sensors)
    level[:2, :2] = [[c, -s], [s, c]]
    for first in (0, 3, *([15] if states.drifts else [])):
        turn[first : first + 3, first : first + 3] = level
    for first in states.vectors:
        if first >= 0:
            turn[15 + first : 18 + first, 15 + first : 18 + first] = level.T
    return turn


def drift_sigma(gnss: GnssParams) -> Floats:
    """Return the standard deviation (3,) of the GNSS drift `WARM_UP` after it was zero [m]."""
    share = portable.approached(2.0 * WARM_UP / gnss.drift_tau)
    return np.array(gnss.drift_sigma_I) * math.sqrt(share)


def root_with_truth(P: Floats, sensors: SensorSuite) -> Floats:
    """Return W with W W^T = P, some of whose columns belong to the true biases and drifts.

    A filter that started from the distribution of the biases, of covariance S, has an estimate that
    is independent of its error, so that cov(error, bias) = P_b, the columns of P for the biases.
    Errors W u have it with u = (n, S^-1/2 bias), where n are standard normals. Time-correlated
    errors of sensors are treated in the same way.

    W is (n, WARM_DRAWS + 2 (n - 15)): the columns of the biases follow the first fifteen, and then,
    in threes, the columns of the time-correlated errors alone and of their true values.
    """
    imu = sensors.imu
    sigma = np.repeat([imu.accel_bias_sigma, imu.gyro_bias_sigma], 3)
    slow = np.array([error.sigma for error in slow_states(sensors).errors])
    if sensors.gnss is not None and sensors.drifts:
        slow[:3] = np.maximum(drift_sigma(sensors.gnss), MIN_DRIFT)
    sigma = np.concatenate([sigma, slow])
    W = np.zeros((len(P), WARM_DRAWS + 2 * len(slow)))
    with_truth = P[:, 9:] / sigma
    # the part that the truth does not explain; where it explains all, rounding leaves a rest
    rest = portable.lower_root(P - portable.product(with_truth, with_truth.T), np.diag(P))
    W[:, :15], W[:, 15:21] = rest[:, :15], with_truth[:, :6]
    for k in range(0, len(slow), 3):
        own = WARM_DRAWS + 2 * k
        W[:, own : own + 3] = rest[:, 15 + k : 18 + k]
        W[:, own + 3 : own + 6] = with_truth[:, 6 + k : 9 + k]
    return W

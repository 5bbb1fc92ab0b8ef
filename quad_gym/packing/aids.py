"""Aiding sensors and slow errors as numbers in the records that kernels read."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_gym.params import portable
from quad_gym.params.aids import SlowError
from quad_gym.params.gnss import MIN_DRIFT
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import (
    AID_BLOCK,
    AID_NUMBERS,
    AIDS,
    FEATURE_BLOCKS,
    FIRST_AID,
    MAX_SLOW,
    Sensor,
)


class SlowStates(NamedTuple):
    """Slow errors among the states of a suite's filter, in the order of the states."""

    errors: tuple[SlowError, ...]
    """slow errors, padded to a multiple of three by constants with standard deviation one"""
    estimated: int  #: number of slow errors without the padding
    drifts: bool
    """True if the first three are the drift of GNSS positions, which is zero at the start"""
    vectors: tuple[int, ...]
    """index of the first of an aiding sensor's three errors, in the order of `Aid`; -1: none"""
    scalars: tuple[int, ...]
    """index of an aiding sensor's single error, in the order of `Aid`; -1: none"""

    @property
    def first_sigmas(self) -> NDArray[np.float64]:
        """(n,) standard deviations at the start."""
        sigmas = np.array([error.sigma for error in self.errors])
        sigmas[: 3 * self.drifts] = 0.0
        return sigmas


def slow_states(sensors: SensorSuite) -> SlowStates:
    """Return the slow errors that a filter estimates if it assumes these sensors."""
    errors: list[SlowError] = []
    vectors, scalars = [-1] * AIDS, [-1] * AIDS
    if sensors.gnss is not None and sensors.drifts:
        tau = sensors.gnss.drift_tau
        errors = [SlowError(max(s, MIN_DRIFT), tau) for s in sensors.gnss.drift_sigma_I]
    for aid, params in sensors.aids.items():
        if params.assumed_vector is not None:
            vectors[aid] = len(errors)
            errors += [params.assumed_vector] * 3
    for aid, params in sensors.aids.items():
        if params.slow_scalar is not None:
            scalars[aid] = len(errors)
            errors.append(params.slow_scalar)
    count = len(errors)
    if count > MAX_SLOW:
        raise ValueError(
            f"sensors must have at most {MAX_SLOW} time-correlated errors for the filter to "
            f"estimate, got {count}"
        )
    errors += [SlowError(1.0)] * (-count % 3)
    return SlowStates(tuple(errors), count, sensors.drifts, tuple(vectors), tuple(scalars))


def blocks_of(sensors: SensorSuite) -> tuple[int, ...]:
    """Return the blocks of innovations of a suite: position, baseline, velocity, features, aids."""
    features = 0 if sensors.camera is None else len(sensors.camera.features_I)
    found = list(range(FEATURE_BLOCKS + features))
    for aid, params in sensors.aids.items():
        found += range(AID_BLOCK[aid], AID_BLOCK[aid] + params.blocks)
    return tuple(found)


def decay_and_drive(error: SlowError, time: float) -> tuple[float, float]:
    """Return the decay of a slow error over a time [s], and its driving noise's sigma."""
    drive = error.sigma * math.sqrt(portable.approached(2.0 * time / error.tau))
    return portable.exp(-time / error.tau), drive


def gate_limit(freedoms: int, false_alarm: float) -> float:
    """Return the NIS above which a measurement is rejected, a quantile of chi-square."""
    return portable.chi_square_limit(freedoms, false_alarm) if false_alarm else math.inf


def pack_aids(p: Any, sensors: SensorSuite) -> None:
    """Write the parameters of aiding sensors and slow errors into a parameter record."""
    p["slow_decay"] = p["slow_sigma"] = 1.0
    states = slow_states(sensors)
    p["slow_sigma"][: len(states.errors)] = states.first_sigmas
    for aid, params in sensors.aids.items():
        p["aid_scale"][aid] = params.scale
        p["aid_sigma"][aid], p["aid_matrix_sigma"][aid] = params.noise_sigma, params.matrix_sigma
        for name in ("vector", "scalar"):
            slow = getattr(params, f"slow_{name}")
            if slow is not None:
                decay, drive = decay_and_drive(slow, 1.0 / params.rate)
                p[f"aid_{name}_sigma"][aid] = slow.sigma
                p[f"aid_{name}_decay"][aid], p[f"aid_{name}_drive"][aid] = decay, drive
        if len(params.numbers) > params.rows:
            raise ValueError(
                f"{type(params).__name__}.numbers must have at most {params.rows} triples, its "
                f"rows, got {len(params.numbers)}"
            )
        for row, numbers in enumerate(params.numbers, AID_NUMBERS[aid]):
            p["aid_numbers"][row] = numbers


def pack_sensors(settings: Any, sensors: SensorSuite) -> None:
    """Write the sensors that a filter assumes into a SETTINGS record, with their slow errors."""
    states = slow_states(sensors)
    settings["slow_states"], settings["slow_errors"] = len(states.errors), states.estimated
    settings["estimates_drift"] = states.drifts
    settings["aid_vector"], settings["aid_scalar"] = states.vectors, states.scalars
    heading = sensors.heading_aid
    settings["heading_sensor"] = -1 if heading is None else FIRST_AID + heading
    features = 0 if sensors.camera is None else len(sensors.camera.features_I)
    settings["sensor_blocks"][: Sensor.CAMERA + 1] = FEATURE_BLOCKS, features
    settings["feature_count"] = features
    for aid, params in sensors.aids.items():
        settings["sensor_blocks"][FIRST_AID + aid] = params.blocks

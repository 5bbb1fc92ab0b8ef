"""Entries for one flight: the scalar instances behind the friendly classes.

Each has a signature, so that it can be compiled ahead; arrays in another order of memory are taken,
too, and compiled for when they come.
"""

import numpy as np
from numba import types
from numba.np.numpy_support import from_dtype

from quad_gym.kernels.compiling import entry
from quad_gym.kernels.filter.align import initialize
from quad_gym.kernels.filter.predict import predict
from quad_gym.kernels.filter.slow import begin_slow
from quad_gym.kernels.filter.update import update
from quad_gym.kernels.filter.wahba import wahba
from quad_gym.kernels.maths.linalg import (
    add_outer,
    load3,
    load4,
    load33,
    scale,
    scale33,
    store3,
    store33,
)
from quad_gym.kernels.sensors.measure import (
    drift_biases,
    drift_gnss,
    measure_features,
    measure_gnss,
    measure_imu,
    measure_imu_average,
)
from quad_gym.kernels.vehicle.air import accelerations_in_air
from quad_gym.kernels.vehicle.dynamics import accelerations, integrate, load_state
from quad_gym.records import FLIGHT, PARAMS, SETTINGS, WORK

FILTER = tuple(f"{__name__}:{name}" for name in ("ukf_update", "ukf_predict", "ukf_initialize"))
"""Names of the entries of a filter, the longest to compile first."""
DRIFT_FILTER = tuple(
    f"{__name__}:{name}" for name in ("drift_update", "drift_predict", "ukf_initialize")
)
"""Those of a filter that estimates the slow error of GNSS positions."""
SINGLE = (
    *FILTER,
    *DRIFT_FILTER[:2],
    *(
        f"{__name__}:{name}"
        for name in (
            "sense_features",
            "sense_gnss",
            "body_accelerations_in_air",
            "integrate_flight",
            "sense_imu_average",
            "sense_imu",
            "body_accelerations",
            "wahba_of_vectors",
            "step_biases",
            "step_gnss_drift",
        )
    ),
)
"""Names of all entries of this module, likewise."""


def _array(kind, dimensions=1):
    return types.Array(from_dtype(np.dtype(kind)), dimensions, "C")


_FLIGHT, _PARAMS, _WORK, _SETTINGS = map(_array, (FLIGHT, PARAMS, WORK, SETTINGS))
_VECTOR, _MATRIX = _array(np.float64), _array(np.float64, 2)


def _entry(*arguments, returns=types.none):
    return lambda function: entry(function, returns(*arguments))


@_entry(_FLIGHT, _PARAMS, _VECTOR, _SETTINGS)
def ukf_initialize(flights, params, x_I, settings):
    """Start the filter of flights[0] from its first fix; x_I is (3,), zero if it is not known."""
    initialize(flights[0], params[0], True, load3(x_I))
    begin_slow(flights[0], params[0], settings[0], True)


@_entry(_FLIGHT, _PARAMS, _WORK, types.int64, types.int64)
def ukf_update(flights, params, work, feature_count, form):
    """Condition the filter of flights[0] on its valid measurements."""
    update(flights[0], params[0], work[0], feature_count, True, form)


@_entry(_FLIGHT, _PARAMS, _WORK, types.int64)
def ukf_predict(flights, params, work, form):
    """Carry the filter of flights[0] over one tick."""
    predict(flights[0], params[0], work[0], form)


@_entry(_FLIGHT, _PARAMS, _WORK, types.int64, types.int64, _SETTINGS)
def drift_update(flights, params, work, feature_count, form, settings):
    """As `ukf_update`, of a filter that estimates slow errors of sensors."""
    update(flights[0], params[0], work[0], feature_count, True, form, settings[0])


@_entry(_FLIGHT, _PARAMS, _WORK, types.int64, _SETTINGS)
def drift_predict(flights, params, work, form, settings):
    """As `ukf_predict`, likewise."""
    predict(flights[0], params[0], work[0], form, settings[0])


@_entry(_FLIGHT, _PARAMS)
def sense_imu(flights, params):
    """Sample the IMU of flights[0]."""
    measure_imu(flights[0], params[0], True)


@_entry(_FLIGHT, _PARAMS, _FLIGHT)
def sense_imu_average(flights, params, starts):
    """Sample the averaging IMU of flights[0] over a tick from the true state of starts[0]."""
    measure_imu_average(flights[0], params[0], load_state(starts[0]), True)


@_entry(_FLIGHT, _PARAMS)
def sense_gnss(flights, params):
    """Measure flights[0] by GNSS."""
    measure_gnss(flights[0], params[0], True)


@_entry(_FLIGHT, _PARAMS)
def step_gnss_drift(flights, params):
    """Step the slow position error of flights[0] to the next measurement."""
    drift_gnss(flights[0], params[0], True, 1.0)


@_entry(_FLIGHT, _PARAMS, types.int64)
def sense_features(flights, params, feature_count):
    """Measure the features that the camera of flights[0] sees."""
    measure_features(flights[0], params[0], feature_count, True)


@_entry(_FLIGHT, _PARAMS)
def step_biases(flights, params):
    """Step the IMU biases of flights[0] by one tick."""
    drift_biases(flights[0], params[0])


@_entry(_FLIGHT, _PARAMS, types.int64)
def integrate_flight(flights, params, substeps):
    """Carry the true state of flights[0] over one tick."""
    integrate(flights[0], params[0], substeps)


@_entry(_MATRIX, *[_VECTOR] * 4, _PARAMS, _VECTOR, _VECTOR)
def body_accelerations(R_BI, v_I, w_B, rotor_speeds, d_I, params, a_I, dw_B):
    """Write the acceleration in I and the angular acceleration in B."""
    a, dw = accelerations(
        load33(R_BI), load3(v_I), load3(w_B), load4(rotor_speeds), load3(d_I), params[0]
    )
    store3(a_I, a)
    store3(dw_B, dw)


@_entry(_VECTOR, _MATRIX, *[_VECTOR] * 4, _PARAMS, _SETTINGS, _VECTOR, _VECTOR)
def body_accelerations_in_air(r_I, R_BI, v_I, w_B, rotor_speeds, d_I, params, settings, a_I, dw_B):
    """Write the acceleration in I and the angular acceleration in B in a world that is not calm."""
    a, dw = accelerations_in_air(
        load3(r_I),
        load33(R_BI),
        load3(v_I),
        load3(w_B),
        load4(rotor_speeds),
        load3(d_I),
        load3(params[0].wind),
        params[0],
        settings[0],
    )
    store3(a_I, a)
    store3(dw_B, dw)


@_entry(_VECTOR, _MATRIX, _MATRIX, _MATRIX, returns=types.float64)
def wahba_of_vectors(weights, v_I, v_B, R_BI):
    """Write the solution of Wahba's problem for (n, 3) vectors; return its uniqueness."""
    zeros = (0.0, 0.0, 0.0)
    profile = (zeros, zeros, zeros)
    for i in range(len(weights)):
        profile = add_outer(profile, scale(weights[i], load3(v_B[i])), load3(v_I[i]))
    # only ratios count: make the largest entry one, far from under- and overflow
    largest = 0.0
    for i in range(3):
        for j in range(3):
            largest = max(largest, abs(profile[i][j]))
    if largest > 0.0:
        profile = scale33(1.0 / largest, profile)
    rotation, uniqueness = wahba(profile)
    store33(R_BI, rotation)
    return uniqueness

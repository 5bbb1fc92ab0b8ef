"""Initial states of filters."""

import numpy as np


def at_rest(**told):
    """The state at rest at the origin, level and without biases, except for `told`."""
    state = {
        "position": np.zeros(3),
        "velocity": np.zeros(3),
        "R_BI": np.eye(3),
        "accel_bias": np.zeros(3),
        "gyro_bias": np.zeros(3),
    }
    return state | told


def set_at_rest(kalman, covariance, **told):
    """Set a filter to the state `at_rest`."""
    kalman.set_state(**at_rest(**told), covariance=covariance)


def set_like(kalman, other):
    """Set a filter to the state of another."""
    names = ("position", "velocity", "R_BI", "accel_bias", "gyro_bias", "covariance")
    kalman.set_state(**{name: getattr(other, name) for name in names})

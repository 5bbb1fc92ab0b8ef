"""Record of a filter's start from one fix."""

import numpy as np

from quad_gym.records.sizes import MAX_SLOW, MAX_STATES

START = np.dtype(
    [
        ("x_I", "f8", 3),  # horizontal direction of body x for a steep baseline; zero: unknown
        # a vehicle of known tilt: see `quad_gym.estimation.filtering.starts`
        ("antenna_I", "f8", 3),
        ("position_root", "f8", (3, 3)),  # of the covariance of the antenna's position
        ("velocity_sigma", "f8", 3),
        ("T", "f8", (3, 3)),  # from the level frame to B
        ("tilt_sigma", "f8"),
        ("tilt_of_bias", "f8"),
        ("heading", "f8"),
        ("heading_sigma", "f8"),
        ("heading_of_tilt", "f8", 2),
        ("heading_of_slow", "f8", MAX_SLOW),
        ("lever_B", "f8", 3),  # the antenna
        ("accel_bias_sigma", "f8"),
        ("gyro_bias_sigma", "f8"),
        ("slow_sigma", "f8", MAX_SLOW),
        ("slow_states", "i8"),
        # results
        ("position", "f8", 3),
        ("R_BI", "f8", (3, 3)),
        ("factor", "f8", (MAX_STATES, MAX_STATES + 1)),  # lower, in the first columns
        ("e", "f8", (3, MAX_STATES + 1)),  # error angles by independent errors
    ]
)
"""Inputs and results of a filter's start."""

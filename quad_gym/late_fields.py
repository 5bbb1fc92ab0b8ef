"""The fields of measurements under way from a sensor to the filter; see `kernels/late.py`."""

from quad_gym.sensor_params import MAX_FEATURES, MAX_UNDER_WAY
from quad_gym.world_fields import Field

_SLOTS = MAX_UNDER_WAY
# fmt: off
LATE_STATE_FIELDS = (
    # what the IMU has summed up since the start of the episode, biases and gravity included
    Field("imu_turn", (3, 3), "-", "C, from the body frame of the start to the present one"),
    Field("imu_velocity", (3,), "m/s", "V, sum of C^T f dt, in the body frame of the start"),
    Field("imu_position", (3,), "m", "X, sum of V dt, in the body frame of the start"),
    Field("imu_bias_gain", (3, 3), "s", "B, sum of C^T dt"),
    # the same when the measurements under way were taken, the latest first; of GNSS and camera
    Field("stamp_tick", (2, _SLOTS), "ticks", "time stamp; NaN: none"),
    Field("stamp_turn", (2, _SLOTS, 3, 3), "-", "C"),
    Field("stamp_velocity", (2, _SLOTS, 3), "m/s", "V"),
    Field("stamp_position", (2, _SLOTS, 3), "m", "X"),
    Field("stamp_bias_gain", (2, _SLOTS, 3, 3), "s", "B"),
    Field("stamp_rates", (2, _SLOTS, 3), "rad/s", "w_meas"),
    # the measurements under way
    Field("late_position", (_SLOTS, 3), "m", "gnss_position"),
    Field("late_baseline", (_SLOTS, 3), "m", "gnss_baseline"),
    Field("late_velocity", (_SLOTS, 3), "m/s", "gnss_velocity"),
    Field("late_valid", (_SLOTS, 3), "0 or 1", "whether these were measured"),
    Field("late_pixels", (_SLOTS, MAX_FEATURES, 2), "pixels", "feature projections"),
    Field("late_seen", (_SLOTS, MAX_FEATURES), "0 or 1", "whether the camera saw a feature"),
)
"""Of a flight."""

LATE_WORK_FIELDS = (
    # what arrived before, while something new is measured
    Field("kept_position", (3,), "m", "gnss_position"),
    Field("kept_baseline", (3,), "m", "gnss_baseline"),
    Field("kept_velocity", (3,), "m/s", "gnss_velocity"),
    Field("kept_pixels", (MAX_FEATURES, 2), "pixels", "feature projections"),
    Field("kept_seen", (MAX_FEATURES,), "0 or 1", "features that arrive now"),
    # the estimate before a late update
    Field("kept_r", (3,), "m", "r_hat"),
    Field("kept_v", (3,), "m/s", "v_hat"),
    Field("kept_R", (3, 3), "-", "R_hat"),
    Field("kept_b_a", (3,), "m/s^2", "b_a_hat"),
    Field("kept_b_g", (3,), "rad/s", "b_g_hat"),
    Field("kept_L", (15, 15), "mixed", "L"),
    Field("kept_rates", (3,), "rad/s", "w_meas"),
    Field("kept_failures", (), "-", "update_failures"),
    # the instant to which a late update goes back
    Field("since_time", (), "s", "T since then"),
    Field("since_turn", (3, 3), "-", "C of then"),
    Field("since_velocity", (3,), "m/s", "V of then"),
    Field("since_position", (3,), "m", "X of then"),
    Field("since_bias_gain", (3, 3), "s", "B_s, gain of the biases since then"),
    Field("since_noise", (), "0 or 1", "whether the noise since then was taken out"),
    Field("columns", (15, 21), "mixed", "L and six columns of noise, taken back or on"),
)
"""Of the workspace."""

LATE_SETTINGS_FIELDS = (
    Field("gnss_delay", (), "ticks", "until a GNSS measurement reaches the filter", "i8"),
    Field("camera_delay", (), "ticks", "until an image reaches the filter", "i8"),
    Field("rewinds", (), "0 or 1", "whether the filter goes back to time stamps", "i8"),
)
"""Of what a batch does."""
# fmt: on

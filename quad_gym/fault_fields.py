"""Kinds of faults, and the fields of records that faults add."""

from enum import IntEnum

from quad_gym.sensor_params import MAX_FEATURES
from quad_gym.world_fields import Field


class FaultKind(IntEnum):
    """What can go wrong; a flight has one fault of each kind at most, which may come again."""

    GNSS_OUTAGE = 0
    GNSS_OUTLIERS = 1
    GNSS_RAMP = 2
    GNSS_JUMP = 3
    BASELINE_LOSS = 4
    POSITION_JUMP = 5
    CAMERA_OCCLUSION = 6
    WRONG_ASSOCIATIONS = 7
    ACCEL_BIAS_STEP = 8
    GYRO_BIAS_STEP = 9
    IMU_SATURATION = 10
    ROTOR_LOSS = 11


FAULT_KINDS = len(FaultKind)
"""Number of kinds."""

_K = FAULT_KINDS

# fmt: off
FAULT_STATE_FIELDS = (
    Field("faults", (), "bits", "active at the present instant: the sum of 2^FaultKind"),
    Field("fault_active", (_K,), "0 or 1", "the same, kind by kind"),
    Field("fault_count", (_K,), "-", "times that a fault has come in this episode"),
    Field("fault_from", (_K,), "ticks", "since the start of the episode, when it comes (next)"),
    Field("fault_until", (_K,), "ticks", "likewise, when it goes"),
    Field("fault_news", (_K,), "-1, 0 or 1", "whether it goes or comes at the present instant"),
    Field("fault_size", (_K,), "mixed", "drawn when it comes"),
    Field("fault_vector", (_K, 3), "mixed", "likewise: its size along its direction"),
    Field("fault_pick", (_K,), "-", "likewise: which rotor, as a share of four"),
    Field("outlier", (), "0 or 1", "whether the last GNSS position is an outlier"),
    Field("feature_hidden", (MAX_FEATURES,), "0 or 1", "whether an occlusion hides a feature"),
    Field("feature_mistaken", (MAX_FEATURES,), "0 or 1", "whether a feature of the last image is another one"),
    Field("rotor_gain", (4,), "-", "thrust of each rotor over that of a sound one; only where rotors can fail"),
)

FAULT_PARAMS_FIELDS = (
    Field("sound_effectiveness", (4, 4), "mixed", "effectiveness with four sound rotors"),
)

FAULT_SETTINGS_FIELDS = (
    Field("faults", (), "0 or 1", "whether there are any faults", "i8"),
    Field("fault_on", (_K,), "0 or 1", "whether a kind of fault can come", "i8"),
    Field("fault_rate", (_K,), "1/tick", "at which it comes at random; 0: once"),
    Field("fault_start", (_K, 2), "ticks", "earliest start, and its range, of a fault that comes once"),
    Field("fault_duration", (_K, 2), "ticks", "least duration, and its range"),
    Field("fault_probability", (_K,), "-", "share of episodes in which it can come"),
    Field("fault_share", (_K,), "-", "of fixes, features or images that it hits"),
    Field("fault_size", (_K, 2), "mixed", "least size, and its range"),
    Field("fault_direction", (_K, 3), "-", "unit vector; zeros: drawn"),
    Field("fault_pick", (2,), "-", "of the rotor, as a share of four: least, and its range"),
    Field("fault_swaps", (), "0 or 1", "whether two features are swapped, or one stands for both", "i8"),
    Field("imu_range", (2,), "m/s^2, rad/s", "at which accelerometer and gyro saturate"),
)
# fmt: on

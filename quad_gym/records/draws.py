"""The parameters that can be drawn in every episode, in the order of a flight's field `drawn`."""

import math
from typing import NamedTuple

from quad_gym.records.sizes import MAX_ACTION_DELAY, MAX_FEATURES

FIXED, UNIFORM, LOG_UNIFORM, NORMAL = 0, 1, 2, 3  #: codes of distributions in the kernels


class Drawable(NamedTuple):
    """A parameter that can be drawn."""

    of: str  #: part of the configuration that has its nominal value; empty: none, nominally 0
    name: str
    size: int
    unit: str
    meaning: str
    least: float = -math.inf  #: smallest meaningful value, where the parameter itself has no bounds
    above: float = -math.inf  #: exclusive lower bound
    most: float = math.inf  #: largest meaningful value

    @property
    def field(self) -> str:
        """Name of the parameter in that part."""
        return self.name.removeprefix(f"{self.of}_")

    @property
    def columns(self) -> slice:
        """Columns of the parameter in a flight's field `drawn`."""
        return COLUMNS[self.name]


# fmt: off
DRAWABLES = (
    # the vehicle
    Drawable("vehicle", "mass", 1, "kg", "mass"),
    Drawable("vehicle", "inertia", 3, "kg m^2", "diagonal of the inertia; the rest follows"),
    Drawable("vehicle", "center_of_mass_B", 3, "m", "true center of mass relative to the assumed one"),
    Drawable("vehicle", "thrust_coefficient", 1, "N/(rad/s)^2", "thrust coefficient kF"),
    Drawable("vehicle", "torque_coefficient", 1, "N m/(rad/s)^2", "torque coefficient kN"),
    Drawable("vehicle", "rotor_efficiency", 4, "-", "factor on thrust and torque of each rotor", above=0.0),
    Drawable("vehicle", "motor_time_constant", 1, "s", "time constant of the rotor speeds"),
    Drawable("vehicle", "motor_speed_per_volt", 1, "rad/s/V", "steady rotor speed per volt"),
    Drawable("vehicle", "max_voltage", 1, "V", "largest voltage of the motors"),
    Drawable("vehicle", "drag_coefficient", 1, "-", "drag coefficient of the drag disc"),
    # the world
    Drawable("world", "wind_east", 1, "m/s", "steady wind toward east"),
    Drawable("world", "wind_north", 1, "m/s", "steady wind toward north"),
    Drawable("world", "wind_up", 1, "m/s", "steady wind upward"),
    Drawable("world", "wind_speed", 1, "m/s", "horizontal speed of the steady wind", least=0.0),
    Drawable("world", "wind_direction", 1, "rad", "direction toward which the steady wind blows, from east toward north"),
    Drawable("world", "gust_wind_speed", 1, "m/s", "W20, the strength of gusts"),
    Drawable("world", "linear_drag_B", 3, "N s/m", "linear drag along each body axis"),
    Drawable("world", "rotor_drag_B", 3, "N s/m per rad/s", "linear drag along each body axis, per rotor speed"),
    Drawable("battery", "battery_charge", 1, "-", "charge of the battery at the start"),
    Drawable("battery", "battery_resistance", 1, "ohm", "resistance of the battery"),
    # the true sensors
    Drawable("imu", "accel_noise_density", 1, "m/s^2/sqrt(Hz)", "white noise of the accelerometer"),
    Drawable("imu", "gyro_noise_density", 1, "rad/s/sqrt(Hz)", "white noise of the gyro"),
    Drawable("imu", "accel_bias_sigma", 1, "m/s^2", "stationary standard deviation of the accelerometer bias"),
    Drawable("imu", "gyro_bias_sigma", 1, "rad/s", "stationary standard deviation of the gyro bias"),
    Drawable("imu", "accel_bias_tau", 1, "s", "correlation time of the accelerometer bias"),
    Drawable("imu", "gyro_bias_tau", 1, "s", "correlation time of the gyro bias"),
    Drawable("gnss", "position_sigma_I", 3, "m", "noise of the GNSS position"),
    Drawable("antennas", "baseline_sigma", 1, "rad", "noise of the GNSS baseline's direction"),
    Drawable("camera", "pixel_sigma", 1, "pixels", "noise of the features' image coordinates"),
    # their mounting
    Drawable("imu", "lever_arm_B", 3, "m", "position of the accelerometer"),
    Drawable("gnss", "primary_antenna_B", 3, "m", "position of the primary GNSS antenna"),
    Drawable("antennas", "secondary_antenna_B", 3, "m", "position of the secondary GNSS antenna"),
    Drawable("camera", "camera_position_B", 3, "m", "position of the camera's projection center"),
    Drawable("camera", "camera_rotation", 3, "rad", "error e of the camera's attitude, R(e) R_CB"),
    Drawable("camera", "focal_length", 1, "pixels", "focal length of the camera"),
    # the start, added to the task's own; values that a caller gives to a reset stay unchanged
    Drawable("", "start_position_I", 3, "m", "added to the start's position", -1e6, most=1e6),
    Drawable("", "start_velocity_I", 3, "m/s", "added to the start's velocity", -1e4, most=1e4),
    Drawable("", "start_body_rates", 3, "rad/s", "body rates at the start", -1e3, most=1e3),
    Drawable("", "start_roll", 1, "rad", "added to the start's roll"),
    Drawable("", "start_pitch", 1, "rad", "added to the start's pitch"),
    Drawable("", "start_yaw", 1, "rad", "added to the start's yaw"),
    # the execution of actions
    Drawable("", "action_delay", 1, "steps", "delay of actions, in control steps", 0.0, most=MAX_ACTION_DELAY),
    # the positions of the camera's features, which are known to the filter
    Drawable("camera", "features_yaw", 1, "rad", "rotation of all features about the vertical through the origin", -1e4, most=1e4),
    Drawable("camera", "features_shift_I", 3, "m", "shift of all features, after the rotation", -1e4, most=1e4),
    Drawable("camera", "feature_offsets_I", 3 * MAX_FEATURES, "m", "offset of each feature, before the rotation", -1e4, most=1e4),
)
# fmt: on
"""Every parameter that can be drawn; the columns of a flight's field `drawn`, in this order."""

COLUMNS: dict[str, slice] = {}
for _drawable in DRAWABLES:
    _first = max((columns.stop for columns in COLUMNS.values()), default=0)
    COLUMNS[_drawable.name] = slice(_first, _first + _drawable.size)
DRAWN_SIZE = sum(drawable.size for drawable in DRAWABLES)  #: number of columns

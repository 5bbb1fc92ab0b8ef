"""Parameters of a vehicle, its sensors and its world, those that can be drawn, and settings."""

import math
from typing import NamedTuple

from quad_gym.records.enums import AID_TRIPLES, RewardTerm
from quad_gym.records.sizes import *
from quad_gym.records.sizes import (
    AIDS,
    MAX_ACTION_DELAY,
    MAX_FEATURES,
    MAX_SLOW,
    SENSOR_GROUPS,
    Field,
)

# --------------------------------------------------------------------------------------------------
# The parameters that can be drawn in every episode, in the order of a flight's field `drawn`.
# --------------------------------------------------------------------------------------------------

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


# --------------------------------------------------------------------------------------------------
# Parameters of a vehicle, its sensors and its world, either the true or the assumed ones.
# --------------------------------------------------------------------------------------------------

PARAMETERS_DRAWN = COLUMNS["action_delay"].stop
"""Number of draws with which the parameters begin; the camera's features have the other draws."""
_OTHER_NAMES = {"inertia": "moments"}  #: names of fields by the names of draws, where they differ

# fmt: off
PARAMS_FIELDS = (
    *(Field(_OTHER_NAMES.get(d.name, d.name), (d.size,) if d.size > 1 else (), d.unit, d.meaning)
      for d in DRAWABLES if COLUMNS[d.name].stop <= PARAMETERS_DRAWN),
    Field("gravity", (), "m/s^2", "gravity"),
    Field("inertia", (3, 3), "kg m^2", "inertia in B"),
    Field("inertia_inverse", (3, 3), "1/(kg m^2)", "inverse of the inertia"),
    Field("half_drag", (), "kg/m", "Cd Ad rho / 2"),
    Field("effectiveness", (4, 4), "mixed", "total thrust and torque per rotor thrust"),
    Field("allocation", (4, 4), "mixed", "inverse of the effectiveness"),
    Field("max_rotor_force", (), "N", "thrust of a rotor at the largest voltage"),
    Field("hover_voltage", (), "V", "voltage that carries the weight"),
    # the world
    Field("half_disc", (), "kg/m", "Ad rho / 2"),
    Field("rotor_positions_B", (4, 3), "m", "rotor hubs in B"),
    Field("wind_I", (3,), "m/s", "steady wind in I"),
    Field("rotor_radius", (), "m", "radius of the rotors"),
    Field("ground_height", (), "m", "height of the ground in I"),
    Field("feet_B", (4, 3), "m", "soles of the feet in B"),
    Field("battery_energy", (), "J", "energy of a full battery"),
    Field("battery_empty_voltage", (), "-", "voltage of an empty battery divided by the voltage of a full one"),
    Field("battery_motor_efficiency", (), "-", "mechanical over electrical power"),
    # faults
    Field("sound_effectiveness", (4, 4), "mixed", "effectiveness with four working rotors"),
    Field("gain_position", (), "N/m", "PD gain of position"),
    Field("gain_velocity", (), "N s/m", "PD gain of velocity"),
    Field("gain_attitude", (3,), "N m", "PD gain of attitude"),
    Field("gain_body_rates", (3,), "N m s", "PD gain of body rates"),
    Field("rate_bandwidth", (), "1/s", "k_w of the inner rate loop"),
    Field("attitude_bandwidth", (), "1/s", "k_a of the inner attitude loop"),
    Field("velocity_bandwidth", (), "1/s", "k_v of the inner velocity loop"),
    Field("rate_scale", (3,), "rad/s", "body rates at full action"),
    Field("torque_scale", (3,), "N m", "torque at full action"),
    Field("tilt_scale", (), "rad", "roll and pitch at full action"),
    Field("velocity_scale", (), "m/s", "velocity at full action"),
    Field("dt", (), "s", "the tick"),
    Field("imu_lever_arm", (3,), "m", "accelerometer in B"),
    Field("accel_sigma", (), "m/s^2", "white noise of a sample"),
    Field("gyro_sigma", (), "rad/s", "white noise of a sample"),
    Field("accel_noise", (), "m/s^2", "noise of a sample that the filter assumes to be white"),
    Field("gyro_noise", (), "rad/s", "noise of a sample that the filter assumes to be white"),
    Field("accel_thrust_noise", (), "-", "noise per m/s^2 of specific force, due to the rotors"),
    Field("gyro_thrust_noise", (), "rad/s per m/s^2", "noise per m/s^2 of specific force, due to the rotors"),
    Field("accel_error_noise", (), "-", "noise due to scale and alignment that the filter assumes, per m/s^2"),
    Field("accel_scale_sigma", (), "-", "scale factor error of each axis"),
    Field("gyro_scale_sigma", (), "-", "scale factor error of each axis"),
    Field("accel_misalignment_sigma", (), "rad", "misalignment of each axis toward each other axis"),
    Field("gyro_misalignment_sigma", (), "rad", "misalignment of each axis toward each other axis"),
    Field("accel_vibration", (), "m/s^2 per (rad/s)^2", "noise of a sample per squared rotor speed"),
    Field("gyro_vibration", (), "rad/s per (rad/s)^2", "noise of a sample per squared rotor speed"),
    Field("accel_bias_decay", (), "-", "alpha_a = exp(-dt/tau)"),
    Field("gyro_bias_decay", (), "-", "alpha_g"),
    Field("accel_bias_drive", (), "m/s^2", "standard deviation of the driving noise"),
    Field("gyro_bias_drive", (), "rad/s", "standard deviation of the driving noise"),
    Field("R_IG", (3, 3), "-", "ECEF to east-north-up"),
    Field("antenna", (3,), "m", "primary antenna in B"),
    Field("baseline", (3,), "m", "primary to secondary antenna in B"),
    Field("baseline_length", (), "m", "length of the baseline"),
    Field("drift_decay", (), "-", "decay of the slow position error between two measurements"),
    Field("drift_step", (), "-", "the time between two measurements over the time constant of this error"),
    Field("drift_drive", (3,), "m", "standard deviation of the driving noise"),
    Field("heading_error_sigma", (), "rad", "standard deviation of the baseline's constant error"),
    Field("first_baseline_sigma", (), "rad", "standard deviation of the direction of one baseline"),
    Field("baseline_noise", (), "rad", "direction noise of the baseline that the filter assumes to be white"),
    Field("heading_sigma", (), "rad", "standard deviation of the initial heading, where it is known from the spot"),
    Field("velocity_sigma", (), "m/s", "velocity noise per axis; 0: not measured"),
    Field("camera", (3,), "m", "projection center in B"),
    Field("R_CB", (3, 3), "-", "body to camera"),
    Field("half_image", (2,), "pixels", "half the image's width and height"),
    Field("max_range", (), "m", "largest distance of a visible feature"),
    Field("blur", (), "pixels/(rad/s)", "noise per body rate"),
    Field("features", (MAX_FEATURES, 3), "m", "features in I"),
    # aiding sensors, in the order of Aid
    Field("aid_sigma", (AIDS,), "m; T", "white noise of each number"),
    Field("aid_vector_sigma", (AIDS,), "T", "initial standard deviation of a slow error of three numbers"),
    Field("aid_vector_decay", (AIDS,), "-", "decay of this error between two measurements"),
    Field("aid_vector_drive", (AIDS,), "T", "standard deviation of the driving noise"),
    Field("aid_scalar_sigma", (AIDS,), "m; rad", "initial standard deviation of a slow error of one number"),
    Field("aid_scalar_decay", (AIDS,), "-", "decay of this error between two measurements"),
    Field("aid_scalar_drive", (AIDS,), "m; rad", "standard deviation of the driving noise"),
    Field("aid_matrix_sigma", (AIDS,), "-", "standard deviation of each error of scale and alignment"),
    Field("aid_numbers", (sum(AID_TRIPLES), 3), "mixed", "further ones of each sensor: `numbers` of its parameters"),
    # raw observations
    Field("raw_scale", (SENSOR_GROUPS,), "mixed", "unit of each reading in raw observations"),
    Field("raw_span", (SENSOR_GROUPS, 3), "-", "further divisors of its numbers, such as half the width and height of an image"),
    # slow errors among the filter's states
    Field("slow_sigma", (MAX_SLOW,), "mixed", "standard deviation of each slow error at the start"),
    Field("slow_decay", (MAX_SLOW,), "-", "decay of each slow error over a tick"),
    Field("slow_rate", (MAX_SLOW,), "1/s", "1 / tau of each slow error; 0: a constant"),
    Field("slow_stationary", (MAX_SLOW,), "mixed", "standard deviation of each slow error in the long run"),
    Field("slow_drive", (MAX_SLOW,), "mixed", "standard deviation of the driving noise over a tick"),
    Field("sigma_spread", (), "-", "alpha of the unscented transform"),
    Field("sigma_beta", (), "-", "beta of the unscented transform"),
    Field("sigma_kappa", (), "-", "kappa of the unscented transform"),
    Field("direction_floor", (), "-", "variance added to every direction's diagonal"),
    Field("noise_pinhole", (), "0 or 1", "noise of a feature is its pixel noise seen under its angle"),
    Field("noise_at_prediction", (), "0 or 1", "noise of a feature is perpendicular to its predicted, not its measured, direction"),
    Field("initial_velocity_variance", (), "m^2/s^2", "variance of the velocity at the filter's start"),
    Field("initial_covariance_scale", (), "-", "factor on the first fix's covariance"),
    Field("initial_tilt_sigma", (), "rad", "standard deviation of roll and pitch at a level start; 0: attitude by Wahba's problem"),
    Field("recursive_update_threshold", (), "-", "ratio of second order and noise above which measurements are processed in steps"),
    Field("gate", (SENSOR_GROUPS,), "-", "largest accepted NIS of a group of measurements"),
    Field("gate_uncertainty", (), "rad^2", "largest sum of the variances of a feature's predicted direction"),
    Field("max_rejections", (), "-", "rejections in a row before a reset"),
    Field("reset_timeout", (), "s", "duration of rejections before a reset"),
    Field("glitch_timeout", (), "s", "duration of rejections before a reset, after a step of the sensor"),
    Field("noisy_sigma", (4,), "mixed", "standard deviations of a noisy observation: position, velocity, attitude, body rates"),
)
# fmt: on


# --------------------------------------------------------------------------------------------------
# Settings of a batch, common to all its flights.
# --------------------------------------------------------------------------------------------------

# fmt: off
SETTINGS_FIELDS = (
    Field("substeps", (), "-", "Runge-Kutta steps in a tick", "i8"),
    Field("ticks_per_step", (), "ticks", "ticks in a control period", "i8"),
    Field("sensor_blocks", (SENSORS,), "-", "blocks that each sensor measures; 0: there is no such sensor", "i8"),
    Field("sensor_ticks", (SENSORS,), "ticks", "ticks between measurements; 0: none", "i8"),
    Field("sensor_phase", (SENSORS,), "ticks", "ticks from the start to the first measurement; -1: at random", "i8"),
    Field("sensor_delay", (SENSORS,), "ticks", "ticks until a measurement reaches the filter", "i8"),
    Field("under_way", (SENSORS,), "-", "measurements in transit, at most", "i8"),
    Field("reading_blocks", (SENSOR_GROUPS,), "-", "blocks of each reading that is measured, or given by the mark of the start; 0: none", "i8"),
    Field("by_motion", (), "0 to 2", "1 if the filter compares its heading with the motion, from GNSS velocities; 2: the motion only shows an unknown one", "i8"),
    Field("drifts", (), "0 or 1", "1 if the measurements of a sensor drift, from zero at the start", "i8"),
    Field("estimates_drift", (), "0 or 1", "1 if the first three slow states of the filter are this drift", "i8"),
    Field("slow_states", (), "-", "slow states of the filter, padded to a multiple of three", "i8"),
    Field("slow_errors", (), "-", "slow states of the filter, without padding", "i8"),
    Field("motion_columns", (), "-", "columns of e, r and, if a measurement depends on it, v: 6 or 9", "i8"),
    Field("aid_vector", (AIDS,), "-", "index of the sensor's first of three slow states; -1: none", "i8"),
    Field("aid_scalar", (AIDS,), "-", "index of the sensor's single slow state; -1: none", "i8"),
    Field("heading_sensor", (), "-", "sensor that initializes the heading; -1: none", "i8"),
    Field("reuse_first_fix", (), "0 or 1", "1 if the fix that initializes the filter is also its first measurement", "i8"),
    Field("warm", (), "0 or 1", "1 if the filter has converged before an episode begins", "i8"),
    Field("feature_count", (), "-", "features in use", "i8"),
    Field("form", (), "bits", "options of the filter, see FilterForm", "i8"),
    Field("imu_averages", (), "0 or 1", "1 if IMU samples are averages over the tick", "i8"),
    Field("source", (), "-", "source of the observed state, see Source", "i8"),
    Field("run_filter", (), "0 or 1", "1 if sensors and filter run", "i8"),
    Field("own_estimator", (), "0 or 1", "1 if a user's estimator replaces the filter", "i8"),
    Field("control", (), "-", "meaning of the action, see Control", "i8"),
    Field("action_delays", (), "steps", "the longest delay of an action, rounded up; 0: none", "i8"),
    Field("task", (), "-", "see TaskKind", "i8"),
    Field("harmonics", (), "-", "terms of the reference's series in use; FOLLOWED: it is a trajectory", "i8"),
    Field("path_count", (), "-", "trajectories that flights may follow", "i8"),
    Field("layout", (), "-", "layout of the observation, see Layout", "i8"),
    Field("include_std", (), "0 or 1", "1 if the observation holds standard deviations", "i8"),
    Field("privileged", (), "0 or 1", "1 if the observation ends with the truth", "i8"),
    Field("shown", (), "0 or 1", "1 if a user's task reads the flights", "i8"),
    Field("start", (), "-", "start of episodes, see Start", "i8"),
    Field("pad", (), "0 or 1", "1 if a launch pad carries vehicles that start on the ground", "i8"),
    Field("reward_scale", (), "-", "factor on a reward per second"),
    Field("reward_weight", (len(RewardTerm),), "mixed", "weight of each term of the reward"),
    Field("near_decay", (), "1/m", "decay of the term NEAR with distance"),
    Field("fine_decay", (), "1/m", "decay of the term FINE with distance"),
    Field("randomize_reference", (), "0 or 1", "1 if each episode draws its reference", "i8"),
    Field("max_steps", (), "steps", "time limit of an episode; 0: none", "f8"),
    Field("out_of_bounds", (), "m", "largest distance from the reference"),
    Field("min_height", (), "m", "height below which the vehicle has crashed"),
    Field("truncate_when_diverged", (), "0 or 1", "1 if divergence of the filter ends the episode"),
    Field("min_up", (), "-", "smallest cosine of the tilt"),
    Field("radius", (), "m", "size of the reference"),
    Field("period", (), "s", "period of the reference"),
    Field("height", (), "m", "height of the reference"),
    Field("max_speed", (), "m/s", "bound of a random reference"),
    Field("max_acceleration", (), "m/s^2", "bound of a random reference"),
    Field("gate_count", (), "-", "gates of a course"),
    Field("gate_radius", (), "m", "distance at which a gate counts as passed"),
    Field("preview", (2,), "s", "times ahead at which the observation shows the reference"),
    Field("start_velocity_variance", (3,), "m^2/s^2", "mean square of the drawn part of the initial velocity"),
    Field("start_tilt_variance", (3,), "rad^2", "mean squares of drawn roll and pitch, then 0"),
    Field("warm_covariance", (MAX_STATES, MAX_STATES), "mixed", "covariance of a converged filter whose vehicle looks east, in the order of memory"),
    Field("warm_root", (MAX_STATES, WARM_DRAWS + WARM_SLOW_DRAWS), "mixed", "W with W W^T = warm_covariance; six columns from the 16th on: of the true biases; the rest as WARM_SLOW_DRAWS says"),
    Field("warm_drift_sigma", (3,), "m", "standard deviation of the true slow error after the filter's convergence"),
    # late measurements
    Field("late", (), "0 or 1", "1 if any measurement reaches the filter late", "i8"),
    Field("rewinds", (), "0 or 1", "1 if the filter goes back to time stamps", "i8"),
    # errors of sensors
    Field("imu_errs", (), "0 or 1", "1 if the IMU has errors of scale or alignment", "i8"),
    Field("imu_vibrates", (), "0 or 1", "1 if the rotors' vibration reaches the IMU", "i8"),
    Field("heading_errs", (), "0 or 1", "1 if baselines have a constant error", "i8"),
    Field("camera_limited", (), "0 or 1", "1 if range, blur or ground limit the images", "i8"),
    Field("camera_blurs", (), "0 or 1", "1 if images are blurred", "i8"),
    Field("ground_hides", (), "0 or 1", "1 if the ground hides features", "i8"),
    # the world
    Field("air", (), "0 or 1", "1 if the air differs from a calm world", "i8"),
    Field("gusts", (), "0 or 1", "1 if there are gusts", "i8"),
    Field("linear_drag", (), "0 or 1", "1 if there is linear drag", "i8"),
    Field("ground_effect", (), "0 or 1", "1 if there is ground effect", "i8"),
    Field("supply", (), "-", "limit of the motor voltages, see Supply", "i8"),
    # obstacles, the geofence and the ground
    Field("contacts", (), "0 or 1", "1 if there are obstacles or a geofence", "i8"),
    Field("obstacle_count", (), "-", "obstacles in use", "i8"),
    Field("obstacle_shape", (MAX_OBSTACLES,), "-", "shape of each obstacle, see Shape", "i8"),
    Field("obstacle_center", (MAX_OBSTACLES, 3), "m", "centers of the obstacles in I, without shifts"),
    Field("obstacle_half", (MAX_OBSTACLES, 3), "m", "half length, thickness and height; of a cylinder: radius, radius, half height"),
    Field("obstacle_axis", (MAX_OBSTACLES, 2), "-", "cosine and sine of the yaw of the length"),
    Field("obstacle_shift", (MAX_OBSTACLES, 3), "m", "largest shift along each axis of I, either way"),
    Field("obstacle_follows", (MAX_OBSTACLES,), "-", "index of the earlier obstacle with the same shift; -1: none", "i8"),
    Field("vehicle_radius", (), "m", "distance from an obstacle at which the vehicle touches it"),
    Field("fenced", (), "0 or 1", "1 if there is a geofence", "i8"),
    Field("fence", (2, 3), "m", "lowest and highest corner of the geofence in I"),
    Field("grounded", (), "0 or 1", "1 if the ground carries vehicles", "i8"),
    Field("friction", (), "-", "friction coefficient of the feet on the ground"),
    Field("hard_speed", (), "m/s", "vertical speed at touchdown above which the vehicle crashes"),
    Field("hard_up", (), "-", "smallest cosine of the tilt at touchdown"),
    # randomization
    Field("randomized", (), "0 or 1", "1 if each flight draws parameters", "i8"),
    Field("observe_world", (), "0 or 1", "1 if the truth in an observation ends with wind and draws", "i8"),
    Field("features_drawn", (), "0 or 1", "1 if each episode draws the positions of the features", "i8"),
    Field("feature_places", (2, MAX_FEATURES, 3), "m", "nominal positions of the features in I: true, and assumed by the filter"),
    Field("known", (), "0 or 1", "1 if filter and controller use the true parameters", "i8"),
    Field("draw_kind", (DRAWN_SIZE,), "-", "distribution of a column, see `quad_gym.params.randomization`", "i8"),
    Field("draw_a", (DRAWN_SIZE,), "mixed", "parameter a of the distribution, see `Affine`"),
    Field("draw_b", (DRAWN_SIZE,), "mixed", "parameter b of the distribution"),
    Field("draw_c", (DRAWN_SIZE,), "-", "parameter c of the distribution"),
    Field("draw_d", (DRAWN_SIZE,), "-", "parameter d of the distribution"),
    Field("draw_low", (DRAWN_SIZE,), "mixed", "least draw"),
    Field("draw_high", (DRAWN_SIZE,), "mixed", "largest draw"),
    Field("draw_center", (DRAWN_SIZE,), "mixed", "middle of the draws, subtracted in observations"),
    Field("draw_spread", (DRAWN_SIZE,), "mixed", "scale of the draws, divided by in observations"),
    # faults
    Field("faults", (), "0 or 1", "1 if there are any faults", "i8"),
    Field("fault_on", (FAULT_KINDS,), "0 or 1", "1 if a kind of fault can occur", "i8"),
    Field("fault_rate", (FAULT_KINDS,), "1/tick", "rate of random onsets; 0: a single onset"),
    Field("fault_start", (FAULT_KINDS, 2), "ticks", "earliest start and its range, for a single onset"),
    Field("fault_duration", (FAULT_KINDS, 2), "ticks", "least duration, and its range"),
    Field("fault_probability", (FAULT_KINDS,), "-", "probability that the fault can occur in an episode"),
    Field("fault_share", (FAULT_KINDS,), "-", "fraction of affected fixes, features or images"),
    Field("fault_size", (FAULT_KINDS, 2), "mixed", "least size, and its range"),
    Field("fault_direction", (FAULT_KINDS, 3), "-", "unit vector; zeros: drawn"),
    Field("fault_pick", (2,), "-", "rotor as a fraction of four: least, and its range"),
    Field("fault_swaps", (), "0 or 1", "1 if two features are swapped; 0: one replaces another", "i8"),
    Field("fault_field", (), "-", "disturbance of the magnetometer, see `FieldFault`", "i8"),
    Field("imu_range", (2,), "m/s^2, rad/s", "saturation of accelerometer and gyro"),
)
# fmt: on

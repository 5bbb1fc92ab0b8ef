"""The memory of flights: structured records whose fields are named, shaped, and given units here.

Eight flights share a record (`block_dtype`): every field has a trailing axis of eight. The scalar
form (`scalar_dtype`) has the same fields without it. Kernels read both by field name. As a flight
is nothing but its record, snapshot, restore, pickling and copying are array copies.
"""

from enum import IntEnum, IntFlag
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.fault_fields import FAULT_PARAMS_FIELDS, FAULT_STATE_FIELDS
from quad_gym.late_fields import LATE_STATE_FIELDS, LATE_WORK_FIELDS
from quad_gym.params import MAX_GATES
from quad_gym.sensor_params import MAX_FEATURES
from quad_gym.settings_fields import SETTINGS_FIELDS
from quad_gym.world_fields import WORLD_PARAMS_FIELDS, WORLD_STATE_FIELDS, Field

WIDTH = 8
"""Flights in a block."""
MAX_HARMONICS = 6
"""Terms of the Fourier series of a reference."""
MAX_BLOCKS = 3 + MAX_FEATURES
"""Blocks of the stacked measurement: antenna position, baseline, velocity, features."""
MAX_MEASUREMENTS = 3 * MAX_BLOCKS
"""Length of the stacked measurement; a direction has three numbers."""
POSITION_BLOCK, BASELINE_BLOCK, VELOCITY_BLOCK, FEATURE_BLOCKS = 0, 1, 2, 3
"""Where the blocks stand in a flight's fields of innovations; feature i is FEATURE_BLOCKS + i."""
FREEDOMS = (3, 2, 3, *[2] * MAX_FEATURES)
"""Degrees of freedom of the blocks: a direction has two."""
MAX_OBSERVATION = 256
"""Numbers that an observation can hold."""


class FilterStatus(IntFlag):
    """What has gone wrong in a filter since its start; 0 when nothing has."""

    PREDICTION_FAILED = 1
    """The predicted covariance was not positive definite; the filter kept its last good state."""
    UPDATE_FAILED = 2
    """A measurement update was not finite; the filter kept the state before it."""


class FilterForm(IntFlag):
    """How a filter differs from the report's, and what it keeps; 0 is the report's UKF."""

    EKF = 1
    """derivatives of the models in place of sigma points"""
    MIDPOINT = 2
    """prediction turns the attitude exactly and the force with the attitude halfway"""
    TURN = 4
    """the covariance turns with the error angles when they are set to zero"""
    INNOVATIONS = 8
    """updates keep the innovations, their predicted deviations and their NIS, block by block"""
    GATE = 16
    """updates leave out blocks whose NIS is beyond the gate, and keep all of these, too"""
    GRADUAL = 32
    """updates take images in portions while the attitude is uncertain"""


class Gate(IntEnum):
    """What became of a block of the last measurement."""

    NONE = 0
    """not measured since the start of the episode"""
    ACCEPTED = 1
    REJECTED = 2
    FAILED = 3
    """the update that it was part of failed as a whole, see FilterStatus"""
    UNSURE = 4
    """a feature left out, as its direction was predicted too vaguely for a linear model"""


class Source(IntEnum):
    """Where the controller's view of the state comes from."""

    TRUTH = 0
    ESTIMATE = 1
    NOISY = 2
    SENSORS = 3


class Control(IntEnum):
    """What the four numbers of an action mean."""

    MOTOR = 0
    WRENCH = 1
    CTBR = 2
    ATTITUDE = 3
    VELOCITY = 4
    PD = 5
    """No action: the report's controller follows the reference at every tick."""


class Task(IntEnum):
    """What a flight is to do."""

    HOVER = 1
    CIRCLE = 2
    LEMNISCATE = 3
    RANDOM_TRAJECTORY = 4
    WAYPOINTS = 5


class Start(IntEnum):
    """How an episode begins."""

    GROUND = 0
    """At rest below the reference at height 0, rotors stopped: the report's."""
    HOVER = 1
    """Hovering, at rest, within some decimetres of the reference."""
    MIXED = 2
    """Either, by a coin: for training, as a policy that has learned to hover learns to take off."""


class Layout(IntEnum):
    """What an observation holds."""

    RELATIVE = 0
    ABSOLUTE = 1
    SENSORS = 2


class Autoreset(IntEnum):
    """When a flight whose episode is over begins the next one."""

    DISABLED = 0
    NEXT_STEP = 1
    SAME_STEP = 2


class Ending(IntEnum):
    """Why an episode ended."""

    NONE = 0
    TIME_LIMIT = 1
    OUT_OF_BOUNDS = 2
    TIPPED_OVER = 3
    ON_THE_GROUND = 4
    LAST_GATE = 5
    FILTER_FAILED = 6


class Command(IntEnum):
    """What a call of the batch kernel does."""

    STEP = 0
    RESET = 1


# fmt: off
FLIGHT_FIELDS = (
    # the truth
    Field("r", (3,), "m", "position r_I of the centre of mass"),
    Field("v", (3,), "m/s", "velocity v_I"),
    Field("q", (4,), "-", "attitude, unit quaternion (w, x, y, z), body to inertial"),
    Field("w", (3,), "rad/s", "body rates w_B"),
    Field("rotor_speeds", (4,), "rad/s", "rotor speeds"),
    Field("voltages", (4,), "V", "motor voltages over the present tick"),
    Field("disturbance", (3,), "N", "external force d_I on the body"),
    Field("b_a", (3,), "m/s^2", "accelerometer bias"),
    Field("b_g", (3,), "rad/s", "gyro bias"),
    Field("gnss_drift", (3,), "m", "slow error of GNSS positions in I"),
    *WORLD_STATE_FIELDS,
    # the last measurements
    Field("w_meas", (3,), "rad/s", "body rates in B that the gyro reads at the present instant"),
    Field("gyro", (3,), "rad/s", "the filter's sample of them: w_meas, or the mean over the last tick"),
    Field("accel", (3,), "m/s^2", "specific force f_meas in B: at the present instant, or likewise"),
    Field("gnss_position", (3,), "m", "primary antenna relative to the reference antenna, in G"),
    Field("gnss_baseline", (3,), "m", "primary to secondary antenna, in G"),
    Field("gnss_velocity", (3,), "m/s", "of the primary antenna, in G"),
    Field("pixels", (MAX_FEATURES, 2), "pixels", "feature projections"),
    Field("position_valid", (), "0 or 1", "whether gnss_position was measured at the present instant"),
    Field("baseline_valid", (), "0 or 1", "whether gnss_baseline was measured at the present instant"),
    Field("velocity_valid", (), "0 or 1", "whether gnss_velocity was measured at the present instant"),
    Field("feature_valid", (MAX_FEATURES,), "0 or 1", "whether the camera saw a feature at the present instant"),
    Field("position_fresh", (), "0 or 1", "whether gnss_position was measured since the last step"),
    Field("baseline_fresh", (), "0 or 1", "whether gnss_baseline was measured since the last step"),
    Field("feature_fresh", (MAX_FEATURES,), "0 or 1", "whether a feature was seen since the last step"),
    # the filter
    Field("r_hat", (3,), "m", "estimated position in I"),
    Field("v_hat", (3,), "m/s", "estimated velocity in I"),
    Field("R_hat", (3, 3), "-", "estimated attitude R_BI"),
    Field("b_a_hat", (3,), "m/s^2", "estimated accelerometer bias"),
    Field("b_g_hat", (3,), "rad/s", "estimated gyro bias"),
    Field("L", (15, 15), "mixed", "lower Cholesky factor of the covariance P = L L^T; order r, v, e, b_a, b_g"),
    Field("filter_status", (), "bits", "failures so far, see FilterStatus", "u8"),
    Field("prediction_failures", (), "-", "predictions that failed since the filter's start"),
    Field("update_failures", (), "-", "updates that failed since the filter's start"),
    Field("nis", (), "-", "normalised innovation squared of the last update; NaN: it was taken in portions"),
    Field("nis_dimension", (), "-", "measurements in the last update"),
    # the innovations of the last measurements, one by one: position, baseline, velocity, features (if asked for)
    Field("innovation", (MAX_BLOCKS, 3), "mixed", "of position and velocity in I; of a direction across the predicted one, horizontal and up, in I (features: in B), then NaN"),
    Field("innovation_sigma", (MAX_BLOCKS, 3), "mixed", "standard deviations that the filter expected of them"),
    Field("block_nis", (MAX_BLOCKS,), "-", "normalised innovation squared of each block, with FREEDOMS; NaN: none yet"),
    Field("gate", (MAX_BLOCKS,), "-", "what became of it, see Gate"),
    Field("rejections", (MAX_BLOCKS,), "-", "rejected since the start of the episode"),
    Field("rejected_in_row", (4,), "-", "positions, baselines, velocities, images wholly rejected since the last accepted one"),
    Field("reopened", (4,), "-", "times that the gate of each of these was reopened in this episode"),
    # what the controller sees
    Field("r_seen", (3,), "m", "position in I from the controller's source"),
    Field("v_seen", (3,), "m/s", "velocity in I from the controller's source"),
    Field("R_seen", (3, 3), "-", "attitude R_BI from the controller's source"),
    Field("w_seen", (3,), "rad/s", "body rates in B from the controller's source"),
    # clocks: whole numbers
    Field("tick", (), "ticks", "since the start of the episode"),
    Field("gnss_wait", (), "ticks", "until GNSS measures next"),
    Field("camera_wait", (), "ticks", "until the camera measures next"),
    # the random stream
    Field("key", (2,), "-", "key of the stream", "u8"),
    Field("instant", (), "-", "instants drawn so far", "u8"),
    # the reference: r*(t) = c + sum_k a_k cos(k w t) + b_k sin(k w t)
    Field("ref_omega", (), "rad/s", "fundamental frequency w"),
    Field("ref_center", (3,), "m", "constant term c in I"),
    Field("ref_cos", (MAX_HARMONICS, 3), "m", "cosine coefficients a_k in I"),
    Field("ref_sin", (MAX_HARMONICS, 3), "m", "sine coefficients b_k in I"),
    Field("ref_heading_rule", (), "-", "0: toward heading_point; 1: along heading_point; 2: along the velocity"),
    Field("ref_heading_point", (3,), "m", "point to look at, or direction to look along, in I"),
    # the course of gates
    Field("gates", (MAX_GATES, 3), "m", "gate centres in I"),
    Field("gate_next", (), "-", "gates passed so far"),
    # the task
    Field("start_given", (7,), "mixed", "position, velocity in I and yaw to start the next episode with; NaN: drawn"),
    Field("action", (4,), "-", "the present action, in [-1, 1]"),
    Field("last_action", (4,), "-", "the action before it"),
    Field("idle", (), "0 or 1", "a lane that only pads the last block"),
    Field("step", (), "steps", "control steps since the start of the episode"),
    Field("episode", (), "-", "episodes begun since seeding"),
    Field("needs_reset", (), "0 or 1", "the episode is over; the next step begins a new one"),
    Field("reward", (), "-", "of the last step"),
    Field("terminated", (), "0 or 1", "the last step ended the episode by a crash or at the goal"),
    Field("truncated", (), "0 or 1", "the last step ended the episode by its time limit or a failed filter"),
    Field("ending", (), "-", "why the episode ended, see Ending"),
    Field("position_error", (), "m", "distance of the true position from the reference"),
    Field("estimation_error", (), "m", "distance of the seen from the true position"),
    Field("episode_return", (), "-", "sum of rewards in this episode"),
    Field("episode_error", (), "m", "sum over steps of the position error in this episode"),
    # what goes wrong
    *FAULT_STATE_FIELDS,
    *LATE_STATE_FIELDS,
)

PARAMS_FIELDS = (
    Field("gravity", (), "m/s^2", "gravity"),
    Field("mass", (), "kg", "mass"),
    Field("inertia", (3, 3), "kg m^2", "inertia in B"),
    Field("inertia_inverse", (3, 3), "1/(kg m^2)", "its inverse"),
    Field("half_drag", (), "kg/m", "Cd Ad rho / 2"),
    Field("kF", (), "N/(rad/s)^2", "thrust coefficient"),
    Field("effectiveness", (4, 4), "mixed", "total thrust and torque per rotor thrust"),
    Field("allocation", (4, 4), "mixed", "its inverse"),
    Field("motor_tau", (), "s", "lag of the rotor speed"),
    Field("motor_gain", (), "rad/s/V", "rotor speed per volt"),
    Field("max_voltage", (), "V", "largest voltage"),
    Field("max_rotor_force", (), "N", "thrust of a rotor at the largest voltage"),
    Field("hover_voltage", (), "V", "voltage that carries the weight"),
    *WORLD_PARAMS_FIELDS,
    *FAULT_PARAMS_FIELDS,
    Field("gain_k", (), "N/m", "PD gain of position"),
    Field("gain_kd", (), "N s/m", "PD gain of velocity"),
    Field("gain_K", (3,), "N m", "PD gain of attitude"),
    Field("gain_Kd", (3,), "N m s", "PD gain of body rates"),
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
    Field("accel_bias_decay", (), "-", "alpha_a = exp(-dt/tau)"),
    Field("gyro_bias_decay", (), "-", "alpha_g"),
    Field("accel_bias_drive", (), "m/s^2", "sigma of the driving noise"),
    Field("gyro_bias_drive", (), "rad/s", "sigma of the driving noise"),
    Field("accel_bias_sigma", (), "m/s^2", "stationary sigma"),
    Field("gyro_bias_sigma", (), "rad/s", "stationary sigma"),
    Field("R_IG", (3, 3), "-", "ECEF to east-north-up"),
    Field("antenna", (3,), "m", "primary antenna in B"),
    Field("baseline", (3,), "m", "primary to secondary antenna in B"),
    Field("baseline_length", (), "m", "its length"),
    Field("gnss_sigma", (3,), "m", "white position noise in I; of the placement where there is no GNSS"),
    Field("position_sigma", (3,), "m", "position noise that the filter takes for white, in I"),
    Field("drift_decay", (), "-", "of the slow position error between two measurements"),
    Field("drift_drive", (3,), "m", "sigma of its driving noise"),
    Field("baseline_sigma", (), "rad", "direction noise of the baseline"),
    Field("heading_sigma", (), "rad", "of the heading that the place of the start tells"),
    Field("velocity_sigma", (), "m/s", "velocity noise per axis; 0: not measured"),
    Field("camera", (3,), "m", "projection centre in B"),
    Field("R_CB", (3, 3), "-", "body to camera"),
    Field("pixel_size", (), "m", "pixel"),
    Field("focal_length", (), "pixels", "focal length"),
    Field("half_image", (2,), "pixels", "half the image's width and height"),
    Field("pixel_sigma", (), "pixels", "noise per axis"),
    Field("features", (MAX_FEATURES, 3), "m", "features in I"),
    Field("sigma_spread", (), "-", "alpha of the unscented transform"),
    Field("sigma_beta", (), "-", "beta of the unscented transform"),
    Field("sigma_kappa", (), "-", "kappa of the unscented transform"),
    Field("direction_floor", (), "-", "variance added to every direction's diagonal"),
    Field("noise_projected", (), "0 or 1", "a feature's noise is that of its pixel seen under its angle"),
    Field("noise_at_prediction", (), "0 or 1", "a feature's noise lies across its predicted, not its measured, direction"),
    Field("initial_velocity_variance", (), "m^2/s^2", "of the filter's start"),
    Field("initial_scale", (), "-", "factor on the first fix's covariance"),
    Field("initial_tilt_sigma", (), "rad", "of roll and pitch at a level start; 0: attitude by Wahba's problem"),
    Field("gradual_above", (), "rad", "deviation of the attitude above which images are taken in portions"),
    Field("gate_position", (), "-", "largest accepted NIS of a position"),
    Field("gate_direction", (), "-", "largest accepted NIS of a direction"),
    Field("gate_uncertainty", (), "rad^2", "largest sum of the variances of a feature's predicted direction"),
    Field("gate_patience", (), "-", "rejections in a row that reopen the gate"),
    Field("noisy_sigma", (4,), "mixed", "of a noisy observation: position, velocity, attitude, body rates"),
)

_N = MAX_MEASUREMENTS
WORK_FIELDS = (
    # prediction
    Field("P", (15, 15), "mixed", "lower triangle of the predicted covariance; then its factor"),
    Field("F", (9, 15), "mixed", "half-differences of the propagated sigma points / c; rows r, v, e"),
    Field("S", (9, 9), "mixed", "half-sums of the propagated sigma points less the centre / c; rows r, v, e"),
    # update; the nine columns of L that matter come last first
    Field("X_B", (MAX_FEATURES, 3), "m", "features relative to the centre of mass, in B"),
    Field("inverse_distance", (MAX_FEATURES,), "1/m", "of the features from the camera"),
    Field("h", (_N,), "mixed", "measurement predicted at the centre"),
    Field("z", (_N,), "mixed", "innovation; then whitened"),
    Field("A", (9, _N), "mixed", "half-differences of the measured sigma points / c; then whitened"),
    Field("E", (9, _N), "mixed", "half-sums of the measured sigma points less the centre / c"),
    Field("mu", (_N,), "mixed", "mean of the measured sigma points less the centre"),
    Field("Rz", (_N, _N), "mixed", "noise, part even in the sigma points included; then its factor"),
    Field("N", (9, 9), "-", "I + C C^T; then its factor"),
    Field("t", (9,), "-", "C times the whitened innovation; then whitened by N"),
    Field("L9", (15, 9), "mixed", "the nine columns of L; then of the updated factor"),
    Field("inverse_diagonal", (_N,), "mixed", "of a Cholesky factor"),
    # the batch
    Field("begins", (), "0 or 1", "lanes that begin an episode"),
    Field("observation", (MAX_OBSERVATION,), "mixed", "observation of the present instant"),
    *LATE_WORK_FIELDS,
)
# fmt: on


def scalar_dtype(fields: tuple[Field, ...]) -> np.dtype:
    """The record of one flight."""
    return np.dtype([(f.name, f.kind, f.shape) for f in fields], align=True)


def block_dtype(fields: tuple[Field, ...]) -> np.dtype:
    """The record of eight flights: every field with a trailing axis of eight."""
    return np.dtype([(f.name, f.kind, (*f.shape, WIDTH)) for f in fields], align=True)


RESULTS = (
    "reward",
    "terminated",
    "truncated",
    "ending",
    "position_error",
    "estimation_error",
    "filter_status",
    "episode_steps",
    "episode_return",
    "episode_error_sum",
    "gates_passed",
    "faults",
)
"""Columns of what a step returns for every flight."""

FLIGHT, FLIGHT_BLOCK = scalar_dtype(FLIGHT_FIELDS), block_dtype(FLIGHT_FIELDS)
PARAMS, PARAMS_BLOCK = scalar_dtype(PARAMS_FIELDS), block_dtype(PARAMS_FIELDS)
WORK, WORK_BLOCK = scalar_dtype(WORK_FIELDS), block_dtype(WORK_FIELDS)
SETTINGS = scalar_dtype(SETTINGS_FIELDS)


def aligned_zeros(count: int, dtype: np.dtype) -> NDArray[Any]:
    """`count` zeroed records that begin on a cache line."""
    raw = np.zeros(count * dtype.itemsize + 64, np.uint8)
    start = -raw.ctypes.data % 64
    return raw[start : start + count * dtype.itemsize].view(dtype)


def field_of_flights(blocks: NDArray[Any], name: str, count: int) -> NDArray[Any]:
    """One field of the first `count` flights, as an array (count, ...): a copy."""
    values = np.moveaxis(blocks[name], -1, 1)
    return values.reshape(-1, *values.shape[2:])[:count].copy()

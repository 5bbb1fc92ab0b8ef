"""Fields of a flight, of a thread's workspace, and of the results of a step."""

from enum import IntEnum
from math import prod

from quad_gym.records.enums import RewardTerm
from quad_gym.records.params import DRAWN_SIZE
from quad_gym.records.sizes import *
from quad_gym.records.sizes import Field

# --------------------------------------------------------------------------------------------------
# Fields of a flight: true state, measurements, filter, clocks, reference, task and faults.
# --------------------------------------------------------------------------------------------------

# fmt: off
PARTS: tuple[tuple[str, tuple[Field, ...]], ...] = (
    ("ground", (
        # contact with the ground
        Field("ground_push", (3,), "m/s^2", "specific force of the ground at the accelerometer, in B, over the last tick"),
        Field("footing", (), "-", "number of feet in contact with the ground"),
        Field("crashed", (), "0 or 1", "1 if the vehicle has crashed into the ground in this episode"),
    )),
    ("contacts", (
        # obstacles and the geofence
        Field("obstacle_center", (MAX_OBSTACLES, 3), "m", "centers of the obstacles in I"),
        Field("obstacle_distance", (), "m", "from the center of mass to the nearest surface of an obstacle, negative inside; infinite: there is none"),
        Field("obstacle_vector", (3,), "m", "from the center of mass to that surface's nearest point, in I"),
        Field("collided", (), "0 or 1", "1 if the vehicle has touched an obstacle in this episode"),
        Field("left_fence", (), "0 or 1", "1 if the vehicle has left the geofence in this episode"),
    )),
    ("path", (
        # the trajectory of this episode, and its values at the present instant
        Field("path", (), "-", "index of the trajectory, in the order in which they were given"),
        Field("path_share", (), "-", "fraction of a closed trajectory at which the episode begins"),
        Field("path_turn", (2,), "-", "cosine and sine of the trajectory's rotation about the vertical"),
        Field("path_r", (3,), "m", "reference position in I"),
        Field("path_v", (3,), "m/s", "reference velocity in I"),
        Field("path_a", (3,), "m/s^2", "reference acceleration in I"),
        Field("path_x", (3,), "-", "reference heading in I"),
        Field("path_ahead", (2, 3), "m", "reference positions in I at the times of the preview"),
    )),
    ("faults", (
        # faults
        Field("fault_active", (FAULT_KINDS,), "0 or 1", "1 if a fault of the kind is active"),
        Field("fault_count", (FAULT_KINDS,), "-", "number of onsets in this episode"),
        Field("fault_from", (FAULT_KINDS,), "ticks", "time of the next onset, from the start of the episode"),
        Field("fault_until", (FAULT_KINDS,), "ticks", "time of the end, from the start of the episode"),
        Field("fault_news", (FAULT_KINDS,), "-1, 0 or 1", "end (-1) or onset (1) at the present instant"),
        Field("fault_size", (FAULT_KINDS,), "mixed", "size, drawn at the onset"),
        Field("fault_vector", (FAULT_KINDS, 3), "mixed", "size times direction, drawn at the onset"),
        Field("fault_pick", (FAULT_KINDS,), "-", "rotor as a fraction of four, drawn at the onset"),
        Field("field_frozen", (3,), "T", "last field that the magnetometer measured before a disturbance"),
        Field("outlier", (), "0 or 1", "1 if the last GNSS position is an outlier"),
        Field("feature_hidden", (MAX_FEATURES,), "0 or 1", "1 if an occlusion hides a feature"),
        Field("feature_mistaken", (MAX_FEATURES,), "0 or 1", "1 if a feature of the last image was confused with another one"),
        Field("rotor_gain", (4,), "-", "thrust of each rotor divided by the thrust of a working one; only where rotors can fail"),
    )),
    ("places", (
        # where the features are in this episode
        Field("feature_place", (MAX_FEATURES, 3), "m", "positions of the features in I, as assumed by the filter"),
    )),
    ("draws", (
        # parameters
        Field("drawn", (DRAWN_SIZE,), "mixed", "parameters of this episode, see `quad_gym.params.randomization`"),
    )),
    ("actions", (
        # actions under way
        Field("past_actions", (MAX_ACTION_DELAY + 1, 4), "-", "present action and earlier ones, the latest first"),
        Field("delayed_action", (4,), "-", "action that the vehicle executes"),
    )),
    ("raw", (
        # raw measurements as observations
        Field("gyro_sum", (3,), "rad/s", "sum of the gyro samples since the last step"),
        Field("accel_sum", (3,), "m/s^2", "sum of the accelerometer samples since the last step"),
    )),
    ("own", (
        # a user's estimator
        Field("w_hat", (3,), "rad/s", "estimated body rates in B"),
    )),
    ("core", (
        # read and written at every tick: the truth, clocks, the random stream
        Field("r", (3,), "m", "position r_I of the center of mass"),
        Field("v", (3,), "m/s", "velocity v_I"),
        Field("q", (4,), "-", "attitude, unit quaternion (w, x, y, z), body to inertial"),
        Field("w", (3,), "rad/s", "body rates w_B"),
        Field("rotor_speeds", (4,), "rad/s", "rotor speeds"),
        Field("voltages", (4,), "V", "motor voltages over the present tick"),
        Field("on_pad", (), "0 or 1", "1 if the launch pad carries the vehicle"),
        Field("disturbance", (3,), "N", "external force d_I on the body"),
        Field("tick", (), "ticks", "time since the start of the episode"),
        Field("instant", (), "-", "instants drawn so far", "u8"),
        Field("key", (2,), "-", "key of the stream", "u8"),
        Field("action", (4,), "-", "the present action, in [-1, 1]"),
        Field("last_action", (4,), "-", "the action before it"),
        # the state that the controller observes
        Field("w_seen", (3,), "rad/s", "body rates in B from the controller's source"),
        Field("R_seen", (3, 3), "-", "attitude R_BI from the controller's source"),
        Field("v_seen", (3,), "m/s", "velocity in I from the controller's source"),
        Field("r_seen", (3,), "m", "position in I from the controller's source"),
        # read and written at every step: the task
        Field("needs_reset", (), "0 or 1", "the episode is over; the next step begins a new one"),
        Field("idle", (), "0 or 1", "a lane that only pads the last block"),
        Field("step", (), "steps", "control steps since the start of the episode"),
        Field("gate_next", (), "-", "gates passed so far"),
        Field("reward", (), "-", "reward of the last step"),
        Field("terminated", (), "0 or 1", "the last step ended the episode by a crash or at the goal"),
        Field("truncated", (), "0 or 1", "the last step ended the episode by its time limit or a failed filter"),
        Field("ending", (), "-", "why the episode ended, see Ending"),
        Field("position_error", (), "m", "distance of the true position from the reference"),
        Field("estimation_error", (), "m", "distance of the seen from the true position"),
        Field("episode_return", (), "-", "sum of rewards in this episode"),
        Field("episode_error", (), "m", "sum over steps of the position error in this episode"),
        Field("filter_status", (), "bits", "failures so far, see FilterStatus", "u8"),
        Field("diverged", (), "0 or 1", "1 if the covariance does not explain the last innovations"),
        Field("faults", (), "bits", "active at the present instant: the sum of 2^FaultKind"),
        # the reference: r*(t) = c + sum_k a_k cos(k w t) + b_k sin(k w t)
        Field("ref_heading_rule", (), "-", "0: toward heading_point; 1: along heading_point; 2: along the velocity"),
        Field("ref_heading_point", (3,), "m", "point to look at, or direction to look along, in I"),
        Field("ref_omega", (), "rad/s", "fundamental frequency w"),
        Field("ref_center", (3,), "m", "constant term c in I"),
        Field("ref_cos", (MAX_HARMONICS, 3), "m", "cosine coefficients a_k in I"),
        Field("ref_sin", (MAX_HARMONICS, 3), "m", "sine coefficients b_k in I"),
        # the course of gates
        Field("gates", (MAX_GATES, 3), "m", "gate centers in I"),
        # episodes
        Field("episode", (), "-", "episodes begun since seeding"),
        Field("start_given", (7,), "mixed", "position, velocity in I and yaw to start the next episode with; NaN: drawn"),
        # the air
        Field("wind", (3,), "m/s", "velocity of the air in I"),
        Field("air_force", (3,), "N", "force of the air in I, without thrust and disc drag"),
        Field("air_torque", (3,), "N m", "torque of the air in B, minus the torque of the rotors' thrust far from the ground"),
        Field("gust", (5,), "-", "states of the Dryden gusts u, v, w, see `kernels.vehicle.gusts`"),
        Field("charge", (), "-", "charge of the battery, 1: full"),
        # slow errors and clocks of the sensors
        Field("b_a", (3,), "m/s^2", "accelerometer bias"),
        Field("b_g", (3,), "rad/s", "gyro bias"),
        Field("drift", (3,), "m", "drift of a sensor's measurements: of GNSS positions, in I"),
        Field("wait", (SENSORS,), "ticks", "time until the next measurement of each sensor"),
        Field("block_fresh", (MAX_BLOCKS,), "0 or 1", "1 if a block of the measurement has arrived since the last step"),
        # the batches that a snapshot fits
        Field("configuration", (), "-", "digest of settings and parameters, see `quad_gym.batch.memory`", "u8"),
    )),
    ("filter", (
        # the last measurements
        Field("w_meas", (3,), "rad/s", "body rates in B that the gyro reads at the present instant"),
        Field("w_before", (3,), "rad/s", "w_meas one sample before"),
        Field("gyro", (3,), "rad/s", "sample for the filter: w_meas, or the mean over the last tick"),
        Field("accel", (3,), "m/s^2", "specific force f_meas in B: at the present instant, or the mean over the last tick"),
        Field("block_valid", (MAX_BLOCKS,), "0 or 1", "1 if a block of the measurement reaches the filter at the present instant"),
        Field("measurement", (MAX_BLOCKS, 3), "mixed", "blocks of the measurement: antenna position, relative to the reference antenna, baseline and velocity in G, pixels, other sensors; beyond a block's own numbers zeros"),
        # the filter
        Field("r_hat", (3,), "m", "estimated position in I"),
        Field("v_hat", (3,), "m/s", "estimated velocity in I"),
        Field("R_hat", (3, 3), "-", "estimated attitude R_BI"),
        Field("b_a_hat", (3,), "m/s^2", "estimated accelerometer bias"),
        Field("b_g_hat", (3,), "rad/s", "estimated gyro bias"),
        Field("v_corrected", (3,), "m/s", "change of v_hat by updates since the prediction, with FIRST_ESTIMATES"),
        Field("arc", (6,), "m, m/s", "deviations of r and v of second order in the heading's error, all of one random number, with FIRST_ESTIMATES"),
        Field("prediction_failures", (), "-", "predictions that failed since the filter's start"),
        Field("update_failures", (), "-", "updates that failed since the filter's start"),
        Field("nis", (), "-", "normalized innovation squared of the last update, with the suite's noise and across directions; NaN: it was done in steps"),
        Field("nis_dimension", (), "-", "degrees of freedom of the measurements in the last update"),
        Field("rejected_in_row", (SENSOR_GROUPS,), "-", "positions, baselines, velocities, images wholly rejected, other sensors, since the last accepted one"),
        Field("resets", (SENSOR_GROUPS,), "-", "times that states were reset to each of these in this episode"),
        Field("accepted_tick", (SENSOR_GROUPS,), "ticks", "time of the last accepted measurement of each group"),
        Field("refused_tick", (SENSOR_GROUPS,), "ticks", "time of the first rejection since then"),
        Field("corrected", (9,), "m/s^2, rad/s, m", "sum of the last corrections of the biases, and of the drift of GNSS positions where that is estimated"),
        Field("corrected_variance", (9,), "m^2/s^4, rad^2/s^2, m^2", "variance of this sum in a consistent filter"),
        Field("corrected_tick", (), "ticks", "time of the last correction"),
        Field("stepped", (SENSOR_GROUPS,), "0 or 1", "1 if the first rejected measurement was a step of the sensor"),
        Field("noise_factor", (SENSOR_GROUPS,), "-", "factor on the noise variance of each group that explains its innovations"),
        Field("alarm_tick", (), "ticks", "time of the last inconsistency alarm; without a gate, later by the time in which biases are corrected"),
        Field("nis_ratio", (), "-", "mean of the last NIS over their degrees of freedom, rejected ones included"),
        # the heading by motion, see `kernels.filter.motion`
        Field("level_turn", (3, 3), "-", "attitude R_BN of a level frame N"),
        Field("level_force", (3,), "m/s, s", "sum of the force in N, east and north, and time"),
        Field("level_sum", (3,), "m/s, s", "the same, with the antenna's velocity relative to the center of mass"),
        Field("level_last", (3,), "m/s, s", "the latter at the last fix"),
        Field("level_state", (6,), "m/s, -, m/s^2", "v, u and d as complex numbers"),
        Field("level_P", (9,), "mixed", "their covariance: vv, uu, dd, vu, vd, ud"),
        Field("level_first", (), "rad^2", "variance of the tilt with which N began, beyond the usual one"),
        Field("level_loose", (), "-", "variance of u if the gyro's bias has changed"),
        Field("level_phase", (), "0 to 2", "0: N has not begun, 1: no fix yet"),
        Field("level_misses", (), "-", "fixes left out in a row"),
        Field("level_fresh", (), "0 or 1", "1 if a fix has not been compared with the filter"),
        Field("level_against", (), "-", "contradictions of the heading in a row"),
        Field("level_doubts", (), "-", "smaller contradictions of the heading in a row"),
        Field("level_lean", (), "-", "contradictions of the vertical in a row"),
        Field("level_tick", (), "ticks", "last confirmation of the heading by motion"),
        Field("level_apart", (), "-", "chord between the headings by motion and of the filter, positive if the former is larger"),
        Field("level_sigma", (), "rad", "standard deviation of the heading by motion"),
        Field("heading_lost", (), "0 or 1", "1 while the heading is unknown"),
        Field("compass_out", (), "0 or 1", "1 while the compass contradicts the motion"),
        Field("compass_leapt", (), "0 or 1", "1 if the last series of rejected fields began far beyond the gate"),
        Field("compass_agrees", (), "0 or 1", "1 if it has agreed since `compass_tick`"),
        Field("compass_tick", (), "ticks", "time since when a compass that is left out has agreed"),
        Field("compass_from", (2,), "-", "cosine and sine of the heading then"),
        Field("compass_least", (), "-", "least cosine of the change of the heading since then"),
        Field("P", (15, 15), "mixed", "lower triangle of the covariance; order e, r, v, b_a, b_g, see `records.states`"),
    )),
    ("errors", (
        # errors of sensors that are constant over an episode
        Field("accel_error", (3, 3), "-", "errors of scale and alignment of the accelerometer"),
        Field("gyro_error", (3, 3), "-", "errors of scale and alignment of the gyro"),
        Field("heading_error", (), "rad", "constant error of the baseline, a turn about body z"),
    )),
    ("watch", (
        # the innovations of the last measurements, one by one: position, baseline, velocity, features, other sensors
        Field("innovation", (MAX_BLOCKS, 3), "mixed", "innovation: of position and velocity in I; of a direction across the predicted one, horizontal and up, in I (features: in B), then NaN"),
        Field("innovation_sigma", (MAX_BLOCKS, 3), "mixed", "standard deviations of these, as predicted by the filter"),
        Field("block_nis", (MAX_BLOCKS,), "-", "normalized innovation squared of each block, with FREEDOMS; NaN: none yet"),
        Field("gate", (MAX_BLOCKS,), "-", "decision of the gate, see GateDecision"),
        Field("rejections", (MAX_BLOCKS,), "-", "number of rejections since the start of the episode"),
    )),
    ("late", (
        # sums of the IMU's samples since the start of the episode, biases and gravity included
        Field("imu_turn", (3, 3), "-", "C, from the body frame of the instant that sums count from to the present one"),
        Field("imu_velocity", (3,), "m/s", "V, sum of C^T f dt, in the body frame of that instant"),
        Field("imu_position", (3,), "m", "X, sum of V dt, in the body frame of that instant"),
        Field("imu_bias_gain", (3, 3), "s", "B, sum of C^T dt"),
        # these sums at the time stamps of the measurements in transit, the latest first
        Field("stamps", (SENSORS, DELAY_SLOTS, STAMP), "mixed", "the tick (NaN: none), C, V, X, B, w_meas"),
        # the measurements in transit
        Field("waiting", (MAX_BLOCKS, DELAY_SLOTS, 3), "mixed", "measurements, block by block"),
        Field("waiting_valid", (MAX_BLOCKS, DELAY_SLOTS), "0 or 1", "1 if the block was measured"),
    )),
    ("slow", (
        # slow errors of sensors, where the filter estimates them
        Field("slow_hat", (MAX_SLOW,), "mixed", "estimated slow errors d, see `kernels.filter.slow`"),
        Field("P_slow", (MAX_SLOW, MAX_STATES), "mixed", "rows of d below P in the joint covariance"),
    )),
    ("aids", (
        # errors of sensors other than GNSS and camera, in the order of Aid
        Field("aid_vector", (AIDS, 3), "T", "true slow error of three numbers in B: hard iron"),
        Field("aid_scalar", (AIDS,), "m; rad", "true slow error of one number: bias of the altitude; declination minus the assumed one"),
        Field("aid_matrix", (AIDS, 3, 3), "-", "true errors of scale and alignment: soft iron"),
    )),
)
# fmt: on
"""The parts of a record, in their order in memory. All flights have the core. Parts that batches
often use are next to it, as the memory of a flight cannot have gaps: see `Room`."""

FLIGHT_FIELDS = tuple(field for _, fields in PARTS for field in fields)
"""All fields, in the order of the parts."""


# --------------------------------------------------------------------------------------------------
# Fields of a thread's workspace, whose contents do not outlast a step.
# --------------------------------------------------------------------------------------------------

# fmt: off
WORK_FIELDS = (
    # the arguments of a stage
    Field("mask", (), "0 or 1", "lanes that the stage works on"),
    Field("start", (17,), "mixed", "true state at the start of the tick: r, v, q, w, rotor speeds"),
    # prediction
    Field("P", (MAX_STATES, MAX_STATES), "mixed", "lower triangle of a covariance, for resets and starts"),
    # update; the columns of L that matter, first those of e, r, v and the slow errors
    Field("L", (MAX_STATES, MAX_STATES), "mixed", "these columns, and behind them the covariance that they leave"),
    Field("z_hat", (MAX_MEASUREMENTS,), "mixed", "measurement predicted at the center"),
    Field("z", (MAX_MEASUREMENTS,), "mixed", "measurement"),
    Field("nu", (MAX_MEASUREMENTS,), "mixed", "innovation; then whitened"),
    Field("A", (MAX_STATES, MAX_MEASUREMENTS), "mixed", "half-differences of the measured sigma points / c; then whitened"),
    Field("odd", (3, 3, 3), "-", "odd parts of the turns R(+-e) of the sigma points"),
    Field("even", (3, 3, 3), "-", "even parts, less the identity"),
    Field("E", (9, MAX_MEASUREMENTS), "mixed", "half-sums of the measured sigma points less the center / c"),
    Field("mu", (MAX_MEASUREMENTS,), "mixed", "mean of the measured sigma points less the center"),
    Field("Rz", (MAX_MEASUREMENTS, MAX_MEASUREMENTS), "mixed", "noise, part even in the sigma points included; then its factor"),
    Field("M", (MAX_STATES, MAX_STATES), "-", "I + C C^T; then its factor M"),
    Field("y", (MAX_STATES,), "-", "C times the whitened innovation; then M^-1 times it"),
    Field("L9", (MAX_STATES, MAX_STATES), "mixed", "the columns of L that matter, last first; then of the updated covariance's root"),
    Field("dx", (MAX_STATES,), "mixed", "correction of the state"),
    Field("inverse_diagonal", (MAX_MEASUREMENTS,), "mixed", "of a Cholesky factor"),
    # shared by the update and the sensors
    Field("measured", (), "-", "numbers that each lane has"),
    Field("spread", (), "-", "c of the sigma points"),
    Field("inverse_spread", (), "-", "1 / c"),
    Field("taking", (), "0 or 1", "lanes that are updated"),
    Field("again", (), "0 or 1", "lanes in a later step of the same measurements"),
    Field("judged_nis", (), "-", "sum of their NIS"),
    Field("judged_freedoms", (), "-", "sum of their degrees of freedom"),
    Field("left_out", (), "-", "numbers masked"),
    Field("along", (MAX_MEASUREMENTS,), "-", "predicted directions; zero where a block in use is none"),
    Field("suite_nis", (), "-", "sum of the NIS of the blocks in use, with the suite's noise"),
    Field("used_nis", (), "-", "this sum with the noise of the update: adapted, or of a bounded weight"),
    Field("reset", (SENSOR_GROUPS,), "0 or 1", "groups to which states are reset"),
    Field("alone", (SENSOR_GROUPS,), "0 or 1", "groups whose quantity no other accepted sensor measures"),
    Field("drifted", (), "0 or 1", "1 if the estimate has drifted gradually"),
    Field("hidden", (MAX_FEATURES,), "0 or 1", "features whose directions are too uncertain"),
    # heading by motion
    Field("held", (), "0 or 1", "1 where an update must not correct the attitude"),
    Field("held_attitude", (3, 3), "-", "the attitude before it"),
    Field("since_level", (3,), "m/s, s", "sums in N at the instant of the measurement"),
    # the segment of a trajectory at an instant
    Field("path_time", (), "s", "time in the episode; then since the beginning of the segment"),
    Field("path_still", (), "0 or 1", "1 before the start and beyond the end"),
    Field("path_held", (), "0 or 1", "1 before, at and beyond the ends"),
    Field("path_terms", (TERMS, 4), "mixed", "coefficients of the segment"),
    Field("path_heading", (), "-", "rule of the heading"),
    Field("path_point", (2,), "m", "point that body x faces, in I"),
    Field("path_end", (2,), "-", "heading at the start or end"),
    # contact with the ground: four feet, then four rotor hubs
    Field("on_ground", (), "0 or 1", "lanes whose episode begins on the ground"),
    Field("ground_arm", (8, 3), "m", "vector from the center of mass, in I"),
    Field("ground_mass", (8, 3), "kg", "effective mass of a point along each axis of I: impulse over change of velocity"),
    Field("ground_impulse", (8, 3), "N s", "impulse of the ground on a point, in I"),
    Field("ground_gap", (8,), "m", "height of a point above the ground"),
    # the batch
    Field("reward_term", (len(RewardTerm),), "-", "terms of the reward of a step"),
    Field("begins", (), "0 or 1", "lanes that begin an episode"),
    Field("kind", (), "bits", "sensors with a measurement that reaches the filter"),
    Field("queued", (KINDS,), "-", "lanes of each kind that wait for an update, first number", "i8"),
    Field("source", (KINDS,), "-", "addresses of these lanes", "u8"),
    Field("source_block", (KINDS,), "-", "addresses of the blocks of these lanes", "u8"),
    Field("observation", (MAX_OBSERVATION,), "mixed", "observation of the present instant"),
    # delayed measurements
    Field("arrives", (DELAY_SLOTS,), "0 or 1", "1 for the measurement in transit that arrives now"),
    Field("arrived", (MAX_BLOCKS, 3), "mixed", "last measurements that arrived, stored while new ones are taken"),
    # the estimate before a late update
    Field("kept_r_hat", (3,), "m", "r_hat"),
    Field("kept_v_hat", (3,), "m/s", "v_hat"),
    Field("kept_v_corrected", (3,), "m/s", "v_corrected"),
    Field("kept_R_hat", (3, 3), "-", "R_hat"),
    Field("kept_b_a_hat", (3,), "m/s^2", "b_a_hat"),
    Field("kept_b_g_hat", (3,), "rad/s", "b_g_hat"),
    Field("kept_P", (15, 15), "mixed", "P"),
    Field("kept_slow_hat", (MAX_SLOW,), "mixed", "slow_hat"),
    Field("kept_P_slow", (MAX_SLOW, MAX_STATES), "mixed", "P_slow"),
    Field("kept_block_valid", (MAX_BLOCKS,), "0 or 1", "measured blocks"),
    Field("kept_w_meas", (3,), "rad/s", "w_meas"),
    Field("kept_update_failures", (), "-", "update_failures"),
    # the instant to which a late update goes back
    Field("slow_decay", (MAX_SLOW,), "-", "decay of the slow errors since then"),
    Field("since_time", (), "s", "T since then"),
    Field("since_turn", (3, 3), "-", "C of then"),
    Field("since_velocity", (3,), "m/s", "V of then"),
    Field("since_position", (3,), "m", "X of then"),
    Field("since_bias_gain", (3, 3), "s", "B_s, gain of the biases since then"),
    Field("since_noise", (), "0 or 1", "1 if the noise since then was removed"),
    Field("columns", (15, 21 + MAX_SLOW), "mixed", "errors of the state, taken back or on: columns of P, of P_slow^T, and six of noise"),
)
# fmt: on
FIRST_OF_FLIGHTS = "path_time"
"""First field that only flights of a batch need: a filter for one vehicle uses those before it."""


# --------------------------------------------------------------------------------------------------
# Results of a step for every flight, and fields that only the views of users' tasks need.
# --------------------------------------------------------------------------------------------------


class Result(IntEnum):
    """Rows of the results of a step."""

    REWARD = 0
    TERMINATED = 1
    TRUNCATED = 2
    ENDING = 3
    POSITION_ERROR = 4
    ESTIMATION_ERROR = 5
    FILTER_STATUS = 6
    EPISODE_STEPS = 7
    EPISODE_RETURN = 8
    EPISODE_ERROR_SUM = 9
    GATES_PASSED = 10
    FAULTS = 11
    FILTER_DIVERGED = 12


RESULTS = (
    *(result.name.lower() for result in Result),
    *(f"reward_{term.name.lower()}" for term in RewardTerm),
)
"""Names of the rows of the results of a step, with the terms of the reward last."""

SHOWN_FIELDS = (
    Field("R_BI", (3, 3), "-", "true attitude"),
    Field("position_gap", (3,), "m", "reference minus observed position, in B"),
    Field("velocity_gap", (3,), "m/s", "reference minus observed velocity, in B"),
    Field("up", (3,), "-", "observed vertical in B"),
    Field("heading", (3,), "-", "reference heading in B"),
    Field("w_seen", (3,), "rad/s", "observed body rates in B"),
    Field("acceleration", (3,), "m/s^2", "reference acceleration in B"),
    Field("ahead", (2, 3), "m", "preview minus reference position, in B"),
    Field("r_ref", (3,), "m", "reference position in I"),
    Field("v_ref", (3,), "m/s", "reference velocity in I"),
    Field("a_ref", (3,), "m/s^2", "reference acceleration in I"),
    Field("x_ref", (3,), "-", "reference heading in I"),
    Field("preview", (2, 3), "m", "reference later, or the gates after the next, in I"),
)
"""Fields for views, computed at the end of a step."""

SHOWN: dict[str, slice] = {}  #: rows of each field, by its name
SHOWN_SIZE = 0  #: number of rows
for _field in SHOWN_FIELDS:
    SHOWN[_field.name] = slice(SHOWN_SIZE, SHOWN_SIZE + prod(_field.shape))
    SHOWN_SIZE = SHOWN[_field.name].stop
SHOWN_SHAPES = {field.name: field.shape for field in SHOWN_FIELDS}
"""Shape of each field, by its name."""

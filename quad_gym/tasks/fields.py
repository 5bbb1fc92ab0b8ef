"""Arrays of a view: shape, unit, frame and meaning of each, in one table."""

from typing import NamedTuple


class ViewField(NamedTuple):
    """Description of one array of a view."""

    name: str
    """Name with its group, such as "truth.position" """
    shape: str
    """Shape. n: flights, m: features of the camera, o: obstacles, k: values of an observation"""
    unit: str
    frame: str
    """Frame. I: inertial (east, north, up), B: body, C: image; "-": none"""
    meaning: str


# fmt: off
VIEW_FIELDS = (
    # available to all methods
    ViewField("count", "", "-", "-", "number of flights, n"),
    ViewField("period", "", "s", "-", "control period, the duration of a step"),
    ViewField("time", "(n,)", "s", "-", "time since the start of the episode"),
    ViewField("step", "(n,) int", "steps", "-", "steps since the start of the episode"),
    ViewField("is_first", "(n,) bool", "-", "-", "True where an episode has just begun and no step of it has been flown"),
    ViewField("action", "(n, 4)", "-", "-", "action of this step, in [-1, 1]"),
    ViewField("last_action", "(n, 4)", "-", "-", "action of the step before, in [-1, 1]"),
    ViewField("reference_position", "(n, 3)", "m", "I", "reference position; on a course, the next gate"),
    ViewField("reference_velocity", "(n, 3)", "m/s", "I", "velocity of the reference"),
    ViewField("reference_acceleration", "(n, 3)", "m/s^2", "I", "acceleration of the reference"),
    ViewField("reference_heading", "(n, 3)", "-", "I", "desired heading: horizontal unit vector for body x"),
    ViewField("preview", "(n, 2, 3)", "m", "I", "reference after each of the two times `preview`; on a course, the two gates after the next"),
    ViewField("gates", "(n, gates, 3)", "m", "I", "gates of a course, in order"),
    ViewField("gates_passed", "(n,) int", "-", "-", "number of gates passed in this episode"),
    ViewField("gate_passed", "(n,) bool", "-", "-", "True where this step passed a gate"),
    ViewField("features", "(n, m, 3)", "m", "I", "positions of the markers in the filter's map of this episode"),
    ViewField("world", "", "-", "-", "nominal `WorldParams`, without parameters drawn for the episode"),
    ViewField("obstacles", "(n, o, 3)", "m", "I", "centers of the obstacles in this episode, in the order given"),
    ViewField("observation", "(n, k)", "mixed", "mixed", "built-in observation without its privileged part"),
    # the truth, which `observe` may read only if the task is privileged
    ViewField("truth.position", "(n, 3)", "m", "I", "position of the center of mass; short: `view.position`"),
    ViewField("truth.velocity", "(n, 3)", "m/s", "I", "velocity; short: `view.velocity`"),
    ViewField("truth.R_BI", "(n, 3, 3)", "-", "I to B", "attitude, v_B = R_BI v_I; short: `view.R_BI`"),
    ViewField("truth.forward", "(n, 3)", "-", "I", "body x axis, the first row of R_BI"),
    ViewField("truth.up", "(n, 3)", "-", "B", "vertical, the last column of R_BI; its z component is the cosine of the tilt"),
    ViewField("truth.quaternion", "(n, 4)", "-", "B to I", "attitude as a quaternion (w, x, y, z); short: `view.quaternion`"),
    ViewField("truth.body_rates", "(n, 3)", "rad/s", "B", "body rates; short: `view.body_rates`"),
    ViewField("truth.rotor_speeds", "(n, 4)", "rad/s", "-", "rotor speeds; short: `view.rotor_speeds`"),
    ViewField("truth.accel_bias", "(n, 3)", "m/s^2", "B", "accelerometer bias; short: `view.accel_bias`"),
    ViewField("truth.gyro_bias", "(n, 3)", "rad/s", "B", "gyro bias; short: `view.gyro_bias`"),
    ViewField("truth.wind", "(n, 3)", "m/s", "I", "wind velocity"),
    ViewField("truth.position_error", "(n,)", "m", "-", "distance of the position from the reference; short: `view.position_error`"),
    ViewField("truth.estimation_error", "(n,)", "m", "-", "distance between observed and true position; short: `view.estimation_error`"),
    ViewField("truth.progress", "(n,)", "m/s", "-", "speed toward the reference; on a course, toward the gate that was next"),
    ViewField("truth.nees", "(n,)", "-", "-", "normalized estimation error squared; 15 on average if the filter is consistent"),
    ViewField("truth.features_in_view", "(n, m) bool", "-", "-", "True for markers in the field of view of the nominal camera that no obstacle hides"),
    ViewField("truth.obstacle_distance", "(n,)", "m", "-", "distance of the position from the nearest obstacle surface, negative inside, infinite without obstacles; short: `view.obstacle_distance`"),
    ViewField("truth.obstacle_vector", "(n, 3)", "m", "I", "vector from the vehicle to the nearest point of an obstacle surface"),
    ViewField("truth.on_ground", "(n,) bool", "-", "-", "True where the ground supports a foot, in worlds whose ground carries vehicles"),
    ViewField("truth.faults", "dict of (n,) bool", "-", "-", "active faults, by name"),
    ViewField("truth.drawn", "dict of (n, ...)", "mixed", "mixed", "parameters drawn for the episode, by name, see `randomization`"),
    # estimate of the filter
    ViewField("estimate.position", "(n, 3)", "m", "I", "position"),
    ViewField("estimate.velocity", "(n, 3)", "m/s", "I", "velocity"),
    ViewField("estimate.R_BI", "(n, 3, 3)", "-", "I to B", "attitude, v_B = R_BI v_I"),
    ViewField("estimate.quaternion", "(n, 4)", "-", "B to I", "attitude as a quaternion (w, x, y, z)"),
    ViewField("estimate.body_rates", "(n, 3)", "rad/s", "B", "body rates: gyro measurement minus estimated bias"),
    ViewField("estimate.accel_bias", "(n, 3)", "m/s^2", "B", "accelerometer bias"),
    ViewField("estimate.gyro_bias", "(n, 3)", "rad/s", "B", "gyro bias"),
    ViewField("estimate.covariance", "(n, 15, 15)", "mixed", "mixed", "covariance of position and velocity in I, attitude, accelerometer and gyro bias in B"),
    ViewField("estimate.factor", "(n, 15, 15)", "mixed", "mixed", "lower Cholesky factor of the covariance"),
    ViewField("estimate.sigma", "(n, 15)", "mixed", "mixed", "standard deviations, square roots of the diagonal of the covariance"),
    ViewField("estimate.X_covariance", "(n, 3, 3)", "mixed", "mixed", "covariance of X: position, velocity, attitude, accel_bias or gyro_bias"),
    ViewField("estimate.X_sigma", "(n, 3)", "mixed", "mixed", "standard deviations of X: position, velocity, attitude, accel_bias or gyro_bias"),
    ViewField("estimate.status", "(n,) int", "bits", "-", "numerical failures so far, see `FilterStatus`; 0: none"),
    ViewField("estimate.diverged", "(n,) bool", "-", "-", "True where the filter flags itself as diverged (filters with an innovation gate, or with `faults`, `truncate_when_diverged` or `innovations`)"),
    ViewField("estimate.nis", "(n,)", "-", "-", "normalized innovation squared of the last update"),
    ViewField("estimate.nis_dimension", "(n,) int", "-", "-", "number of scalar measurements in the last update"),
    # source of the controller's observation: the estimate, the truth, or the truth with noise
    ViewField("observed.position", "(n, 3)", "m", "I", "position from the source that `observation` names"),
    ViewField("observed.velocity", "(n, 3)", "m/s", "I", "velocity"),
    ViewField("observed.R_BI", "(n, 3, 3)", "-", "I to B", "attitude, v_B = R_BI v_I"),
    ViewField("observed.body_rates", "(n, 3)", "rad/s", "B", "body rates"),
    ViewField("observed.position_error", "(n, 3)", "m", "B", "reference position minus observed position"),
    ViewField("observed.velocity_error", "(n, 3)", "m/s", "B", "reference velocity minus observed velocity"),
    ViewField("observed.up", "(n, 3)", "-", "B", "vertical"),
    ViewField("observed.heading", "(n, 3)", "-", "B", "desired heading: horizontal unit vector for body x"),
    ViewField("observed.reference_acceleration", "(n, 3)", "m/s^2", "B", "acceleration of the reference"),
    ViewField("observed.preview", "(n, 2, 3)", "m", "B", "`view.preview` minus the present reference position"),
    ViewField("observed.obstacle_distance", "(n,)", "m", "-", "distance of the observed position from the nearest obstacle surface, negative inside"),
    ViewField("observed.obstacle_vector", "(n, 3)", "m", "B", "vector from the observed position to the nearest point of an obstacle surface"),
    # last measurement of each kind in this step; NaN if there was none
    ViewField("measured.gyro", "(n, 3)", "rad/s", "B", "angular rate measured by the gyro"),
    ViewField("measured.accel", "(n, 3)", "m/s^2", "B", "specific force measured by the accelerometer"),
    ViewField("measured.gnss_position", "(n, 3)", "m", "I", "position of the primary antenna"),
    ViewField("measured.gnss_baseline", "(n, 3)", "m", "I", "baseline from the primary to the secondary antenna"),
    ViewField("measured.gnss_velocity", "(n, 3)", "m/s", "I", "velocity of the primary antenna, if the receiver measures it"),
    ViewField("measured.pixels", "(n, m, 2)", "pixels", "C", "image coordinates of the features, relative to the image center"),
    ViewField("measured.gnss_valid", "(n,) bool", "-", "-", "True where a position was measured in this step"),
    ViewField("measured.baseline_valid", "(n,) bool", "-", "-", "True where a baseline was measured in this step"),
    ViewField("measured.features_seen", "(n, m) bool", "-", "-", "True for features in an image of this step"),
    # reward and endings of the built-in task
    ViewField("builtin.reward", "(n,)", "-", "-", "reward of the built-in task, per step"),
    ViewField("builtin.terminated", "(n,) bool", "-", "-", "True where the built-in task terminates the episode"),
    ViewField("builtin.truncated", "(n,) bool", "-", "-", "True at the time limit, after a failure of the filter, or after divergence with `truncate_when_diverged`; may be True together with `terminated`"),
    ViewField("builtin.ending", "(n,) int", "-", "-", "reason of the ending, see `quad_gym.records.Ending`"),
)
# fmt: on

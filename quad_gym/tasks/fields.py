"""What a view holds: every array with its shape, unit, frame and meaning, in one table."""

from typing import NamedTuple


class ViewField(NamedTuple):
    """One array of a view."""

    name: str
    """with its group: "truth.position" """
    shape: str
    """n: flights, m: features of the camera, o: obstacles, k: numbers of an observation"""
    unit: str
    frame: str
    """I: inertial (east, north, up), B: body, C: image; "-": none"""
    meaning: str


# fmt: off
VIEW_FIELDS = (
    # what everybody may know
    ViewField("count", "", "-", "-", "n, how many flights there are"),
    ViewField("period", "", "s", "-", "of control: from step to step"),
    ViewField("time", "(n,)", "s", "-", "since the start of the episode"),
    ViewField("step", "(n,) int", "steps", "-", "since the start of the episode"),
    ViewField("is_first", "(n,) bool", "-", "-", "whether the episode has just begun, and nothing was flown in it"),
    ViewField("action", "(n, 4)", "-", "-", "of this step, in [-1, 1]"),
    ViewField("last_action", "(n, 4)", "-", "-", "the one before it"),
    ViewField("reference_position", "(n, 3)", "m", "I", "where the vehicle should be; on a course, the next gate"),
    ViewField("reference_velocity", "(n, 3)", "m/s", "I", "of the reference"),
    ViewField("reference_acceleration", "(n, 3)", "m/s^2", "I", "of the reference"),
    ViewField("reference_heading", "(n, 3)", "-", "I", "horizontal direction that body x is to point in"),
    ViewField("preview", "(n, 2, 3)", "m", "I", "the reference after `preview` seconds; on a course, the two gates after the next"),
    ViewField("gates", "(n, gates, 3)", "m", "I", "of a course, in order"),
    ViewField("gates_passed", "(n,) int", "-", "-", "in this episode"),
    ViewField("gate_passed", "(n,) bool", "-", "-", "whether this step passed one"),
    ViewField("features", "(n, m, 3)", "m", "I", "the markers that the camera sees, where the filter knows them to be in this episode"),
    ViewField("world", "", "-", "-", "the `WorldParams`, without draws and shifts"),
    ViewField("obstacles", "(n, o, 3)", "m", "I", "where the middles of the world's obstacles are in this episode, in their order"),
    ViewField("observation", "(n, k)", "mixed", "mixed", "the built-in observation, less its privileged part"),
    # the truth, which `observe` may read only if the task is privileged
    ViewField("truth.position", "(n, 3)", "m", "I", "of the center of mass; `view.position` for short"),
    ViewField("truth.velocity", "(n, 3)", "m/s", "I", "`view.velocity`"),
    ViewField("truth.R_BI", "(n, 3, 3)", "-", "I to B", "attitude, v_B = R_BI v_I; `view.R_BI`"),
    ViewField("truth.forward", "(n, 3)", "-", "I", "the body x axis: first row of R_BI"),
    ViewField("truth.up", "(n, 3)", "-", "B", "the vertical: last column of R_BI; its z is the cosine of the tilt"),
    ViewField("truth.quaternion", "(n, 4)", "-", "B to I", "the same as (w, x, y, z); `view.quaternion`"),
    ViewField("truth.body_rates", "(n, 3)", "rad/s", "B", "`view.body_rates`"),
    ViewField("truth.rotor_speeds", "(n, 4)", "rad/s", "-", "`view.rotor_speeds`"),
    ViewField("truth.accel_bias", "(n, 3)", "m/s^2", "B", "of the accelerometer; `view.accel_bias`"),
    ViewField("truth.gyro_bias", "(n, 3)", "rad/s", "B", "`view.gyro_bias`"),
    ViewField("truth.wind", "(n, 3)", "m/s", "I", "velocity of the air"),
    ViewField("truth.position_error", "(n,)", "m", "-", "distance of the position from the reference; `view.position_error`"),
    ViewField("truth.estimation_error", "(n,)", "m", "-", "distance of the seen from the true position; `view.estimation_error`"),
    ViewField("truth.progress", "(n,)", "m/s", "-", "speed toward the reference; on a course, toward the gate that was next"),
    ViewField("truth.nees", "(n,)", "-", "-", "normalized estimation error squared; 15 on average if the filter is consistent"),
    ViewField("truth.features_in_view", "(n, m) bool", "-", "-", "whether the camera faces a marker, as the vehicle and the sensors are nominally, and no obstacle hides it"),
    ViewField("truth.obstacle_distance", "(n,)", "m", "-", "from the nearest obstacle's surface, negative inside, infinite where there is none; `view.obstacle_distance`"),
    ViewField("truth.obstacle_vector", "(n, 3)", "m", "I", "to that surface's nearest point"),
    ViewField("truth.on_ground", "(n,) bool", "-", "-", "whether the ground pushes a foot, in a world whose ground carries vehicles"),
    ViewField("truth.faults", "dict of (n,) bool", "-", "-", "which are there now, by name"),
    ViewField("truth.drawn", "dict of (n, ...)", "mixed", "mixed", "parameters of the episode, by name, see `randomization`"),
    # what the filter estimates
    ViewField("estimate.position", "(n, 3)", "m", "I", ""),
    ViewField("estimate.velocity", "(n, 3)", "m/s", "I", ""),
    ViewField("estimate.R_BI", "(n, 3, 3)", "-", "I to B", ""),
    ViewField("estimate.quaternion", "(n, 4)", "-", "B to I", "(w, x, y, z)"),
    ViewField("estimate.body_rates", "(n, 3)", "rad/s", "B", "measured rates less the estimated bias"),
    ViewField("estimate.accel_bias", "(n, 3)", "m/s^2", "B", ""),
    ViewField("estimate.gyro_bias", "(n, 3)", "rad/s", "B", ""),
    ViewField("estimate.covariance", "(n, 15, 15)", "mixed", "mixed", "of position and velocity in I, attitude, accelerometer and gyro bias in B"),
    ViewField("estimate.factor", "(n, 15, 15)", "mixed", "mixed", "its lower Cholesky factor"),
    ViewField("estimate.sigma", "(n, 15)", "mixed", "mixed", "square roots of its diagonal"),
    ViewField("estimate.X_covariance", "(n, 3, 3)", "mixed", "mixed", "its block of X: position, velocity, attitude, accel_bias or gyro_bias"),
    ViewField("estimate.X_sigma", "(n, 3)", "mixed", "mixed", "square roots of the block's diagonal"),
    ViewField("estimate.status", "(n,) int", "bits", "-", "what has failed so far, see `FilterStatus`; 0: nothing"),
    ViewField("estimate.diverged", "(n,) bool", "-", "-", "whether the filter flags itself as diverged (one that gates, or with `faults`, `truncate_when_diverged` or `innovations`)"),
    ViewField("estimate.nis", "(n,)", "-", "-", "normalized innovation squared of the last update"),
    ViewField("estimate.nis_dimension", "(n,) int", "-", "-", "measurements in it"),
    # what the controller goes by: the estimate, the truth, or the truth with noise
    ViewField("observed.position", "(n, 3)", "m", "I", "from the source that `observation` names"),
    ViewField("observed.velocity", "(n, 3)", "m/s", "I", ""),
    ViewField("observed.R_BI", "(n, 3, 3)", "-", "I to B", ""),
    ViewField("observed.body_rates", "(n, 3)", "rad/s", "B", ""),
    ViewField("observed.position_error", "(n, 3)", "m", "B", "reference less position"),
    ViewField("observed.velocity_error", "(n, 3)", "m/s", "B", "reference less velocity"),
    ViewField("observed.up", "(n, 3)", "-", "B", "the vertical"),
    ViewField("observed.heading", "(n, 3)", "-", "B", "horizontal direction that body x is to point in"),
    ViewField("observed.reference_acceleration", "(n, 3)", "m/s^2", "B", "of the reference"),
    ViewField("observed.preview", "(n, 2, 3)", "m", "B", "`view.preview` less the present reference"),
    ViewField("observed.obstacle_distance", "(n,)", "m", "-", "of the seen position from the nearest obstacle's surface, negative inside"),
    ViewField("observed.obstacle_vector", "(n, 3)", "m", "B", "to that surface's nearest point"),
    # what was measured in this step; the last of each kind, NaN where there was none
    ViewField("measured.gyro", "(n, 3)", "rad/s", "B", ""),
    ViewField("measured.accel", "(n, 3)", "m/s^2", "B", "specific force"),
    ViewField("measured.gnss_position", "(n, 3)", "m", "I", "primary antenna"),
    ViewField("measured.gnss_baseline", "(n, 3)", "m", "I", "primary to secondary antenna"),
    ViewField("measured.gnss_velocity", "(n, 3)", "m/s", "I", "of the primary antenna, where the receiver gives it"),
    ViewField("measured.pixels", "(n, m, 2)", "pixels", "C", "features, from the image's center"),
    ViewField("measured.gnss_valid", "(n,) bool", "-", "-", "whether a position was measured"),
    ViewField("measured.baseline_valid", "(n,) bool", "-", "-", "whether a baseline was"),
    ViewField("measured.features_seen", "(n, m) bool", "-", "-", "whether an image of this step has the feature"),
    # what the id's task says of the step
    ViewField("builtin.reward", "(n,)", "-", "-", "as with `reward_per=\"step\"`"),
    ViewField("builtin.terminated", "(n,) bool", "-", "-", ""),
    ViewField("builtin.truncated", "(n,) bool", "-", "-", "time limit, failed filter, or diverged with `truncate_when_diverged`; also where terminated"),
    ViewField("builtin.ending", "(n,) int", "-", "-", "see `quad_gym.records.Ending`"),
)
# fmt: on

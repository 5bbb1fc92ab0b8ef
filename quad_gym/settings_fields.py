"""The fields of a batch's settings: what it does, the same for all its flights."""

from quad_gym.fault_fields import FAULT_SETTINGS_FIELDS
from quad_gym.late_fields import LATE_SETTINGS_FIELDS
from quad_gym.world_fields import WORLD_SETTINGS_FIELDS, Field

WARM_DRAWS = 21
"""Standard normals that make the errors of a warm start: fifteen, and those of the true biases."""

# fmt: off
SETTINGS_FIELDS = (
    Field("substeps", (), "-", "Runge-Kutta steps in a tick", "i8"),
    Field("ticks_per_step", (), "ticks", "in a control period", "i8"),
    Field("gnss_ticks", (), "ticks", "between GNSS measurements; 0: none", "i8"),
    Field("camera_ticks", (), "ticks", "between camera measurements; 0: none", "i8"),
    Field("gnss_phase", (), "ticks", "from the start to the first GNSS measurement; -1: at random", "i8"),
    Field("camera_phase", (), "ticks", "from the start to the first image; -1: at random", "i8"),
    Field("gnss_velocity", (), "0 or 1", "whether GNSS measures velocity", "i8"),
    Field("gnss_drifts", (), "0 or 1", "whether GNSS positions have a slow error", "i8"),
    Field("reuse_first_fix", (), "0 or 1", "whether the fix that starts the filter is its first measurement, too", "i8"),
    Field("warm", (), "0 or 1", "whether the filter has converged before an episode begins", "i8"),
    Field("feature_count", (), "-", "features in use", "i8"),
    Field("form", (), "bits", "of the filter, see FilterForm", "i8"),
    Field("imu_averages", (), "0 or 1", "whether IMU samples are averages over the tick", "i8"),
    Field("source", (), "-", "what the controller sees, see Source", "i8"),
    Field("run_filter", (), "0 or 1", "whether sensors and filter run", "i8"),
    Field("control", (), "-", "what the action means, see Control", "i8"),
    Field("task", (), "-", "see Task", "i8"),
    Field("layout", (), "-", "of the observation, see Layout", "i8"),
    Field("include_covariance", (), "0 or 1", "whether the observation holds standard deviations", "i8"),
    Field("privileged", (), "0 or 1", "whether the observation ends with the truth", "i8"),
    Field("autoreset", (), "-", "see Autoreset", "i8"),
    Field("start", (), "-", "how episodes begin, see Start", "i8"),
    Field("randomize", (), "0 or 1", "whether the reference is drawn anew each episode", "i8"),
    Field("max_steps", (), "steps", "time limit of an episode; 0: none", "f8"),
    Field("out_of_bounds", (), "m", "largest distance from the reference"),
    Field("ground", (), "m", "height below which the vehicle has crashed"),
    Field("least_up", (), "-", "least cosine of the tilt"),
    Field("radius", (), "m", "size of the reference"),
    Field("period", (), "s", "period of the reference"),
    Field("height", (), "m", "height of the reference"),
    Field("max_speed", (), "m/s", "bound of a random reference"),
    Field("max_acceleration", (), "m/s^2", "bound of a random reference"),
    Field("gate_count", (), "-", "gates of a course"),
    Field("gate_radius", (), "m", "distance at which a gate counts as passed"),
    Field("preview", (2,), "s", "how far ahead the observation shows the reference"),
    Field("warm_covariance", (15, 15), "mixed", "of a converged filter whose vehicle looks east"),
    Field("warm_root", (15, WARM_DRAWS), "mixed", "W with W W^T = warm_covariance; the last six columns: of the true biases"),
    *LATE_SETTINGS_FIELDS,
    *WORLD_SETTINGS_FIELDS,
    *FAULT_SETTINGS_FIELDS,
)
# fmt: on

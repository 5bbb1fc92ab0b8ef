"""Features of a camera whose positions differ between episodes, and are known to the filter.

Feature i, nominally at X_i, is at `R_z(yaw) (X_i + offset_i) + shift`: each feature has its own
offset; all are rotated about the vertical through the origin and shifted together.
"""

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.maths.elementary import sin_cos
from quad_gym.kernels.maths.linalg import keep, load3, store, vector
from quad_gym.records import COLUMNS

_YAW, _SHIFT = COLUMNS["features_yaw"].start, COLUMNS["features_shift_I"].start
_OFFSETS = COLUMNS["feature_offsets_I"].start


@kernel
def _place(flight, X_I, i):
    """Position in I of feature i in this episode, nominally at X_I [m]."""
    drawn, k = flight.drawn, _OFFSETS + 3 * i
    s, c = sin_cos(drawn[_YAW])
    x, y, z = X_I[0] + drawn[k], X_I[1] + drawn[k + 1], X_I[2] + drawn[k + 2]
    return vector(c * x - s * y, s * x + c * y, z) + load3(drawn[_SHIFT:])


@stage
def place_features_stage(flight, world, model, settings, work, stages, flag):
    """Set the positions of the current flights' features, both true and assumed by the filter.

    `flag`: 1 if episodes begin, whose positions are then stored in the flights.
    """
    for i in range(settings.feature_count):
        place = _place(flight, load3(settings.feature_places[1, i]), i)
        store(model.features[i], place)
        store(world.features[i], _place(flight, load3(settings.feature_places[0, i]), i))
        if flag:
            keep(flight.feature_place[i], work.mask > 0.0, place)

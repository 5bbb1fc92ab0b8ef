"""Features of a camera whose positions differ between episodes, and are known to the filter.

Feature i, nominally at X_i, is at `R_z(yaw) (X_i + offset_i) + shift`: each feature has its own
offset; all are rotated about the vertical through the origin and shifted together.
"""

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.maths.elementary import sin_cos
from quad_gym.kernels.maths.linalg import add, keep3, load3, store3
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.records import COLUMNS

_YAW, _SHIFT = COLUMNS["features_yaw"].start, COLUMNS["features_shift_I"].start
_OFFSETS = COLUMNS["feature_offsets_I"].start


@kernel
def place_of(flight, X_I, i):
    """Return the position of feature i in this episode in I [m].

    Args:
        flight: Record, with its draws.
        X_I: Nominal position in I [m].
        i: Index of the feature.
    """
    drawn, k = flight.drawn, _OFFSETS + 3 * i
    s, c = sin_cos(drawn[_YAW])
    x, y, z = X_I[0] + drawn[k], X_I[1] + drawn[k + 1], X_I[2] + drawn[k + 2]
    shift = (drawn[_SHIFT], drawn[_SHIFT + 1], drawn[_SHIFT + 2])
    return add((c * x - s * y, s * x + c * y, z), shift)


@stage
def place_features_stage(flight, world, model, settings, work, stages, flag):
    """Set the positions of the current flights' features, both true and assumed by the filter.

    `flag`: 1 if episodes begin, whose positions are then stored in the flights.
    """
    flying, true, believed = lanes_of(flight), lanes_of(world), lanes_of(model)
    mask = lanes_of(work).mask > 0.0
    for i in range(settings.feature_count):
        place = place_of(flying, load3(settings.feature_places[1, i]), i)
        store3(believed.features[i], place)
        store3(true.features[i], place_of(flying, load3(settings.feature_places[0, i]), i))
        if flag:
            keep3(flying.feature_place[i], mask, place)

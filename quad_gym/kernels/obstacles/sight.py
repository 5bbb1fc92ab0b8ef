"""Features that an obstacle hides from the camera."""

from quad_gym.kernels.compiling import stage
from quad_gym.kernels.maths.linalg import load3, load4
from quad_gym.kernels.maths.rotation import quaternion_to_dcm
from quad_gym.kernels.obstacles.shapes import crosses
from quad_gym.kernels.simd.lanes import no_lane, select
from quad_gym.records import FEATURE_BLOCKS


@stage
def hide_features_stage(flight, world, model, settings, work, stages, flag):
    """Remove features behind an obstacle from the image just taken."""
    camera_I = load3(flight.r) + quaternion_to_dcm(load4(flight.q)).T @ load3(world.camera)
    for i in range(settings.feature_count):
        X_I, hidden = load3(world.features[i]), no_lane(flight.tick)
        for k in range(settings.obstacle_count):
            center_I = load3(flight.obstacle_center[k])
            hidden = hidden | crosses(camera_I, X_I, center_I, settings, k)
        valid = flight.block_valid[FEATURE_BLOCKS + i]
        hidden = (work.mask > 0.0) & hidden
        flight.block_valid[FEATURE_BLOCKS + i] = select(hidden, 0.0, valid)

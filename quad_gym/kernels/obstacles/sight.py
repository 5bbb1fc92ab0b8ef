"""What the camera does not see, as an obstacle stands before it."""

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.maths.linalg import add, apply_transposed, load3, load4
from quad_gym.kernels.maths.rotation import quaternion_to_dcm
from quad_gym.kernels.obstacles.shapes import crosses
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.kernels.simd.lanes import select
from quad_gym.records import FEATURE_BLOCKS


@kernel
def hide_features(flight, p, settings, mask):
    """Lose the features of the image just taken that are behind an obstacle, where `mask`."""
    camera_I = apply_transposed(quaternion_to_dcm(load4(flight.q)), load3(p.camera))
    camera_I = add(load3(flight.r), camera_I)
    for i in range(settings.feature_count):
        X_I, hidden = load3(p.features[i]), flight.tick < 0.0
        for k in range(settings.obstacle_count):
            center_I = load3(flight.obstacle_center[k])
            hidden = hidden | crosses(camera_I, X_I, center_I, settings, k)
        valid = flight.block_valid[FEATURE_BLOCKS + i]
        flight.block_valid[FEATURE_BLOCKS + i] = select(mask & hidden, 0.0, valid)


@stage
def hide_features_stage(flight, world, model, settings, work, stages, flag):
    """Lose the features of the image just taken that are behind an obstacle."""
    hide_features(lanes_of(flight), lanes_of(world), settings, lanes_of(work).mask > 0.0)

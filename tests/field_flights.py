"""Flights to evaluate filters: errors in the filter's coordinates, and NEES."""

import numpy as np
from scipy.spatial.transform import Rotation

from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.envs.config import TASK_DEFAULTS
from quad_gym.records import AID_BLOCKS, Control


def fly(
    sensors, count=200, *, task="random_trajectory", seed=0, start=None, trajectory=None, **keywords
):
    """A batch under PD control on its estimate, with episodes that do not end."""
    params = TASK_DEFAULTS[task].replace(
        duration=0.0,
        out_of_bounds=1e6,
        max_tilt=np.pi,
        min_height=-1e6,
        start=start or TASK_DEFAULTS[task].start,
        trajectory=trajectory,
    )
    batch = FlightBatch(
        count,
        sensors=sensors,
        task=params,
        gains="tuned",
        control=Control.PD,
        innovations=True,
        **keywords,
    )
    batch.reset(seeds=range(seed, seed + count))
    return batch


def steps(batch, seconds):
    for _ in range(round(seconds * batch.sensors.imu.rate)):
        batch.step()


def small_euler_angles(R):
    """The 3-1-2 Euler angles (n, 3) of rotations (n, 3, 3) near the identity."""
    yaw, pitch = np.arctan2(-R[:, 1, 0], R[:, 1, 1]), np.arctan2(-R[:, 0, 2], R[:, 2, 2])
    return np.stack([np.arcsin(R[:, 1, 2]), pitch, yaw], axis=-1)


def attitudes(q):
    """R_BI (n, 3, 3) of unit quaternions (w, x, y, z), by Rodrigues' formula."""
    w, v = q[:, 0, None, None], q[:, 1:]
    K = np.zeros((len(q), 3, 3))
    K[:, 0, 1], K[:, 0, 2], K[:, 1, 2] = v[:, 2], -v[:, 1], v[:, 0]
    K -= K.transpose(0, 2, 1)
    return np.eye(3) + 2 * w * K + 2 * K @ K


def state_errors(batch):
    """Truth minus estimate (n, 15), in the order r, v, e, b_a, b_g."""
    R_error = attitudes(batch.record("q")) @ batch.record("R_hat").transpose(0, 2, 1)
    return np.concatenate(
        [
            batch.record("r") - batch.record("r_hat"),
            batch.record("v") - batch.record("v_hat"),
            -Rotation.from_matrix(R_error).as_rotvec(),
            batch.record("b_a") - batch.record("b_a_hat"),
            batch.record("b_g") - batch.record("b_g_hat"),
        ],
        axis=1,
    )


def nees(batch, block=slice(0, 15)):
    """Normalized estimation error squared (n,) of all 15 states, or of some."""
    x, P = state_errors(batch)[:, block], batch.covariance()[:, block, block]
    return np.einsum("ni,ni->n", x, np.linalg.solve(P, x[..., np.newaxis])[..., 0])


def measured_now(batch):
    """Array (n, blocks): True for blocks that were measured at the present instant."""
    return batch.record("block_valid")[:, :AID_BLOCKS] > 0.0

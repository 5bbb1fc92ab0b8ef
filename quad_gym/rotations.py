"""Attitude conversions on NumPy arrays.

`R_BI` turns inertial components into body components, v_B = R_BI v_I. Euler angles are 3-1-2: yaw
about z, then roll about x, then pitch about y. Quaternions are Hamilton's (w, x, y, z), body to
inertial.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.kernels import single


def _rows(name: str, value: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    try:
        array = np.ascontiguousarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be an array of numbers, got {value!r}") from None
    if array.shape[array.ndim - len(shape) :] != shape or array.ndim < len(shape):
        wanted = ", ".join(str(n) for n in shape)
        raise ValueError(f"{name} must have shape (..., {wanted}), got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite")
    return array


def euler_to_dcm(e: ArrayLike) -> NDArray[np.float64]:
    """The rotation matrix of 3-1-2 Euler angles.

    Args:
        e: (..., 3) roll phi, pitch theta, yaw psi [rad].

    Returns:
        (..., 3, 3) R_BI = R_y(theta) R_x(phi) R_z(psi).

    Raises:
        ValueError: If `e` has another shape or is not finite.
    """
    angles = _rows("e", e, (3,))
    R = np.empty((angles.size // 3, 3, 3))
    single.dcms_of_eulers(angles.reshape(-1, 3), R)
    return R.reshape(*angles.shape[:-1], 3, 3)


def dcm_to_euler(R_BI: ArrayLike) -> NDArray[np.float64]:
    """The 3-1-2 Euler angles of a rotation matrix.

    Args:
        R_BI: (..., 3, 3) rotation matrices.

    Returns:
        (..., 3) roll in [-pi/2, pi/2], pitch and yaw in [-pi, pi] [rad]; at a roll of +-pi/2, where
        only one combination of pitch and yaw is determined, the pitch is 0.

    Raises:
        ValueError: If `R_BI` has another shape or is not finite.
    """
    R = _rows("R_BI", R_BI, (3, 3))
    # atan2 keeps its accuracy where asin loses it, near +-pi/2
    cos_roll = np.hypot(R[..., 1, 0], R[..., 1, 1])
    roll = np.arctan2(R[..., 1, 2], cos_roll)
    locked = cos_roll < 1e-12
    pitch = np.where(locked, 0.0, np.arctan2(-R[..., 0, 2], R[..., 2, 2]))
    yaw = np.where(
        locked,
        np.arctan2(R[..., 0, 1], R[..., 0, 0]),
        np.arctan2(-R[..., 1, 0], R[..., 1, 1]),
    )
    return np.stack([roll, pitch, yaw], axis=-1)


def quaternion_to_dcm(q: ArrayLike) -> NDArray[np.float64]:
    """The rotation matrix of a quaternion, which is normalised first.

    Args:
        q: (..., 4) quaternions (w, x, y, z), not zero.

    Returns:
        (..., 3, 3) R_BI.

    Raises:
        ValueError: If `q` has another shape, is not finite, or has no direction.
    """
    quaternions = _rows("q", q, (4,))
    norms = np.linalg.norm(quaternions, axis=-1, keepdims=True)
    if (norms < 1e-12).any():
        raise ValueError("q must not be zero")
    R = np.empty((quaternions.size // 4, 3, 3))
    single.dcms_of_quaternions((quaternions / norms).reshape(-1, 4), R)
    return R.reshape(*quaternions.shape[:-1], 3, 3)


def dcm_to_quaternion(R_BI: ArrayLike) -> NDArray[np.float64]:
    """The unit quaternion of a rotation matrix, its largest component positive.

    Args:
        R_BI: (..., 3, 3) rotation matrices.

    Returns:
        (..., 4) quaternions (w, x, y, z).

    Raises:
        ValueError: If `R_BI` has another shape or is not finite.
    """
    R = _rows("R_BI", R_BI, (3, 3))
    q = np.empty((R.size // 9, 4))
    single.quaternions_of_dcms(R.reshape(-1, 3, 3), q)
    return q.reshape(*R.shape[:-2], 4)

"""Attitude conversions on NumPy arrays.

`R_BI` converts inertial components to body components, v_B = R_BI v_I. Euler angles are 3-1-2: yaw
about z, then roll about x, then pitch about y. Quaternions are Hamilton's (w, x, y, z), body to
inertial.
"""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation


NORM_ERROR = 1e-2
"""Largest error of an element of R R^T, or of the squared norm of a quaternion, in input that is
taken as a rotation."""


def _rows(name: str, value: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    try:
        array = np.ascontiguousarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be an array of numbers, got {value!r}") from None
    if array.shape[array.ndim - len(shape) :] != shape or array.ndim < len(shape):
        wanted = ", ".join(str(n) for n in shape)
        raise ValueError(f"{name} must have shape (..., {wanted}), got {array.shape}")
    if not np.isfinite(array).all():
        wrong = array[~np.isfinite(array)].flat[0]
        raise ValueError(f"{name} must be finite, got {wrong} among its values")
    return array


def are_rotations(R: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which of some (..., 3, 3) matrices are orthonormal with determinant 1, or nearly."""
    error = np.abs(R @ R.swapaxes(-2, -1) - np.eye(3)).max(axis=(-2, -1))
    good: NDArray[np.bool_] = (error < NORM_ERROR) & (np.linalg.det(R) > 0.0)
    return good


def _rotation_matrices(name: str, value: ArrayLike) -> NDArray[np.float64]:
    R = _rows(name, value, (3, 3))
    good = are_rotations(R)
    if not good.all():
        raise ValueError(
            f"{name} must be a rotation, with R R^T = I within {NORM_ERROR:g} and determinant 1, "
            f"got {R[~good][0].tolist()}"
        )
    return R


def _rotations() -> "type[Rotation]":
    """Return SciPy's rotations. Importing them takes 0.2 s, only where they are needed."""
    from scipy.spatial.transform import Rotation

    return Rotation


def _dcms(turns: "Rotation", shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return R_BI from SciPy's rotations, which rotate vectors from B to I."""
    return turns.as_matrix().transpose(0, 2, 1).reshape(*shape, 3, 3)  # type: ignore[no-any-return]


def euler_to_dcm(e: ArrayLike) -> NDArray[np.float64]:
    """Convert 3-1-2 Euler angles to a rotation matrix.

    Args:
        e: (..., 3) roll phi, pitch theta, yaw psi [rad].

    Returns:
        (..., 3, 3) R_BI = R_y(theta) R_x(phi) R_z(psi).

    Raises:
        ValueError: If `e` has another shape or is not finite.
    """
    angles = _rows("e", e, (3,))
    turns = _rotations().from_euler("ZXY", angles.reshape(-1, 3)[:, [2, 0, 1]])
    return _dcms(turns, angles.shape[:-1])


def dcm_to_euler(R_BI: ArrayLike) -> NDArray[np.float64]:
    """Convert a rotation matrix to 3-1-2 Euler angles.

    Args:
        R_BI: (..., 3, 3) rotation matrices.

    Returns:
        (..., 3) roll in [-pi/2, pi/2], pitch and yaw in [-pi, pi] [rad]; at a roll of +-pi/2, where
        only a combination of pitch and yaw is determined, the pitch is 0.

    Raises:
        ValueError: If `R_BI` has another shape, is not finite, or is not a rotation.
    """
    R = _rotation_matrices("R_BI", R_BI)
    # atan2 keeps its accuracy where asin loses it, near +-pi/2
    cos_roll = np.hypot(R[..., 1, 0], R[..., 1, 1])
    roll = np.arctan2(R[..., 1, 2], cos_roll)
    locked = cos_roll < 1e-12
    pitch = np.where(locked, 0.0, np.arctan2(-R[..., 0, 2], R[..., 2, 2]))
    yaw = np.where(
        locked, np.arctan2(R[..., 0, 1], R[..., 0, 0]), np.arctan2(-R[..., 1, 0], R[..., 1, 1])
    )
    return np.stack([roll, pitch, yaw], axis=-1)


def dcm_to_vector(R_BI: ArrayLike) -> NDArray[np.float64]:
    """Convert a rotation matrix to a rotation vector.

    Args:
        R_BI: (..., 3, 3) rotation matrices.

    Returns:
        (..., 3) theta, of at most half a turn, with R_BI = exp(-[theta x]) [rad].

    Raises:
        ValueError: If `R_BI` has another shape, is not finite, or is not a rotation.
    """
    R = _rotation_matrices("R_BI", R_BI)
    turns = _rotations().from_matrix(R.reshape(-1, 3, 3).transpose(0, 2, 1))
    return turns.as_rotvec().reshape(R.shape[:-1])  # type: ignore[no-any-return]


def quaternion_to_dcm(q: ArrayLike) -> NDArray[np.float64]:
    """Convert a quaternion, which is normalized first, to a rotation matrix.

    Args:
        q: (..., 4) quaternions (w, x, y, z), not zero.

    Returns:
        (..., 3, 3) R_BI.

    Raises:
        ValueError: If `q` has another shape, is not finite, or is zero.
    """
    quaternions = _rows("q", q, (4,))
    norms = np.linalg.norm(quaternions, axis=-1, keepdims=True)
    if (norms < 1e-12).any():
        raise ValueError("q must not be zero")
    turns = _rotations().from_quat((quaternions / norms).reshape(-1, 4), scalar_first=True)
    return _dcms(turns, quaternions.shape[:-1])


def dcm_to_quaternion(R_BI: ArrayLike) -> NDArray[np.float64]:
    """Convert a rotation matrix to a unit quaternion whose largest component is positive.

    Args:
        R_BI: (..., 3, 3) rotation matrices.

    Returns:
        (..., 4) quaternions (w, x, y, z).

    Raises:
        ValueError: If `R_BI` has another shape, is not finite, or is not a rotation.
    """
    R = _rotation_matrices("R_BI", R_BI)
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(R, (-2, -1), (0, 1))
    rows = (  # each is the quaternion times four times one of its components
        (1.0 + a + e + i, f - h, g - c, b - d),
        (f - h, 1.0 + a - e - i, b + d, g + c),
        (g - c, b + d, 1.0 - a + e - i, f + h),
        (b - d, g + c, f + h, 1.0 - a - e + i),
    )
    largest = np.argmax([rows[k][k] for k in range(4)], axis=0)
    w, x, y, z = (np.choose(largest, column) for column in zip(*rows, strict=True))
    return np.stack([w, x, y, z], axis=-1) / np.sqrt(w * w + x * x + y * y + z * z)[..., np.newaxis]

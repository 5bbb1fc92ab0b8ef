"""Wahba's problem."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.kernels import entries
from quad_gym.params import checks as check


def solve_wahba(weights: ArrayLike, v_I: ArrayLike, v_B: ArrayLike) -> NDArray[np.float64]:
    """Return the rotation that best maps vectors in I to the same vectors measured in B.

    It minimizes `sum_i a_i |v_B,i - R_BI v_I,i|^2`.

    Args:
        weights: (n,) weights a_i, none negative and not all zero.
        v_I: (n, 3) vectors in I.
        v_B: (n, 3) the same vectors in B.

    Returns:
        (3, 3) R_BI, a proper rotation.

    Raises:
        ValueError: If the shapes do not fit, a value is not finite, or the vectors do not determine
            the rotation (all parallel, for example).

    Source: report section 4.1; F. L. Markley, J. Astronautical Sciences 36(3), 1988.
    """
    a = check.array("weights", weights, (None,))
    vectors_I = check.array("v_I", v_I, (len(a), 3))
    vectors_B = check.array("v_B", v_B, (len(a), 3))
    if (a < 0.0).any() or not (a > 0.0).any():
        raise ValueError(f"weights must be at least 0 and not all zero, got {a}")
    R_BI = np.empty((3, 3))
    uniqueness = entries.wahba_of_vectors(a, vectors_I, vectors_B, R_BI)
    if not uniqueness > 1e-10:
        raise ValueError(
            "v_I and v_B must determine a rotation: at least two directions must differ"
        )
    return R_BI

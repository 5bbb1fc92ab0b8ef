"""Wahba's problem: the rotation that best turns one set of vectors into another.

Minimize sum_i a_i |v_B,i - R_BI v_I,i|^2 over rotations R_BI. With B = sum a_i v_B,i v_I,i^T = U S
V^T the solution is R_BI = U diag(1, 1, det U det V) V^T (G. Wahba, SIAM Review 7(3), 1965; F. L.
Markley, J. Astronautical Sciences 36(3), 1988).
"""

import math

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.maths.elementary import maximum
from quad_gym.kernels.maths.linalg import cross, dot, outer, rounded, unit_or
from quad_gym.kernels.simd.lanes import select, zero_like

_SWEEPS = 10


@kernel
def _rotate_pair(a, b, v, w):
    """Rotate columns a and b of B, and v and w of V with them, so that a . b = 0."""
    gamma = dot(a, b)
    orthogonal = gamma == 0.0
    zeta = (dot(b, b) - dot(a, a)) / (2.0 * select(orthogonal, 1.0, gamma))
    tangent = select(zeta < 0.0, -1.0, 1.0) / (abs(zeta) + math.sqrt(1.0 + zeta * zeta))
    tangent = select(orthogonal, 0.0, tangent)
    cosine = 1.0 / math.sqrt(1.0 + tangent * tangent)
    sine = cosine * tangent
    return (
        cosine * a - rounded(sine * b),
        sine * a + rounded(cosine * b),
        cosine * v - rounded(sine * w),
        sine * v + rounded(cosine * w),
    )


@kernel
def _sorted(a, b, v, w):
    """Swap columns a and b of B, and v and w of V with them, where b is longer."""
    larger = dot(b, b) > dot(a, a)
    return select(larger, b, a), select(larger, a, b), select(larger, w, v), select(larger, v, w)


@kernel
def _perpendicular(a):
    """A vector perpendicular to the unit vector a, with a length well above zero."""
    return select(abs(a[0]) < 0.6, cross(a, (1.0, 0.0, 0.0)), cross(a, (0.0, 1.0, 0.0)))


@kernel
def _perpendicular_unit(candidate, a):
    """The direction of `candidate` made perpendicular to a, or another if it has none."""
    fallback = unit_or(_perpendicular(a), a)
    once = unit_or(candidate - rounded(dot(candidate, a) * a), fallback)
    return unit_or(once - rounded(dot(once, a) * a), fallback)


@kernel
def wahba(B):
    """The rotation R_BI that maximizes tr(R_BI^T B), by one-sided Jacobi rotations.

    B is the attitude profile matrix, sum of a_i v_B,i v_I,i^T.

    Returns:
        (R_BI, uniqueness): the second is (s_2 + d s_3) / s_1 for singular values s and d = det U
        det V; where it is zero, a whole family of rotations is equally good and R_BI is one of
        them.
    """
    a0, a1, a2 = B.T
    one, zero = 1.0 + zero_like(B[0][0]), zero_like(B[0][0])
    v0, v1, v2 = (one, zero, zero), (zero, one, zero), (zero, zero, one)
    for _ in range(_SWEEPS):
        a0, a1, v0, v1 = _rotate_pair(a0, a1, v0, v1)
        a0, a2, v0, v2 = _rotate_pair(a0, a2, v0, v2)
        a1, a2, v1, v2 = _rotate_pair(a1, a2, v1, v2)

    # largest singular value first, smallest last
    a0, a1, v0, v1 = _sorted(a0, a1, v0, v1)
    a1, a2, v1, v2 = _sorted(a1, a2, v1, v2)
    a0, a1, v0, v1 = _sorted(a0, a1, v0, v1)

    u0 = unit_or(a0, (1.0, 0.0, 0.0))
    u1 = _perpendicular_unit(a1, u0)
    # the third columns as cross products: the factor det U det V is then in them
    u2 = cross(u0, u1)
    v2_right = cross(v0, v1)
    R_IB = outer(v0, u0) + rounded(outer(v1, u1)) + rounded(outer(v2_right, u2))
    s0, s1 = math.sqrt(dot(a0, a0)), math.sqrt(dot(a1, a1))
    signed_s2 = dot(a2, u2) * dot(v2, v2_right)
    return R_IB.T, (s1 + signed_s2) / maximum(s0, 1e-300)

"""Attitude: 3-1-2 Euler angles, rotation matrices R_BI (v_B = R_BI v_I) and quaternions.

Quaternions are Hamilton's, (w, x, y, z), and turn body components into inertial ones.
"""

import math

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.numbers.elementary import TINY, atan2, sin_cos, sin_cos_minus_one
from quad_gym.kernels.numbers.lanes import select, zero_like
from quad_gym.kernels.numbers.linalg import add_to_diagonal, unit_or


@kernel
def euler_to_dcm(e):
    """R(e) for e = (roll, pitch, yaw) [rad]: yaw about z, then roll about x, then pitch about y."""
    s_phi, c_phi = sin_cos(e[0])
    s_th, c_th = sin_cos(e[1])
    s_psi, c_psi = sin_cos(e[2])
    return (
        (c_psi * c_th - s_phi * s_psi * s_th, c_th * s_psi + c_psi * s_phi * s_th, -c_phi * s_th),
        (-c_phi * s_psi, c_phi * c_psi, s_phi),
        (c_psi * s_th + c_th * s_phi * s_psi, s_psi * s_th - c_psi * c_th * s_phi, c_phi * c_th),
    )


@kernel
def orthonormal(R):
    """R without rounding errors that make it no rotation: a Newton step toward orthonormality."""
    return R - 0.5 * (add_to_diagonal(R @ R.T, -1.0) @ R)


@kernel
def split_rotation(e):
    """R(e) = I + even(e) + odd(e), which keep and change sign with e, free of cancellation.

    A pair of sigma points is at +e and -e, so its sum and difference need one evaluation of these.
    The third result, (s_phi, c_phi - 1, s_th, c_th - 1) of roll and pitch, is for the Euler rates.
    """
    (s_phi, m_phi), (s_th, m_th), (s_psi, m_psi) = sin_cos_minus_one(e)
    c_phi, c_th, c_psi = 1.0 + m_phi, 1.0 + m_th, 1.0 + m_psi
    even = (
        (m_psi * c_th + m_th, c_psi * s_phi * s_th, 0.0),
        (0.0, m_psi * c_phi + m_phi, 0.0),
        (c_th * s_phi * s_psi, s_psi * s_th, m_phi * c_th + m_th),
    )
    odd = (
        (-s_phi * s_psi * s_th, c_th * s_psi, -c_phi * s_th),
        (-c_phi * s_psi, 0.0, s_phi),
        (c_psi * s_th, -c_psi * c_th * s_phi, 0.0),
    )
    return even, odd, (s_phi, m_phi, s_th, m_th)


@kernel
def split_turn(d):
    """exp(-[d x]) = I + even(d) + odd(d) for a rotation vector d, likewise free of cancellation."""
    x, y, z = d
    angle = math.sqrt(x * x + y * y + z * z)
    sine, cosine = sin_cos(0.5 * angle)
    turned = angle > TINY
    per_angle = select(turned, sine / select(turned, angle, 1.0), 0.5)
    q, k = 2.0 * per_angle * cosine, 2.0 * per_angle * per_angle
    even = (
        (-k * (y * y + z * z), k * x * y, k * x * z),
        (k * x * y, -k * (x * x + z * z), k * y * z),
        (k * x * z, k * y * z, -k * (x * x + y * y)),
    )
    odd = ((0.0, q * z, -q * y), (-q * z, 0.0, q * x), (q * y, -q * x, 0.0))
    return even, odd


@kernel
def turn_pair(even, odd, x, d):
    """The odd and even parts of (I + even +- odd) (x -+ d) - x, with the parts of `split_rotation`.

    They are `odd x - d - even d` and `even x - odd d`, written out to omit the zeros.
    """
    (e00, e01, _), (_, e11, _), (e20, e21, e22) = even
    (o00, o01, o02), (o10, _, o12), (o20, o21, _) = odd
    x0, x1, x2 = x
    d0, d1, d2 = d
    return (
        (
            o00 * x0 + o01 * x1 + o02 * x2 - d0 - e00 * d0 - e01 * d1,
            o10 * x0 + o12 * x2 - d1 - e11 * d1,
            o20 * x0 + o21 * x1 - d2 - e20 * d0 - e21 * d1 - e22 * d2,
        ),
        (
            e00 * x0 + e01 * x1 - o00 * d0 - o01 * d1 - o02 * d2,
            e11 * x1 - o10 * d0 - o12 * d2,
            e20 * x0 + e21 * x1 + e22 * x2 - o20 * d0 - o21 * d1,
        ),
    )


@kernel
def turn_pair_back(even, odd, x, d):
    """The odd and even parts of (I + even +- odd)^T (x -+ d) - x."""
    (e00, e01, _), (_, e11, _), (e20, e21, e22) = even
    (o00, o01, o02), (o10, _, o12), (o20, o21, _) = odd
    x0, x1, x2 = x
    d0, d1, d2 = d
    return (
        (
            o00 * x0 + o10 * x1 + o20 * x2 - d0 - e00 * d0 - e20 * d2,
            o01 * x0 + o21 * x2 - d1 - e01 * d0 - e11 * d1 - e21 * d2,
            o02 * x0 + o12 * x1 - d2 - e22 * d2,
        ),
        (
            e00 * x0 + e20 * x2 - o00 * d0 - o10 * d1 - o20 * d2,
            e01 * x0 + e11 * x1 + e21 * x2 - o01 * d0 - o21 * d2,
            e22 * x2 - o02 * d0 - o12 * d1,
        ),
    )


@kernel
def quaternion_to_dcm(q):
    """R_BI of the unit quaternion q (w, x, y, z)."""
    w, x, y, z = q
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        (2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


@kernel
def vector_to_dcm(phi):
    """exp(-[phi x]), the R_BI of a body rotated from I by the rotation vector phi [rad]."""
    angle = math.sqrt(phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2])
    sine, cosine = sin_cos(0.5 * angle)
    turned = angle > TINY
    per_angle = select(turned, sine / select(turned, angle, 1.0), 0.5)
    return quaternion_to_dcm((cosine, per_angle * phi[0], per_angle * phi[1], per_angle * phi[2]))


@kernel
def dcm_to_quaternion(R_BI):
    """The unit quaternion of R_BI with the sign that makes its largest component positive.

    Each of the four squares 4 q_i^2 is a sum of diagonal entries; the largest is well conditioned
    (S. W. Shepperd, J. Guidance and Control 1(3), 1978).
    """
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = R_BI
    square_w, square_x = 1.0 + r00 + r11 + r22, 1.0 + r00 - r11 - r22
    square_y, square_z = 1.0 - r00 + r11 - r22, 1.0 - r00 - r11 + r22
    wx, wy, wz = r12 - r21, r20 - r02, r01 - r10
    xy, xz, yz = r01 + r10, r02 + r20, r12 + r21
    # each candidate is 4 q_i q, for one i
    best, q = square_w, (square_w, wx, wy, wz)
    better = square_x > best
    best, q = select(better, square_x, best), select(better, (wx, square_x, xy, xz), q)
    better = square_y > best
    best, q = select(better, square_y, best), select(better, (wy, xy, square_y, yz), q)
    return normalize_quaternion(select(square_z > best, (wz, xz, yz, square_z), q))


@kernel
def normalize_quaternion(q):
    """Q / |q|."""
    inverse = 1.0 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return inverse * q


@kernel
def mean_quaternion(a, b):
    """The attitude halfway from a to b, two attitudes less than half a turn apart."""
    # b and -b are the same attitude; of the two rotations, halve the shorter one
    near = select(a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] < 0.0, -1.0, 1.0)
    return normalize_quaternion(a + near * b)


@kernel
def rotation_between(a, b):
    """The rotation vector [rad] in B from attitude a to attitude b, both quaternions.

    It is phi with b = a (cos |phi|/2, sin |phi|/2 phi/|phi|), less than half a turn.
    """
    w = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]
    x = a[0] * b[1] - a[1] * b[0] - a[2] * b[3] + a[3] * b[2]
    y = a[0] * b[2] - a[2] * b[0] - a[3] * b[1] + a[1] * b[3]
    z = a[0] * b[3] - a[3] * b[0] - a[1] * b[2] + a[2] * b[1]
    near = select(w < 0.0, -1.0, 1.0)  # b and -b are the same attitude
    sine = math.sqrt(x * x + y * y + z * z)
    turned = sine > TINY
    per_sine = near * select(turned, atan2(sine, near * w) / select(turned, sine, 1.0), 1.0)
    return (2.0 * per_sine * x, 2.0 * per_sine * y, 2.0 * per_sine * z)


@kernel
def quaternion_rate(q, w_B):
    """dq/dt = 1/2 q (0, w_B)."""
    w, x, y, z = q
    return (
        0.5 * (-x * w_B[0] - y * w_B[1] - z * w_B[2]),
        0.5 * (w * w_B[0] + y * w_B[2] - z * w_B[1]),
        0.5 * (w * w_B[1] + z * w_B[0] - x * w_B[2]),
        0.5 * (w * w_B[2] + x * w_B[1] - y * w_B[0]),
    )


@kernel
def level_attitude(v_B, v_I):
    """The level attitude R_BI in which a vector in B has the heading that it has in I."""
    zero = zero_like(v_B[0])
    east = (zero + 1.0, zero, zero)
    b = unit_or((v_B[0], v_B[1], zero), east)
    i = unit_or((v_I[0], v_I[1], zero), east)
    c, s = b[0] * i[0] + b[1] * i[1], b[0] * i[1] - b[1] * i[0]
    return ((c, s, zero), (-s, c, zero), (zero, zero, zero + 1.0))

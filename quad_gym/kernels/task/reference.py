"""References: a finite Fourier series per axis and a rule for the heading.

`r*(t) = c + sum_k a_k cos(k w t) + b_k sin(k w t)`: hover has no terms, a circle one, a lemniscate
two, a random trajectory several. One kernel evaluates them all, with exact derivatives. A user's
trajectory is looked up by the stage of `follow.py`, and read here.
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.maths.elementary import sin_cos
from quad_gym.kernels.maths.linalg import load3, unit_or
from quad_gym.kernels.simd.lanes import select, zero_like
from quad_gym.records import FOLLOWED, HEADING_ALONG, HEADING_VELOCITY, MAX_HARMONICS


@kernel
def position_on_reference(flight, t, harmonics=MAX_HARMONICS):
    """Return r*(t) in I [m]."""
    x, y, z = load3(flight.ref_center)
    s1, c1 = zero_like(x), zero_like(x)
    if harmonics > 0:
        s1, c1 = sin_cos(flight.ref_omega * t)
    s, c = s1, c1
    for k in range(harmonics):
        a, b = flight.ref_cos[k], flight.ref_sin[k]
        x, y, z = x + a[0] * c + b[0] * s, y + a[1] * c + b[1] * s, z + a[2] * c + b[2] * s
        s, c = s * c1 + c * s1, c * c1 - s * s1
    return (x, y, z)


@kernel
def direction_of(v, zero):
    """Return the horizontal unit vector along v, east if v is vertical; `zero`: its z component."""
    return unit_or((v[0], v[1], zero), (zero + 1.0, zero, zero))


@kernel
def heading(flight, r_ref, v_ref):
    """Return x*, the desired direction of the body x axis: a horizontal unit vector in I."""
    point = load3(flight.ref_heading_point)
    rule = flight.ref_heading_rule
    along = select(rule == HEADING_VELOCITY, v_ref, point - r_ref)
    direction = select(rule == HEADING_ALONG, point, along)
    return direction_of(direction, zero_like(r_ref[0]))


@kernel
def _followed(flight):
    """Return (r*, v*, a*, x*) of a user's trajectory at the present instant."""
    r, v = load3(flight.path_r), load3(flight.path_v)
    return r, v, load3(flight.path_a), load3(flight.path_x)


@kernel
def evaluate_reference(flight, t, harmonics=MAX_HARMONICS):
    """Return (r*, v*, a*, x*) in I at the time t of the episode [s].

    `harmonics`: number of nonzero terms of the series; FOLLOWED: the reference is a trajectory, and
    t the present instant, for which `follow.py` has looked it up.
    """
    if harmonics == FOLLOWED:
        return _followed(flight)
    return _evaluate_series(flight, t, harmonics)


@kernel
def _evaluate_series(flight, t, harmonics):
    omega = flight.ref_omega
    x, y, z = load3(flight.ref_center)
    zero = zero_like(x)
    s1, c1 = zero, zero
    if harmonics > 0:
        s1, c1 = sin_cos(omega * t)
    s, c = s1, c1
    vx, vy, vz, ax, ay, az = zero, zero, zero, zero, zero, zero
    rate = omega
    for k in range(harmonics):
        a, b = flight.ref_cos[k], flight.ref_sin[k]
        ex, ey, ez = a[0] * c + b[0] * s, a[1] * c + b[1] * s, a[2] * c + b[2] * s
        x, y, z = x + ex, y + ey, z + ez
        vx = vx + rate * (b[0] * c - a[0] * s)
        vy = vy + rate * (b[1] * c - a[1] * s)
        vz = vz + rate * (b[2] * c - a[2] * s)
        square = rate * rate
        ax, ay, az = ax - square * ex, ay - square * ey, az - square * ez
        s, c = s * c1 + c * s1, c * c1 - s * s1
        rate = rate + omega
    r_ref, v_ref = (x, y, z), (vx, vy, vz)
    return r_ref, v_ref, (ax, ay, az), heading(flight, r_ref, v_ref)

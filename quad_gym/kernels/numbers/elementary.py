"""Elementary functions on any number type, without the C library: the same bits everywhere.

Sine and cosine are within one unit in the last place, the other functions within a few. The
polynomials come from fdlibm (Sun Microsystems, 1993), the public-domain ancestor of most C
libraries; here they have no branches, so that all lanes evaluate them together.
"""

import math

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.numbers.lanes import (
    any_of,
    exponent_of,
    fused_multiply_add,
    mantissa_of,
    power_of_two,
    round_to_even,
    select,
)
from quad_gym.kernels.numbers.linalg import polynomial
from quad_gym.records import SINGLE

# pi/2 in three parts (Cody and Waite): x - k * first is exact, k * second is for |k| < 2^20
_PIO2_1, _PIO2_2, _PIO2_3 = 1.5707963267948966, 6.12323399538461e-17, 3.5215598651832e-27
_MAX_TURNED = 1e9
_LN2_HIGH, _LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
_LARGEST = 1.7976931348623157e308
_EXP_LEAST, _EXP_MOST = -708.396, 709.782712893384  #: beyond which the result is 0, or infinite
if SINGLE:  # the same for float32, whose split parts have fewer bits
    _PIO2_1, _PIO2_2, _PIO2_3 = 1.57079637050628662109375, -4.37113882867379e-8, -1.71512451e-15
    _MAX_TURNED = 3e4
    _LN2_HIGH, _LN2_LOW = 0.693359375, -2.12194440e-4
    _LARGEST = 3.4028234663852886e38
    _EXP_LEAST, _EXP_MOST = -87.3, 88.7
_SMALL_ANGLE = 0.05
TINY = 1e-30 if SINGLE else 1e-100
"""Least divisor, which replaces zero and nothing larger."""

# fmt: off
_SIN = (-1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04,
        2.75573137070700676789e-06, -2.50507602534068634195e-08, 1.58969099521155010221e-10)
_COS = (4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05,
        -2.75573143513906633035e-07, 2.08757232129817482790e-09, -1.13596475577881948265e-11)
_EXP = (1.66666666666666019037e-01, -2.77777777770155933842e-03, 6.61375632143793436117e-05,
        -1.65339022054652515390e-06, 4.13813679705723846039e-08)
_LOG = (6.666666666666735130e-01, 3.999999999940941908e-01, 2.857142874366239149e-01,
        2.222219843214978396e-01, 1.818357216161805012e-01, 1.531383769920937332e-01,
        1.479819860511658591e-01)
_ATAN = (3.33333333333329318027e-01, -1.99999999998764832476e-01, 1.42857142725034663711e-01,
         -1.11111104054623557880e-01, 9.09088713343650656196e-02, -7.69187620504482999495e-02,
         6.66107313738753120669e-02, -5.83357013379057348645e-02, 4.97687799461593236017e-02,
         -3.65315727442169155270e-02, 1.62858201153657823623e-02)
# fmt: on


@kernel
def minimum(a, b):
    """The smaller of two numbers; `b` where either is NaN."""
    return select(a < b, a, b)


@kernel
def maximum(a, b):
    """The larger of two numbers; `b` where either is NaN."""
    return select(a > b, a, b)


@kernel
def clip(x, low, high):
    """`x` limited to [low, high]."""
    return minimum(maximum(x, low), high)


@kernel
def is_finite(x):
    """True where x is neither infinite nor NaN."""
    return abs(x) <= _LARGEST


@kernel
def near_zero(x):
    """(sin x, cos x) for |x| <= pi/4."""
    z = x * x
    cosine = 1.0 + (-0.5 * z + z * z * polynomial(z, _COS))
    return x + x * z * polynomial(z, _SIN), cosine


@kernel
def quarter_turns(sine, cosine, quadrant):
    """(sin, cos) of an angle, from sine and cosine `quadrant` (0 to 4) quarter turns before it."""
    odd = (quadrant == 1.0) | (quadrant == 3.0)
    turned_sine, turned_cosine = select(odd, cosine, sine), select(odd, sine, cosine)
    return (
        select((quadrant == 2.0) | (quadrant == 3.0), -turned_sine, turned_sine),
        select((quadrant == 1.0) | (quadrant == 2.0), -turned_cosine, turned_cosine),
    )


@kernel
def _of_sum(x, rest):
    """(sin, cos) of `x + rest`, where x is the sum rounded, for |x| <= pi/4."""
    z = x * x
    w = 1.0 - 0.5 * z
    cosine = w + (((1.0 - w) - 0.5 * z) + (z * z * polynomial(z, _COS) - x * rest))
    return x + (x * z * polynomial(z, _SIN) + rest * w), cosine


@kernel
def sin_cos(x):
    """(sin x, cos x) of an angle x [rad].

    The error is at most one unit in the last place for |x| <= 1e6, and at most 2^-53 for
    |x| <= 1e9; in float32 it is at most 5e-8 for |x| <= 3e4. Any larger angle counts as 0, which is
    as good as any: a unit in its last place may be many degrees. Infinity and NaN give NaN.
    """
    x = select(abs(x) <= _MAX_TURNED, x, x - x)
    turns = round_to_even(x * 0.63661977236758138243)
    near = fused_multiply_add(-turns, _PIO2_1, x)
    reduced = fused_multiply_add(-turns, _PIO2_2, near)
    rest = fused_multiply_add(-turns, _PIO2_2, near - reduced)
    rest = fused_multiply_add(-turns, _PIO2_3, rest)
    quadrant = turns - 4.0 * round_to_even(0.25 * turns - 0.375)
    sine, cosine = _of_sum(reduced, rest)
    sine, cosine = quarter_turns(sine, cosine, quadrant)
    return select(x == 0.0, x, sine), cosine  # which keeps the sign of zero


@kernel
def _tiny(x):
    """(sin x, cos x - 1) for |x| < 0.05 rad."""
    z = x * x
    sine = polynomial(z, (-1.0 / 6.0, 1.0 / 120.0, -1.0 / 5040.0))
    return x + x * z * sine, z * polynomial(z, (-0.5, 1.0 / 24.0, -1.0 / 720.0, 1.0 / 40320.0))


@kernel
def _where_large(x, near):
    """(sin x, cos x - 1) for any x, `near` where that is small."""
    sine, _ = sin_cos(x)
    half_sine, _ = sin_cos(0.5 * x)
    small = abs(x) < _SMALL_ANGLE
    return select(small, near[0], sine), select(small, near[1], -2.0 * half_sine * half_sine)


@kernel
def sin_cos_minus_one(angles):
    """(sin x, cos x - 1) of three angles x without cancellation, fastest below 0.05 rad.

    Sigma points have such angles. One branch for all three lets the processor go ahead.
    """
    x, y, z = angles
    of_x, of_y, of_z = _tiny(x), _tiny(y), _tiny(z)
    large = (abs(x) >= _SMALL_ANGLE) | (abs(y) >= _SMALL_ANGLE) | (abs(z) >= _SMALL_ANGLE)
    if any_of(large):
        of_x, of_y, of_z = _where_large(x, of_x), _where_large(y, of_y), _where_large(z, of_z)
    return of_x, of_y, of_z


@kernel
def _exp_rest(r):
    """The c with exp(r) = 1 + r + r c / (2 - c), for |r| <= ln(2) / 2."""
    z = r * r
    return r - z * polynomial(z, _EXP)


@kernel
def exp(x):
    """E ** x, with 0 and infinity beyond the range of the number (subnormal results are 0)."""
    k = round_to_even(clip(x, _EXP_LEAST - 1.0, _EXP_MOST + 1.0) * 1.44269504088896338700)
    high = fused_multiply_add(-k, _LN2_HIGH, x)
    low = k * _LN2_LOW
    r = high - low
    c = _exp_rest(r)
    mantissa = 1.0 - ((low - (r * c) / (2.0 - c)) - high)
    # two factors, as 2**k alone overflows at k = 1024
    half = round_to_even(0.5 * k)
    value = mantissa * power_of_two(half) * power_of_two(k - half)
    value = select(x > _EXP_MOST, math.inf, select(x < _EXP_LEAST, 0.0, value))
    return select(x == x, value, x)


@kernel
def approached(x):
    """1 - exp(-x) for x >= 0, without cancellation: the share that a decay has lost after x."""
    r = minimum(0.34, x)  # NaN remains
    c = _exp_rest(-r)
    return select(x > 0.34, 1.0 - exp(-x), r + r * c / (2.0 - c))


@kernel
def log(x):
    """Natural logarithm of a positive normal number; -inf at 0, NaN below."""
    m, k = mantissa_of(x), exponent_of(x)
    above = m > 1.41421356237309504880
    m, k = select(above, 0.5 * m, m), select(above, k + 1.0, k)
    f = m - 1.0
    s = f / (2.0 + f)
    z = s * s
    r = z * polynomial(z, _LOG)
    half_square = 0.5 * f * f
    value = k * _LN2_HIGH - ((half_square - (s * (half_square + r) + k * _LN2_LOW)) - f)
    value = select(x > 0.0, value, select(x == 0.0, -math.inf, math.nan))
    return select(x == math.inf, x, value)


@kernel
def _atan_polynomial(x):
    z = x * x
    return x - x * z * polynomial(z, _ATAN)


@kernel
def atan2(y, x):
    """The angle of the point (x, y) in [-pi, pi] rad; 0 at the origin."""
    ay, ax = abs(y), abs(x)
    large, little = maximum(ax, ay), minimum(ay, ax)
    ratio = little / select(large > 0.0, large, 1.0)
    # around tan(pi/8) < ratio <= 1 reduce by pi/4: atan t = pi/4 + atan((t - 1)/(t + 1))
    steep = ratio > 0.41421356237309503
    angle = _atan_polynomial(select(steep, (ratio - 1.0) / (ratio + 1.0), ratio))
    angle = select(steep, angle + 3.06161699786838301793e-17 + 0.78539816339744827900, angle)
    angle = select(ay > ax, 1.57079632679489655800 - angle, angle)
    angle = select(x < 0.0, 3.14159265358979311600 - angle, angle)
    angle = select(y < 0.0, -angle, angle)
    return select((x == x) & (y == y), angle, math.nan)

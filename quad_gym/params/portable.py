"""Small computations with bitwise identical results on every processor.

NumPy, SciPy and the C library choose or compile their code by the processor, and with it the order
of sums and the last bit of a sine. The results here become parameters of flights, so sums are
Python's, in a fixed order, and other functions are computed with many decimal digits and rounded
once. (`x**2` is a function of the C library, too; `x * x` is not.)
"""

import math
from collections.abc import Callable, Sequence
from decimal import MAX_EMAX, MIN_EMIN, Context, Decimal, localcontext
from functools import cache, wraps

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

_PI = Decimal("3.14159265358979323846264338327950288419716939937510582097494459")
_LN2_HIGH, _LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
"""ln 2 in two parts; the first ends with zeros, so that its small multiples are exact"""
_LOG2_E = 1.44269504088896338700
_TAYLOR = tuple(1.0 / math.factorial(n) for n in range(14))
_PRECISE = Context(prec=50, Emax=MAX_EMAX, Emin=MIN_EMIN, traps=[])


def _rounded_once(function: Callable[..., Decimal]) -> Callable[..., float]:
    """Make a function of decimal numbers one of floats."""

    @wraps(function)
    def rounded(*values: float) -> float:
        with localcontext(_PRECISE):
            return float(function(*map(Decimal, values)))

    return rounded


@_rounded_once
def exp(x: Decimal) -> Decimal:
    """Exponential function."""
    return x.exp()


@_rounded_once
def approached(x: Decimal) -> Decimal:
    """The share 1 - exp(-x), without cancellation for small x."""
    return 1 - (-x).exp()


@_rounded_once
def log(x: Decimal) -> Decimal:
    """Natural logarithm of x > 0."""
    return x.ln()


@_rounded_once
def hypot(*components: Decimal) -> Decimal:
    """Length of a vector; `norm` rounds each square."""
    return Decimal(sum(x * x for x in components)).sqrt()


def _sin_cos(angle: Decimal) -> tuple[Decimal, Decimal]:
    """Sine and cosine, by their series."""
    angle, term, sums = angle.remainder_near(2 * _PI), Decimal(1), [Decimal(0)] * 4
    for n in range(60):
        sums[n % 4] += term
        term *= angle / (n + 1)
    return sums[1] - sums[3], sums[0] - sums[2]


@_rounded_once
def sin(angle: Decimal) -> Decimal:
    """Sine of an angle [rad]."""
    return _sin_cos(angle)[0]


@_rounded_once
def cos(angle: Decimal) -> Decimal:
    """Cosine of an angle [rad]."""
    return _sin_cos(angle)[1]


@_rounded_once
def atan2(y: Decimal, x: Decimal) -> Decimal:
    """Angle of a vector (x, y) [rad]: the C library's, and a step of Newton's method."""
    near = Decimal(math.atan2(y, x))
    s, c = _sin_cos(near)
    return near + (y * c - x * s) / (x * c + y * s) if x or y else near


def _beyond(freedoms: Decimal, limit: Decimal) -> tuple[Decimal, Decimal]:
    """Probability of chi-square beyond a limit, of one to three freedoms, and its density there."""
    half, y = freedoms / 2, limit / 2
    if y > 800:  # less than the smallest float
        return Decimal(0), Decimal(0)
    term = y if freedoms == 2 else 2 * (y / _PI).sqrt() * (y / half if freedoms == 3 else 1)
    term *= (-y).exp()
    density, tail, fraction = term * half / limit, Decimal(1), y
    if y > 20:  # the continued fraction, which does not cancel
        for n in range(60, 0, -1):
            fraction = y + 2 * n - 1 - half - n * (n - half) / fraction
        return term * half / fraction, density
    for n in range(150):
        tail -= term
        term *= y / (half + n + 1)
    return tail, density


@cache
@_rounded_once
def chi_square_limit(freedoms: Decimal, beyond: Decimal) -> Decimal:
    """The limit that chi-square of one to three freedoms exceeds with a probability below 1/2."""
    limit = step = -2 * beyond.ln()  # exact for two freedoms
    while abs(step) > limit * Decimal("1e-25"):  # Newton's method for the logarithm, concave
        tail, density = _beyond(freedoms, limit)
        step = tail / density * (tail / beyond).ln()
        limit += step
    return limit


@_rounded_once
def erfc(x: Decimal) -> Decimal:
    """Complementary error function."""
    tail = _beyond(Decimal(1), 2 * x * x)[0] if x else Decimal(1)
    return tail if x > 0 else 2 - tail


def exp_of(x: ArrayLike) -> Floats:
    """Exponential function of an array, unlike `numpy.exp` with the same bits with AVX-512.

    exp(x) = 2^k exp(r), with k = round(x / ln 2) and the Taylor polynomial of exp(r). Products and
    sums of arrays, and scaling by a power of two, have the same bits on every processor.

    Args:
        x: Arguments, of any shape.

    Returns:
        Values of the same shape, with a relative error below 3e-16.
    """
    x = np.clip(x, -800.0, 800.0)  # 0 and infinity beyond
    k = np.rint(x * _LOG2_E)
    r = (x - k * _LN2_HIGH) - k * _LN2_LOW
    value = np.full_like(r, _TAYLOR[-1])
    for coefficient in reversed(_TAYLOR[:-1]):
        value = coefficient + r * value
    with np.errstate(over="ignore", under="ignore"):
        return np.ldexp(value, np.where(np.isnan(k), 0.0, k).astype(np.int64))


def norm(vector: Sequence[float] | Floats) -> float:
    """Length of a vector (n,)."""
    return math.sqrt(math.fsum(float(x) * float(x) for x in vector))


def product(a: ArrayLike, b: ArrayLike) -> Floats:
    """Matrix product of a (n, m) and b (m, k)."""
    rows, columns = np.asarray(a, np.float64).tolist(), np.asarray(b, np.float64).T.tolist()
    return np.array([[math.fsum(map(_times, row, column)) for column in columns] for row in rows])


def _times(x: float, y: float) -> float:
    return x * y


def turned(matrix: ArrayLike, vector: ArrayLike) -> Floats:
    """Product of a matrix (n, 3) and a vector (3,), with plain sums, as C code computes it."""
    x, y, z = np.asarray(vector, np.float64).tolist()
    rows = np.asarray(matrix, np.float64).tolist()
    return np.array([a * x + b * y + c * z for a, b, c in rows])


def inverse(matrix: ArrayLike) -> Floats:
    """Inverse of a regular matrix (n, n), by elimination with partial pivoting."""
    rows = np.asarray(matrix, np.float64).tolist()
    n = len(rows)
    rows = [row + [float(i == j) for j in range(n)] for i, row in enumerate(rows)]
    for j in range(n):
        pivot = max(range(j, n), key=lambda i: abs(rows[i][j]))
        rows[j], rows[pivot] = rows[pivot], rows[j]
        if rows[j][j] == 0.0:
            raise ValueError("matrix must be regular, got a singular one")
        rows[j] = [x / rows[j][j] for x in rows[j]]
        for i in range(n):
            if i != j:
                factor = rows[i][j]
                rows[i] = [x - factor * y for x, y in zip(rows[i], rows[j], strict=True)]
    return np.array([row[n:] for row in rows])


def lower_root(matrix: ArrayLike, scale: ArrayLike) -> Floats:
    """Return the lower triangular L with L L^T = M, for a positive semidefinite M (n, n).

    A pivot below 1e-12 times its variance in `scale` (n,) counts as zero.
    """
    M, scales = np.asarray(matrix, np.float64).tolist(), np.asarray(scale, np.float64).tolist()
    n = len(M)
    L = [[0.0] * n for _ in range(n)]
    for j in range(n):
        pivot = M[j][j] - math.fsum(x * x for x in L[j][:j])
        if pivot <= 1e-12 * scales[j]:
            continue
        L[j][j] = math.sqrt(pivot)
        for i in range(j + 1, n):
            L[i][j] = (M[i][j] - math.fsum(map(_times, L[i][:j], L[j][:j]))) / L[j][j]
    return np.array(L)


def euler_dcm(e: Sequence[float]) -> Floats:
    """R(e) (3, 3) of the 3-1-2 Euler angles (roll, pitch, yaw) [rad]."""
    (sphi, sth, spsi), (cphi, cth, cpsi) = map(sin, e), map(cos, e)
    return np.array(
        [
            [cpsi * cth - sphi * spsi * sth, cth * spsi + cpsi * sphi * sth, -cphi * sth],
            [-cphi * spsi, cphi * cpsi, sphi],
            [cpsi * sth + cth * sphi * spsi, spsi * sth - cpsi * cth * sphi, cphi * cth],
        ]
    )

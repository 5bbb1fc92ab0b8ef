"""Slow errors d of sensors as additional states of the filter, after the other fifteen.

A measurement with a slow error is `z = h(x) + d + white noise`, where each d is a Gauss-Markov
process of first order,

    d+ = alpha d + v,  alpha = exp(-dt / tau),  var(v) = sigma^2 (1 - alpha^2),

or a constant (alpha = 1, v = 0). With d as a state, the filter models the error that successive
measurements share: other information about position or heading determines d, and the measurement
improves these only if it is more accurate. White noise instead would have to be so strong that
measurements had almost no weight. (R. G. Brown and P. Y. C. Hwang, Introduction to Random Signals
and Applied Kalman Filtering, section on colored measurement noise.)

The states are the drift of GNSS positions (three states in I, the first three of d), and the slow
errors of other sensors (`kernels/sensors/`): vectors first, then scalars. As blocks are 3 x
3, their number is a multiple of three; the states that pad it are constant, with variance one, and
never measured.

The factor of the joint covariance has the rows of `flight.L`, and below them the rows of
`flight.L_slow`. As d comes last, the first fifteen rows are the factor of the covariance of the
fifteen states, as without d, and their prediction does not depend on d. Kernels of the filter take
`slow`, which is the settings record, or None if no sensor has a slow error: the compiler evaluates
`slow is None`, so that a filter without d has none of this code.
"""

from typing import Any

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.filter.error_state import BA, BG, D, E
from quad_gym.kernels.numbers.lanes import select, zero_like
from quad_gym.kernels.numbers.linalg import (
    add_diagonal,
    cross,
    load3,
    load33,
    load_block,
    load_column3,
    store_block,
    store_column3,
    sum_of_outers,
    sum_of_squares,
)
from quad_gym.kernels.numbers.rotation import euler_to_dcm
from quad_gym.records import AID_NUMBERS, Aid

_MAGNETOMETER = int(Aid["MAGNETOMETER"])
_FIELD = AID_NUMBERS[_MAGNETOMETER]


def stages_of(name: str, body: Any) -> tuple[Any, Any]:
    """Make a stage of a filter without slow errors, and one of a filter that estimates them.

    Args:
        name: Name of the first one, and the beginning of the name of the second.
        body: `(flight, p, work, settings, stages, slow)`, with the parameters that the filter
            assumes.
    """

    def plain(flight, world, model, settings, work, stages, flag):  # type: ignore[no-untyped-def]
        body(flight, model, work, settings, stages, None)

    def slow(flight, world, model, settings, work, stages, flag):  # type: ignore[no-untyped-def]
        body(flight, model, work, settings, stages, settings)

    plain.__name__ = plain.__qualname__ = f"{name}_stage"  # for caches and messages
    slow.__name__ = slow.__qualname__ = f"{name}_with_slow_stage"
    return stage(plain), stage(slow)


@kernel
def begin_slow(flight, p, slow, mask):
    """Begin an episode, where `mask`: estimates of zero with initial standard deviations."""
    for i in range(slow.slow_states):
        flight.slow_hat[i] = select(mask, 0.0, flight.slow_hat[i])
        for j in range(D + slow.slow_states):
            value = p.slow_sigma[i] if j == D + i else zero_like(p.slow_sigma[i])
            flight.L_slow[i, j] = select(mask, value, flight.L_slow[i, j])


@kernel
def stationary(p, i):
    """Variance of a slow error in the long run."""
    a, s = p.slow_decay[i], p.slow_drive[i]
    return s * s / ((1.0 - a) * (1.0 + a))


@kernel
def _scale_both(a, b, m):
    """Diag(a) M diag(b)."""
    return (_product(a[0] * b, m[0]), _product(a[1] * b, m[1]), _product(a[2] * b, m[2]))


@kernel
def _product(a, b):
    """Diag(a) B of a matrix or a vector."""
    return (a[0] * b[0], a[1] * b[1], a[2] * b[2])


@kernel
def copy_factor(L, source, first, rows, ok):
    """Copy `rows` of a lower factor, from row `first` of the whole one on, where `ok`."""
    for i in range(rows):
        for j in range(first + i + 1):
            L[i, j] = select(ok, source[i, j], L[i, j])


@kernel
def keep_factor(flight, slow, work, ok):
    """Store the factor in work.P, where `ok`."""
    copy_factor(flight.L, work.P, 0, D, ok)
    if slow is not None:
        copy_factor(flight.L_slow, work.P[D:], D, slow.slow_states, ok)


@kernel
def predict_slow(flight, slow, p, work):
    """Predict the rows of d in work.P; d does not act on other states."""
    L, F, P, M = flight.L, work.F, work.P, flight.L_slow
    for i in range(0, slow.slow_states, 3):
        a, s = load3(p.slow_decay[i : i + 3]), load3(p.slow_drive[i : i + 3])
        for j in range(0, BA, 3):
            store_block(P, D + i, j, _product(a, sum_of_outers(M, i, F, j, 15)))
        with_a, with_g = sum_of_outers(M, i, L, BA, 12), sum_of_outers(M, i, L, BG, 15)
        store_block(P, D + i, BA, _product(p.accel_bias_decay * a, with_a))
        store_block(P, D + i, BG, _product(p.gyro_bias_decay * a, with_g))
        for j in range(0, i, 3):
            b = load3(p.slow_decay[j : j + 3])
            other = sum_of_outers(M, i, M, j, D + j + 3)
            store_block(P, D + i, D + j, _scale_both(a, b, other))
        own = _scale_both(a, a, sum_of_squares(M, i, D + i + 3))
        store_block(P, D + i, D + i, add_diagonal(own, _product(s, s)))


@kernel
def decay_slow(flight, slow, p, ok):
    """Predict the estimates of d over a tick, where `ok`."""
    for i in range(slow.slow_states):
        d = flight.slow_hat[i]
        flight.slow_hat[i] = select(ok, p.slow_decay[i] * d, d)


@kernel
def turn_slow(slow, P, T):
    """Transform the correlation of d with the error angles, as `turn_covariance` the other ones."""
    for i in range(0, slow.slow_states, 3):
        store_block(P, D + i, E, load_block(P, D + i, E) @ T.T)


@kernel
def load_slow(flight, slow, columns):
    """Add the columns of d to the factor of fifteen states in `columns`, last column first."""
    last = D + slow.slow_states - 1
    for i in range(D):
        for j in range(D, last + 1):
            columns[i, last - j] = zero_like(flight.slow_hat[0])
    for i in range(slow.slow_states):
        for j in range(last + 1):
            columns[D + i, last - j] = flight.L_slow[i, j]


@kernel
def turn_iron(flight, slow, p, L9, T, correction, columns):
    """Correct the covariance of hard iron when an update rotates the attitude.

    The field measures the sum b + f x e, with hard iron b, error angles e and the expected field f
    in B, much better than either term. An update that rotates the attitude by degrees rotates f,
    and another sum takes its place. With the variance of the former sum, the next field, from
    another tilt, would seem to measure the heading. To keep the covariance of the sum unchanged,
    the rows of b absorb the difference.

    The effect of the declination's error, delta g with g = R_BI (m_I x e3), rotates as well; this
    is neglected, as is the correction of delta in f: 0.35 degrees matter little. The standard
    deviation of hard iron, if much smaller than the field's noise, grows by up to |f x m| times the
    standard deviation of the attitude, where m is the rotation.

    L9 is the factor after the update, last column first; R_hat is the attitude before it, T the
    transformation of the attitude errors by `reset_matrix`.
    """
    first = slow.aid_vector[_MAGNETOMETER]
    if first >= 0:
        m, delta = load3(p.aid_numbers[_FIELD]), slow.aid_scalar[_MAGNETOMETER]
        turned = (m[1], -m[0], zero_like(m[2]))
        field_I = flight.slow_hat[delta] * turned + m
        before = load33(flight.R_hat) @ field_I
        after = euler_to_dcm(correction) @ before
        for j in range(columns - 9, columns):
            e = load_column3(L9, E, j)
            more = cross(T @ e, after) - cross(e, before)
            store_column3(L9, D + first, j, load_column3(L9, D + first, j) + more)


@kernel
def shift_slow(flight, slow, columns, ok, shift):
    """Store d and its rows after an update, where `ok`, from the factor, last column first."""
    last = D + slow.slow_states - 1
    for i in range(slow.slow_states):
        d = flight.slow_hat[i]
        flight.slow_hat[i] = select(ok, d + shift[D + i], d)
        for j in range(D + i + 1):
            flight.L_slow[i, j] = select(ok, columns[D + i, last - j], flight.L_slow[i, j])


@kernel
def fill_slow(flight, slow, P):
    """Fill the rows of d in P with the present ones."""
    L, M = flight.L, flight.L_slow
    for i in range(0, slow.slow_states, 3):
        for j in range(0, D, 3):
            store_block(P, D + i, j, sum_of_outers(M, i, L, j, j + 3))
        for j in range(0, i, 3):
            store_block(P, D + i, D + j, sum_of_outers(M, i, M, j, D + j + 3))
        store_block(P, D + i, D + i, sum_of_squares(M, i, D + i + 3))


@kernel
def begin_to_carry_slow(slow, p, work, ticks):
    """Fill work.slow_decay with alpha over a number of ticks; one where nothing is delayed."""
    for i in range(slow.slow_states):
        decay = 1.0 + zero_like(p.dt)
        for _ in range(ticks):
            decay = decay * p.slow_decay[i]
        work.slow_decay[i] = select(work.since_time > 0.0, decay, 1.0)


@kernel
def _gained(p, work, i, noise):
    """Variances that three slow errors have gained over the time, times `noise`."""
    return (_gain(p, work, i, noise), _gain(p, work, i + 1, noise), _gain(p, work, i + 2, noise))


@kernel
def _gain(p, work, i, noise):
    decay, one, s = work.slow_decay[i], p.slow_decay[i], p.slow_drive[i]
    fall = (1.0 - one) * (1.0 + one)
    share = noise * ((1.0 - decay) * (1.0 + decay) / fall)
    return select(fall > 0.0, share * s * s, 0.0)  # a constant gains nothing


@kernel
def _factors(work, i, back):
    """Factors by which three slow errors change over the time, or back over it."""
    a = load3(work.slow_decay[i : i + 3])
    if back:
        return (1.0 / a[0], 1.0 / a[1], 1.0 / a[2])
    return a


@kernel
def carry_slow(flight, slow, p, work, noise, back):
    """Propagate the rows of d in work.P back in time by work.slow_decay, or forward.

    The variance that d has gained since then is multiplied by `noise`, as the noise of the IMU is:
    -1 or 0 on the way back, 1 or 0 on the way forward. work.columns has the fifteen propagated
    columns of the other states.
    """
    M, P, rows = work.columns, work.P, flight.L_slow
    for i in range(0, slow.slow_states, 3):
        a, gained = _factors(work, i, back), _gained(p, work, i, noise)
        for j in range(0, D, 3):
            store_block(P, D + i, j, _product(a, sum_of_outers(rows, i, M, j, 15)))
        for j in range(0, i, 3):
            other = sum_of_outers(rows, i, rows, j, D + j + 3)
            store_block(P, D + i, D + j, _scale_both(a, _factors(work, j, back), other))
        own = sum_of_squares(rows, i, D + i + 3)
        if back:
            own = _scale_both(a, a, add_diagonal(own, gained))
        else:
            own = add_diagonal(_scale_both(a, a, own), gained)
        store_block(P, D + i, D + i, own)


@kernel
def shift_carried_slow(flight, slow, work, back):
    """Propagate the estimates of d back or forward."""
    for i in range(slow.slow_states):
        d, decay = flight.slow_hat[i], work.slow_decay[i]
        flight.slow_hat[i] = (1.0 / decay) * d if back else decay * d

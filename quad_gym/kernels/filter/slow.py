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

The joint covariance has the rows of `flight.P`, and below them the rows of `flight.P_slow`, so that
the prediction of the fifteen states is the same with and without d. An update takes d before the
biases, on which no measurement depends: its factor has the rows e, r, v, d, b_a, b_g, see
`columns.py`. Kernels of the filter take `slow`, which is the settings record, or None if no sensor
has a slow error: the compiler evaluates `slow is None`, so that a filter without d has none of this
code.
"""

from typing import Any

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.filter.error_state import BA, BG, D, E, R, V, reset_matrix
from quad_gym.kernels.numbers.elementary import approached
from quad_gym.kernels.numbers.factors import solve_right33
from quad_gym.kernels.numbers.lanes import select, zero_like
from quad_gym.kernels.numbers.linalg import (
    add_diagonal,
    cross,
    keep_block,
    keep_lower,
    load3,
    load33,
    load_block,
    load_column3,
    load_symmetric,
    store_block,
    store_column3,
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
            sigma = p.slow_sigma[i]
            value = sigma * sigma if j == D + i else zero_like(sigma)
            flight.P_slow[i, j] = select(mask, value, flight.P_slow[i, j])


@kernel
def stationary(p, i):
    """Variance of a slow error in the long run."""
    return p.slow_stationary[i] * p.slow_stationary[i]


@kernel
def _scale_both(a, b, m):
    """Diag(a) M diag(b)."""
    return (_product(a[0] * b, m[0]), _product(a[1] * b, m[1]), _product(a[2] * b, m[2]))


@kernel
def _product(a, b):
    """Diag(a) B of a matrix or a vector."""
    return (a[0] * b[0], a[1] * b[1], a[2] * b[2])


@kernel
def predict_slow(flight, slow, p, maps, factor, turn, turns, midpoint, ok):
    """Predict the rows of d in the covariance, where `ok`; d does not act on other states.

    Args:
        flight: Record.
        slow: The settings.
        p: Parameters assumed by the filter.
        maps: Matrices of the prediction, and its nonlinear remainders, see `predict.py`.
        factor: Factor of the covariance of the error angles.
        turn, turns: Mean of the error angles; True if the covariance is transformed with its reset.
        midpoint: True for the midpoint rule.
        ok: Lanes.
    """
    full, B, K, G, H, q, q_e = maps
    P, half_dt = flight.P_slow, 0.5 * p.dt
    for i in range(0, slow.slow_states, 3):
        decay, drive = load3(p.slow_decay[i : i + 3]), load3(p.slow_drive[i : i + 3])
        e, r, v = load_block(P, i, E), load_block(P, i, R), load_block(P, i, V)
        with_a, with_g = load_block(P, i, BA), load_block(P, i, BG)
        l_d = solve_right33(e, factor)
        new_v = v + e @ K.T + with_a @ G.T + with_g @ H.T + l_d @ q
        new_e = e @ full.T + with_g @ B.T
        if not midpoint:
            new_e = new_e + l_d @ q_e
            if turns:
                new_e = new_e @ reset_matrix(turn).T
        keep_block(P, i, E, ok, _product(decay, new_e))
        keep_block(P, i, R, ok, _product(decay, r + half_dt * (v + new_v)))
        keep_block(P, i, V, ok, _product(decay, new_v))
        keep_block(P, i, BA, ok, _product(p.accel_bias_decay * decay, with_a))
        keep_block(P, i, BG, ok, _product(p.gyro_bias_decay * decay, with_g))
        for j in range(0, i, 3):
            other = load3(p.slow_decay[j : j + 3])
            scaled = _scale_both(decay, other, load_block(P, i, D + j))
            keep_block(P, i, D + j, ok, scaled)
        own = P[:, D:]
        scaled = _scale_both(decay, decay, load_symmetric(own, i))
        keep_lower(own, i, ok, add_diagonal(scaled, _product(drive, drive)))


@kernel
def decay_slow(flight, slow, p, ok):
    """Predict the estimates of d over a tick, where `ok`."""
    for i in range(slow.slow_states):
        d = flight.slow_hat[i]
        flight.slow_hat[i] = select(ok, p.slow_decay[i] * d, d)


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
        for j in range(columns - 3, columns):  # of e; the others do not change it
            e = load_column3(L9, E, j)
            more = cross(T @ e, after) - cross(e, before)
            store_column3(
                L9,
                slow.motion_columns + first,
                j,
                load_column3(L9, slow.motion_columns + first, j) + more,
            )


@kernel
def shift_slow(flight, slow, ok, shift):
    """Correct the estimates of d by an update, where `ok`."""
    for i in range(slow.slow_states):
        d = flight.slow_hat[i]
        flight.slow_hat[i] = select(ok, d + shift[slow.motion_columns + i], d)


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
    # a constant, with a rate of zero, gains nothing
    return noise * approached(2.0 * p.slow_rate[i] * work.since_time) * stationary(p, i)


@kernel
def _factors(work, i, back):
    """Factors by which three slow errors change over the time, or back over it."""
    a = load3(work.slow_decay[i : i + 3])
    if back:
        return (1.0 / a[0], 1.0 / a[1], 1.0 / a[2])
    return a


@kernel
def carry_slow(flight, slow, p, work, noise, back):
    """Propagate the rows of d in the covariance back in time by work.slow_decay, or forward.

    The variance that d has gained since then is multiplied by `noise`, as the noise of the IMU is:
    -1 or 0 on the way back, 1 or 0 on the way forward. Behind the fifteen columns of other states,
    work.columns has the propagated covariances of these with d. The result is in work.P.
    """
    M, P, rows = work.columns, work.P, flight.P_slow
    for i in range(0, slow.slow_states, 3):
        a, gained = _factors(work, i, back), _gained(p, work, i, noise)
        for j in range(0, D, 3):
            store_block(P, D + i, j, _product(a, load_block(M, j, D + i).T))
        for j in range(0, i, 3):
            other = _scale_both(a, _factors(work, j, back), load_block(rows, i, D + j))
            store_block(P, D + i, D + j, other)
        own = load_symmetric(rows[:, D:], i)
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

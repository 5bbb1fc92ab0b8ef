"""The slow error d of GNSS positions as three more states of the filter, behind the other fifteen.

A fix measures `z = r + R^T l_p + d + white noise`, where d is a Gauss-Markov process in I,

    d+ = alpha d + v,  alpha = exp(-dt / tau),  var(v) = sigma^2 (1 - alpha^2),

that is zero at the start. With d as a state the filter knows that fixes share their error: velocity
and camera tell fast changes of the position, so that fixes tell d, and the position itself only as
far as they are better than that. White noise in its place would have to be so strong that fixes
counted for nothing. (R. G. Brown and P. Y. C. Hwang, Introduction to Random Signals and Applied
Kalman Filtering, section on colored measurement noise.)

The factor of the joint covariance of 18 states has the rows of `flight.L` and below them those of
`flight.L_drift`. As d comes last, the first fifteen rows are the factor of the covariance of the
fifteen states, as ever, and the prediction of these does not know of d. Kernels of the filter take
`drift`, which is these three rows, or None where no position drifts: what is under `drift is None`
is decided as they are compiled, so that a filter without d has none of this.
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import BA, BG, D, E
from quad_gym.kernels.maths.linalg import (
    add,
    add33,
    keep3,
    load3,
    load_block,
    multiply,
    scale33,
    select3,
    store_block,
    sum_of_outers,
    sum_of_squares,
    transpose,
)
from quad_gym.kernels.simd.lanes import select


@kernel
def begin_drift(flight, mask):
    """Begin an episode without a slow error, where `mask`."""
    keep3(flight.gnss_drift_hat, mask, (0.0, 0.0, 0.0))
    for i in range(3):
        for j in range(D + 3):
            flight.L_drift[i, j] = select(mask, 0.0, flight.L_drift[i, j])


@kernel
def add_diagonal(m, d):
    """M + diag(d)."""
    return (
        (m[0][0] + d[0], m[0][1], m[0][2]),
        (m[1][0], m[1][1] + d[1], m[1][2]),
        (m[2][0], m[2][1], m[2][2] + d[2]),
    )


@kernel
def keep_drift(flight, drift, work, ok, d):
    """Take over the estimate d, and its rows of the factor in work.P, where `ok`."""
    keep3(flight.gnss_drift_hat, ok, d)
    for i in range(3):
        for j in range(D + i + 1):
            drift[i, j] = select(ok, work.P[D + i, j], drift[i, j])


# ---- prediction ------------------------------------------------------------------------------


@kernel
def predict_drift(flight, drift, p, work):
    """Fill the rows of d in work.P, as of the end of a tick; d does not act on other states."""
    L, F, P, decay = flight.L, work.F, work.P, p.drift_tick_decay
    for j in range(0, BA, 3):
        store_block(P, D, j, scale33(decay, sum_of_outers(drift, 0, F, j, 15)))
    with_a, with_g = sum_of_outers(drift, 0, L, BA, 12), sum_of_outers(drift, 0, L, BG, 15)
    store_block(P, D, BA, scale33(decay * p.accel_bias_decay, with_a))
    store_block(P, D, BG, scale33(decay * p.gyro_bias_decay, with_g))
    s = load3(p.drift_tick_drive)
    own = scale33(decay * decay, sum_of_squares(drift, 0, D + 3))
    store_block(P, D, D, add_diagonal(own, (s[0] * s[0], s[1] * s[1], s[2] * s[2])))


@kernel
def turn_drift(P, T):
    """What `turn_covariance` is for the correlation of d with the error angles."""
    store_block(P, D, E, multiply(load_block(P, D, E), transpose(T)))


# ---- update ----------------------------------------------------------------------------------


@kernel
def measure_drift(flight, drift, work, n, use_position):
    """Add to work.A what a fix has of d, in all columns of the factor.

    Column j is row 17 - j; the columns from the tenth on, on which nothing else depends, are empty
    so far.
    """
    has = flight.position_valid > 0.0
    nothing = (0.0 * work.h[0], 0.0 * work.h[0], 0.0 * work.h[0])
    for j in range(D + 3):
        row = work.A[D + 2 - j]
        if j >= 9:
            for k in range(n):
                row[k] = nothing[0]
        if use_position:
            d = select3(has, (drift[0, j], drift[1, j], drift[2, j]), nothing)
            for i in range(3):
                row[i] = row[i] + d[i]


@kernel
def load_drift(drift, columns):
    """Complete the (18, 18) factor in `columns`, last first, that has those of fifteen states."""
    for i in range(D):
        for j in range(D, D + 3):
            columns[i, D + 2 - j] = 0.0 * drift[0, 0]
    for i in range(3):
        for j in range(D + 3):
            columns[D + i, D + 2 - j] = drift[i, j]


@kernel
def shift_drift(flight, drift, columns, ok, shift):
    """Take over what an update has made of d and its rows, where `ok`."""
    keep3(flight.gnss_drift_hat, ok, add(load3(flight.gnss_drift_hat), shift))
    for i in range(3):
        for j in range(D + i + 1):
            drift[i, j] = select(ok, columns[D + i, D + 2 - j], drift[i, j])


# ---- doubts ----------------------------------------------------------------------------------


@kernel
def add_to_drift(flight, drift, P, D_d):
    """Fill the rows of d in P with the present ones and D_d more of d."""
    for j in range(0, D, 3):
        store_block(P, D, j, sum_of_outers(drift, 0, flight.L, j, j + 3))
    store_block(P, D, D, add33(sum_of_squares(drift, 0, D + 3), D_d))


# ---- late measurements -----------------------------------------------------------------------


@kernel
def decay_over(p, ticks):
    """Alpha over a number of ticks."""
    decay = 1.0 + 0.0 * p.dt
    for _ in range(ticks):
        decay = decay * p.drift_tick_decay
    return decay


@kernel
def carry_drift(drift, p, work, noise, decay, back):
    """Fill the rows of d in work.P for a filter that goes back in time by `decay` of d, or on.

    What d has gained since then counts `noise` times, as the noise of the IMU does.

    Args:
        drift: Rows of the factor for the slow error.
        p: Parameters as the filter believes them.
        work: Workspace; work.columns has the fifteen columns of the other states, as taken.
        noise: -1 or 0 on the way back, 1 or 0 on the way on.
        decay: Alpha over the time.
        back: Whether the filter goes back.
    """
    M, P, one, s = work.columns, work.P, p.drift_tick_decay, load3(p.drift_tick_drive)
    share = noise * ((1.0 - decay) * (1.0 + decay) / ((1.0 - one) * (1.0 + one)))
    gained = (share * s[0] * s[0], share * s[1] * s[1], share * s[2] * s[2])
    factor = 1.0 / decay if back else decay
    for j in range(0, D, 3):
        store_block(P, D, j, scale33(factor, sum_of_outers(drift, 0, M, j, 15)))
    own = sum_of_squares(drift, 0, D + 3)
    if back:
        own = scale33(factor * factor, add_diagonal(own, gained))
    else:
        own = add_diagonal(scale33(factor * factor, own), gained)
    store_block(P, D, D, own)

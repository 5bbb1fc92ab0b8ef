"""A jump of the vehicle that the filter takes for drift of GNSS.

Where GNSS positions drift (`slow.py`), the filter knows better how the vehicle has moved than where
GNSS has drifted, so that it takes any fix that is off for drift, however suddenly it comes: once
the drift has followed, no innovation is left. But corrections of the drift are white in a right
filter, each with the variance that its update takes away, as those of biases are (`recovery.py`).
Their sum over about a second has the deviation by which GNSS drifts meanwhile, 0.1 m with
`consumer`, and shows what drift does not do. Then the position is doubted as much as the drift. The
same happens when a barometer is rejected `max_rejections` times in a row, as it sees the vertical
part of a jump.

Source: ours.
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import D, R
from quad_gym.kernels.filter.recovery import MOST_POSITION, enlarge, variance_of
from quad_gym.kernels.maths.elementary import maximum
from quad_gym.kernels.simd.lanes import select

_TIME = 1.5
"""How long corrections of the drift are added up [s]; it follows fixes within 0.6 s, or as long as
a gate rejects some."""
_SUDDEN, _LIKELY = 24.0, 12.0
"""Normalized square of their sum, chi-square of three numbers, beyond which it is no drift. That of
a right filter exceeds it with a probability of 2e-5. Less, 0.7 %, where the filter is lost anyway:
a barometer may have seen the vertical share of the jump."""


@kernel
def follow_drift_corrections(flight, p, L9, dx, columns, ok):
    """Add up an update's corrections of the drift, and their variances, where `ok`.

    Args:
        flight: Record; its factor is that before the update.
        p: Parameters as the filter believes them.
        L9: The factor that the update has made, its columns last first.
        dx: The correction of the state.
        columns: How many columns there are.
        ok: Which lanes.
    """
    kept = maximum(1.0 - (flight.tick - flight.corrected_tick) * p.dt / _TIME, 0.0)
    for i in range(3):
        variance = 0.0 * kept
        for j in range(columns):
            before, after = flight.L_slow[i, j], L9[D + i, j]
            variance = variance + before * before - after * after
        before, total = flight.drift_corrected[i], kept * flight.drift_corrected[i] + dx[D + i]
        flight.drift_corrected[i] = select(ok, total, before)
        before = flight.drift_corrected_variance[i]
        variance = kept * kept * before + maximum(variance, 0.0)
        flight.drift_corrected_variance[i] = select(ok, variance, before)


@kernel
def drifts_suddenly(flight):
    """Where corrections of the drift are more than drift, and than the position's deviation.

    Less than the latter does no harm.
    """
    square, limit = 0.0 * flight.tick, select(flight.diverged > 0.0, _LIKELY, _SUDDEN)
    for i in range(3):
        own = variance_of(flight, R + i)
        total, variance = flight.drift_corrected[i], flight.drift_corrected_variance[i]
        square = square + total * total / (own / limit + variance)
    return square > limit


@kernel
def doubt_position_and_drift(flight, P, doubted):
    """Raise the variances of position and drift to what a jump may have been.

    Some axes follow it later than others, so that none is raised by less than the mean.
    """
    mean = 0.0 * flight.tick
    for i in range(3):
        mean = mean + flight.drift_corrected[i] * flight.drift_corrected[i] / 3.0
    for i in range(3):
        total = flight.drift_corrected[i]
        square = maximum(total * total, mean)
        wanted = select(doubted, enlarge(square, MOST_POSITION), 0.0)
        P[R + i, R + i] = maximum(P[R + i, R + i], wanted)
        P[D + i, D + i] = maximum(P[D + i, D + i], wanted)


@kernel
def forget_drift_corrections(flight, mask):
    """Begin to add up corrections of the drift anew, where `mask`."""
    for i in range(3):
        flight.drift_corrected[i] = select(mask, 0.0, flight.drift_corrected[i])
        before = flight.drift_corrected_variance[i]
        flight.drift_corrected_variance[i] = select(mask, 0.0, before)

"""Detection of a jump of the vehicle that the filter attributes to the drift of GNSS positions.

Where GNSS positions drift (`slow.py`), the filter predicts the motion better than the drift, so it
attributes any offset of a fix to the drift, however sudden: once the drift has followed, no
innovation is left. But corrections of the drift are white in a consistent filter, each with the
variance that its update removes, like corrections of biases (`recovery.py`). Their sum over about a
second has the standard deviation of the drift in that time, 0.1 m with `consumer`, and shows jumps.
Then both position and drift are inflated. This also happens when a barometer is rejected
`max_rejections` times in a row, as it observes the vertical part of a jump.

Source: ours.
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.filter.error_state import D, R
from quad_gym.kernels.filter.recovery import (
    MOST_POSITION,
    add_correction,
    enlarge,
    raise_variance,
    variance_of,
)
from quad_gym.kernels.maths.elementary import maximum
from quad_gym.kernels.simd.blocks import reset
from quad_gym.kernels.simd.lanes import select

_TIME = 1.5
"""Time over which corrections of the drift are summed [s]; the drift follows fixes within 0.6 s, or
later while the gate rejects some."""
_SUDDEN, _LIKELY = 24.0, 12.0
"""Normalized square of their sum, chi-square with three degrees of freedom, beyond which it counts
as a jump: exceeded with a probability of 2e-5 in a consistent filter. The second threshold,
exceeded with 0.7 %, applies where the filter is flagged as diverged: a barometer may have observed
the vertical part of the jump."""


@kernel
def follow_drift_corrections(flight, p, L9, dx, columns, ok):
    """Add up an update's corrections dx of the drift, and their variances, where `ok`.

    L9 is the updated factor, last column first; the record still has the factor before.
    """
    kept = maximum(1.0 - (flight.tick - flight.corrected_tick) * p.dt / _TIME, 0.0)
    sums, variances = flight.drift_corrected, flight.drift_corrected_variance
    for i in range(3):
        removed = 0.0 * kept
        for j in range(columns):
            before, after = flight.L_slow[i, j], L9[D + i, j]
            removed = removed + before * before - after * after
        add_correction(sums, variances, i, ok, kept, dx[D + i], maximum(removed, 0.0))


@kernel
def drifts_suddenly(flight):
    """Lanes whose corrections exceed the drift and the standard deviation of the position.

    Corrections below that standard deviation are harmless.
    """
    square, limit = 0.0 * flight.tick, select(flight.diverged > 0.0, _LIKELY, _SUDDEN)
    for i in range(3):
        own = variance_of(flight, R + i)
        total, variance = flight.drift_corrected[i], flight.drift_corrected_variance[i]
        square = square + total * total / (own / limit + variance)
    return square > limit


@kernel
def inflate_position_and_drift(flight, P, moved):
    """Inflate position and drift to the square of the likely jump.

    The axes do not follow it at the same time, so none is inflated by less than the mean.
    """
    mean = 0.0 * flight.tick
    for i in range(3):
        mean = mean + flight.drift_corrected[i] * flight.drift_corrected[i] / 3.0
    for i in range(3):
        total = flight.drift_corrected[i]
        square = maximum(total * total, mean)
        raise_variance(P, R + i, moved, enlarge(square, MOST_POSITION))
        raise_variance(P, D + i, moved, enlarge(square, MOST_POSITION))


@kernel
def forget_drift_corrections(flight, mask):
    """Reset the sum of corrections of the drift, in the lanes `mask`."""
    reset(flight, mask, 0.0, "drift_corrected drift_corrected_variance")

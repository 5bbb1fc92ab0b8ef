"""When a sensor measures first."""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.simd.lanes import select


@kernel
def first_wait(phase, period, share):
    """Ticks to a sensor's first measurement: its phase, or at random within its period."""
    ticks = 0.0 * share
    for k in range(1, period):
        ticks = ticks + select(share * period >= 1.0 * k, 1.0, 0.0)
    if phase >= 0:
        ticks = 0.0 * share + phase
    return ticks

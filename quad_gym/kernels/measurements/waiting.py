"""Three numbers that wait for a late sensor's latency to pass, see `filter/waiting.py`."""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.maths.linalg import keep3, load3
from quad_gym.kernels.simd.lanes import any_of, select
from quad_gym.records import DELAY_SLOTS


@kernel
def exchange_three(flight, work, block, values, valid, waiting, kept):
    """Let what is measured now wait, and keep what arrives.

    Args:
        flight: Record; `late_valid` says which of the waiting ones were measured.
        work: Workspace; `here` and `taken` say which one arrives, and where one is measured.
        block: Number of the block.
        values: What is measured now.
        valid: Whether it is, 0 or 1.
        waiting: What was measured before, the latest first.
        kept: What arrived last; becomes what arrives.

    Returns:
        Whether something arrives, 0 or 1.
    """
    flags, arrived = flight.late_valid, 0.0 * flight.tick
    for slot in range(DELAY_SLOTS):
        here = work.here[slot] > 0.0
        keep3(kept, here, load3(waiting[slot]))
        arrived = select(here, flags[slot, block], arrived)
    taken = work.taken > 0.0
    if any_of(taken):
        for slot in range(DELAY_SLOTS - 1, 0, -1):
            keep3(waiting[slot], taken, load3(waiting[slot - 1]))
            flags[slot, block] = select(taken, flags[slot - 1, block], flags[slot, block])
        keep3(waiting[0], taken, load3(values))
        flags[0, block] = select(taken, valid, flags[0, block])
    return arrived

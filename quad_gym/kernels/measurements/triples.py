"""What blocks of three numbers that GNSS measures share: position, baseline and velocity.

They differ in the names of their fields alone, so that their functions are made here, by name. How
measurements wait for a late sensor's latency to pass is in `filter/waiting.py`.
"""

from typing import Any, NamedTuple

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.maths.linalg import keep3, load3, store3
from quad_gym.kernels.measurements.gate import mark_block
from quad_gym.kernels.simd.blocks import set_field
from quad_gym.kernels.simd.lanes import any_of, select
from quad_gym.records import DELAY_SLOTS, FLIGHT_FIELDS, Sensor

_GNSS = int(Sensor.GNSS)
_FIELDS = {field.name for field in FLIGHT_FIELDS}


class TripleFunctions(NamedTuple):
    """Kernels by the names that `blocks.py` knows."""

    count: Any
    mark_failed: Any
    set_aside: Any
    exchange: Any
    keep_valid: Any
    choose: Any


def triple_functions(name: str, block: int) -> TripleFunctions:
    """The functions of a block of three numbers.

    Args:
        name: For instance "position" of `gnss_position`, `position_valid`, `late_position` and
            `kept_position`, and of `position_fresh` where there is such a field.
        block: Its number.
    """
    value, valid, fresh = f"gnss_{name}", f"{name}_valid", f"{name}_fresh"
    late, kept = f"late_{name}", f"kept_{name}"

    @kernel
    def count(flight, p, work, settings, slow, k):
        """Count what is measured; return the row behind it."""
        if any_of(getattr(flight, valid) > 0.0):
            work.measured = work.measured + 3.0 * getattr(flight, valid)
            k += 3
        return k

    @kernel
    def mark_failed(flight, p, work, settings, slow, k):
        """Say that the update failed that it was part of, where `work.taking`."""
        mark_block(flight, block, (work.taking > 0.0) & (getattr(flight, valid) > 0.0))
        return k

    @kernel
    def set_aside(flight, p, work, settings, slow, k):
        """Keep what has arrived so far, before something new is measured."""
        store3(getattr(work, kept), load3(getattr(flight, value)))
        return k

    @kernel
    def mark_fresh(flight, arrived):
        """Say that it was measured since the last step."""
        set_field(flight, fresh, select(arrived > 0.0, 1.0, getattr(flight, fresh)))

    @kernel
    def mark_nothing(flight, arrived):
        """Say nothing: there is no such field."""

    tell_arrival = mark_fresh if fresh in _FIELDS else mark_nothing

    @kernel
    def exchange(flight, p, work, settings, slow, starting):
        """Let what is measured now wait, and what waited arrive."""
        arrived = _exchange(
            flight, work, block, getattr(flight, value), getattr(flight, valid),
            getattr(flight, late), getattr(work, kept),
        )  # fmt: skip
        set_field(flight, valid, select(work.mask > 0.0, arrived, getattr(flight, valid)))
        if not starting:  # a first fix has started the filter
            store3(getattr(flight, value), load3(getattr(work, kept)))
            tell_arrival(flight, arrived)
        return starting

    @kernel
    def keep_valid(flight, p, work, settings, slow, k):
        """Keep whether it is measured, for the turns of late measurements."""
        work.kept_valid[block] = getattr(flight, valid)
        return k

    @kernel
    def choose(flight, p, work, settings, slow, k):
        """Let it be measured only where its sensor has its turn."""
        set_field(flight, valid, work.turn[_GNSS] * work.kept_valid[block])
        return k

    return TripleFunctions(count, mark_failed, set_aside, exchange, keep_valid, choose)


@kernel
def _exchange(flight, work, block, values, valid, waiting, kept):
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

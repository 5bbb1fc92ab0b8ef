"""The measurements of GNSS and camera that are one joint update: their list.

Each is a file that says what it measures and what the filter makes of it, by functions of the same
names: `count`, `expect`, `judge` and `mark_failed` for an update, `set_aside` and `exchange` for
what is late, `keep_valid` and `choose` for its turn in an update of late measurements, `suspect`
and `doubt` for a filter that doubts itself (`filter/doubts.py`).
"""

import functools

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.measurements import baseline, features, position, velocity

BLOCKS = (position, baseline, velocity, features)
"""In the order of `records.Block`, and of their rows in the stacked measurement."""


def _one_after_another(first, second):
    @kernel
    def both(flight, p, work, settings, slow, k):
        k = first(flight, p, work, settings, slow, k)
        return second(flight, p, work, settings, slow, k)

    return both


def in_turn(name, sensor=None):
    """A kernel that calls the function `name` of every block, or of those of a sensor, in turn.

    Its arguments are the flight, the parameters as the filter believes them, the workspace, the
    settings, these again where sensors have slow errors (`filter/slow.py`) or None, and k: what one
    block returns is the k of the next. Where rows are concerned that is a block's first row.
    """
    chosen = [block for block in BLOCKS if sensor is None or sensor == block.SENSOR]
    return functools.reduce(_one_after_another, [getattr(block, name) for block in chosen])


count, expect, judge = in_turn("count"), in_turn("expect"), in_turn("judge")
mark_failed = in_turn("mark_failed")
set_aside = in_turn("set_aside")
suspect, doubt = in_turn("suspect"), in_turn("doubt")
keep_valid, choose = in_turn("keep_valid"), in_turn("choose")

"""The stage of an aiding sensor, made of the sensor's own kernels.

Its flag is the `Act`, and `ACTS` times the first of the sensor's rows, see `aid.py`; where an
episode begins, anything above zero in place of the row says so to `Act.SAMPLE`.
"""

from typing import Any

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.measurements.aid import ACTS, judge_aid
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.records import Act, Aid

_BEGIN, _SAMPLE = int(Act.BEGIN), int(Act.SAMPLE)
_EXPECT, _JUDGE, _ALIGN = int(Act.EXPECT), int(Act.JUDGE), int(Act.ALIGN)


@kernel
def _cannot_align(flight, p, work, settings, mask):
    """What a sensor that tells no heading does for the filter's start, never called."""


def aid_stage(
    aid: Aid,
    begin: Any,
    measure: Any,
    expect: Any,
    doubt: Any,
    align: Any = _cannot_align,
) -> Any:
    """The stage of an aiding sensor: which of its kernels an `Act` calls.

    Args:
        aid: Which sensor.
        begin: `(flight, p, settings, s, mask)`: begin an episode; `begin_aid`, and perhaps more.
        measure: `(flight, p, settings, mask, starting)`: measure where it is due, and deliver.
        expect: `(flight, p, work, settings, k)`: fill the rows k to k + 2.
        doubt: `(flight, p, work, settings, mask)`: what the filter doubts that keeps rejecting it.
        align: `(flight, p, work, settings, mask)`: give the filter's start its heading.
    """
    s = int(aid)

    def call(flight, world, model, settings, work, stages, flag):  # type: ignore[no-untyped-def]
        flying, scratch, act, k = lanes_of(flight), lanes_of(work), flag % ACTS, flag // ACTS
        p, mask = lanes_of(model), scratch.mask > 0.0
        if act == _BEGIN:
            begin(flying, lanes_of(world), settings, s, mask)
        elif act == _SAMPLE:
            measure(flying, lanes_of(world), settings, mask, k > 0)
        elif act == _EXPECT:
            expect(flying, p, scratch, settings, k)
        elif act == _JUDGE:
            judge_aid(flying, p, scratch, settings, s, k)
        elif act == _ALIGN:
            align(flying, p, scratch, settings, mask)
        else:
            doubt(flying, p, scratch, settings, scratch.taking > 0.0)

    call.__name__ = call.__qualname__ = f"{aid.name.lower()}_stage"  # as caches and messages say
    return stage(call)

"""The stage of a sensor, composed of the sensor's kernels."""

from typing import Any

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.filter.gate import gate_blocks
from quad_gym.kernels.filter.measurements import ACTS
from quad_gym.kernels.simd.lanes import any_of, select
from quad_gym.records import FIRST_BLOCK, FIRST_GROUP, GROUP_COUNT, GROUP_FREEDOMS, Act, Sensor


@kernel
def _cannot_align(flight, p, work, settings, mask):
    """Placeholder for sensors that observe no heading; never called."""


def sensor_stage(
    sensor: Sensor,
    begin: Any,
    sample: Any,
    expect: Any,
    reset: Any,
    align: Any = _cannot_align,
) -> Any:
    """Make the stage of a sensor; its flag is an `Act`, and an argument times `ACTS`.

    Args:
        sensor: The sensor.
        begin: `(flight, p, settings, mask)`: begin an episode: clock and constant errors.
        sample: `(flight, world, settings, work, stages, mask, starting)`: measure when due, and
            deliver.
        expect: `(flight, p, work, settings, k)`: fill the sensor's rows, from k on.
        reset: `(flight, p, work, settings)`: reset states where `work.reset`.
        align: `(flight, p, work, settings, mask)`: initialize the heading.
    """
    first, group, several = FIRST_BLOCK[sensor], FIRST_GROUP[sensor], GROUP_COUNT[sensor] > 1
    numbers = tuple(map(float, GROUP_FREEDOMS[group : group + GROUP_COUNT[sensor]]))

    @kernel
    def gate(flight, p, work, settings, k):  # type: ignore[no-untyped-def]
        if several:  # each group is a block
            for i in range(len(numbers)):
                s, g = first + i, group + i
                if any_of(flight.block_valid[s] > 0.0):
                    gate_blocks(flight, p, work, settings, k, s, 1, g, p.gate[g], numbers[i])
                    k += 3
        else:
            count, limit = settings.sensor_blocks[sensor], p.gate[group]
            gate_blocks(flight, p, work, settings, k, first, count, group, limit, numbers[0])

    def call(flight, world, model, settings, work, stages, flag):  # type: ignore[no-untyped-def]
        act, argument, mask = flag % ACTS, flag // ACTS, work.mask > 0.0
        if act == Act.BEGIN:
            begin(flight, world, settings, mask)
        elif act == Act.SAMPLE:
            sample(flight, world, settings, work, stages, mask, argument > 0)
            work.mask = select(mask, 1.0, 0.0)
        elif act == Act.EXPECT:
            expect(flight, model, work, settings, argument)
        elif act == Act.GATE:
            gate(flight, model, work, settings, argument)
        elif act == Act.RESET:
            reset(flight, model, work, settings)
        else:
            align(flight, model, work, settings, mask)

    call.__name__ = call.__qualname__ = f"{sensor.name.lower()}_stage"  # for caches and messages
    return stage(call)

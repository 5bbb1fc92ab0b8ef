"""The stage of a sensor, composed of the sensor's kernels."""

from typing import Any

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.filter.measurements import ACTS
from quad_gym.kernels.simd.lanes import select
from quad_gym.records import Act, Sensor


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

    def call(flight, world, model, settings, work, stages, flag):  # type: ignore[no-untyped-def]
        act, argument, mask = flag % ACTS, flag // ACTS, work.mask > 0.0
        if act == Act.BEGIN:
            begin(flight, world, settings, mask)
        elif act == Act.SAMPLE:
            sample(flight, world, settings, work, stages, mask, argument > 0)
            work.mask = select(mask, 1.0, 0.0)
        elif act == Act.EXPECT:
            expect(flight, model, work, settings, argument)
        elif act == Act.RESET:
            reset(flight, model, work, settings)
        else:
            align(flight, model, work, settings, mask)

    call.__name__ = call.__qualname__ = f"{sensor.name.lower()}_stage"  # for caches and messages
    return stage(call)

"""One flight: the stages of a tick, and the stages of an episode's beginning.

A tick is one IMU sample: control on the observed state, motion of the true state, prediction with
the tick's sample (taken at its start or, if samples are averages, over the tick), drift of the
biases, then measurements and the update at its end.

The lists name slots of the table of stages. The settings determine the function in each slot, or
leave it empty, see `SOURCES` in `kernels/stages.py`.
"""

import numpy as np

from quad_gym.kernels.compiling import Stage, call_stage, kernel
from quad_gym.kernels.filter.measurements import call_sensor, call_sensors
from quad_gym.kernels.maths.linalg import load3, norm
from quad_gym.kernels.simd.lanes import select, zero_like
from quad_gym.kernels.task.reference import evaluate_reference
from quad_gym.records import Act

_ONE, _TICKS_OF_EPISODE = np.uint64(1), np.uint64(2**32 - 1)


@kernel
def run(stage, here, flag=0):
    """Run a stage on a flight; `here` holds the arguments of all stages except `flag`."""
    flight, world, model, settings, work, stages = here
    call_stage(stages, stage, flight, world, model, settings, work, flag)


@kernel
def move_and_measure(flight, world, model, settings, work, stages, within):
    """Fly a tick up to its measurements, before `update` and `look`.

    Args:
        flight: Record.
        world: True parameters.
        model: Parameters that filter and controller assume.
        settings: Options of the batch.
        work: Workspace.
        stages: Table of stages.
        within: 1 if the tick ends within a control period, where only inner loops observe; else 0.
    """
    here = (flight, world, model, settings, work, stages)
    work.mask = 1.0
    run(Stage.DELAY_ACTION, here)
    run(Stage.CONTROL, here)
    run(Stage.SUPPLY, here)
    flight.instant = flight.instant + _ONE
    run(Stage.KEEP_START, here)
    run(Stage.MOVE, here)
    run(Stage.REST_ON_PAD, here)
    run(Stage.STAND, here)
    run(Stage.TOUCH, here)
    if settings.run_filter:
        run(Stage.AVERAGE_IMU, here)
        run(Stage.PREDICT, here)
        run(Stage.INCREMENT, here)
        run(Stage.DRIFT_BIASES, here)
    flight.tick = flight.tick + 1.0
    run(Stage.FOLLOW, here, within)
    run(Stage.ADVANCE_FAULTS, here)
    if settings.run_filter:
        run(Stage.SAMPLE, here)
        call_sensors(flight, world, model, settings, work, stages, Act.SAMPLE, 0)


@kernel
def update(here):
    """Update the filter with the measurements of a tick, where `work.mask`."""
    _, _, _, settings, _, _ = here
    if settings.late and settings.rewinds:
        run(Stage.LATE_UPDATE, here)
    else:
        run(Stage.UPDATE, here)


@kernel
def look(flight, world, model, settings, work, stages, within):
    """Set the observed state at the end of a tick; `within` as for `move_and_measure`."""
    here = (flight, world, model, settings, work, stages)
    work.mask = 1.0
    run(Stage.LOOK, here, within)
    run(Stage.SUM_IMU, here)


@kernel
def begin_episode(flight, nominal, world, model, settings, work, stages, mask):
    """Begin a new episode, where `mask`: reference, true state, first measurements, filter.

    The flights' own parameters, in `world`, are drawn around the `nominal` ones according to the
    settings. Each episode has its own instants, so that its draws do not depend on the length of
    the previous one.
    """
    here = (flight, world, model, settings, work, stages)
    instant = (flight.instant | _TICKS_OF_EPISODE) + _ONE
    flight.instant = select(mask, instant, flight.instant)
    flight.tick = select(mask, 0.0, flight.tick)
    work.mask = select(mask, 1.0, 0.0)
    run(Stage.DRAW, (flight, world, nominal, settings, work, stages))
    run(Stage.IMPOSE, (flight, world, nominal, settings, work, stages))
    run(Stage.PLACE_FEATURES, here, 1)
    run(Stage.DELAY_ACTION, here, 1)
    run(Stage.BEGIN_LATE, here)
    run(Stage.BEGIN, here)
    run(Stage.BEGIN_IMPERFECT, here)
    call_sensors(flight, world, model, settings, work, stages, Act.BEGIN, 0)
    run(Stage.BEGIN_FAULTS, here)
    run(Stage.BEGIN_IN_AIR, here)  # after the faults, which restore a rotor lost before
    run(Stage.BEGIN_GROUND, here)
    run(Stage.BEGIN_CONTACTS, here)
    run(Stage.SAMPLE, here, 1)
    call_sensors(flight, world, model, settings, work, stages, Act.SAMPLE, 1)
    run(Stage.ALIGN, here)
    run(Stage.WARM, here)
    if not settings.warm and settings.heading_sensor >= 0:
        sensor = settings.heading_sensor
        call_sensor(flight, world, model, settings, work, stages, sensor, Act.ALIGN, 0)
    run(Stage.UPDATE, here)
    run(Stage.LOOK, here)
    r_ref, _, _, _ = evaluate_reference(flight, zero_like(flight.tick), settings.harmonics)
    error = norm(r_ref - load3(flight.r))
    flight.position_error = select(mask, error, flight.position_error)

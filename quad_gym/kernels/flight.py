"""One flight: a tick, and an episode's first instant.

A tick is one IMU sample: control with what is seen, let the true state evolve, predict with the
tick's sample - the one taken at its start or, where samples are averages, the one over it - let the
biases evolve, then measure and update at its end.

What happens in each is a stage, see `kernels/compiling/stages.py`: here is their order alone.
"""

import numpy as np

from quad_gym.kernels.compiling import Stage, call_stage, kernel
from quad_gym.kernels.maths.linalg import load3, load4, norm, sub
from quad_gym.kernels.measurements.aid import ACTS, align_by_aid, call_aids
from quad_gym.kernels.simd.lanes import any_of, select
from quad_gym.kernels.task.reference import evaluate_reference
from quad_gym.records import FOLLOWED, Act, Control, Layout, Supply

_DISTURB_IMU, _BEGIN_IMPERFECT = int(Stage.DISTURB_IMU), int(Stage.BEGIN_IMPERFECT)
_DELAY_ACTION = int(Stage.DELAY_ACTION)
_CONTROL, _SUPPLY = int(Stage.CONTROL), int(Stage.SUPPLY)
_MOVE, _MOVE_IN_AIR = int(Stage.MOVE), int(Stage.MOVE_IN_AIR)
_REST_ON_PAD = int(Stage.REST_ON_PAD)
_AVERAGE_IMU, _SATURATE_IMU = int(Stage.AVERAGE_IMU), int(Stage.SATURATE_IMU)
_SUM_IMU = int(Stage.SUM_IMU)
_PREDICT, _INCREMENT, _UPDATE = int(Stage.PREDICT), int(Stage.INCREMENT), int(Stage.UPDATE)
_DRIFT_BIASES, _ADVANCE_FAULTS = int(Stage.DRIFT_BIASES), int(Stage.ADVANCE_FAULTS)
_SET_ASIDE, _SAMPLE, _LOOK = int(Stage.SET_ASIDE), int(Stage.SAMPLE), int(Stage.LOOK)
_EXCHANGE, _LATE_UPDATE = int(Stage.EXCHANGE), int(Stage.LATE_UPDATE)
_PREDICT_WITH_SLOW = int(Stage.PREDICT_WITH_SLOW)
_UPDATE_WITH_SLOW = int(Stage.UPDATE_WITH_SLOW)
_WARM_WITH_SLOW = int(Stage.WARM_WITH_SLOW)
_LATE_UPDATE_WITH_SLOW = int(Stage.LATE_UPDATE_WITH_SLOW)
_ALIGN, _WARM = int(Stage.ALIGN), int(Stage.WARM)
_DRAW, _IMPOSE, _BEGIN = int(Stage.DRAW), int(Stage.IMPOSE), int(Stage.BEGIN)
_BEGIN_IN_AIR, _BEGIN_LATE = int(Stage.BEGIN_IN_AIR), int(Stage.BEGIN_LATE)
_BEGIN_FAULTS = int(Stage.BEGIN_FAULTS)
_BEGIN_CONTACTS, _TOUCH = int(Stage.BEGIN_CONTACTS), int(Stage.TOUCH)
_FOLLOW = int(Stage.FOLLOW)
_PLACE_FEATURES = int(Stage.PLACE_FEATURES)
_BEGIN_GROUND, _STAND = int(Stage.BEGIN_GROUND), int(Stage.STAND)

_BEGIN_AID, _SAMPLE_AID = int(Act.BEGIN), int(Act.SAMPLE)
_ONE, _TICKS_OF_EPISODE = np.uint64(1), np.uint64(2**32 - 1)


@kernel
def sense(flight, world, model, settings, work, stages, mask, starting, within):
    """Measure at the present instant, update the filter and look, where `mask`.

    Args:
        flight: Record.
        world: Parameters as they are.
        model: Parameters as filter and controller believe them.
        settings: What the batch does.
        work: Workspace.
        stages: Table of stages.
        mask: Which lanes.
        starting: 1 at the first instant of their episode, else 0.
        within: 1 within a control period, where an action's inner loop alone looks, else 0.
    """
    work.mask = select(mask, 1.0, 0.0)
    if settings.run_filter:
        late = settings.late > 0
        if late:
            call_stage(stages, _SET_ASIDE, flight, world, model, settings, work, 0)
        call_stage(stages, _SAMPLE, flight, world, model, settings, work, starting)
        if settings.aids > 0:
            call_aids(flight, world, model, settings, work, stages, _SAMPLE_AID + ACTS * starting)
        if starting:
            call_stage(stages, _ALIGN, flight, world, model, settings, work, 0)
            if settings.warm:
                warm = _WARM_WITH_SLOW if settings.slow_states > 0 else _WARM
                call_stage(stages, warm, flight, world, model, settings, work, 0)
            elif settings.heading_aid >= 0:
                align_by_aid(flight, model, settings, work, stages)
        if late:
            call_stage(stages, _EXCHANGE, flight, world, model, settings, work, starting)
        if late and settings.rewinds and not starting:
            late_update = _LATE_UPDATE_WITH_SLOW if settings.slow_states > 0 else _LATE_UPDATE
            call_stage(stages, late_update, flight, world, model, settings, work, 0)
            work.mask = select(mask, 1.0, 0.0)
        else:
            update = _UPDATE_WITH_SLOW if settings.slow_states > 0 else _UPDATE
            call_stage(stages, update, flight, world, model, settings, work, 0)
    call_stage(stages, _LOOK, flight, world, model, settings, work, within)


@kernel
def _store_start(flight, work):
    """Keep the true state at the start of a tick, for IMU samples that are averages over it."""
    start = work.start
    start[0], start[1], start[2] = load3(flight.r)
    start[3], start[4], start[5] = load3(flight.v)
    start[6], start[7], start[8], start[9] = load4(flight.q)
    start[10], start[11], start[12] = load3(flight.w)
    start[13], start[14], start[15], start[16] = load4(flight.rotor_speeds)


@kernel
def tick(flight, world, model, settings, work, stages, last):
    """Fly one tick; `last`: whether it is the last one of a control period."""
    everyone = flight.tick >= 0.0
    work.mask = 1.0
    if settings.action_delays > 0:
        call_stage(stages, _DELAY_ACTION, flight, world, model, settings, work, 0)
    call_stage(stages, _CONTROL, flight, world, model, settings, work, 0)
    if settings.supply != Supply.NOMINAL:
        call_stage(stages, _SUPPLY, flight, world, model, settings, work, 0)
    flight.instant = flight.instant + _ONE
    resting = settings.pad > 0 and any_of(flight.on_pad > 0.0)
    if settings.imu_averages or resting or settings.grounded:
        _store_start(flight, work)
    if settings.air:
        call_stage(stages, _MOVE_IN_AIR, flight, world, model, settings, work, 0)
    else:
        call_stage(stages, _MOVE, flight, world, model, settings, work, 0)
    if resting:
        call_stage(stages, _REST_ON_PAD, flight, world, model, settings, work, 0)
    if settings.grounded:
        call_stage(stages, _STAND, flight, world, model, settings, work, 0)
    if settings.contacts:
        call_stage(stages, _TOUCH, flight, world, model, settings, work, 0)
    if settings.run_filter:
        if settings.imu_averages:
            call_stage(stages, _AVERAGE_IMU, flight, world, model, settings, work, 0)
            if settings.imu_errs + settings.imu_vibrates > 0:
                call_stage(stages, _DISTURB_IMU, flight, world, model, settings, work, 0)
            if settings.faults:
                call_stage(stages, _SATURATE_IMU, flight, world, model, settings, work, 0)
        predict = _PREDICT_WITH_SLOW if settings.slow_states > 0 else _PREDICT
        call_stage(stages, predict, flight, world, model, settings, work, 0)
        if settings.late > 0:
            call_stage(stages, _INCREMENT, flight, world, model, settings, work, 0)
        call_stage(stages, _DRIFT_BIASES, flight, world, model, settings, work, 0)
    flight.tick = flight.tick + 1.0
    if settings.harmonics == FOLLOWED and (last or settings.control == Control.PD):
        call_stage(stages, _FOLLOW, flight, world, model, settings, work, 0)
    if settings.faults:
        call_stage(stages, _ADVANCE_FAULTS, flight, world, model, settings, work, 0)
    sense(flight, world, model, settings, work, stages, everyone, 0, 0 if last else 1)
    if settings.run_filter and settings.layout == Layout.MEASUREMENTS:
        work.mask = 1.0
        call_stage(stages, _SUM_IMU, flight, world, model, settings, work, 0)


@kernel
def begin_episode(flight, nominal, world, model, settings, work, stages, mask):
    """Begin a new episode, where `mask`: reference, true state, first measurements, filter.

    The flights' own parameters, in `world`, are drawn from what the `nominal` ones and the settings
    say. Each episode has instants of its own, so that what it draws does not depend on how long
    the one before it lasted.
    """
    instant = (flight.instant | _TICKS_OF_EPISODE) + _ONE
    flight.instant = select(mask, instant, flight.instant)
    flight.tick = select(mask, 0.0, flight.tick)
    work.mask = select(mask, 1.0, 0.0)
    if settings.randomized:
        call_stage(stages, _DRAW, flight, world, nominal, settings, work, 0)
        call_stage(stages, _IMPOSE, flight, world, nominal, settings, work, 0)
    if settings.features_drawn:
        call_stage(stages, _PLACE_FEATURES, flight, world, model, settings, work, 1)
    if settings.action_delays > 0:
        call_stage(stages, _DELAY_ACTION, flight, world, model, settings, work, 1)
    if settings.run_filter and settings.late > 0:
        call_stage(stages, _BEGIN_LATE, flight, world, model, settings, work, 0)
    call_stage(stages, _BEGIN, flight, world, model, settings, work, 0)
    if settings.run_filter and settings.imu_errs + settings.heading_errs > 0:
        call_stage(stages, _BEGIN_IMPERFECT, flight, world, model, settings, work, 0)
    if settings.run_filter and settings.aids > 0:
        call_aids(flight, world, model, settings, work, stages, _BEGIN_AID)
    if settings.faults:
        call_stage(stages, _BEGIN_FAULTS, flight, world, model, settings, work, 0)
    if settings.air:  # after the faults, which give back a rotor that the last episode had lost
        call_stage(stages, _BEGIN_IN_AIR, flight, world, model, settings, work, 0)
    if settings.grounded:
        call_stage(stages, _BEGIN_GROUND, flight, world, model, settings, work, 0)
    if settings.contacts:
        call_stage(stages, _BEGIN_CONTACTS, flight, world, model, settings, work, 0)
    sense(flight, world, model, settings, work, stages, mask, 1, 0)
    r_ref, _, _, _ = evaluate_reference(flight, 0.0 * flight.tick, settings.harmonics)
    error = norm(sub(r_ref, load3(flight.r)))
    flight.position_error = select(mask, error, flight.position_error)

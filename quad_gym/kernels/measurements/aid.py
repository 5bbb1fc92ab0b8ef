"""What aiding sensors share: clocks, errors that last, latency, the gate, and their stages' calls.

An aiding sensor is one stage, in a file of its own (`aid_stage.py`), that is called with an `Act`
and, for its part in an update, with the first of its three rows in the stacked measurement. Sensors
with fewer numbers leave the other rows masked. Suites without aiding sensors know nothing of them,
as only filters with slow errors among their states (`filter/slow.py`) call them.
"""

import math

import numpy as np

from quad_gym.kernels.compiling import Stage, call_stage, kernel
from quad_gym.kernels.filter.recovery import follow_drift
from quad_gym.kernels.maths.linalg import keep3, keep33, load3
from quad_gym.kernels.maths.random import normal_pair, stream_of, uniform_pair
from quad_gym.kernels.measurements.clock import first_wait
from quad_gym.kernels.measurements.gate import (
    covariance,
    decide,
    keep_block,
    leave_out,
    mark_block,
    nis_of_triple,
)
from quad_gym.kernels.measurements.stamps import forget_stamps, put_stamp
from quad_gym.kernels.simd.lanes import any_of, logical_not, select
from quad_gym.records import (
    AID_BLOCKS,
    AID_FREEDOMS,
    AID_GROUPS,
    AIDS,
    DELAY_SLOTS,
    DRAW_AID_DRIFT,
    DRAW_AID_MATRIX,
    DRAW_AID_PHASE,
    DRAW_SLOW,
    SENSORS,
    Act,
    Aid,
    FaultKind,
    FilterForm,
    GateDecision,
)

ACTS = len(Act)
_EXPECT, _JUDGE, _ALIGN = int(Act.EXPECT), int(Act.JUDGE), int(Act.ALIGN)
_FIRST = int(Stage[Aid(0).name])
_NUMBERS = tuple(map(float, AID_FREEDOMS))
_LOSS = int(FaultKind[f"{Aid(0).name}_LOSS"])
_REJECTED = float(GateDecision.REJECTED)
_GATE = int(FilterForm.GATE)

for _aid in Aid:  # aid number k has the stage and the fault of number k after the first
    assert Stage[_aid.name] == _FIRST + _aid
    assert FaultKind[f"{_aid.name}_LOSS"] == _LOSS + _aid


# ---- calls -----------------------------------------------------------------------------------


@kernel
def call_aids(flight, world, model, settings, work, stages, act):
    """Call every aiding sensor that there is for an `Act`."""
    for s in range(AIDS):
        call_stage(stages, _FIRST + s, flight, world, model, settings, work, act)


@kernel
def align_by_aid(flight, p, settings, work, stages):
    """Let a sensor give the filter's start its heading, where `work.mask`."""
    call_stage(stages, _FIRST + settings.heading_aid, flight, p, p, settings, work, _ALIGN)


@kernel
def count_aids(flight, work, settings, k):
    """Count what is measured; return the row behind that of all sensors, which begin at k."""
    if settings.aids > 0:
        for s in range(AIDS):
            if settings.aid_on[s] > 0 and any_of(flight.aid_valid[s] > 0.0):
                work.measured = work.measured + _NUMBERS[s] * flight.aid_valid[s]
                k += 3
    return k


@kernel
def _call_measured(flight, p, work, settings, stages, n, act):
    """Call the sensors that any lane has a measurement of; their rows begin at n."""
    if settings.aids > 0:
        k = n
        for s in range(AIDS):
            if settings.aid_on[s] > 0 and any_of(flight.aid_valid[s] > 0.0):
                call_stage(stages, _FIRST + s, flight, p, p, settings, work, act + ACTS * k)
                k += 3


@kernel
def expect_aids(flight, p, work, settings, stages, n):
    """Let the sensors fill their rows from n on: center, measured, noise, columns."""
    _call_measured(flight, p, work, settings, stages, n, _EXPECT)


@kernel
def judge_aids(flight, p, work, settings, stages, n):
    """Let the sensors keep their innovations and mask what is beyond the gate."""
    _call_measured(flight, p, work, settings, stages, n, _JUDGE)


@kernel
def mark_failed_aids(flight, work, settings):
    """Say that the update failed that the sensors' blocks were part of, where `work.taking`."""
    if settings.aids > 0:
        failed = work.taking > 0.0
        for s in range(AIDS):
            mark_block(flight, AID_BLOCKS + s, failed & (flight.aid_valid[s] > 0.0))


@kernel
def keep_valid_aids(flight, work, settings):
    """Keep what is measured, for the turns of late measurements."""
    if settings.aids > 0:
        for s in range(AIDS):
            work.kept_valid[AID_BLOCKS + s] = flight.aid_valid[s]


@kernel
def choose_aids(flight, work, settings, turn, present):
    """Let the sensors be measured whose turn it is; what is not late has that of the present."""
    if settings.aids > 0:
        for s in range(AIDS):
            its = turn == (SENSORS + s if settings.aid_delay[s] > 0 else present)
            share = 1.0 if its else 0.0
            flight.aid_valid[s] = share * work.kept_valid[AID_BLOCKS + s]


@kernel
def restore_valid_aids(flight, work, settings):
    """Let be measured what was so before the turns."""
    if settings.aids > 0:
        for s in range(AIDS):
            flight.aid_valid[s] = work.kept_valid[AID_BLOCKS + s]


# ---- simulation ------------------------------------------------------------------------------


@kernel
def begin_aid(flight, p, settings, s, mask):
    """Begin an episode of sensor s, where `mask`: draw its errors, set its clock.

    The normals of slow errors are those that a warm start takes, see `filter/warm.py`.
    """
    stream = stream_of(flight)
    k = settings.aid_vector[s]
    if k >= 0:
        for i in range(3):
            _, n = normal_pair(stream, DRAW_SLOW + k + i)
            error = p.aid_vector_sigma[s] * n
            flight.aid_vector[s, i] = select(mask, error, flight.aid_vector[s, i])
    k = settings.aid_scalar[s]
    if k >= 0:
        _, n = normal_pair(stream, DRAW_SLOW + k)
        flight.aid_scalar[s] = select(mask, p.aid_scalar_sigma[s] * n, flight.aid_scalar[s])
    share, _ = uniform_pair(stream, DRAW_AID_PHASE + s)
    wait = first_wait(settings.aid_phase[s], settings.aid_ticks[s], share)
    flight.aid_wait[s] = select(mask, wait, flight.aid_wait[s])
    flight.aid_fresh[s] = select(mask, 0.0, flight.aid_fresh[s])
    flight.aid_valid[s] = select(mask, 0.0, flight.aid_valid[s])
    if settings.aid_delay[s] > 0:
        forget_stamps(flight.aid_stamps[s], mask)


@kernel
def draw_matrix(flight, p, s, mask):
    """Draw the errors of scale and alignment of sensor s, where `mask`."""
    stream = stream_of(flight)
    a, b = normal_pair(stream, DRAW_AID_MATRIX + 5 * s)
    c, d = normal_pair(stream, DRAW_AID_MATRIX + 5 * s + 1)
    e, f = normal_pair(stream, DRAW_AID_MATRIX + 5 * s + 2)
    g, h = normal_pair(stream, DRAW_AID_MATRIX + 5 * s + 3)
    i, _ = normal_pair(stream, DRAW_AID_MATRIX + 5 * s + 4)
    z = p.aid_matrix_sigma[s]
    keep33(
        flight.aid_matrix[s],
        mask,
        ((z * a, z * b, z * c), (z * d, z * e, z * f), (z * g, z * h, z * i)),
    )


@kernel
def aid_due(flight, p, settings, s, mask, starting):
    """Where sensor s measures now; its clock, and the slow error of one number, go on."""
    due = mask & (flight.aid_wait[s] <= 0.0)
    wait = select(due, 1.0 * settings.aid_ticks[s], flight.aid_wait[s]) - 1.0
    flight.aid_wait[s] = select(mask, wait, flight.aid_wait[s])
    if not starting and any_of(due):
        n, _ = normal_pair(stream_of(flight), DRAW_AID_DRIFT + s)
        error = p.aid_scalar_decay[s] * flight.aid_scalar[s] + p.aid_scalar_drive[s] * n
        flight.aid_scalar[s] = select(due, error, flight.aid_scalar[s])
    return due


@kernel
def _exchange(flight, settings, s, mask, taken, values):
    """Let what is measured now wait, and what was measured `aid_delay` ticks ago arrive."""
    stamps, waiting = flight.aid_stamps[s], flight.aid_waiting[s]
    arrived = mask & (flight.tick < 0.0)
    for slot in range(DELAY_SLOTS):
        here = mask & (stamps[slot, 0] == flight.tick - settings.aid_delay[s])
        keep3(flight.aid_measurement[s], here, load3(waiting[slot]))
        arrived = arrived | here
    if any_of(taken):
        put_stamp(stamps, flight, taken)
        for slot in range(DELAY_SLOTS - 1, 0, -1):
            keep3(waiting[slot], taken, load3(waiting[slot - 1]))
        keep3(waiting[0], taken, values)
    return arrived


@kernel
def deliver_first(flight, s, mask, values):
    """Keep the measurement of sensor s that starts the filter, which counts it but once."""
    keep3(flight.aid_measurement[s], mask, values)
    flight.aid_fresh[s] = select(mask, 1.0, flight.aid_fresh[s])


@kernel
def deliver(flight, settings, s, mask, due, values):
    """Hand to the filter what sensor s measures where it is `due`, now or after its latency."""
    if settings.faults:
        due = due & (flight.fault_active[_LOSS + s] <= 0.0)
    arrived = due
    if settings.aid_delay[s] > 0:
        arrived = _exchange(flight, settings, s, mask, due, values)
    else:
        keep3(flight.aid_measurement[s], due, values)
    flight.aid_valid[s] = select(mask, select(arrived, 1.0, 0.0), flight.aid_valid[s])
    flight.aid_fresh[s] = select(arrived, 1.0, flight.aid_fresh[s])


# ---- gate ------------------------------------------------------------------------------------


@kernel
def judge_aid(flight, p, work, settings, s, k):
    """Keep the innovation of sensor s, whose rows begin at k, and mask it beyond the gate.

    A sensor of one number has two masked rows behind it, which add nothing to its NIS.
    """
    gating, columns = (settings.form & _GATE) != 0, 15 + settings.slow_states
    again = work.again > 0.0
    has = (work.taking > 0.0) & (flight.aid_valid[s] > 0.0)
    S = covariance(p, work, k, columns)
    nu = (work.z[k], work.z[k + 1], work.z[k + 2])
    nis = nis_of_triple(S, nu)
    rejected = decide(flight, AID_BLOCKS + s, has, (nis > p.aid_gate[s]) & gating, again, _REJECTED)
    sigma = (math.sqrt(S[0][0]), math.sqrt(S[1][1]), math.sqrt(S[2][2]))
    scaled = (nu[0] / sigma[0], nu[1] / sigma[1], nu[2] / sigma[2])
    if _NUMBERS[s] < 3.0:
        none = np.nan + 0.0 * nis
        nu, sigma = (nu[0], none, none), (sigma[0], none, none)
        scaled = (scaled[0], 0.0 * nis, 0.0 * nis)
    nowhere, first = rejected & logical_not(rejected), has & logical_not(again)
    follow_drift(flight, AID_GROUPS + s, first, scaled[0], scaled[1], scaled[2])
    keep_block(flight, AID_BLOCKS + s, first, nu, sigma, nis, rejected, nowhere)
    work.judged_nis = work.judged_nis + select(first, nis, 0.0)
    work.judged_freedoms = work.judged_freedoms + select(first, _NUMBERS[s], 0.0)
    leave_out(flight, work, settings, k, AID_GROUPS + s, has, rejected, columns, _NUMBERS[s])

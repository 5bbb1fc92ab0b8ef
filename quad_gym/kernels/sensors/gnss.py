"""The GNSS receiver: one clock and latency for position, baseline and velocity."""

from quad_gym.kernels.compiling import Stage, call_stage, kernel
from quad_gym.kernels.filter.error_state import D
from quad_gym.kernels.maths.elementary import minimum
from quad_gym.kernels.maths.linalg import keep, load3, load4
from quad_gym.kernels.maths.random import six_normals, stream_of, uniform_pair
from quad_gym.kernels.maths.rotation import quaternion_to_dcm
from quad_gym.kernels.sensors import gnss_baseline, gnss_position, gnss_velocity
from quad_gym.kernels.sensors.faults import gnss_heard
from quad_gym.kernels.sensors.latency import (
    begin_clock,
    begin_sample,
    deliver_arrived,
    exchange,
    find_arrivals,
    stamp,
    tick_clock,
)
from quad_gym.kernels.sensors.stage import sensor_stage
from quad_gym.kernels.simd.lanes import any_of, logical_not, select, zero_like
from quad_gym.records import (
    BASELINE_BLOCK,
    DRAW_GNSS,
    DRAW_PHASE,
    POSITION_BLOCK,
    VELOCITY_BLOCK,
    Sensor,
)

_GNSS = int(Sensor.GNSS)
_BLOCKS = (POSITION_BLOCK, BASELINE_BLOCK, VELOCITY_BLOCK)


@kernel
def _begin(flight, p, settings, mask):
    share, _ = uniform_pair(stream_of(flight), DRAW_PHASE)
    begin_clock(flight, settings, _GNSS, share, mask)
    keep(flight.gnss_drift, mask, (0.0, 0.0, 0.0))


@kernel
def measure_gnss(flight, p, paired, mask):
    """Measure the antenna's position and, if `paired`, the baseline, in G, in the lanes `mask`."""
    R_BI = quaternion_to_dcm(load4(flight.q))
    n_p, n_b = six_normals(stream_of(flight), DRAW_GNSS)
    gnss_position.measure(flight, p, R_BI, n_p, mask)
    if paired:
        gnss_baseline.measure(flight, p, R_BI, n_b, mask)


@kernel
def _measure(flight, p, settings, work, stages, mask, corrupted):
    """Measure, with constant heading error and, if `corrupted`, faults, in the lanes `mask`."""
    measure_gnss(flight, p, settings.gnss_baseline > 0, mask)
    work.mask = select(mask, 1.0, 0.0)
    call_stage(stages, Stage.TURN_BASELINE, flight, p, p, settings, work, 0)
    if corrupted:
        call_stage(stages, Stage.CORRUPT_GNSS, flight, p, p, settings, work, 0)
    if settings.gnss_velocity > 0:
        gnss_velocity.measure(flight, p, mask)


@kernel
def _flag(flags, mask, position, baseline, settings):
    """Set the flags of the three blocks, in the lanes `mask`."""
    flags[POSITION_BLOCK] = select(mask, position, flags[POSITION_BLOCK])
    flags[BASELINE_BLOCK] = select(mask, baseline, flags[BASELINE_BLOCK])
    if settings.gnss_velocity > 0:
        flags[VELOCITY_BLOCK] = select(mask, position, flags[VELOCITY_BLOCK])


@kernel
def _sample(flight, p, settings, work, stages, mask, starting):
    """Measure when due, and at the start for the initialization of the filter."""
    due = tick_clock(flight, settings, _GNSS, mask)
    delayed, period = settings.sensor_delay[_GNSS] > 0, settings.sensor_ticks[_GNSS]
    values = (flight.gnss_position, flight.gnss_baseline, flight.gnss_velocity)
    begin_sample(flight, work, settings, _GNSS, values, 3, mask)
    arrives = find_arrivals(flight, work, settings, _GNSS, mask)
    if not starting and not any_of(due | arrives):
        return
    if settings.gnss_drifts > 0 and not starting and any_of(due):
        share = minimum(flight.tick / period, 1.0)
        gnss_position.drift_gnss(flight, p, due, share)
    measured = mask if starting else due
    paired = measured
    initializes = starting and not settings.warm  # this fix has no faults
    if settings.faults and not initializes:
        measured, paired = gnss_heard(flight, settings, due)
    if any_of(measured):
        _measure(flight, p, settings, work, stages, measured, not initializes)
    if settings.gnss_baseline == 0:
        paired = paired & logical_not(measured)
    unpaired = measured & logical_not(paired)
    if starting or not delayed:
        fresh = measured & (period > 0)
        one = 1.0 + zero_like(flight.tick)
        _flag(flight.block_fresh, fresh, one, select(unpaired, 0.0, one), settings)
    if starting and settings.reuse_first_fix == 0 and not settings.warm:
        due = due & (period < 0)  # none
    valid = select(due & measured, 1.0, 0.0)
    _flag(flight.block_valid, mask, valid, select(unpaired, 0.0, valid), settings)
    if delayed:
        taken, n = stamp(flight, settings, _GNSS, mask), settings.under_way[_GNSS]
        for block in _BLOCKS:
            exchange(flight, work, block, values[block], 3, n, mask, taken)
            if not starting:  # there, it stays in the record, for the initialization of the filter
                deliver_arrived(work, block, values[block], 3, mask)


@kernel
def _expect(flight, p, work, settings, k):
    """Fill three rows for each block that any lane has, from k on."""
    for block in _BLOCKS:
        valid = flight.block_valid[block] > 0.0
        if any_of(valid):
            if block == POSITION_BLOCK:
                gnss_position.expect(flight, p, work, settings, k, valid)
            elif block == BASELINE_BLOCK:
                gnss_baseline.expect(flight, p, work, settings, k, valid)
            else:
                gnss_velocity.expect(flight, p, work, settings, k, valid)
            k += 3


@kernel
def _reset(flight, p, work, settings):
    states = D + settings.slow_states
    for block in _BLOCKS:
        nu, lanes = load3(flight.innovation[block]), work.reset[block] > 0.0
        if block == POSITION_BLOCK:
            gnss_position.reset(flight, p, work, settings, states, lanes, nu)
        elif block == BASELINE_BLOCK:
            gnss_baseline.reset(flight, work, states, lanes, nu)
        else:
            gnss_velocity.reset(work, states, lanes, nu)


gnss_stage = sensor_stage(Sensor.GNSS, _begin, _sample, _expect, _reset)

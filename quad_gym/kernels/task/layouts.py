"""Layouts of observations: the numbers of each, in the order of the table in `envs/spaces.py`.

A function writes to a row from index k on, and returns the next index.
"""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.numbers.lanes import select, zero_like
from quad_gym.kernels.numbers.linalg import load3, load4, load33
from quad_gym.kernels.numbers.rotation import quaternion_to_dcm
from quad_gym.kernels.task.reference import evaluate_reference, position_on_reference
from quad_gym.records import (
    DRAWN_SIZE,
    FIXED,
    FOLLOWED,
    GROUP_BLOCK,
    IN_G,
    LENGTHS,
    MARKED,
    MAX_GATES,
    SENSOR_GROUPS,
    Source,
    TaskKind,
)


@kernel
def _put3(row, k, v):
    row[k], row[k + 1], row[k + 2] = v
    return k + 3


@kernel
def _upcoming_gate(flight, ahead):
    """Return the gate that is `ahead` gates after the present one; the last one is repeated."""
    gate = load3(flight.gates[MAX_GATES - 1])
    for k in range(MAX_GATES):
        gate = select(flight.gate_next + ahead == 1.0 * k, load3(flight.gates[k]), gate)
    return gate


@kernel
def _previewed(flight, p, settings, i):
    """Return preview i of the reference: a later time or, on a course, a gate after the next."""
    if settings.task == TaskKind.WAYPOINTS:
        return _upcoming_gate(flight, 1.0 + i)
    if settings.harmonics == FOLLOWED:
        return load3(flight.path_ahead[i])
    later = flight.tick * p.dt + settings.preview[i]
    return position_on_reference(flight, later, settings.harmonics)


@kernel
def reference_shown(flight, p, settings):
    """Return (r*, v*, a*, x*) at the present instant, and r* at the first and second preview."""
    r_ref, v_ref, a_ref, x_ref = evaluate_reference(flight, flight.tick * p.dt, settings.harmonics)
    first, second = _previewed(flight, p, settings, 0), _previewed(flight, p, settings, 1)
    return r_ref, v_ref, a_ref, x_ref, first, second


@kernel
def put_relative(reference, row, k, r, v, R_BI, w_B):
    """Write errors, directions and rates in B from index k on; return the next index."""
    r_ref, v_ref, a_ref, x_ref, first, second = reference
    k = _put3(row, k, R_BI @ (r_ref - r))
    k = _put3(row, k, R_BI @ (v_ref - v))
    k = _put3(row, k, R_BI.T[2])
    k = _put3(row, k, R_BI @ x_ref)
    k = _put3(row, k, w_B)
    k = _put3(row, k, R_BI @ a_ref)
    k = _put3(row, k, R_BI @ (first - r_ref))
    return _put3(row, k, R_BI @ (second - r_ref))


@kernel
def _put_reference(flight, p, settings, row, k):
    """Write the reference in I from index k on; return the next index."""
    for vector in reference_shown(flight, p, settings):
        k = _put3(row, k, vector)
    return k


@kernel
def put_absolute(flight, p, settings, row):
    """Write state and reference in I; biases are true, estimated or zero, by the source."""
    k = _put3(row, 0, load3(flight.r_seen))
    k = _put3(row, k, load3(flight.v_seen))
    for i in range(3):
        k = _put3(row, k, load3(flight.R_seen[i]))
    b_a, b_g = load3(flight.b_a), load3(flight.b_g)
    if settings.source == Source.ESTIMATE:
        b_a, b_g = load3(flight.b_a_hat), load3(flight.b_g_hat)
    elif settings.source == Source.NOISY:
        b_a, b_g = zero_like(b_a), zero_like(b_g)
    k = _put3(row, k, b_a)
    k = _put3(row, k, b_g)
    k = _put3(row, k, load3(flight.w_seen))
    return _put_reference(flight, p, settings, row, k)


@kernel
def _put_readings(flight, p, settings, row, k):
    """Write the sensors' readings since the last step, over their units, and flags, or zeros.

    Readings that a mark may give have their place also where a suite lacks them.
    """
    R_IG = load33(p.R_IG)
    for g in range(SENSOR_GROUPS):
        first, count = GROUP_BLOCK[g], max(settings.reading_blocks[g], MARKED[g])
        for block in range(first, first + count):
            z, fresh, span = load3(flight.measurement[block]), flight.block_fresh[block], p.raw_span
            if IN_G[g] > 0:
                z = R_IG @ z
            z = (fresh / p.raw_scale[g]) * z
            _put3(row, k, (z[0] / span[g, 0], z[1] / span[g, 1], z[2] / span[g, 2]))
            row[k + LENGTHS[g]] = fresh
            k += LENGTHS[g] + 1
    return k


@kernel
def put_sensors(flight, p, settings, row):
    """Write raw measurements; entries of sensors without one since the last step are zero.

    The IMU contributes its last sample and the mean of all samples since the last step (a single
    sample at the start of an episode).
    """
    gyro, accel = load3(flight.gyro), load3(flight.accel)
    k = _put3(row, 0, gyro)
    k = _put3(row, k, accel)
    starts, share = flight.tick == 0.0, 1.0 / settings.ticks_per_step
    k = _put3(row, k, select(starts, gyro, share * load3(flight.gyro_sum)))
    k = _put3(row, k, select(starts, accel, share * load3(flight.accel_sum)))
    k = _put_readings(flight, p, settings, row, k)
    return _put_reference(flight, p, settings, row, k)


@kernel
def put_privileged(flight, p, settings, row, k):
    """Write the truth, for critics: relative state, biases and rotor speeds."""
    R_BI = quaternion_to_dcm(load4(flight.q))
    r_ref, v_ref, _, x_ref = evaluate_reference(flight, flight.tick * p.dt, settings.harmonics)
    k = _put3(row, k, R_BI @ (r_ref - load3(flight.r)))
    k = _put3(row, k, R_BI @ (v_ref - load3(flight.v)))
    k = _put3(row, k, R_BI.T[2])
    k = _put3(row, k, R_BI @ x_ref)
    k = _put3(row, k, load3(flight.w))
    k = _put3(row, k, load3(flight.b_a))
    k = _put3(row, k, load3(flight.b_g))
    hover = p.motor_speed_per_volt * p.hover_voltage
    for i in range(4):
        row[k + i] = flight.rotor_speeds[i] / hover
    return k + 4


@kernel
def put_world(flight, settings, row, k):
    """Write the air's velocity, and each draw minus its center, divided by its spread."""
    k = _put3(row, k, quaternion_to_dcm(load4(flight.q)) @ load3(flight.wind))
    for column in range(DRAWN_SIZE):
        if settings.draw_kind[column] != FIXED:
            deviation = flight.drawn[column] - settings.draw_center[column]
            row[k] = deviation / settings.draw_spread[column]
            k += 1

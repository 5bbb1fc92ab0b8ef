"""Observed state and observations of the controller, and numbers for views of tasks."""

import math

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.filter.error_state import variance_of
from quad_gym.kernels.numbers.lanes import select, zero_like
from quad_gym.kernels.numbers.linalg import keep, load3, load4, load33, norm, store
from quad_gym.kernels.numbers.random import six_normals, stream_of
from quad_gym.kernels.numbers.rotation import euler_to_dcm, quaternion_to_dcm
from quad_gym.kernels.task.reference import evaluate_reference, position_on_reference
from quad_gym.records import (
    AID_BLOCK,
    AID_FREEDOMS,
    AIDS,
    BASELINE_BLOCK,
    DRAW_NOISY,
    DRAWN_SIZE,
    FEATURE_BLOCKS,
    FIRST_AID,
    FIXED,
    FOLLOWED,
    MAX_GATES,
    POSITION_BLOCK,
    VELOCITY_BLOCK,
    Control,
    Layout,
    Source,
    TaskKind,
)
from quad_gym.records.states import ROWS

# --------------------------------------------------------------------------------------------------
# Observed state of the controller: the truth, the estimate, or the truth with noise.
# --------------------------------------------------------------------------------------------------


@kernel
def _estimated_rates(flight, own):
    """Body rates of the estimate: the gyro minus its bias, or those of a user's estimator."""
    if own is not None:
        return load3(flight.w_hat)
    return load3(flight.w_meas) - load3(flight.b_g_hat)


@kernel
def _look(flight, model, settings, mask, own=None):
    """Set the state that the controller observes from its source, where `mask`.

    `own`: the settings, if the estimate is a user's; else None.
    """
    R_BI = quaternion_to_dcm(load4(flight.q))
    r, v, w_B = load3(flight.r), load3(flight.v), load3(flight.w)
    if settings.source == Source.ESTIMATE or settings.source == Source.MEASUREMENTS:
        r, v, R_BI = load3(flight.r_hat), load3(flight.v_hat), load33(flight.R_hat)
        w_B = load3(flight.w_meas)
        if settings.source == Source.ESTIMATE:
            w_B = _estimated_rates(flight, own)
    elif settings.source == Source.NOISY:
        stream, s = stream_of(flight), load4(model.noisy_sigma)
        n_r, n_v = six_normals(stream, DRAW_NOISY)
        n_e, n_w = six_normals(stream, DRAW_NOISY + 3)
        r, v, w_B = s[0] * n_r + r, s[1] * n_v + v, s[3] * n_w + w_B
        R_BI = euler_to_dcm(s[2] * n_e) @ R_BI
    keep(flight.r_seen, mask, r)
    keep(flight.v_seen, mask, v)
    keep(flight.R_seen, mask, R_BI)
    keep(flight.w_seen, mask, w_B)
    error = norm(load3(flight.r_seen) - load3(flight.r))
    flight.estimation_error = select(mask, error, flight.estimation_error)


@kernel
def _look_within(flight, model, settings, own=None):
    """Set the body rates that an inner loop reads, at an instant within a control period."""
    control, source = settings.control, settings.source
    if control != Control.MOTOR and control != Control.WRENCH:
        w_B = load3(flight.w)
        if source == Source.ESTIMATE:
            w_B = _estimated_rates(flight, own)
        elif source == Source.MEASUREMENTS:
            w_B = load3(flight.w_meas)
        elif source == Source.NOISY:
            _, n_w = six_normals(stream_of(flight), DRAW_NOISY + 3)
            w_B = model.noisy_sigma[3] * n_w + w_B
        store(flight.w_seen, w_B)


@stage
def look_stage(flight, world, model, settings, work, stages, flag):
    """Set the state that the controller observes; `flag`: 1 within a control period."""
    if flag and settings.control <= Control.CTBR:
        _look_within(flight, model, settings)
    else:
        _look(flight, model, settings, work.mask > 0.0)


@stage
def look_at_own_stage(flight, world, model, settings, work, stages, flag):
    """Set the state that the controller observes, where a user's estimator runs."""
    if flag and settings.control <= Control.CTBR:
        _look_within(flight, model, settings, settings)
    else:
        _look(flight, model, settings, work.mask > 0.0, settings)


# --------------------------------------------------------------------------------------------------
# Observations of the controller; `envs.spaces` has a table of their layouts.
# --------------------------------------------------------------------------------------------------


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
def _put_absolute(flight, p, settings, row):
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
def _put_aids(flight, p, settings, row, k):
    """Write measurements of aiding sensors since the last step, or zeros if there are none."""
    for s in range(AIDS):
        for block in range(settings.sensor_blocks[FIRST_AID + s]):
            fresh = flight.block_fresh[AID_BLOCK[s] + block]
            scaled = fresh / p.aid_scale[s]
            for i in range(AID_FREEDOMS[s]):
                row[k + i] = scaled * flight.measurement[AID_BLOCK[s] + block, i]
            row[k + AID_FREEDOMS[s]] = fresh
            k += AID_FREEDOMS[s] + 1
    return k


@kernel
def _put_sensors(flight, p, settings, row):
    """Write raw measurements; entries of sensors without one since the last step are zero.

    The IMU contributes its last sample and the mean of all samples since the last step (a single
    sample at the start of an episode).
    """
    R_IG = load33(p.R_IG)
    gyro, accel = load3(flight.gyro), load3(flight.accel)
    k = _put3(row, 0, gyro)
    k = _put3(row, k, accel)
    starts, share = flight.tick == 0.0, 1.0 / settings.ticks_per_step
    k = _put3(row, k, select(starts, gyro, share * load3(flight.gyro_sum)))
    k = _put3(row, k, select(starts, accel, share * load3(flight.accel_sum)))
    fresh = flight.block_fresh[POSITION_BLOCK]
    k = _put3(row, k, fresh * (R_IG @ load3(flight.measurement[POSITION_BLOCK])))
    row[k] = fresh
    measured = flight.block_fresh[BASELINE_BLOCK]
    fresh = measured / p.baseline_length
    k = _put3(row, k + 1, fresh * (R_IG @ load3(flight.measurement[BASELINE_BLOCK])))
    row[k] = measured
    k += 1
    if settings.gnss_velocity > 0:  # measured with every position
        fresh = flight.block_fresh[VELOCITY_BLOCK]
        k = _put3(row, k, fresh * (R_IG @ load3(flight.measurement[VELOCITY_BLOCK])))
        row[k] = fresh
        k += 1
    for i in range(settings.feature_count):
        fresh = flight.block_fresh[FEATURE_BLOCKS + i]
        row[k] = fresh * flight.measurement[FEATURE_BLOCKS + i, 0] / p.half_image[0]
        row[k + 1] = fresh * flight.measurement[FEATURE_BLOCKS + i, 1] / p.half_image[1]
        row[k + 2] = fresh
        k += 3
    k = _put_aids(flight, p, settings, row, k)
    return _put_reference(flight, p, settings, row, k)


@kernel
def _put_privileged(flight, p, settings, row, k):
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
def _put_world(flight, settings, row, k):
    """Write the air's velocity, and each draw minus its center, divided by its spread."""
    k = _put3(row, k, quaternion_to_dcm(load4(flight.q)) @ load3(flight.wind))
    for column in range(DRAWN_SIZE):
        if settings.draw_kind[column] != FIXED:
            deviation = flight.drawn[column] - settings.draw_center[column]
            row[k] = deviation / settings.draw_spread[column]
            k += 1


@stage
def observe_stage(flight, world, model, settings, work, stages, flag):
    """Write the observation of the present instant to the workspace."""
    p, row = model, work.observation
    if settings.layout == Layout.MEASUREMENTS:
        k = _put_sensors(flight, p, settings, row)
    elif settings.layout == Layout.ABSOLUTE:
        k = _put_absolute(flight, p, settings, row)
    else:
        r, v, w = load3(flight.r_seen), load3(flight.v_seen), load3(flight.w_seen)
        reference = reference_shown(flight, p, settings)
        k = put_relative(reference, row, 0, r, v, load33(flight.R_seen), w)
    for i in range(4):
        row[k + i] = flight.action[i]
    k += 4
    if settings.include_std:
        for i in range(15):
            row[k + i] = math.sqrt(variance_of(flight, ROWS[i]))
        k += 15
    if settings.privileged:
        k = _put_privileged(flight, p, settings, row, k)
        if settings.observe_world:
            _put_world(flight, settings, row, k)


# --------------------------------------------------------------------------------------------------
# Numbers for the views of user-defined tasks, see `quad_gym.records.SHOWN`.
# --------------------------------------------------------------------------------------------------


@stage
def show_stage(flight, world, model, settings, work, stages, flag):
    """Write the fields of `SHOWN`, in order, to the workspace's observation."""
    row, reference = work.observation, reference_shown(flight, model, settings)
    R_BI = quaternion_to_dcm(load4(flight.q))
    for i in range(3):
        store(row[3 * i :], R_BI[i])
    r, v, w = load3(flight.r_seen), load3(flight.v_seen), load3(flight.w_seen)
    k = put_relative(reference, row, 9, r, v, load33(flight.R_seen), w)
    for vector in reference:
        store(row[k:], vector)
        k += 3

"""Observed state and observations of the controller, and numbers for views of tasks."""

import math

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.filter.error_state import variance_of
from quad_gym.kernels.numbers.lanes import select
from quad_gym.kernels.numbers.linalg import keep, load3, load4, load33, norm, store
from quad_gym.kernels.numbers.random import six_normals, stream_of
from quad_gym.kernels.numbers.rotation import euler_to_dcm, quaternion_to_dcm
from quad_gym.kernels.task.layouts import (
    put_absolute,
    put_privileged,
    put_relative,
    put_sensors,
    put_world,
    reference_shown,
)
from quad_gym.records import DRAW_NOISY, Control, Layout, Source
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
# Observations of the controller.
# --------------------------------------------------------------------------------------------------


@stage
def observe_stage(flight, world, model, settings, work, stages, flag):
    """Write the observation of the present instant to the workspace."""
    p, row = model, work.observation
    if settings.layout == Layout.MEASUREMENTS:
        k = put_sensors(flight, p, settings, row)
    elif settings.layout == Layout.ABSOLUTE:
        k = put_absolute(flight, p, settings, row)
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
        k = put_privileged(flight, p, settings, row, k)
        if settings.observe_world:
            put_world(flight, settings, row, k)


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

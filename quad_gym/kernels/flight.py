"""One flight: a tick, and an episode's first instant.

A tick is one IMU sample: control with what is seen, let the true state evolve, predict with the
tick's sample - the one taken at its start or, where samples are averages, the one over it - let the
biases evolve, then measure and update at its end.
"""

import numpy as np

from quad_gym.kernels.air import begin_world, fly_through_air, supply
from quad_gym.kernels.alignment import initialize
from quad_gym.kernels.compilation import kernel
from quad_gym.kernels.control import act
from quad_gym.kernels.draws import draw_parameters, impose
from quad_gym.kernels.faults import (
    advance_faults,
    begin_faults,
    gnss_heard,
    saturate_imu,
    spoil_features,
    spoil_gnss,
)
from quad_gym.kernels.innovations import forget_innovations
from quad_gym.kernels.lanes import any_of, logical_not, select
from quad_gym.kernels.late import begin_without_waiting, exchange, set_aside, update_in_turn
from quad_gym.kernels.linalg import (
    add,
    keep3,
    keep33,
    load3,
    load33,
    multiply,
    norm,
    scale,
    sub,
)
from quad_gym.kernels.preintegration import add_increment
from quad_gym.kernels.random import uniform_pair
from quad_gym.kernels.reference import evaluate_reference
from quad_gym.kernels.rotation import euler_to_dcm, quaternion_to_dcm
from quad_gym.kernels.sensors import (
    DRAW_NOISY,
    DRAW_PHASE,
    drift_biases,
    drift_gnss,
    look_along_mark,
    measure_features,
    measure_gnss,
    measure_gnss_velocity,
    measure_imu,
    measure_imu_average,
    six_normals,
    stream_of,
)
from quad_gym.kernels.task import draw_reference, draw_start
from quad_gym.kernels.ukf import predict
from quad_gym.kernels.vehicle import integrate, load4, load_state
from quad_gym.kernels.warm import start_warm
from quad_gym.records import Control, FilterForm, Source
from quad_gym.world_fields import Supply

_ONE = np.uint64(1)
_WATCH = int(FilterForm.GATE | FilterForm.INNOVATIONS)


@kernel
def _look(flight, model, settings, mask):
    """Set what the controller sees from its source, where `mask`."""
    R_BI = quaternion_to_dcm(load4(flight.q))
    r, v, w_B = load3(flight.r), load3(flight.v), load3(flight.w)
    if settings.source == Source.ESTIMATE or settings.source == Source.SENSORS:
        r, v, R_BI = load3(flight.r_hat), load3(flight.v_hat), load33(flight.R_hat)
        w_B = load3(flight.w_meas)
        if settings.source == Source.ESTIMATE:
            w_B = sub(w_B, load3(flight.b_g_hat))
    elif settings.source == Source.NOISY:
        stream = stream_of(flight)
        s = load4(model.noisy_sigma)
        n_r, n_v = six_normals(stream, DRAW_NOISY)
        n_e, n_w = six_normals(stream, DRAW_NOISY + 3)
        r, v = add(r, scale(s[0], n_r)), add(v, scale(s[1], n_v))
        R_BI, w_B = multiply(euler_to_dcm(scale(s[2], n_e)), R_BI), add(w_B, scale(s[3], n_w))
    keep3(flight.r_seen, mask, r)
    keep3(flight.v_seen, mask, v)
    keep33(flight.R_seen, mask, R_BI)
    keep3(flight.w_seen, mask, w_B)
    error = norm(sub(load3(flight.r_seen), load3(flight.r)))
    flight.estimation_error = select(mask, error, flight.estimation_error)


@kernel
def _sense_gnss(flight, world, settings, mask, starting):
    """Measure by GNSS where it is due, and the place of the start for the filter to start from."""
    due = mask & (flight.gnss_wait <= 0.0) & (settings.gnss_ticks > 0)
    if settings.gnss_drifts > 0 and not starting and any_of(due):
        drift_gnss(flight, world, due)
    measured = mask if starting else due
    paired = measured
    sound = starting and not settings.warm  # the fix that starts the filter
    if settings.faults and not sound:
        measured, paired = gnss_heard(flight, settings, due)
    if any_of(measured):
        measure_gnss(flight, world, measured)
        if settings.faults and not sound:
            spoil_gnss(flight, world, settings, measured)
        if settings.gnss_velocity > 0:
            measure_gnss_velocity(flight, world, measured)
    wait = select(due, 1.0 * settings.gnss_ticks, flight.gnss_wait) - 1.0
    flight.gnss_wait = select(mask, wait, flight.gnss_wait)
    fresh, alone = measured & (settings.gnss_ticks > 0), measured & logical_not(paired)
    fresh = fresh & (starting or settings.gnss_delay == 0)
    flight.position_fresh = select(fresh, 1.0, flight.position_fresh)
    flight.baseline_fresh = select(fresh, 1.0, flight.baseline_fresh)
    flight.baseline_fresh = select(fresh & alone, 0.0, flight.baseline_fresh)
    if starting and settings.reuse_first_fix == 0 and not settings.warm:
        due = due & (settings.gnss_ticks < 0)
    valid = select(due & measured, 1.0, 0.0)
    flight.position_valid = select(mask, valid, flight.position_valid)
    flight.baseline_valid = select(mask, select(alone, 0.0, valid), flight.baseline_valid)
    if settings.gnss_velocity > 0:
        flight.velocity_valid = select(mask, valid, flight.velocity_valid)


@kernel
def _first_wait(phase, period, share):
    """Ticks to a sensor's first measurement: its phase, or at random within its period."""
    ticks = 0.0 * share
    for k in range(1, period):
        ticks = ticks + select(share * period >= 1.0 * k, 1.0, 0.0)
    if phase >= 0:
        ticks = 0.0 * share + phase
    return ticks


@kernel
def sense(flight, world, model, settings, work, mask, starting):
    """Measure at the present instant, update the filter and look, where `mask`.

    Args:
        flight: Record.
        world: Parameters as they are.
        model: Parameters as filter and controller believe them.
        settings: What the batch does.
        work: Workspace.
        mask: Which lanes.
        starting: Whether this is the first instant of their episode.
    """
    if settings.run_filter:
        if starting or not settings.imu_averages:  # at its start an average has nothing behind it
            measure_imu(flight, world, mask)
            if settings.faults:
                saturate_imu(flight, settings, mask)
        anything_late = settings.gnss_delay + settings.camera_delay > 0
        if anything_late:
            set_aside(flight, work, settings)
        _sense_gnss(flight, world, settings, mask, starting)

        if settings.camera_ticks > 0:
            period = 1.0 * settings.camera_ticks
            due = mask & (flight.camera_wait <= 0.0)
            for i in range(settings.feature_count):
                flight.feature_valid[i] = select(mask, 0.0, flight.feature_valid[i])
            if any_of(due):
                measure_features(flight, world, settings.feature_count, due)
                if settings.faults:
                    spoil_features(flight, settings, due)
            wait = select(due, period, flight.camera_wait) - 1.0
            flight.camera_wait = select(mask, wait, flight.camera_wait)
            for i in range(settings.feature_count):
                seen = due & (flight.feature_valid[i] > 0.0) & (settings.camera_delay == 0)
                flight.feature_fresh[i] = select(seen, 1.0, flight.feature_fresh[i])

        if starting:
            initialize(flight, model, mask, look_along_mark(flight, world))
            if settings.warm:
                start_warm(flight, settings, stream_of(flight), work, mask)
        if anything_late:
            exchange(flight, work, settings, mask, starting)
        update_in_turn(flight, model, work, settings, mask, starting)
    _look(flight, model, settings, mask)


@kernel
def tick(flight, world, model, settings, work):
    """Fly one tick."""
    nothing = load3(flight.disturbance)
    reference = (nothing, nothing, nothing, nothing)
    if settings.control == Control.PD:
        reference = evaluate_reference(flight, flight.tick * model.dt)
    act(flight, model, settings.control, reference)
    if settings.supply != Supply.NOMINAL:
        supply(flight, world, settings)
    flight.instant = flight.instant + _ONE
    everyone = flight.tick >= 0.0
    start = load_state(flight)
    if settings.air:
        fly_through_air(flight, world, settings)
    else:
        integrate(flight, world, settings.substeps)
    if settings.run_filter:
        if settings.imu_averages:
            measure_imu_average(flight, world, start, everyone)
            if settings.faults:
                saturate_imu(flight, settings, everyone)
        predict(flight, model, work, settings.form)
        if settings.gnss_delay + settings.camera_delay > 0:
            add_increment(flight, model, settings.form)
        drift_biases(flight, world)
    flight.tick = flight.tick + 1.0
    if settings.faults:
        advance_faults(flight, world, settings, everyone)
    sense(flight, world, model, settings, work, everyone, False)


@kernel
def begin_episode(flight, nominal, world, model, settings, work, mask):
    """Begin a new episode, where `mask`: reference, true state, first measurements, filter.

    The flights' own parameters, in `world`, are drawn from what the `nominal` ones and the settings
    say.
    """
    flight.instant = select(mask, flight.instant + _ONE, flight.instant)
    flight.tick = select(mask, 0.0, flight.tick)
    gnss_share, camera_share = uniform_pair(stream_of(flight), DRAW_PHASE)
    wait = _first_wait(settings.gnss_phase, settings.gnss_ticks, gnss_share)
    flight.gnss_wait = select(mask, wait, flight.gnss_wait)
    wait = _first_wait(settings.camera_phase, settings.camera_ticks, camera_share)
    flight.camera_wait = select(mask, wait, flight.camera_wait)
    keep3(flight.gnss_drift, mask, (0.0, 0.0, 0.0))
    if settings.gnss_delay + settings.camera_delay > 0:
        begin_without_waiting(flight, mask)
    if (settings.form & _WATCH) != 0:
        forget_innovations(flight, settings.feature_count, mask)
    flight.position_fresh = select(mask, 0.0, flight.position_fresh)
    flight.baseline_fresh = select(mask, 0.0, flight.baseline_fresh)
    for i in range(settings.feature_count):
        flight.feature_fresh[i] = select(mask, 0.0, flight.feature_fresh[i])
    stream = stream_of(flight)
    if settings.randomized:
        draw_parameters(flight, settings, stream, mask)
        impose(flight, nominal, world, settings)
    draw_reference(flight, settings, stream, mask)
    draw_start(flight, world, model, settings, stream, mask)
    begin_world(flight, world, settings, stream, mask)
    if settings.faults:
        begin_faults(flight, world, settings, stream, mask)
    sense(flight, world, model, settings, work, mask, True)

    flight.step = select(mask, 0.0, flight.step)
    flight.episode = select(mask, flight.episode + 1.0, flight.episode)
    flight.gate_next = select(mask, 0.0, flight.gate_next)
    flight.needs_reset = select(mask, 0.0, flight.needs_reset)
    flight.reward = select(mask, 0.0, flight.reward)
    flight.terminated = select(mask, 0.0, flight.terminated)
    flight.truncated = select(mask, 0.0, flight.truncated)
    flight.ending = select(mask, 0.0, flight.ending)
    flight.episode_return = select(mask, 0.0, flight.episode_return)
    flight.episode_error = select(mask, 0.0, flight.episode_error)
    r_ref, _, _, _ = evaluate_reference(flight, 0.0 * flight.tick)
    error = norm(sub(r_ref, load3(flight.r)))
    flight.position_error = select(mask, error, flight.position_error)

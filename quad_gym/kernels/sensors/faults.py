"""Faults of sensors and rotors: their times and their effects.

A fault of kind k is active at the ticks from `fault_from[k]` until before `fault_until[k]`. Both
are drawn when an episode begins, and again when a fault that occurs at a rate has ended; its size
and direction are drawn when it begins. Every draw has its own number within its instant, so that a
fault changes no other draw. All branches are on settings, except `any_of` to skip idle work.
"""

import math

import numpy as np

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.numbers.blocks import reset
from quad_gym.kernels.numbers.elementary import approached, clip, log, sin_cos
from quad_gym.kernels.numbers.lanes import any_of, logical_not, select, zero_like
from quad_gym.kernels.numbers.linalg import dot, keep, load3, load33, load44, store
from quad_gym.kernels.numbers.random import stream_of, uniform_pair
from quad_gym.records import (
    DRAW_FAULTS,
    DRAW_HIDDEN,
    DRAWS_OF_FAULT,
    FAULT_KINDS,
    FEATURE_BLOCKS,
    NEVER,
    POSITION_BLOCK,
    FaultKind,
    FieldFault,
)

_FIRST, _FIRST_HIDDEN = np.uint64(DRAW_FAULTS), np.uint64(DRAW_HIDDEN)


@kernel
def _draw_of(k, number):
    """One of the draws of faults of kind k."""
    return _FIRST + np.uint64(DRAWS_OF_FAULT * k + number)


@kernel
def _draw_when(flight, settings, stream, k, mask):
    """Draw when fault k begins, from the present instant on, and when it ends, where `mask`."""
    chance, u = uniform_pair(stream, _draw_of(k, 0))
    length, _ = uniform_pair(stream, _draw_of(k, 1))
    if settings.fault_rate[k] > 0.0:  # waits of a Poisson process
        wait = -log(1.0 - u) / settings.fault_rate[k]
    else:
        wait = settings.fault_start[k, 0] + settings.fault_start[k, 1] * u
    start = flight.tick + wait
    end = start + (settings.fault_duration[k, 0] + settings.fault_duration[k, 1] * length)
    flight.fault_from[k] = select(mask, start, flight.fault_from[k])
    flight.fault_until[k] = select(mask, end, flight.fault_until[k])
    return chance


@kernel
def _any_direction(stream, draw):
    """A unit vector, uniform on the sphere."""
    height, turn = uniform_pair(stream, draw)
    z = 2.0 * height - 1.0
    s, c = sin_cos(6.28318530717958647692 * turn - 3.14159265358979323846)
    level = math.sqrt((1.0 - z) * (1.0 + z))
    return (level * c, level * s, z)


@kernel
def _draw_what(flight, settings, stream, k, mask):
    """Draw size and direction of fault k, where `mask`."""
    _, u = uniform_pair(stream, _draw_of(k, 1))
    size = settings.fault_size[k, 0] + settings.fault_size[k, 1] * u
    given, drawn = load3(settings.fault_direction[k]), _any_direction(stream, _draw_of(k, 2))
    direction = select(dot(given, given) + zero_like(size) > 0.0, given, drawn)
    pick, _ = uniform_pair(stream, _draw_of(k, 3))
    pick = settings.fault_pick[0] + settings.fault_pick[1] * pick
    flight.fault_size[k] = select(mask, size, flight.fault_size[k])
    keep(flight.fault_vector[k], mask, size * direction)
    flight.fault_pick[k] = select(mask, pick, flight.fault_pick[k])


@kernel
def _step_bias(flight, k, bias, decay, step, mask):
    """Add a step to a bias that has just decayed, so that the step itself does not decay.

    `step` is the duration of a tick over the bias's time constant, `decay` is exp(-step).
    """
    vector, news = flight.fault_vector[k], flight.fault_news[k]
    active, lost = mask & (flight.fault_active[k] > 0.0), approached(step)
    for i in range(3):
        held = select(active, lost * vector[i], 0.0)
        step = select(news > 0.0, vector[i], select(news < 0.0, -decay * vector[i], held))
        bias[i] = bias[i] + step


@kernel
def _weaken_rotors(flight, world):
    """Set the true effectiveness of the rotors at the present instant."""
    lost = flight.fault_active[FaultKind.ROTOR_LOSS] > 0.0
    which = 4.0 * flight.fault_pick[FaultKind.ROTOR_LOSS]
    for i in range(4):
        struck = lost & (which >= 1.0 * i) & (which < 1.0 * i + 1.0)
        gain = select(struck, 1.0 - flight.fault_size[FaultKind.ROTOR_LOSS], 1.0)
        flight.rotor_gain[i] = gain
        for j in range(4):
            world.effectiveness[j, i] = gain * world.sound_effectiveness[j, i]


@kernel
def _apply_rotor_faults(flight, world, settings):
    """Apply the rotors' faults of the present flights, after `impose` has assembled `world`."""
    if settings.fault_on[FaultKind.ROTOR_LOSS]:
        if settings.randomized:
            store(world.sound_effectiveness, load44(world.effectiveness))
        _weaken_rotors(flight, world)


@kernel
def _advance(flight, settings, stream, mask):
    """Begin and end the faults of all kinds at the present instant, in the lanes `mask`."""
    bits, bit = zero_like(flight.tick), 1.0
    for k in range(FAULT_KINDS):
        if settings.fault_on[k]:
            if settings.fault_rate[k] > 0.0:
                over = mask & (flight.tick >= flight.fault_until[k])
                if any_of(over):
                    _draw_when(flight, settings, stream, k, over)
            active = (flight.tick >= flight.fault_from[k]) & (flight.tick < flight.fault_until[k])
            before = flight.fault_active[k] > 0.0
            came, went = active & logical_not(before) & mask, before & logical_not(active) & mask
            if any_of(came):
                _draw_what(flight, settings, stream, k, came)
            flight.fault_active[k] = select(mask, select(active, 1.0, 0.0), flight.fault_active[k])
            flight.fault_count[k] = select(came, flight.fault_count[k] + 1.0, flight.fault_count[k])
            flight.fault_news[k] = select(came, 1.0, select(went, -1.0, 0.0))
            bits = bits + select(active, bit, 0.0)
        bit = 2.0 * bit
    flight.faults = select(mask, bits, flight.faults)


@kernel
def _advance_faults(flight, world, settings, mask):
    """Begin and end faults at the present instant, in the lanes `mask`.

    A position jump displaces the vehicle; a bias step changes the true bias; a rotor loss the true
    effectiveness. The kernels below apply the effects of faults on measurements.
    """
    on, stream = settings.fault_on, stream_of(flight)
    _advance(flight, settings, stream, mask)
    if on[FaultKind.POSITION_JUMP]:
        r_I = load3(flight.r) + load3(flight.fault_vector[FaultKind.POSITION_JUMP])
        keep(flight.r, flight.fault_news[FaultKind.POSITION_JUMP] > 0.0, r_I)
    if settings.run_filter:
        if on[FaultKind.ACCEL_BIAS_STEP]:
            decay, step = world.accel_bias_decay, world.dt / world.accel_bias_tau
            _step_bias(flight, FaultKind.ACCEL_BIAS_STEP, flight.b_a, decay, step, mask)
        if on[FaultKind.GYRO_BIAS_STEP]:
            decay, step = world.gyro_bias_decay, world.dt / world.gyro_bias_tau
            _step_bias(flight, FaultKind.GYRO_BIAS_STEP, flight.b_g, decay, step, mask)
    if on[FaultKind.CAMERA_OCCLUSION]:
        came = flight.fault_news[FaultKind.CAMERA_OCCLUSION] > 0.0
        if any_of(came):
            for i in range(settings.feature_count):  # drawn again at each occlusion
                u, _ = uniform_pair(stream, _FIRST_HIDDEN + np.uint64(i))
                hidden = select(u < settings.fault_share[FaultKind.CAMERA_OCCLUSION], 1.0, 0.0)
                flight.feature_hidden[i] = select(came, hidden, flight.feature_hidden[i])
    if on[FaultKind.ROTOR_LOSS]:
        _weaken_rotors(flight, world)


@kernel
def gnss_heard(flight, settings, due):
    """Lanes in which GNSS has a position, and lanes in which it has a baseline, among those due."""
    heard = due
    if settings.fault_on[FaultKind.GNSS_OUTAGE]:
        heard = heard & (flight.fault_active[FaultKind.GNSS_OUTAGE] <= 0.0)
    paired = heard
    if settings.fault_on[FaultKind.BASELINE_LOSS]:
        paired = paired & (flight.fault_active[FaultKind.BASELINE_LOSS] <= 0.0)
    return heard, paired


@kernel
def _draw_outlier(flight, p, settings, mask):
    """Offset of an outlier in I; zero where this fix is not an outlier.

    Its size is measured in standard deviations of a fix. These include the slow error, which has
    the variance drive^2 / (1 - decay^2).
    """
    k, stream = FaultKind.GNSS_OUTLIERS, stream_of(flight)
    chance, u = uniform_pair(stream, _draw_of(k, 4))
    struck = mask & (flight.fault_active[k] > 0.0) & (chance < settings.fault_share[k])
    size = settings.fault_size[k, 0] + settings.fault_size[k, 1] * u
    size, direction = select(struck, size, 0.0), _any_direction(stream, _draw_of(k, 5))
    white, drive = load3(p.position_sigma_I), load3(p.drift_drive)
    gained = approached(2.0 * p.drift_step)
    flight.outlier = select(mask, select(struck, 1.0, 0.0), flight.outlier)
    return (
        size * math.sqrt(white[0] * white[0] + drive[0] * drive[0] / gained) * direction[0],
        size * math.sqrt(white[1] * white[1] + drive[1] * drive[1] / gained) * direction[1],
        size * math.sqrt(white[2] * white[2] + drive[2] * drive[2] / gained) * direction[2],
    )


@kernel
def _nth(count, share, total):
    """The whole number below `total` at a share of it, at most `count` - 1."""
    place, number = total * share, zero_like(share)
    for i in range(1, count):
        number = select(place >= 1.0 * i, 1.0 * i, number)
    return number


@kernel
def _mistake_features(flight, settings, mask):
    """Confuse two visible features in the image just taken, at random in the lanes `mask`.

    The two are the `first`-th and the `second`-th visible ones, counted from zero.
    """
    k, stream, count = FaultKind.WRONG_ASSOCIATIONS, stream_of(flight), settings.feature_count
    zero = zero_like(flight.tick)
    seen = zero
    for i in range(count):
        seen = seen + flight.block_valid[FEATURE_BLOCKS + i]
    chance, u = uniform_pair(stream, _draw_of(k, 4))
    w, _ = uniform_pair(stream, _draw_of(k, 5))
    struck = mask & (flight.fault_active[k] > 0.0) & (chance < settings.fault_share[k])
    struck = struck & (seen > 1.0)
    first, second = _nth(count, u, seen), _nth(count, w, seen - 1.0)
    second = select(second >= first, second + 1.0, second)

    rank, x_first, y_first, x_second, y_second = zero, zero, zero, zero, zero
    for i in range(count):
        valid = flight.block_valid[FEATURE_BLOCKS + i] > 0.0
        here, there = valid & (rank == first), valid & (rank == second)
        x, y = flight.measurement[FEATURE_BLOCKS + i, 0], flight.measurement[FEATURE_BLOCKS + i, 1]
        x_first, y_first = select(here, x, x_first), select(here, y, y_first)
        x_second, y_second = select(there, x, x_second), select(there, y, y_second)
        rank = rank + flight.block_valid[FEATURE_BLOCKS + i]

    swaps = settings.fault_swaps > 0
    rank = zero
    for i in range(count):
        valid = struck & (flight.block_valid[FEATURE_BLOCKS + i] > 0.0)
        here, there = valid & (rank == first) & swaps, valid & (rank == second)
        x, y = flight.measurement[FEATURE_BLOCKS + i, 0], flight.measurement[FEATURE_BLOCKS + i, 1]
        x, y = select(here, x_second, x), select(here, y_second, y)
        flight.measurement[FEATURE_BLOCKS + i, 0] = select(there, x_first, x)
        flight.measurement[FEATURE_BLOCKS + i, 1] = select(there, y_first, y)
        mistaken = select(here | there, 1.0, 0.0)
        flight.feature_mistaken[i] = select(mask, mistaken, flight.feature_mistaken[i])
        rank = rank + flight.block_valid[FEATURE_BLOCKS + i]


@kernel
def disturb_field(flight, settings, field_B, due):
    """The field in B that a disturbed magnetometer measures, in the lanes `due`.

    The sign of an angle is that of the vertical part of the fault's direction.
    """
    k = FaultKind.MAGNETOMETER_DISTURBANCE
    active, vector = due & (flight.fault_active[k] > 0.0), load3(flight.fault_vector[k])
    disturbed = load3(flight.field_frozen)
    if settings.fault_field == FieldFault.IRON:
        disturbed = field_B + vector
    elif settings.fault_field == FieldFault.TURNED:
        s, c = sin_cos(select(vector[2] > 0.0, flight.fault_size[k], -flight.fault_size[k]))
        x, y, z = field_B
        disturbed = (c * x - s * y, s * x + c * y, z)
    field_B = select(active, disturbed, field_B)
    keep(flight.field_frozen, due, field_B)
    return field_B


@stage
def begin_faults_stage(flight, world, model, settings, work, stages, flag):
    """Draw the times of the faults of a new episode."""
    stream, mask = stream_of(flight), work.mask > 0.0
    for k in range(FAULT_KINDS):
        if settings.fault_on[k]:
            chance = _draw_when(flight, settings, stream, k, mask)
            never = mask & (chance >= settings.fault_probability[k])
            flight.fault_from[k] = select(never, NEVER, flight.fault_from[k])
            flight.fault_until[k] = select(never, NEVER, flight.fault_until[k])
            flight.fault_active[k] = select(mask, 0.0, flight.fault_active[k])
            flight.fault_count[k] = select(mask, 0.0, flight.fault_count[k])
    reset(flight, mask, 0.0, "outlier feature_mistaken")
    if settings.randomized:
        _apply_rotor_faults(flight, world, settings)
    _advance_faults(flight, world, settings, mask)


@stage
def advance_faults_stage(flight, world, model, settings, work, stages, flag):
    """Begin and end faults at the present instant."""
    _advance_faults(flight, world, settings, work.mask > 0.0)


@stage
def meet_rotors_stage(flight, world, model, settings, work, stages, flag):
    """Apply the rotors' faults of the present flights."""
    _apply_rotor_faults(flight, world, settings)


@stage
def saturate_imu_stage(flight, world, model, settings, work, stages, flag):
    """Limit the IMU's samples to its ranges, where the fault is active."""
    if settings.fault_on[FaultKind.IMU_SATURATION]:
        full = (work.mask > 0.0) & (flight.fault_active[FaultKind.IMU_SATURATION] > 0.0)
        a, w = settings.imu_range[0], settings.imu_range[1]
        for i in range(3):
            flight.accel[i] = select(full, clip(flight.accel[i], -a, a), flight.accel[i])
            flight.gyro[i] = select(full, clip(flight.gyro[i], -w, w), flight.gyro[i])
            flight.w_meas[i] = select(full, clip(flight.w_meas[i], -w, w), flight.w_meas[i])


@stage
def corrupt_gnss_stage(flight, world, model, settings, work, stages, flag):
    """Add ramp, jump and outliers to the GNSS position that has just been measured."""
    active, mask = flight.fault_active, work.mask > 0.0
    zero = zero_like(flight.tick)
    offset_I = (zero, zero, zero)
    if settings.fault_on[FaultKind.GNSS_RAMP]:
        seconds = (flight.tick - flight.fault_from[FaultKind.GNSS_RAMP]) * world.dt
        seconds = select(active[FaultKind.GNSS_RAMP] > 0.0, seconds, 0.0)
        offset_I = seconds * load3(flight.fault_vector[FaultKind.GNSS_RAMP]) + offset_I
    if settings.fault_on[FaultKind.GNSS_JUMP]:
        jump_I = load3(flight.fault_vector[FaultKind.GNSS_JUMP])
        offset_I = active[FaultKind.GNSS_JUMP] * jump_I + offset_I
    if settings.fault_on[FaultKind.GNSS_OUTLIERS]:
        offset_I = offset_I + _draw_outlier(flight, world, settings, mask)
    offset_G = load33(world.R_IG).T @ offset_I
    position = flight.measurement[POSITION_BLOCK]
    keep(position, mask, load3(position) + offset_G)


@stage
def corrupt_features_stage(flight, world, model, settings, work, stages, flag):
    """Hide features of the image just taken and confuse some with others.

    A feature hidden now counts as not visible in the whole step.
    """
    mask = work.mask > 0.0
    if settings.fault_on[FaultKind.CAMERA_OCCLUSION]:
        covered = mask & (flight.fault_active[FaultKind.CAMERA_OCCLUSION] > 0.0)
        for i in range(settings.feature_count):
            hidden, block = covered & (flight.feature_hidden[i] > 0.0), FEATURE_BLOCKS + i
            flight.block_valid[block] = select(hidden, 0.0, flight.block_valid[block])
            flight.block_fresh[block] = select(hidden, 0.0, flight.block_fresh[block])
    if settings.fault_on[FaultKind.WRONG_ASSOCIATIONS]:
        _mistake_features(flight, settings, mask)

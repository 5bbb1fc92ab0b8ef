"""Faults of sensors and rotors: their times and their effects.

A fault of kind k is active at the ticks from `fault_from[k]` until before `fault_until[k]`. Both
are drawn when an episode begins, and again when a fault that occurs at a rate has ended; its size
and direction are drawn when it begins. Every draw has its own number within its instant, so that a
fault changes no other draw. All branches are on settings, except `any_of` to skip idle work.
"""

import math

import numpy as np

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.maths.elementary import clip, log, sin_cos
from quad_gym.kernels.maths.linalg import (
    add,
    apply_transposed,
    dot,
    keep3,
    load3,
    load33,
    scale,
    select3,
)
from quad_gym.kernels.maths.random import stream_of, uniform_pair
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.kernels.simd.lanes import any_of, logical_not, select
from quad_gym.records import (
    DRAW_FAULTS,
    DRAW_HIDDEN,
    DRAWS_OF_FAULT,
    FAULT_KINDS,
    FEATURE_BLOCKS,
    FaultKind,
)

_FIRST, _FIRST_HIDDEN = np.uint64(DRAW_FAULTS), np.uint64(DRAW_HIDDEN)
_DRAWS = np.uint64(DRAWS_OF_FAULT)
NEVER = 1e18
"""A tick that no flight reaches."""

_ONE, _TWO, _THREE, _FOUR, _FIVE = (np.uint64(number) for number in range(1, 6))
_GNSS_OUTAGE, _BASELINE_LOSS = int(FaultKind.GNSS_OUTAGE), int(FaultKind.BASELINE_LOSS)
_OUTLIERS, _RAMP = int(FaultKind.GNSS_OUTLIERS), int(FaultKind.GNSS_RAMP)
_JUMP, _ROTOR_LOSS = int(FaultKind.GNSS_JUMP), int(FaultKind.ROTOR_LOSS)
_POSITION_JUMP, _OCCLUSION = int(FaultKind.POSITION_JUMP), int(FaultKind.CAMERA_OCCLUSION)
_ASSOCIATIONS, _SATURATION = int(FaultKind.WRONG_ASSOCIATIONS), int(FaultKind.IMU_SATURATION)
_ACCEL_STEP, _GYRO_STEP = int(FaultKind.ACCEL_BIAS_STEP), int(FaultKind.GYRO_BIAS_STEP)


@kernel
def _draw_of(k):
    """Number of the first draw of kind k."""
    return _FIRST + _DRAWS * np.uint64(k)


@kernel
def _draw_when(flight, settings, stream, k, mask):
    """Draw when fault k begins, from the present instant on, and when it ends, where `mask`."""
    chance, u = uniform_pair(stream, _draw_of(k))
    length, _ = uniform_pair(stream, _draw_of(k) + _ONE)
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
    _, u = uniform_pair(stream, _draw_of(k) + _ONE)
    size = settings.fault_size[k, 0] + settings.fault_size[k, 1] * u
    given = load3(settings.fault_direction[k])
    drawn = _any_direction(stream, _draw_of(k) + _TWO)
    direction = select3(dot(given, given) + 0.0 * size > 0.0, given, drawn)
    pick, _ = uniform_pair(stream, _draw_of(k) + _THREE)
    pick = settings.fault_pick[0] + settings.fault_pick[1] * pick
    flight.fault_size[k] = select(mask, size, flight.fault_size[k])
    keep3(flight.fault_vector[k], mask, scale(size, direction))
    flight.fault_pick[k] = select(mask, pick, flight.fault_pick[k])


@kernel
def _step_bias(bias, vector, decay, news, active):
    """Add a step to a bias that has just decayed, so that the step itself does not decay."""
    for i in range(3):
        held = select(active > 0.0, (1.0 - decay) * vector[i], 0.0)
        step = select(news > 0.0, vector[i], select(news < 0.0, -decay * vector[i], held))
        bias[i] = bias[i] + step


@kernel
def _hide_features(flight, settings, stream, came):
    """Draw the features that an occlusion hides, where it has begun."""
    share = settings.fault_share[_OCCLUSION]
    for i in range(settings.feature_count):
        u, _ = uniform_pair(stream, _FIRST_HIDDEN + np.uint64(i))
        hidden = select(u < share, 1.0, 0.0)
        flight.feature_hidden[i] = select(came, hidden, flight.feature_hidden[i])


@kernel
def _weaken_rotors(flight, world, settings):
    """Set the true effectiveness of the rotors at the present instant."""
    lost = flight.fault_active[_ROTOR_LOSS] > 0.0
    which = 4.0 * flight.fault_pick[_ROTOR_LOSS]
    for i in range(4):
        struck = lost & (which >= 1.0 * i) & (which < 1.0 * i + 1.0)
        gain = select(struck, 1.0 - flight.fault_size[_ROTOR_LOSS], 1.0)
        flight.rotor_gain[i] = gain
        for j in range(4):
            world.effectiveness[j, i] = gain * world.sound_effectiveness[j, i]


@kernel
def meet_rotors(flight, world, settings):
    """Apply the rotors' faults of the present flights, after `impose` has assembled `world`.

    Args:
        flight: Record.
        world: True parameters, this thread's own.
        settings: Configuration of the batch.
    """
    if settings.fault_on[_ROTOR_LOSS]:
        if settings.randomized:
            for i in range(4):
                for j in range(4):
                    world.sound_effectiveness[i, j] = world.effectiveness[i, j]
        _weaken_rotors(flight, world, settings)


@kernel
def advance_faults(flight, world, settings, mask):
    """Begin and end faults at the present instant, in the lanes `mask`.

    A position jump displaces the vehicle; a bias step changes the true bias; a rotor loss the true
    effectiveness. The kernels below apply the effects of faults on measurements.

    Args:
        flight: Record.
        world: True parameters; this thread's own where rotors can fail.
        settings: Configuration of the batch.
        mask: Lanes to work on.
    """
    stream = stream_of(flight)
    bits, bit = 0.0 * flight.tick, 1.0
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

    if settings.fault_on[_POSITION_JUMP]:
        r_I = add(load3(flight.r), load3(flight.fault_vector[_POSITION_JUMP]))
        keep3(flight.r, flight.fault_news[_POSITION_JUMP] > 0.0, r_I)
    if settings.run_filter:
        if settings.fault_on[_ACCEL_STEP]:
            k = _ACCEL_STEP
            held = select(mask, flight.fault_active[k], 0.0)
            vector = load3(flight.fault_vector[k])
            _step_bias(flight.b_a, vector, world.accel_bias_decay, flight.fault_news[k], held)
        if settings.fault_on[_GYRO_STEP]:
            k = _GYRO_STEP
            held = select(mask, flight.fault_active[k], 0.0)
            vector = load3(flight.fault_vector[k])
            _step_bias(flight.b_g, vector, world.gyro_bias_decay, flight.fault_news[k], held)
    if settings.fault_on[_OCCLUSION]:
        came = flight.fault_news[_OCCLUSION] > 0.0
        if any_of(came):
            _hide_features(flight, settings, stream, came)
    if settings.fault_on[_ROTOR_LOSS]:
        _weaken_rotors(flight, world, settings)


@kernel
def begin_faults(flight, world, settings, stream, mask):
    """Draw the times of the faults of a new episode, in the lanes `mask`.

    Args:
        flight: Record, with the true initial state.
        world: True parameters; this thread's own where rotors can fail.
        settings: Configuration of the batch.
        stream: The random stream at the episode's first instant.
        mask: Lanes to work on.
    """
    for k in range(FAULT_KINDS):
        if settings.fault_on[k]:
            chance = _draw_when(flight, settings, stream, k, mask)
            spared = mask & (chance >= settings.fault_probability[k])
            flight.fault_from[k] = select(spared, NEVER, flight.fault_from[k])
            flight.fault_until[k] = select(spared, NEVER, flight.fault_until[k])
            flight.fault_active[k] = select(mask, 0.0, flight.fault_active[k])
            flight.fault_count[k] = select(mask, 0.0, flight.fault_count[k])
    flight.outlier = select(mask, 0.0, flight.outlier)
    for i in range(settings.feature_count):
        flight.feature_mistaken[i] = select(mask, 0.0, flight.feature_mistaken[i])
    if settings.fault_on[_ROTOR_LOSS] and settings.randomized:
        meet_rotors(flight, world, settings)
    advance_faults(flight, world, settings, mask)


# ---- effects on measurements ------------------------------------------------------------------


@kernel
def saturate_imu(flight, settings, mask):
    """Limit the IMU's samples to its ranges, where the fault is active and `mask`."""
    if settings.fault_on[_SATURATION]:
        full = mask & (flight.fault_active[_SATURATION] > 0.0)
        a, w = settings.imu_range[0], settings.imu_range[1]
        for i in range(3):
            flight.accel[i] = select(full, clip(flight.accel[i], -a, a), flight.accel[i])
            flight.gyro[i] = select(full, clip(flight.gyro[i], -w, w), flight.gyro[i])
            flight.w_meas[i] = select(full, clip(flight.w_meas[i], -w, w), flight.w_meas[i])


@kernel
def gnss_heard(flight, settings, due):
    """Lanes in which GNSS has a position, and lanes in which it has a baseline, among those due."""
    heard = due
    if settings.fault_on[_GNSS_OUTAGE]:
        heard = heard & (flight.fault_active[_GNSS_OUTAGE] <= 0.0)
    paired = heard
    if settings.fault_on[_BASELINE_LOSS]:
        paired = paired & (flight.fault_active[_BASELINE_LOSS] <= 0.0)
    return heard, paired


@kernel
def _draw_outlier(flight, p, settings, mask):
    """Offset of an outlier in I; zero where this fix is not an outlier.

    Its size is measured in standard deviations of a fix. These include the slow error, which has
    the variance drive^2 / (1 - decay^2).
    """
    k = _OUTLIERS
    stream = stream_of(flight)
    chance, u = uniform_pair(stream, _draw_of(k) + _FOUR)
    struck = mask & (flight.fault_active[k] > 0.0) & (chance < settings.fault_share[k])
    size = settings.fault_size[k, 0] + settings.fault_size[k, 1] * u
    size = select(struck, size, 0.0)
    direction = _any_direction(stream, _draw_of(k) + _FIVE)
    white, drive = load3(p.position_sigma_I), load3(p.drift_drive)
    kept = (1.0 - p.drift_decay) * (1.0 + p.drift_decay)
    flight.outlier = select(mask, select(struck, 1.0, 0.0), flight.outlier)
    return (
        size * math.sqrt(white[0] * white[0] + drive[0] * drive[0] / kept) * direction[0],
        size * math.sqrt(white[1] * white[1] + drive[1] * drive[1] / kept) * direction[1],
        size * math.sqrt(white[2] * white[2] + drive[2] * drive[2] / kept) * direction[2],
    )


@kernel
def corrupt_gnss(flight, p, settings, mask):
    """Add ramp, jump and outliers to the GNSS position that has just been measured."""
    zero = 0.0 * flight.tick
    offset_I = (zero, zero, zero)
    if settings.fault_on[_RAMP]:
        seconds = (flight.tick - flight.fault_from[_RAMP]) * p.dt
        seconds = select(flight.fault_active[_RAMP] > 0.0, seconds, 0.0)
        offset_I = add(offset_I, scale(seconds, load3(flight.fault_vector[_RAMP])))
    if settings.fault_on[_JUMP]:
        jump_I = scale(flight.fault_active[_JUMP], load3(flight.fault_vector[_JUMP]))
        offset_I = add(offset_I, jump_I)
    if settings.fault_on[_OUTLIERS]:
        offset_I = add(offset_I, _draw_outlier(flight, p, settings, mask))
    offset_G = apply_transposed(load33(p.R_IG), offset_I)
    keep3(flight.gnss_position, mask, add(load3(flight.gnss_position), offset_G))


@kernel
def _mistake_features(flight, settings, mask):
    """Confuse two visible features in the image just taken, at random in the lanes `mask`.

    The two are the `first`-th and the `second`-th visible ones, counted from zero.
    """
    k = _ASSOCIATIONS
    stream = stream_of(flight)
    seen = 0.0 * flight.tick
    for i in range(settings.feature_count):
        seen = seen + flight.block_valid[FEATURE_BLOCKS + i]
    chance, u = uniform_pair(stream, _draw_of(k) + _FOUR)
    w, _ = uniform_pair(stream, _draw_of(k) + _FIVE)
    struck = mask & (flight.fault_active[k] > 0.0) & (chance < settings.fault_share[k])
    struck = struck & (seen > 1.0)
    first, place = 0.0 * u, seen * u
    for i in range(1, settings.feature_count):
        first = select(place >= 1.0 * i, 1.0 * i, first)
    second, place = 0.0 * u, (seen - 1.0) * w
    for i in range(1, settings.feature_count):
        second = select(place >= 1.0 * i, 1.0 * i, second)
    second = select(second >= first, second + 1.0, second)

    rank = 0.0 * u
    zero = 0.0 * u
    x_first, y_first, x_second, y_second = zero, zero, zero, zero
    for i in range(settings.feature_count):
        valid = flight.block_valid[FEATURE_BLOCKS + i] > 0.0
        here, there = valid & (rank == first), valid & (rank == second)
        x, y = flight.pixels[i, 0], flight.pixels[i, 1]
        x_first, y_first = select(here, x, x_first), select(here, y, y_first)
        x_second, y_second = select(there, x, x_second), select(there, y, y_second)
        rank = rank + flight.block_valid[FEATURE_BLOCKS + i]

    swaps = settings.fault_swaps > 0
    rank = zero
    for i in range(settings.feature_count):
        valid = struck & (flight.block_valid[FEATURE_BLOCKS + i] > 0.0)
        here, there = valid & (rank == first) & swaps, valid & (rank == second)
        x, y = flight.pixels[i, 0], flight.pixels[i, 1]
        x, y = select(here, x_second, x), select(here, y_second, y)
        flight.pixels[i, 0] = select(there, x_first, x)
        flight.pixels[i, 1] = select(there, y_first, y)
        mistaken = select(here | there, 1.0, 0.0)
        flight.feature_mistaken[i] = select(mask, mistaken, flight.feature_mistaken[i])
        rank = rank + flight.block_valid[FEATURE_BLOCKS + i]


@kernel
def corrupt_features(flight, settings, mask):
    """Hide features of the image just taken and confuse some with others, in the lanes `mask`.

    A feature hidden now counts as not visible in the whole step.
    """
    if settings.fault_on[_OCCLUSION]:
        covered = mask & (flight.fault_active[_OCCLUSION] > 0.0)
        for i in range(settings.feature_count):
            hidden, block = covered & (flight.feature_hidden[i] > 0.0), FEATURE_BLOCKS + i
            flight.block_valid[block] = select(hidden, 0.0, flight.block_valid[block])
            flight.block_fresh[block] = select(hidden, 0.0, flight.block_fresh[block])
    if settings.fault_on[_ASSOCIATIONS]:
        _mistake_features(flight, settings, mask)


# ---- stages ----------------------------------------------------------------------------------


@stage
def begin_faults_stage(flight, world, model, settings, work, stages, flag):
    """Draw the times of the faults of a new episode."""
    flying = lanes_of(flight)
    mask = lanes_of(work).mask > 0.0
    begin_faults(flying, lanes_of(world), settings, stream_of(flying), mask)


@stage
def advance_faults_stage(flight, world, model, settings, work, stages, flag):
    """Begin and end faults at the present instant."""
    advance_faults(lanes_of(flight), lanes_of(world), settings, lanes_of(work).mask > 0.0)


@stage
def meet_rotors_stage(flight, world, model, settings, work, stages, flag):
    """Apply the rotors' faults of the present flights."""
    meet_rotors(lanes_of(flight), lanes_of(world), settings)


@stage
def saturate_imu_stage(flight, world, model, settings, work, stages, flag):
    """Limit the IMU's samples to its ranges."""
    saturate_imu(lanes_of(flight), settings, lanes_of(work).mask > 0.0)


@stage
def corrupt_gnss_stage(flight, world, model, settings, work, stages, flag):
    """Corrupt the GNSS position that has just been measured."""
    corrupt_gnss(lanes_of(flight), lanes_of(world), settings, lanes_of(work).mask > 0.0)


@stage
def corrupt_features_stage(flight, world, model, settings, work, stages, flag):
    """Corrupt the image that has just been taken."""
    corrupt_features(lanes_of(flight), settings, lanes_of(work).mask > 0.0)

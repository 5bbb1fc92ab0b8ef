"""Faults of sensors and rotors: their times, and their effects on rotors and biases.

Effects on a measurement are in the file of its sensor.

A fault of kind k is active at the ticks from `fault_from[k]` until before `fault_until[k]`. Both
are drawn when an episode begins, and again when a fault that occurs at a rate has ended; its size
and direction are drawn when it begins. Every draw has its own number within its instant, so that a
fault changes no other draw. All branches are on settings, except `any_of` to skip idle work.
"""

import math

import numpy as np

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.numbers.blocks import reset
from quad_gym.kernels.numbers.elementary import approached, log, sin_cos
from quad_gym.kernels.numbers.lanes import any_of, logical_not, select, zero_like
from quad_gym.kernels.numbers.linalg import dot, keep, load3, load44, store
from quad_gym.kernels.numbers.random import stream_of, uniform_pair
from quad_gym.records import (
    DRAW_FAULTS,
    DRAW_HIDDEN,
    DRAWS_OF_FAULT,
    FAULT_KINDS,
    NEVER,
    FaultKind,
)

_FIRST, _FIRST_HIDDEN = np.uint64(DRAW_FAULTS), np.uint64(DRAW_HIDDEN)


@kernel
def draw_of(k, number):
    """One of the draws of faults of kind k."""
    return _FIRST + np.uint64(DRAWS_OF_FAULT * k + number)


@kernel
def _draw_when(flight, settings, stream, k, mask):
    """Draw when fault k begins, from the present instant on, and when it ends, where `mask`."""
    chance, u = uniform_pair(stream, draw_of(k, 0))
    length, _ = uniform_pair(stream, draw_of(k, 1))
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
def any_direction(stream, draw):
    """A unit vector, uniform on the sphere."""
    height, turn = uniform_pair(stream, draw)
    z = 2.0 * height - 1.0
    s, c = sin_cos(6.28318530717958647692 * turn - 3.14159265358979323846)
    level = math.sqrt((1.0 - z) * (1.0 + z))
    return (level * c, level * s, z)


@kernel
def _draw_what(flight, settings, stream, k, mask):
    """Draw size and direction of fault k, where `mask`."""
    _, u = uniform_pair(stream, draw_of(k, 1))
    size = settings.fault_size[k, 0] + settings.fault_size[k, 1] * u
    given, drawn = load3(settings.fault_direction[k]), any_direction(stream, draw_of(k, 2))
    direction = select(dot(given, given) + zero_like(size) > 0.0, given, drawn)
    pick, _ = uniform_pair(stream, draw_of(k, 3))
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

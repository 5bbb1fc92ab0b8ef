"""Late measurements in transit: GNSS fixes and images wait in a flight's record until they arrive.

With each waits its time stamp: what the IMU had summed up when it was taken. What becomes of those
that arrive is in `late.py`. Aiding sensors do the same by themselves (`measurements/aid.py`).
"""

import numpy as np

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.filter.preintegration import add_increment, begin_increments
from quad_gym.kernels.maths.linalg import keep3, keep33, load3, load33, store3
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.kernels.simd.lanes import any_of, select
from quad_gym.records import DELAY_SLOTS

_GNSS, _CAMERA = 0, 1


@kernel
def begin_without_waiting(flight, mask):
    """Begin an episode with nothing in transit, where `mask`."""
    begin_increments(flight, mask)
    for sensor in range(2):
        for slot in range(DELAY_SLOTS):
            tick = flight.stamp_tick[sensor, slot]
            flight.stamp_tick[sensor, slot] = select(mask, np.nan, tick)


@kernel
def set_aside(flight, work, settings):
    """Keep what has arrived so far, before something new is measured."""
    store3(work.kept_position, load3(flight.gnss_position))
    store3(work.kept_baseline, load3(flight.gnss_baseline))
    store3(work.kept_velocity, load3(flight.gnss_velocity))
    for i in range(settings.feature_count):
        work.kept_pixels[i, 0], work.kept_pixels[i, 1] = flight.pixels[i, 0], flight.pixels[i, 1]


@kernel
def _stamp(flight, sensor, taken):
    """Move the stamps of a sensor on by a place and stamp the first with now, where `taken`."""
    tick, turn, rates = flight.stamp_tick, flight.stamp_turn, flight.stamp_rates
    velocity, position = flight.stamp_velocity, flight.stamp_position
    gain = flight.stamp_bias_gain
    for slot in range(DELAY_SLOTS - 1, 0, -1):
        tick[sensor, slot] = select(taken, tick[sensor, slot - 1], tick[sensor, slot])
        keep33(turn[sensor, slot], taken, load33(turn[sensor, slot - 1]))
        keep33(gain[sensor, slot], taken, load33(gain[sensor, slot - 1]))
        keep3(velocity[sensor, slot], taken, load3(velocity[sensor, slot - 1]))
        keep3(position[sensor, slot], taken, load3(position[sensor, slot - 1]))
        keep3(rates[sensor, slot], taken, load3(rates[sensor, slot - 1]))
    tick[sensor, 0] = select(taken, flight.tick, tick[sensor, 0])
    keep33(turn[sensor, 0], taken, load33(flight.imu_turn))
    keep33(gain[sensor, 0], taken, load33(flight.imu_bias_gain))
    keep3(velocity[sensor, 0], taken, load3(flight.imu_velocity))
    keep3(position[sensor, 0], taken, load3(flight.imu_position))
    keep3(rates[sensor, 0], taken, load3(flight.w_meas))


@kernel
def _exchange_gnss(flight, work, settings, mask, starting):
    """Let GNSS measurements of now wait, and those of `gnss_delay` ticks ago arrive."""
    wait = flight.late_valid
    zero = 0.0 * flight.tick
    p, b, v = zero, zero, zero
    for slot in range(DELAY_SLOTS):
        here = mask & (flight.stamp_tick[_GNSS, slot] == flight.tick - settings.gnss_delay)
        keep3(work.kept_position, here, load3(flight.late_position[slot]))
        keep3(work.kept_baseline, here, load3(flight.late_baseline[slot]))
        keep3(work.kept_velocity, here, load3(flight.late_velocity[slot]))
        p = select(here, wait[slot, 0], p)
        b = select(here, wait[slot, 1], b)
        v = select(here, wait[slot, 2], v)
    flags = (flight.position_valid, flight.baseline_valid, flight.velocity_valid)
    taken = mask & (flags[0] + flags[1] + flags[2] > 0.0)
    if any_of(taken):
        _stamp(flight, _GNSS, taken)
        for slot in range(DELAY_SLOTS - 1, 0, -1):
            keep3(flight.late_position[slot], taken, load3(flight.late_position[slot - 1]))
            keep3(flight.late_baseline[slot], taken, load3(flight.late_baseline[slot - 1]))
            keep3(flight.late_velocity[slot], taken, load3(flight.late_velocity[slot - 1]))
            keep3(wait[slot], taken, load3(wait[slot - 1]))
        keep3(flight.late_position[0], taken, load3(flight.gnss_position))
        keep3(flight.late_baseline[0], taken, load3(flight.gnss_baseline))
        keep3(flight.late_velocity[0], taken, load3(flight.gnss_velocity))
        keep3(wait[0], taken, flags)
    flight.position_valid = select(mask, p, flight.position_valid)
    flight.baseline_valid = select(mask, b, flight.baseline_valid)
    flight.velocity_valid = select(mask, v, flight.velocity_valid)
    if not starting:  # a first fix has started the filter
        store3(flight.gnss_position, load3(work.kept_position))
        store3(flight.gnss_baseline, load3(work.kept_baseline))
        store3(flight.gnss_velocity, load3(work.kept_velocity))
        flight.position_fresh = select(p > 0.0, 1.0, flight.position_fresh)
        flight.baseline_fresh = select(b > 0.0, 1.0, flight.baseline_fresh)


@kernel
def _keep_image(pixels, seen, slot, mask, new_pixels, new_seen, count):
    for i in range(count):
        for axis in range(2):
            pixels[slot, i, axis] = select(mask, new_pixels[i, axis], pixels[slot, i, axis])
        seen[slot, i] = select(mask, new_seen[i], seen[slot, i])


@kernel
def _exchange_camera(flight, work, settings, mask):
    """Let the image of now wait, and the one of `camera_delay` ticks ago arrive."""
    pixels, seen, count = flight.late_pixels, flight.late_seen, settings.feature_count
    arrived = work.kept_seen
    for i in range(count):
        arrived[i] = 0.0 * flight.tick
    for slot in range(DELAY_SLOTS):
        here = mask & (flight.stamp_tick[_CAMERA, slot] == flight.tick - settings.camera_delay)
        if any_of(here):
            for i in range(count):
                arrived[i] = select(here, seen[slot, i], arrived[i])
                for axis in range(2):
                    kept = work.kept_pixels[i, axis]
                    work.kept_pixels[i, axis] = select(here, pixels[slot, i, axis], kept)
    features = 0.0 * flight.tick
    for i in range(count):
        features = features + flight.feature_valid[i]
    taken = mask & (features > 0.0)
    if any_of(taken):
        _stamp(flight, _CAMERA, taken)
        for slot in range(DELAY_SLOTS - 1, 0, -1):
            _keep_image(pixels, seen, slot, taken, pixels[slot - 1], seen[slot - 1], count)
        _keep_image(pixels, seen, 0, taken, flight.pixels, flight.feature_valid, count)
    for i in range(count):
        flight.feature_valid[i] = select(mask, arrived[i], flight.feature_valid[i])
        fresh = mask & (arrived[i] > 0.0)
        flight.feature_fresh[i] = select(fresh, 1.0, flight.feature_fresh[i])
        for axis in range(2):
            flight.pixels[i, axis] = select(mask, work.kept_pixels[i, axis], flight.pixels[i, axis])


@kernel
def exchange(flight, work, settings, mask, starting):
    """Let what late sensors measure now wait, and what they measured before arrive, where `mask`.

    The measurements and flags of validity in the record become those that arrive.
    """
    if settings.gnss_delay > 0:
        _exchange_gnss(flight, work, settings, mask, starting)
    if settings.camera_delay > 0:
        _exchange_camera(flight, work, settings, mask)


# ---- stages ----------------------------------------------------------------------------------


@stage
def begin_late_stage(flight, world, model, settings, work, stages, flag):
    """Begin an episode with no measurement in transit."""
    begin_without_waiting(lanes_of(flight), lanes_of(work).mask > 0.0)


@stage
def increment_stage(flight, world, model, settings, work, stages, flag):
    """Add the tick's IMU sample to the sums that late measurements go back by."""
    add_increment(lanes_of(flight), lanes_of(model), settings.form)


@stage
def set_aside_stage(flight, world, model, settings, work, stages, flag):
    """Keep what has arrived so far, before something new is measured."""
    set_aside(lanes_of(flight), lanes_of(work), settings)


@stage
def exchange_stage(flight, world, model, settings, work, stages, flag):
    """Let new measurements wait and old ones arrive; `flag`: whether an episode begins."""
    scratch = lanes_of(work)
    exchange(lanes_of(flight), scratch, settings, scratch.mask > 0.0, flag > 0)

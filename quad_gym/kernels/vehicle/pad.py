"""The launch pad: it carries a vehicle that starts on the ground until its thrust lifts it."""

from quad_gym.kernels.compiling import stage
from quad_gym.kernels.maths.linalg import keep, load3, load4, store
from quad_gym.kernels.maths.rotation import quaternion_to_dcm
from quad_gym.kernels.simd.lanes import any_of, select
from quad_gym.kernels.vehicle.dynamics import accelerations, load_start, load_state


@stage
def keep_start_stage(flight, world, model, settings, work, stages, flag):
    """Keep the true state at the start of a tick, for contact and for IMU samples that average."""
    if settings.grounded or settings.imu_averages or any_of(flight.on_pad > 0.0):
        r, v, q, w, W = load_state(flight)
        store(work.start, r)
        store(work.start[3:], v)
        store(work.start[6:], q)
        store(work.start[10:], w)
        store(work.start[13:], W)


@stage
def rest_on_pad_stage(flight, world, model, settings, work, stages, flag):
    """Undo the tick's motion of vehicles on the pad, and release those that lift off.

    On the pad only the rotors move: its normal force balances weight less thrust, and friction
    holds position and attitude. It can push, not pull: a vehicle that the other forces accelerate
    upward has lifted off. The pad does no work, as nothing moves on it.
    """
    on_pad = flight.on_pad > 0.0
    if any_of(on_pad):
        r, v, q, w, _ = load_start(work)
        keep(flight.r, on_pad, r)
        keep(flight.v, on_pad, v)
        keep(flight.w, on_pad, w)
        keep(flight.q, on_pad, q)
        d_I = load3(flight.disturbance) + load3(flight.air_force)
        W, v_air_I = load4(flight.rotor_speeds), v - load3(flight.wind)
        a_I, _ = accelerations(quaternion_to_dcm(q), v_air_I, w, W, d_I, world)
        flight.on_pad = select(on_pad & (a_I[2] <= 0.0), 1.0, 0.0)

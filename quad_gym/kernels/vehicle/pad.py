"""The launch pad: it carries a vehicle that starts on the ground until its thrust lifts it."""

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.maths.linalg import keep3, load3, load4
from quad_gym.kernels.maths.rotation import quaternion_to_dcm
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.kernels.simd.lanes import any_of, select
from quad_gym.kernels.vehicle.dynamics import accelerations, load_start


@kernel
def rest_on_pad(flight, p, start):
    """Undo the tick's motion of vehicles on the pad, and release those that lift off.

    On the pad only the rotors move: its normal force balances weight less thrust, and friction
    holds position and attitude. It can push, not pull: a vehicle that the other forces accelerate
    upward has lifted off. The pad does no work, as nothing moves on it.

    Args:
        flight: Record, after the tick's motion.
        p: True parameters.
        start: The true state at the tick's start, from `load_start`.
    """
    on_pad = flight.on_pad > 0.0
    r_I, v_I, q, w_B, _ = start
    keep3(flight.r, on_pad, r_I)
    keep3(flight.v, on_pad, v_I)
    keep3(flight.w, on_pad, w_B)
    for i in range(4):
        flight.q[i] = select(on_pad, q[i], flight.q[i])
    v_air_I = v_I - load3(flight.wind)
    d_I = load3(flight.disturbance) + load3(flight.air_force)
    W = load4(flight.rotor_speeds)
    a_I, _ = accelerations(quaternion_to_dcm(q), v_air_I, w_B, W, d_I, p)
    flight.on_pad = select(on_pad & (a_I[2] <= 0.0), 1.0, 0.0)


@stage
def keep_start_stage(flight, world, model, settings, work, stages, flag):
    """Keep the true state at the start of a tick, for contact and for IMU samples that average."""
    flying, start = lanes_of(flight), lanes_of(work).start
    if settings.grounded or settings.imu_averages or any_of(flying.on_pad > 0.0):
        start[0], start[1], start[2] = load3(flying.r)
        start[3], start[4], start[5] = load3(flying.v)
        start[6], start[7], start[8], start[9] = load4(flying.q)
        start[10], start[11], start[12] = load3(flying.w)
        start[13], start[14], start[15], start[16] = load4(flying.rotor_speeds)


@stage
def rest_on_pad_stage(flight, world, model, settings, work, stages, flag):
    """Keep the vehicles on the pad that have not lifted off."""
    flying = lanes_of(flight)
    if any_of(flying.on_pad > 0.0):
        rest_on_pad(flying, lanes_of(world), load_start(lanes_of(work)))

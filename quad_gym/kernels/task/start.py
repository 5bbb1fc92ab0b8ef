"""True state at the start of an episode, drawn around the start of the reference."""

from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.maths.elementary import atan2, clip, maximum
from quad_gym.kernels.maths.linalg import dot, keep, load3, vector
from quad_gym.kernels.maths.random import normal_pair, six_normals, uniform_pair
from quad_gym.kernels.maths.rotation import dcm_to_quaternion, euler_to_dcm
from quad_gym.kernels.simd.blocks import reset
from quad_gym.kernels.simd.lanes import select, zero_like
from quad_gym.kernels.task.reference import evaluate_reference
from quad_gym.records import (
    COLUMNS,
    DRAW_FIRST_BIASES,
    DRAW_GROUND,
    DRAW_MOTION,
    DRAW_START,
    MAX_START_RATE,
    MAX_START_VELOCITY,
    Start,
    TaskKind,
)

START_POSITION_SIGMA, START_YAW_SIGMA, START_TILT_SIGMA, START_VELOCITY_SIGMA = 0.3, 0.2, 0.03, 0.03
"""Standard deviations of a hovering start: [m], [rad], [rad], [m/s]."""
GROUND_SHARE = 0.5  #: share of mixed starts that are on the ground
_POSITION, _VELOCITY = COLUMNS["start_position_I"].start, COLUMNS["start_velocity_I"].start
_RATES, _YAW = COLUMNS["start_body_rates"].start, COLUMNS["start_yaw"].start
_ROLL, _PITCH = COLUMNS["start_roll"].start, COLUMNS["start_pitch"].start


@kernel
def _signed_pair(stream, draw):
    """Return two independent numbers, uniform on [-1, 1)."""
    a, b = uniform_pair(stream, draw)
    return 2.0 * a - 1.0, 2.0 * b - 1.0


@kernel
def _given_or(given, drawn):
    """Return a start value from the caller, or the drawn one where that is NaN."""
    return select(given == given, given, drawn)


@kernel
def draw_start(flight, p, model, settings, work, stream, mask):
    """Set the true state at the start of an episode, where `mask`; mark lanes on the ground."""
    (x, y, z), _, _, x_ref = evaluate_reference(flight, zero_like(flight.tick), settings.harmonics)
    yaw = atan2(x_ref[1], x_ref[0])
    zero = zero_like(yaw)
    v_I = (zero, zero, zero)
    roll, pitch, rotor_speed = zero, zero, zero
    on_ground = mask
    if settings.start != Start.GROUND:
        n_r, n_v = six_normals(stream, DRAW_START)
        n_roll, n_pitch = normal_pair(stream, DRAW_START + 3)
        n_yaw, _ = normal_pair(stream, DRAW_START + 4)
        u_ground, _ = uniform_pair(stream, DRAW_GROUND)
        share = GROUND_SHARE if settings.start == Start.MIXED else 0.0
        on_ground = u_ground < share
        if settings.task == TaskKind.WAYPOINTS:
            x, y, z = load3(flight.gates[0])
            x, y, z = 0.25 * x, 0.25 * y, zero + settings.height
        r_I = (
            x + START_POSITION_SIGMA * clip(n_r[0], -3.0, 3.0),
            y + START_POSITION_SIGMA * clip(n_r[1], -3.0, 3.0),
            maximum(z + START_POSITION_SIGMA * clip(n_r[2], -3.0, 3.0), 0.1),
        )
        x, y = select(on_ground, x, r_I[0]), select(on_ground, y, r_I[1])
        z = r_I[2]
        hovering = select(on_ground, 0.0, 1.0)
        v_I = hovering * START_VELOCITY_SIGMA * n_v
        roll = hovering * START_TILT_SIGMA * n_roll
        pitch = hovering * START_TILT_SIGMA * n_pitch
        yaw = yaw + hovering * START_YAW_SIGMA * n_yaw
        rotor_speed = hovering * model.motor_speed_per_volt * model.hover_voltage
    w_B = (zero, zero, zero)
    if settings.start == Start.MOVING:
        a, b = _signed_pair(stream, DRAW_MOTION)
        c, d = _signed_pair(stream, DRAW_MOTION + 1)
        e, f = _signed_pair(stream, DRAW_MOTION + 2)
        v_I = MAX_START_VELOCITY * (a, b, c) + v_I
        w_B = MAX_START_RATE * (d, e, f)
    z = select(on_ground, 0.0, z)
    if settings.randomized:
        drawn = flight.drawn
        x, y, z = vector(x, y, z) + load3(drawn[_POSITION:])
        v_I, w_B = v_I + load3(drawn[_VELOCITY:]), w_B + load3(drawn[_RATES:])
        roll, pitch, yaw = roll + drawn[_ROLL], pitch + drawn[_PITCH], yaw + drawn[_YAW]
    given = flight.start_given
    x, y, z = _given_or(given[0], x), _given_or(given[1], y), _given_or(given[2], z)
    v_I = (_given_or(given[3], v_I[0]), _given_or(given[4], v_I[1]), _given_or(given[5], v_I[2]))
    yaw = _given_or(given[6], yaw)
    still = dot(v_I, v_I) + dot(w_B, w_B) <= 0.0
    work.on_ground = select(on_ground, 1.0, 0.0)
    on_pad = select(on_ground & still, 1.0 * settings.pad, 0.0)
    flight.on_pad = select(mask, on_pad, flight.on_pad)
    keep(flight.r, mask, (x, y, z))
    keep(flight.v, mask, v_I)
    keep(flight.w, mask, w_B)
    R_BI = euler_to_dcm((roll, pitch, zero)) @ euler_to_dcm((zero, zero, yaw))
    keep(flight.q, mask, dcm_to_quaternion(R_BI))
    keep(flight.rotor_speeds, mask, (rotor_speed, rotor_speed, rotor_speed, rotor_speed))
    reset(flight, mask, 0.0, "disturbance voltages action last_action")

    n_a, n_g = six_normals(stream, DRAW_FIRST_BIASES)
    keep(flight.b_a, mask, p.accel_bias_sigma * n_a)
    keep(flight.b_g, mask, p.gyro_bias_sigma * n_g)

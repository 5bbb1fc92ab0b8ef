"""Errors, reward and endings of a step, from the true state alone."""

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.maths.elementary import exp, is_finite
from quad_gym.kernels.maths.linalg import dot, keep3, load3, load4, norm, sub
from quad_gym.kernels.maths.rotation import quaternion_to_dcm
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.kernels.simd.lanes import logical_not, select
from quad_gym.kernels.task.reference import evaluate_reference
from quad_gym.records import MAX_GATES, Ending, Task

NEAR_WEIGHT, FINE_WEIGHT, HEADING_WEIGHT, ACTION_COST, RATE_COST = 1.0, 0.5, 0.1, 0.02, 0.002
"""Reward a second: exp(-2e), exp(-20e), alignment, |change of action|^2, |body rates|^2."""
PROGRESS_WEIGHT, GATE_BONUS = 1.0, 1.0
"""Reward of a course: per meter toward the next gate, and per gate passed."""

_FILTER_DIVERGED = float(Ending.FILTER_DIVERGED)
_TIME_LIMIT, _FILTER_FAILED = float(Ending.TIME_LIMIT), float(Ending.FILTER_FAILED)
_ON_THE_GROUND, _TIPPED_OVER = float(Ending.BELOW_MIN_HEIGHT), float(Ending.TIPPED_OVER)
_OUT_OF_BOUNDS, _LAST_GATE = float(Ending.OUT_OF_BOUNDS), float(Ending.LAST_GATE)


@kernel
def _pass_gate(flight, settings, active):
    """Move on to the next gate where the present one is reached; return where, and progress."""
    target = load3(flight.ref_center)
    distance = norm(sub(target, load3(flight.r)))
    progress = flight.position_error - distance
    passed = active & (distance < settings.gate_radius)
    flight.gate_next = select(passed, flight.gate_next + 1.0, flight.gate_next)
    x, y, z = target
    for k in range(1, MAX_GATES):
        gate = flight.gates[k]
        here = passed & (flight.gate_next == 1.0 * k) & (k < settings.gate_count)
        x, y, z = select(here, gate[0], x), select(here, gate[1], y), select(here, gate[2], z)
    keep3(flight.ref_center, passed, (x, y, z))
    return passed, progress


@kernel
def judge(flight, p, settings, active):
    """Set reward, errors and endings of the step that has just been flown, where `active`.

    Args:
        flight: Record.
        p: Parameters, for the tick.
        settings: What the batch does.
        active: Lanes that flew a step, not those that are about to begin an episode.
    """
    seconds = p.dt * settings.ticks_per_step
    R_BI, w_B = quaternion_to_dcm(load4(flight.q)), load3(flight.w)
    flight.step = select(active, flight.step + 1.0, flight.step)

    change = 0.0 * seconds
    for i in range(4):
        gap = flight.action[i] - flight.last_action[i]
        change = change + gap * gap
    costs = ACTION_COST * change + RATE_COST * dot(w_B, w_B)
    finished = active & (change < 0.0)  # nowhere, as yet
    if settings.task == Task.WAYPOINTS:
        passed, progress = _pass_gate(flight, settings, active)
        _, _, _, x_ref = evaluate_reference(flight, flight.tick * p.dt, settings.harmonics)
        reward = PROGRESS_WEIGHT * progress + select(passed, GATE_BONUS, 0.0)
        reward = reward + seconds * (HEADING_WEIGHT * dot(R_BI[0], x_ref) - costs)
        finished = active & (flight.gate_next >= settings.gate_count)
        error = norm(sub(load3(flight.ref_center), load3(flight.r)))
    else:
        r_ref, _, _, x_ref = evaluate_reference(flight, flight.tick * p.dt, settings.harmonics)
        error = norm(sub(r_ref, load3(flight.r)))
        closeness = NEAR_WEIGHT * exp(-2.0 * error) + FINE_WEIGHT * exp(-20.0 * error)
        reward = seconds * (closeness + HEADING_WEIGHT * dot(R_BI[0], x_ref) - costs)

    sound = is_finite(error + dot(w_B, w_B) + R_BI[2][2])
    lost = (error > settings.out_of_bounds) | logical_not(sound)
    tipped = R_BI[2][2] < settings.least_up
    grounded = flight.r[2] < settings.min_height
    terminated = active & (finished | lost | tipped | grounded)
    failed = logical_not(flight.filter_status == 0)
    over = (settings.max_steps > 0.0) & (flight.step >= settings.max_steps)
    ended = (settings.truncate_when_diverged > 0.0) & (flight.diverged > 0.0)
    truncated = active & (over | failed | ended)

    ending = select(over, _TIME_LIMIT, 0.0)
    ending = select(ended, _FILTER_DIVERGED, ending)
    ending = select(failed, _FILTER_FAILED, ending)
    ending = select(grounded, _ON_THE_GROUND, ending)
    ending = select(tipped, _TIPPED_OVER, ending)
    ending = select(lost, _OUT_OF_BOUNDS, ending)
    ending = select(finished, _LAST_GATE, ending)
    error = select(sound, error, settings.out_of_bounds)
    reward = select(sound, settings.reward_scale * reward, 0.0)
    flight.position_error = select(active, error, flight.position_error)
    flight.reward = select(active, reward, 0.0)
    flight.terminated = select(terminated, 1.0, 0.0)
    flight.truncated = select(truncated, 1.0, 0.0)
    flight.ending = select(active, ending, 0.0)
    flight.episode_return = select(active, flight.episode_return + reward, flight.episode_return)
    flight.episode_error = select(active, flight.episode_error + error, flight.episode_error)


@stage
def judge_stage(flight, world, model, settings, work, stages, flag):
    """Set reward, errors and endings of a step."""
    judge(lanes_of(flight), lanes_of(model), settings, lanes_of(work).mask > 0.0)

"""Errors, reward and endings of a step, computed from the true state."""

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.numbers.elementary import exp, is_finite
from quad_gym.kernels.numbers.lanes import logical_not, no_lane, select, zero_like
from quad_gym.kernels.numbers.linalg import dot, keep, load3, load4, norm
from quad_gym.kernels.numbers.rotation import quaternion_to_dcm
from quad_gym.kernels.task.reference import evaluate_reference
from quad_gym.records import MAX_GATES, Ending, RewardTerm, TaskKind

_TERMS = len(RewardTerm)


@kernel
def _pass_gate(flight, settings, active):
    """Advance to the next gate where the present one is reached; return (passed, progress)."""
    target = load3(flight.ref_center)
    distance = norm(target - load3(flight.r))
    progress = flight.position_error - distance
    passed = active & (distance < settings.gate_radius)
    flight.gate_next = select(passed, flight.gate_next + 1.0, flight.gate_next)
    for k in range(1, MAX_GATES):
        here = passed & (flight.gate_next == 1.0 * k) & (k < settings.gate_count)
        target = select(here, load3(flight.gates[k]), target)
    keep(flight.ref_center, passed, target)
    return passed, progress


@kernel
def _reward(flight, p, settings, work, active, R_BI, w_B):
    """Return (reward, position error, last gate passed, finite) of a step.

    The reward is the sum of its terms, in the order of `RewardTerm`. They remain in `work`.
    """
    seconds, weight, term = p.dt * settings.ticks_per_step, settings.reward_weight, work.reward_term
    change, spin = zero_like(seconds), dot(w_B, w_B)
    for i in range(4):
        gap = flight.action[i] - flight.last_action[i]
        change = change + gap * gap
    scale = settings.reward_scale
    finished = no_lane(spin)
    if settings.task == TaskKind.WAYPOINTS:
        passed, progress = _pass_gate(flight, settings, active)
        _, _, _, x_ref = evaluate_reference(flight, flight.tick * p.dt, settings.harmonics)
        facing, bonus = dot(R_BI[0], x_ref), select(passed, weight[RewardTerm.GATE_PASSED], 0.0)
        finished = active & (flight.gate_next >= settings.gate_count)
        error = norm(load3(flight.ref_center) - load3(flight.r))
        term[RewardTerm.PROGRESS] = scale * weight[RewardTerm.PROGRESS] * progress
        term[RewardTerm.GATE_PASSED] = scale * bonus
    else:
        r_ref, _, _, x_ref = evaluate_reference(flight, flight.tick * p.dt, settings.harmonics)
        facing, error = dot(R_BI[0], x_ref), norm(r_ref - load3(flight.r))
        near, fine = exp(-settings.near_decay * error), exp(-settings.fine_decay * error)
        term[RewardTerm.NEAR] = scale * weight[RewardTerm.NEAR] * seconds * near
        term[RewardTerm.FINE] = scale * weight[RewardTerm.FINE] * seconds * fine
    term[RewardTerm.HEADING] = scale * weight[RewardTerm.HEADING] * seconds * facing
    term[RewardTerm.ACTION_RATE] = -scale * weight[RewardTerm.ACTION_RATE] * seconds * change
    term[RewardTerm.BODY_RATES] = -scale * weight[RewardTerm.BODY_RATES] * seconds * spin
    sound = is_finite(error + spin + R_BI[2][2])
    reward = zero_like(seconds)
    for k in range(_TERMS):
        term[k] = select(active & sound, term[k], 0.0)
        reward = reward + term[k]
    return reward, error, finished, sound


@stage
def judge_stage(flight, world, model, settings, work, stages, flag):
    """Set reward, errors and endings of the step that has just been flown, where `work.mask`.

    Other lanes are about to begin an episode.
    """
    active = work.mask > 0.0
    R_BI, w_B = quaternion_to_dcm(load4(flight.q)), load3(flight.w)
    flight.step = select(active, flight.step + 1.0, flight.step)
    reward, error, finished, sound = _reward(flight, model, settings, work, active, R_BI, w_B)
    lost = (error > settings.out_of_bounds) | logical_not(sound)
    tipped = R_BI[2][2] < settings.min_up
    grounded = flight.r[2] < settings.min_height
    terminated = active & (finished | lost | tipped | grounded)
    failed = logical_not(flight.filter_status == 0)
    over = (settings.max_steps > 0.0) & (flight.step >= settings.max_steps)
    ended = (settings.truncate_when_diverged > 0.0) & (flight.diverged > 0.0)
    truncated = active & (over | failed | ended)

    ending = select(over, Ending.TIME_LIMIT, 0.0)
    ending = select(ended, Ending.FILTER_DIVERGED, ending)
    ending = select(failed, Ending.FILTER_FAILED, ending)
    ending = select(grounded, Ending.BELOW_MIN_HEIGHT, ending)
    ending = select(tipped, Ending.TIPPED_OVER, ending)
    ending = select(lost, Ending.OUT_OF_BOUNDS, ending)
    ending = select(finished, Ending.LAST_GATE, ending)
    error = select(sound, error, settings.out_of_bounds)
    flight.position_error = select(active, error, flight.position_error)
    flight.reward = select(active, reward, 0.0)
    flight.terminated = select(terminated, 1.0, 0.0)
    flight.truncated = select(truncated, 1.0, 0.0)
    flight.ending = select(active, ending, 0.0)
    flight.episode_return = select(active, flight.episode_return + reward, flight.episode_return)
    flight.episode_error = select(active, flight.episode_error + error, flight.episode_error)

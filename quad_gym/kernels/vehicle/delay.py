"""Actions that reach the vehicle some time after they are commanded.

Transport from a computer to the inner loops takes time, in which the vehicle still carries out
earlier commands. The inner loops themselves run on board, without delay.
"""

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.maths.linalg import load4, store4
from quad_gym.kernels.simd.blocks import lanes_of
from quad_gym.kernels.simd.lanes import select


@kernel
def forget_actions(flight, settings, mask):
    """Begin an episode as if zero, which is hover, had been commanded before it, where `mask`."""
    for k in range(settings.action_delays + 1):
        for i in range(4):
            past = flight.past_actions[k, i]
            flight.past_actions[k, i] = select(mask, 0.0, past)


@kernel
def delay_action(flight, p, settings):
    """Set the action of the coming tick: the one commanded `action_delay` steps ago.

    The delay is in control steps, and is rounded to whole ticks: with T ticks per step, tick j of a
    step carries out the action of k steps ago, where k is `delay T - j` ticks in steps, rounded up.

    Args:
        flight: Record; reads the present action, sets the delayed one.
        p: True parameters.
        settings: Ticks per step and the largest delay.
    """
    T, past = settings.ticks_per_step, flight.past_actions
    since = flight.tick - T * flight.step
    new = since == 0.0
    for k in range(settings.action_delays, 0, -1):
        for i in range(4):
            past[k, i] = select(new, past[k - 1, i], past[k, i])
    for i in range(4):
        past[0, i] = flight.action[i]
    chosen = load4(past[0])
    for k in range(settings.action_delays):
        late = p.action_delay * T - 0.5 >= since + 1.0 * k * T
        older = load4(past[k + 1])
        chosen = (
            select(late, older[0], chosen[0]),
            select(late, older[1], chosen[1]),
            select(late, older[2], chosen[2]),
            select(late, older[3], chosen[3]),
        )
    store4(flight.delayed_action, chosen)


@stage
def delay_action_stage(flight, world, model, settings, work, stages, flag):
    """Set the action of the coming tick; `flag`: whether an episode begins instead."""
    flying = lanes_of(flight)
    if flag > 0:
        forget_actions(flying, settings, lanes_of(work).mask > 0.0)
    else:
        delay_action(flying, lanes_of(world), settings)

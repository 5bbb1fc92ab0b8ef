"""Actions that reach the vehicle some time after they are commanded.

Transport from a computer to the inner loops takes time, in which the vehicle still carries out
earlier commands. The inner loops themselves run on board, without delay.
"""

from quad_gym.kernels.compiling import kernel, stage
from quad_gym.kernels.maths.linalg import keep, load4, store
from quad_gym.kernels.simd.lanes import select


@kernel
def _forget_actions(flight, settings, mask):
    """Begin an episode as if zero, which is hover, had been commanded before it, where `mask`."""
    for k in range(settings.action_delays + 1):
        keep(flight.past_actions[k], mask, (0.0, 0.0, 0.0, 0.0))


@kernel
def _delay_action(flight, p, settings):
    """Set the action of the coming tick: the one commanded `action_delay` steps ago.

    The delay is in control steps, and is rounded to whole ticks: with T ticks per step, tick j of a
    step carries out the action of k steps ago, where k is `delay T - j` ticks in steps, rounded up.
    """
    T, past = settings.ticks_per_step, flight.past_actions
    since = flight.tick - T * flight.step
    for k in range(settings.action_delays, 0, -1):
        keep(past[k], since == 0.0, load4(past[k - 1]))
    chosen = load4(flight.action)
    store(past[0], chosen)
    for k in range(settings.action_delays):
        late = p.action_delay * T - 0.5 >= since + 1.0 * k * T
        chosen = select(late, load4(past[k + 1]), chosen)
    store(flight.delayed_action, chosen)


@stage
def delay_action_stage(flight, world, model, settings, work, stages, flag):
    """Set the action of the coming tick; `flag`: 1 where an episode begins instead."""
    if flag > 0:
        _forget_actions(flight, settings, work.mask > 0.0)
    else:
        _delay_action(flight, world, settings)

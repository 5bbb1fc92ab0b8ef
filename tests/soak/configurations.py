"""Random configurations: a vector environment against single environments, bit by bit."""

import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from quad_gym.envs.single import QuadEnv
from quad_gym.envs.vector import QuadVectorEnv
from tests.contract.comparing import assert_same_results
from tests.soak.drawing import MODES, actions, configuration, log_uniform, pick

ABOUT = "a vector environment with single ones, over random options, faults and actions"


def refusal(make):
    """Return the result of a function and an empty text, or None and the text of its error."""
    try:
        return make(), ""
    except ValueError as error:
        return None, str(error)


def run(rng):
    """Fly a random configuration in a vector environment and in as many single ones."""
    base, keywords = configuration(rng)
    count, steps = round(log_uniform(rng, 1.0, 20.0)), int(rng.integers(20, 90))
    mode, threads, seed = pick(rng, MODES), int(rng.integers(1, 4)), int(rng.integers(1 << 32))
    flown = actions(rng, steps, count)

    def vector():
        return QuadVectorEnv(count, base=base, autoreset_mode=mode, threads=threads, **keywords)

    ours, text = refusal(vector)
    _, other = refusal(lambda: QuadEnv(base=base, **keywords))
    assert text == other, f"the vector environment says {text!r}, the single one {other!r}"
    if ours is None:
        assert " " in text
        return True
    theirs = SyncVectorEnv(
        [lambda: QuadEnv(base=base, **keywords)] * count, autoreset_mode=AutoresetMode(mode)
    )
    compare(ours, theirs, flown, seed)
    theirs.close()
    return False


def compare(ours, theirs, flown, seed):
    """Fly the same actions in both, with a reset by mask where episodes do not begin alone."""
    assert_same_results(ours.reset(seed=seed), theirs.reset(seed=seed), "start")
    for k, given in enumerate(flown):
        mine, other = ours.step(given), theirs.step(given)
        compare_terms(mine, other)
        assert_same_results(mine, other, f"step {k}")
        over = mine[2] | mine[3]
        if ours.autoreset_mode == AutoresetMode.DISABLED and over.any():
            mine, other = (each.reset(options={"reset_mask": over}) for each in (ours, theirs))
            assert_same_results(mine, other, f"reset after step {k}")


def compare_terms(mine, other):
    """Compare and remove the terms of rewards, which single environments lack where they begin.

    The terms of a vector environment have the reward as their sum in every step.
    """
    own, alone = (each[-1].pop("reward_terms", None) for each in (mine, other))
    for each in (mine, other):
        each[-1].pop("_reward_terms", None)
    if own is None:
        assert alone is None
        return
    total = np.zeros(len(mine[1]))
    for values in (values for name, values in own.items() if name[0] != "_"):
        total = total + values
    np.testing.assert_array_equal(total, mine[1])
    for name, flags in ((n, f) for n, f in (alone or {}).items() if n[0] == "_"):
        assert own[name[1:]][flags].tobytes() == alone[name[1:]][flags].tobytes(), name[1:]

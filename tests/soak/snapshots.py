"""Random configurations: flights go on from a snapshot with the same bits, also in a new object."""

import copy
import pickle

import numpy as np

from quad_gym.envs.vector import QuadVectorEnv
from tests.contract.comparing import assert_same, state_of
from tests.soak.drawing import MODES, actions, chance, configuration, log_uniform, pick

ABOUT = "flights with their repetition from a snapshot or a copy, after steps and resets of some"


def run(rng):
    """Save flights in their midst, go on, restore, and go on again."""
    base, keywords = configuration(rng)
    count, mode = round(log_uniform(rng, 1.0, 30.0)), pick(rng, MODES)
    before, after = (int(n) for n in rng.integers(1, 50, 2))
    flown, seed = actions(rng, before + after, count), int(rng.integers(1 << 32))
    masks = rng.random((before + after, count)) < 0.5
    reset_at = np.flatnonzero(rng.random(before + after) < 0.1)
    kind, reseeded = pick(rng, ("same", "new", "pickled", "copied")), chance(rng, 0.5)

    def made(threads):
        return QuadVectorEnv(count, base=base, autoreset_mode=mode, threads=threads, **keywords)

    try:
        env = made(threads=int(rng.integers(1, 4)))
    except ValueError:  # the kind `configurations` compares the sentences
        return True

    def fly(env, steps):
        rows = []
        for k in steps:
            rows.append(env.step(flown[k]))
            mask = rows[-1][2] | rows[-1][3] if mode == "Disabled" else np.zeros(count, bool)
            if k in reset_at:
                mask = mask | masks[k]
            if mask.any():
                seeds = [seed + k + i if reseeded and i % 2 else None for i in range(count)]
                rows.append(env.reset(seed=seeds, options={"reset_mask": mask}))
        return rows

    env.reset(seed=seed)
    fly(env, range(before))
    instant, state = env.flights.batch.snapshot(), state_of(env)
    twin = {"pickled": lambda e: pickle.loads(pickle.dumps(e)), "copied": copy.deepcopy}.get(kind)
    other = twin(env) if twin else None
    wanted, end = fly(env, range(before, before + after)), state_of(env)
    assert instant.tobytes() == state, "a snapshot has changed in flight"
    if other is None:
        other = env if kind == "same" else made(threads=int(rng.integers(1, 4)))
        if kind == "new" and chance(rng, 0.5):  # with other flights behind it
            other.reset(seed=seed + 1)
            other.step(flown[0])
        other.flights.batch.restore(instant)
    assert state_of(other) == state, "the restored state differs"
    assert_same(fly(other, range(before, before + after)), wanted, kind)
    assert state_of(other) == end, "the state at the end differs"
    return False

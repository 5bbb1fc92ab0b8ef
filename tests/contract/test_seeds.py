"""Training, validation and test have disjoint flights; equal seeds give paired flights."""

import itertools

import gymnasium
import numpy as np
import pytest

from baselines.recipes import BLOCK, MAX_SEED, PURPOSES, TEST_END, first_seed, flight_seeds
from tests.builders import vec_env

SEEDS, COUNT = range(10), 256


def keys_of(seeds):
    """Return the keys of random streams, drawn from seeds as in Gymnasium."""
    generators = (gymnasium.utils.seeding.np_random(int(seed))[0] for seed in seeds)
    return {tuple(g.integers(0, 2**64, size=2, dtype=np.uint64).tolist()) for g in generators}


def keys_flown(batch):
    return {tuple(key) for key in batch.record("key").tolist()}


def assert_disjoint(sets):
    for first, second in itertools.combinations(sets, 2):
        assert not first & second


def test_training_validation_and_test_share_no_stream():
    keys = {
        (purpose, seed): keys_of(flight_seeds(purpose, seed, COUNT))
        for purpose in PURPOSES
        for seed in SEEDS
    }
    assert all(len(found) == COUNT for found in keys.values())
    together = [set().union(*(keys[purpose, seed] for seed in SEEDS)) for purpose in PURPOSES]
    assert_disjoint(together)
    for purpose in ("training", "validation"):  # two trainings or validations, too
        assert_disjoint([keys[purpose, seed] for seed in SEEDS])


def test_blocks_are_as_documented_and_end_before_the_next_begins():
    assert list(flight_seeds("test", 0, 1000)) == list(range(1000))
    assert first_seed("test", 17, 5) == 17
    assert flight_seeds("test", TEST_END - 4, 4)[-1] < flight_seeds("training", 0, 1)[0]
    assert flight_seeds("training", 3, BLOCK)[-1] < flight_seeds("training", 4, 1)[0]
    assert flight_seeds("training", MAX_SEED, BLOCK)[-1] < flight_seeds("validation", 0, 1)[0]


@pytest.mark.parametrize(
    ("purpose", "seed", "count", "message"),
    [
        ("testing", 0, 1, "purpose must be one of training, validation, test"),
        ("test", TEST_END - 4, 5, "seed must be at most"),
        ("training", MAX_SEED + 1, 1, "seed must be at most"),
        ("training", 0, BLOCK + 1, "count must be at most"),
        ("validation", -1, 1, "seed must be at least 0"),
        ("training", 1.5, 1, "seed must be a whole number"),
        ("training", 0, 0, "count must be at least 1"),
    ],
)
def test_refuses_seeds_out_of_their_block(purpose, seed, count, message):
    with pytest.raises(ValueError, match=message):
        flight_seeds(purpose, seed, count)


def test_trainings_are_evaluated_on_seeds_of_validation_block():
    """The algorithm also seeds its environment, which must not change the flights."""
    pytest.importorskip("stable_baselines3")
    from baselines.models import Keeper, make_flights, make_model
    from baselines.recipes import Plan, recipe

    flown = []
    for seed in (0, 4):
        small = {"environment": {"duration": 0.1}, "threads": 1, "episodes": 8}
        plan = Plan(recipe=recipe("QuadGym/Circle-v0").replace(n_envs=16), seed=seed, **small)
        env, judge = make_flights(plan), plan.make_judge()
        model = make_model(plan, env)
        env.reset()
        trained = keys_flown(env.unwrapped.flights.batch)
        assert trained == keys_of(flight_seeds("training", seed, 16))
        keeper = Keeper(plan, None, judge, quiet=True)
        from quad_gym.evaluation import roll_out

        roll_out(model, judge, seed=keeper._first_seed)
        judged = keys_flown(judge.unwrapped.flights.batch)
        assert judged == keys_of(flight_seeds("validation", seed, 8))
        flown += [trained, judged]
    assert_disjoint([*flown, keys_of(range(1000))])


def test_equal_seeds_with_autoreset_have_equal_starts():
    """The start of the tenth episode does not depend on the times of earlier crashes."""

    def tenth(seed):
        rng, count = np.random.default_rng(seed), 9
        made = {"autoreset_mode": "SameStep", "max_tilt": 0.3, "max_episode_steps": 25}
        env = vec_env(count=count, seed=70, **made)
        flights = env.flights.batch
        found, at = np.full((count, 10), np.nan), np.zeros(count, int)
        for step in range(260):
            _, _, terminated, truncated, _ = env.step(rng.uniform(-1.0, 1.0, (count, 4)))
            begun = (terminated | truncated) & (flights.record("episode") == 10.0)
            found[begun] = np.hstack([flights.record(name) for name in ("r", "q", "b_a")])[begun]
            at[begun] = step
        assert np.isfinite(found).all()
        return found, at

    (first, when), (second, then) = tenth(5), tenth(6)
    np.testing.assert_array_equal(first, second)
    assert (when != then).any()

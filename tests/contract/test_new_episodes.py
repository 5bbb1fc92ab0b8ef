"""A new episode keeps nothing of what a flight's record held before: clocks, sensors, filter."""

import pytest

from tests.builders import SHORT, actions_for, flat, vec_env
from tests.contract.comparing import assert_same
from tests.contract.configurations import CONFIGURATIONS

GIVEN = {"idle", "start_given", "drawn", "wind", "air_force", "air_torque", "feature_place"}
"""Fields that a reset reads: lanes without a flight, starts of its caller, and what is constant
where it is not drawn."""
SPOILED = 7.25  #: a number that nothing has
FLIGHTS, STEPS = range(8), 20


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_episode_does_not_depend_on_what_the_record_held_before(name):
    """Only seeds, instants and flags of failures stay."""
    base, keywords = CONFIGURATIONS[name]
    rows = []
    for spoils in (False, True):
        env = vec_env(base, len(FLIGHTS), **{**SHORT, "autoreset_mode": "SameStep", **keywords})
        env.reset(seed=5)
        env.step(actions_for(FLIGHTS)[0])
        batch = env.flights.batch
        record = batch.snapshot()
        for field in set(record.dtype.names) - GIVEN if spoils else ():
            if record.dtype[field].base.kind == "f":
                record[field] = SPOILED
        batch.restore(record)
        found = [env.reset(seed=list(range(30, 38)))[:1]]
        found += [env.step(action)[:4] for action in actions_for(FLIGHTS)[:STEPS]]
        rows.append([[flat(part) for part in row] for row in found])
    assert_same(rows[1], rows[0])

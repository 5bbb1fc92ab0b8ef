"""Any action is either flown as documented or refused before a state changes."""

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import quad_gym
from quad_gym.envs.single import QuadEnv
from quad_gym.envs.vector import QuadVectorEnv
from tests.contract.comparing import assert_same, state_of

COUNT = 3
INTERFACES = ("single", "vector", "sb3")


def make(interface, action="ctbr"):
    if interface == "single":
        env = QuadEnv("hover", action=action)
    elif interface == "vector":
        env = QuadVectorEnv(COUNT, "hover", action=action)
    else:
        env = quad_gym.make_sb3_vec_env("QuadGym/Hover-v0", COUNT, action=action)
    begin(env)
    return env


def begin(env):
    """Reset the environment to the episode of seed 1."""
    if isinstance(env, gymnasium.Env | QuadVectorEnv):
        env.reset(seed=1)
    else:
        env.seed(1)
        env.reset()


def for_all(interface, row):
    """Repeat the action of one flight for all flights of an interface."""
    return row if interface == "single" else [row] * COUNT


def refuses(env, action):
    """Check that a step raises a ValueError that names the action, and changes no flight."""
    before = state_of(env)
    with pytest.raises(ValueError, match="action"):
        env.step(action)
    assert state_of(env) == before


MASKED = np.ma.masked_array(np.zeros(4), mask=[0, 0, 1, 0])
ROWS = [
    MASKED,
    np.array([0.0, np.nan, 0.0, 0.0]),
    [0.0, 0.0, 0.0, -np.inf],
    np.zeros((4, 1)),
    [0.0, None, 0.0, 0.0],
    ["0.1", "0.2", "0.3", "0.4"],
    [b"0", b"1", b"0", b"1"],
    np.array([1j, 0.0, 0.0, 0.0]),
    [1j, 0.0, 0.0, 0.0],
    np.array([0, 1, 2, 3], "datetime64[s]"),
    [10**400, 0, 0, 0],  # too large for a float
    [[0.0], [0.0, 1.0], 0.0, 0.0],
    [set(), set(), set(), set()],
]
NO_ACTIONS = [None, "forward", 0.0, {}, {"a": 1}, object(), (), [], np.zeros((2, 4))]


@pytest.mark.parametrize("interface", INTERFACES)
def test_invalid_actions_are_refused(interface):
    env = make(interface)
    for row in ROWS:
        one = row if interface == "single" else [row] * COUNT
        refuses(env, np.ma.stack(one) if row is MASKED and interface != "single" else one)
    for action in NO_ACTIONS:
        refuses(env, action)


@pytest.mark.parametrize("interface", ["vector", "sb3"])
def test_invalid_action_of_one_flight_refuses_step_of_all_flights(interface):
    actions = np.zeros((COUNT, 4))
    actions[1, 2] = np.nan
    env = make(interface)
    refuses(env, actions)
    with pytest.raises(ValueError, match=r"action must be finite, got nan at \[1, 2\]"):
        env.step(actions)
    assert_same(env.step(np.zeros((COUNT, 4)))[0], make(interface).step(np.zeros((COUNT, 4)))[0])


@pytest.mark.parametrize("interface", INTERFACES)
@pytest.mark.parametrize("action", ["ctbr", "motor", "wrench", "attitude", "velocity"])
def test_numbers_beyond_the_bounds_are_clipped(interface, action):
    env, twin = make(interface, action), make(interface, action)
    wild = for_all(interface, [1e308, -1e308, 1.0000001, -7.0])
    assert_same(
        env.step(np.array(wild))[0],
        twin.step(np.array(for_all(interface, [1.0, -1.0, 1.0, -1.0])))[0],
    )
    assert state_of(env) == state_of(twin)


@pytest.mark.parametrize("interface", INTERFACES)
def test_actions_of_any_real_type_or_sequence_are_accepted(interface):
    row = [1.0, 0.0, 1.0, 0.0]
    twin = make(interface)
    plain = np.array(for_all(interface, row))
    twin.step(plain)
    padded = np.full((*plain.shape, 3), np.nan)
    padded[..., 1] = plain
    dtypes = [np.float64, np.float32, np.float16, np.int64, np.int8, bool]
    for action in [
        *(plain.astype(dtype) for dtype in dtypes),
        for_all(interface, row),
        tuple(for_all(interface, tuple(row))),
        padded[..., 1],
    ]:
        env = make(interface)
        env.step(action)
        assert state_of(env) == state_of(twin)


def test_step_does_not_modify_action_of_caller():
    env = make("single")
    action = np.array([5.0, -5.0, 0.5, 0.0])
    env.step(action)
    np.testing.assert_array_equal(action, [5.0, -5.0, 0.5, 0.0])


def test_step_before_reset_raises_reset_needed_or_refuses_action():
    env = QuadEnv("hover")
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(4))
    with pytest.raises(ValueError, match="action"):
        env.step(np.full(4, np.nan))


numbers = st.floats(allow_nan=True, allow_infinity=True)
rows = st.one_of(
    hnp.arrays(np.float64, 4, elements=numbers),
    hnp.arrays(np.float32, 4, elements=st.floats(width=32)),
    hnp.arrays(np.float64, 4, elements=st.floats(-2.0, 2.0)),
    hnp.arrays(np.int64, 4),
    st.lists(numbers, min_size=0, max_size=6),
    st.lists(st.one_of(numbers, st.none(), st.text(max_size=3), st.integers()), max_size=5),
    hnp.arrays(
        st.sampled_from([np.float64, np.int8, bool, "U2", "complex128"]), hnp.array_shapes()
    ),
    st.one_of(st.none(), st.text(), st.integers(), numbers, st.binary(max_size=4)),
)


def expected_action(action, shape):
    """Return the clipped numbers of an action by the documentation; None if it is invalid."""
    if not isinstance(action, (list, np.ndarray)):
        return None
    if isinstance(action, np.ndarray):
        cells = action.ravel().tolist() if action.shape == shape else None
    elif len(action) == shape[-1] and len(shape) == 1:
        cells = action
    else:
        cells = None
    if cells is None or not all(isinstance(cell, (float, int)) for cell in cells):
        return None
    if any(abs(cell) >= 2**1024 or cell != cell for cell in cells):
        return None
    return np.array([min(max(float(cell), -1.0), 1.0) for cell in cells]).reshape(shape)


@pytest.fixture(scope="module")
def pairs():
    return {interface: (make(interface), make(interface)) for interface in INTERFACES}


@settings(max_examples=250)
@given(action=rows)
def test_single_env_flies_or_refuses_any_action(pairs, action):
    check_one(pairs["single"], action, (4,))


@settings(max_examples=250)
@given(action=hnp.arrays(np.float64, (COUNT, 4), elements=numbers))
def test_vector_envs_fly_or_refuse_any_actions(pairs, action):
    check_one(pairs["vector"], action, (COUNT, 4))
    check_one(pairs["sb3"], action, (COUNT, 4))


def check_one(pair, action, shape):
    env, twin = pair
    for each in pair:
        begin(each)
    numbers = expected_action(action, shape)
    if numbers is None:
        refuses(env, action)
        return
    assert_same(env.step(action)[:3], twin.step(numbers)[:3])
    assert state_of(env) == state_of(twin)

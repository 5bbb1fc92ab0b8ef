"""Values that resets and filters refuse: no numbers, not finite, of another shape, too large.

A refused value changes nothing; the last good one is accepted. Fields of parameters and keywords
are in `tests/unit/test_limits.py`, actions in `test_hostile_actions.py`.
"""

import math
import re
import warnings

import numpy as np
import pytest

import quad_gym
from quad_gym import FlightBatch
from quad_gym.envs.config import TASK_DEFAULTS
from tests.filter_states import at_rest

RTK = quad_gym.sensor_suite("rtk")
NO_ARRAYS = ["three", b"3", True, {}, object(), 3j, 10**400, [set()] * 3, math.nan, math.inf]
"""No arrays of numbers, whatever their shape should be."""
ONE = 1.0
NO_VECTORS = [*NO_ARRAYS, ONE, (), [1.0, 2.0], [[1.0]], np.zeros((2, 2)), np.zeros((3, 2))]
NO_VECTORS += [(0.0, bad, 1.0) for bad in (math.nan, math.inf, None, "1", True, 10**400)]
NO_NUMBERS = [*NO_ARRAYS, (), [], [[1.0]], -math.inf]
HIGH, TURN = 1e4, 2.0 * math.pi


def above(x):
    return math.nextafter(x, math.inf)


# --------------------------------------------------------------------------------------------------
# Resets of environments and batches.
# --------------------------------------------------------------------------------------------------

RESET = {
    # at most 1.6 m from (4, 0, 1) in an environment, and from all references in a batch
    "position": ([(4.0, 0.0, 2.5999), (4.0, -1.5999, 1.0)], [(0.0, 0.0, 9.0), *NO_VECTORS]),
    "velocity": ([(0.0, HIGH, 0.0)], [(0.0, 0.0, -above(HIGH)), (HIGH, 1.0, 0.0), *NO_VECTORS]),
    "yaw": ([TURN, -TURN], [above(TURN), -above(TURN), 90.0, 1e15, *NO_NUMBERS]),
}
"""Accepted and refused values of starts."""


@pytest.mark.parametrize("name", RESET)
def test_start_at_its_limit_is_accepted_and_beyond_it_refused(name):
    env, batch = quad_gym.QuadEnv("hover"), FlightBatch(3, task=TASK_DEFAULTS["hover"])
    env.reset(seed=1)
    batch.reset(seeds=range(3))
    good, bad = RESET[name]
    for value in good:
        assert np.isfinite(env.reset(seed=1, options={name: value})[0]).all()
        batch.reset(**{name: value})
        batch.reset(**{name: np.array([value] * 3)})
    kept, state = env.flights.batch.snapshot().tobytes(), env.np_random.bit_generator.state
    flown = batch.snapshot().tobytes()
    for value in bad:
        with pytest.raises(ValueError, match=name):
            env.reset(options={name: value})
        with pytest.raises(ValueError, match=name):
            batch.reset(**{name: value})
        if name == "yaw" or value is not ONE:  # three of these are one vector
            with pytest.raises(ValueError, match=name):
                batch.reset(**{name: [value] * 3})
    if name == "position":
        with pytest.raises(ValueError, match="position must be within out_of_bounds"):
            env.reset(options={name: (4.0, 0.0, 2.6001)})
    assert env.flights.batch.snapshot().tobytes() == kept
    assert env.np_random.bit_generator.state == state
    assert batch.snapshot().tobytes() == flown


BATCH_RESET = {
    "seeds": [*NO_NUMBERS, (1, 2), (1, 2, -1), (1, 2, 3.0), (1, 2, True), range(4), "123"],
    "keys": [*NO_NUMBERS, np.zeros((3, 2)), np.zeros((2, 2), np.uint64), np.zeros(6, np.uint64)],
    "mask": [*NO_NUMBERS, [True, False], [1, 0, 1], np.ones((3, 1), bool), "yes"],
}


@pytest.mark.parametrize("name", BATCH_RESET)
def test_argument_of_batch_reset_of_another_shape_or_type_is_refused(name):
    batch = FlightBatch(3)
    batch.reset(seeds=range(3))
    before = batch.snapshot().tobytes()
    for value in BATCH_RESET[name]:
        with pytest.raises(ValueError, match=name):
            batch.reset(**{name: value})
    assert batch.snapshot().tobytes() == before


def test_options_of_a_reset_are_a_dictionary_of_known_names():
    env = quad_gym.QuadEnv("hover")
    for options in ("three", 3.0, [("yaw", 1.0)], {"colour": 1.0}, {3: 1.0}):
        with pytest.raises(ValueError, match=r"options|is not a keyword"):
            env.reset(seed=1, options=options)
    env.reset(seed=1, options={})


# --------------------------------------------------------------------------------------------------
# Filters.
# --------------------------------------------------------------------------------------------------

TURNED = np.eye(3)[[1, 0, 2]]  # a reflection
NO_MATRICES = [*NO_ARRAYS, 1.0, np.zeros(3), np.eye(2), np.eye(16), None]
PIXELS = np.full((12, 2), np.nan)
NO_PIXELS = [*NO_ARRAYS[:-2], np.zeros((3, 2)), np.zeros((12, 3)), np.zeros(24)]
NO_PIXELS += [[[0, math.inf], *PIXELS[1:]], [[0.0, None], *PIXELS[1:]]]
FAR = (1e15, -1e15, 1e15)
ARGUMENTS = {
    ("initialize", "gnss_position_G"): ([(1e6, 1e6, 1e6)], [(0.0, 0.0, 6e6), *NO_VECTORS, None]),
    ("initialize", "gnss_baseline_G"): ([(0.1, 0.1, 0.0)], [(0.0, 0.0, 0.0), *NO_VECTORS]),
    ("initialize", "heading"): ([0.0, -TURN], NO_NUMBERS),
    ("set_state", "position"): ([FAR], NO_VECTORS),
    ("set_state", "R_BI"): ([np.eye(3)], [*NO_MATRICES, TURNED, 1.001 * np.eye(3), np.eye(15)]),
    ("set_state", "covariance"): (
        [np.eye(15)],
        [*NO_MATRICES, -np.eye(15), np.eye(15) + np.eye(15, k=1), np.eye(3), np.zeros((15, 15))],
    ),
    ("update", "gnss_position_G"): ([FAR, None], NO_VECTORS),
    ("update", "gnss_baseline_G"): ([FAR, None], [(0.0, 0.0, 0.0), *NO_VECTORS]),
    ("update", "gnss_velocity_G"): ([FAR, None], NO_VECTORS),
    ("update", "pixels"): ([PIXELS, None], NO_PIXELS),
    ("predict", "gyro"): ([FAR], [*NO_VECTORS, None]),
    ("predict", "accel"): ([FAR], [*NO_VECTORS, None]),
}
"""Accepted and refused arguments of the methods of filters."""


@pytest.mark.parametrize("kind", [quad_gym.UnscentedKalmanFilter, quad_gym.ExtendedKalmanFilter])
@pytest.mark.parametrize(("method", "name"), ARGUMENTS)
def test_wrong_argument_of_a_filter_is_refused_without_effect(kind, method, name):
    start = {"gnss_position_G": np.ones(3), "gnss_baseline_G": [0.1, 0.1, 0.0]}
    others = {
        "initialize": start,
        "set_state": at_rest(covariance=np.eye(15) * 1e-2),
        "update": {},
        "predict": {"gyro": np.zeros(3), "accel": np.array([0.0, 0.0, 9.8])},
    }[method]
    if name == "heading":
        others = {"gnss_position_G": np.ones(3)}

    def made():
        kf = kind(RTK)
        kf.initialize(**start)
        return kf

    def state(kf):
        return [kf.position, kf.velocity, kf.R_BI, kf.accel_bias, kf.gyro_bias, kf.covariance]

    good, bad = ARGUMENTS[method, name]
    for value in good:
        kf = made()
        with warnings.catch_warnings():  # a filter that keeps its last valid state warns
            warnings.simplefilter("ignore", RuntimeWarning)
            getattr(kf, method)(**{**others, name: value})
        assert all(np.isfinite(part).all() for part in state(kf))
    kf = made()
    before = state(kf)
    for value in bad:
        with pytest.raises(ValueError, match=re.escape(name)):
            getattr(kf, method)(**{**others, name: value})
        for was, now in zip(before, state(kf), strict=True):
            np.testing.assert_array_equal(was, now)
    assert kf.status == 0

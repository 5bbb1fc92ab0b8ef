"""Every pair of options of different features flies briefly: where two features meet, defects sit.

A pair flies consistently and independently of the batch's size, or is one of those that are refused
by name. A new feature gets a line in `OPTIONS`. Exported filters meet calibrated suites, delays and
rotations in `tests/unit/test_filter_library.py`.
"""

import itertools
import warnings

import numpy as np
import pytest

import quad_gym
from baselines import PDPolicy
from tests.builders import vec_env
from tests.contract.configurations import LATE
from tests.estimators import Simple
from tests.field_flights import nees

FLIGHTS, FEW, STEPS = 48, 3, 40
MAX_NEES = 5.5 * np.sqrt(2.0 * 15.0 / FLIGHTS)
"""Alarm level of the mean NEES beyond 15: 5.5 standard deviations of a consistent filter. One of a
thousand pairs would exceed it once in 10,000 runs, or less."""
CRAZYFLIE = quad_gym.sensor_suite("crazyflie")
OPTIONS = {
    "sensors": {
        "rtk": {"sensors": "rtk"},
        "consumer": {"sensors": "consumer"},
        "indoor": {"sensors": "indoor"},
        "flow and range": {"sensors": "crazyflie"},
        "late flow": {
            "sensors": CRAZYFLIE.replace(
                optical_flow=CRAZYFLIE.optical_flow.replace(latency=0.02),
                range_finder=CRAZYFLIE.range_finder.replace(latency=0.04),
            )
        },
        "late": {"sensors": LATE},
    },
    "vehicle": {"crazyflie": {"vehicle": "crazyflie"}},
    "world": {
        "low ground": {"world": quad_gym.WorldParams(ground_height=-1.0)},
        "high ground": {"world": quad_gym.WorldParams(ground_height=0.4)},
        "contact": {
            "world": quad_gym.WorldParams(
                ground=quad_gym.GroundParams(
                    feet_B=[(x, y, -0.1) for x, y in ((1, -1), (1, 1), (-1, 1), (-1, -1))]
                ),
                ground_height=-0.3,
            )
        },
        "breeze": {"world": "breeze"},
        "walls": {"world": "slalom"},
    },
    "faults": {
        "rotor": {"faults": quad_gym.faults.RotorLoss(start=0.3, duration=0.1, share=0.3)},
        "GNSS outage": {"faults": quad_gym.faults.GnssOutage(start=0.2)},
        "occlusion": {"faults": quad_gym.faults.CameraOcclusion(start=0.2)},
    },
    "delay": {"action": {"action_delay": 1.5}},
    "estimator": {"ekf": {"estimator": "ekf"}, "own": {"estimator": Simple()}},
    "action": {
        "motor": {"action": "motor", "control_rate": 200.0},
        "attitude": {"action": "attitude"},
        "velocity": {"action": "velocity", "layout": "absolute"},
    },
    "task": {
        "circle": {"base": "circle"},
        "waypoints": {"base": "waypoints"},
        "random": {"base": "random_trajectory"},
    },
    "start": {
        "warm": {"filter_start": "warm"},
        "ground": {"start": "ground"},
        "moving": {"start": "moving"},
    },
    "draws": {"mass": {"randomization": {"mass": quad_gym.Uniform(0.9, 1.1, relative=True)}}},
    "innovations": {"innovations": {"innovations": True}},
}


def _pairs():
    """Pairs of (feature, option), of different features."""
    every = [(feature, option) for feature, options in OPTIONS.items() for option in options]
    pairs = [(a, b) for a, b in itertools.combinations(every, 2) if a[0] != b[0]]
    return [*pairs, *(((feature, option), None) for feature, option in every)]


PAIRS = _pairs()
REFUSED = [
    *(
        (("sensors", sensors), ("faults", fault))
        for sensors, fault in (
            ("consumer", "occlusion"),
            ("indoor", "GNSS outage"),
            ("flow and range", "GNSS outage"),
            ("flow and range", "occlusion"),
            ("late flow", "GNSS outage"),
            ("late flow", "occlusion"),
        )
    ),
    (("estimator", "own"), ("innovations", "innovations")),
]
"""Pairs without a meaning; all others fly."""
ALWAYS = [
    (("sensors", "flow and range"), ("world", "low ground")),
    (("sensors", "flow and range"), ("world", "high ground")),
    (("vehicle", "crazyflie"), ("world", "breeze")),
    (("sensors", "late flow"), ("start", "warm")),
]
"""Pairs in which audits found defects."""


def _sample():
    """Few pairs that have each option at least once, in an arbitrary but fixed order."""
    order = np.random.default_rng(20).permutation(len(PAIRS))
    found, missing = list(ALWAYS), {part for pair in PAIRS for part in pair if part is not None}
    missing -= {part for pair in found for part in pair}
    flown = [PAIRS[k] for k in order if PAIRS[k] not in REFUSED]
    while missing:
        found.append(max(flown, key=lambda pair: len(missing & set(pair))))
        missing -= set(found[-1])
    return found


SAMPLE = _sample()
"""Pairs of the normal run; the slow one has all."""


def name_of(pair):
    return " x ".join("none" if part is None else " ".join(part) for part in pair)


def keywords_of(pair):
    found = {"sensors": "rtk", "start": "hover", "out_of_bounds": 50.0}
    for part in pair:
        if part is not None:
            found |= OPTIONS[part[0]][part[1]]
    return found


def fly(count, keywords):
    """Fly PD control on the estimate; return the batch, and positions with estimates."""
    base = keywords.get("base", "hover")
    more = {name: value for name, value in keywords.items() if name != "base"}
    env = vec_env(base, count, seed=5, **more)
    policy, observations, rows = PDPolicy(env), env.reset(seed=5)[0], []
    steps = round(STEPS * keywords.get("control_rate", 50.0) / 50.0)
    for _ in range(steps):
        observations = env.step(policy.predict(observations)[0])[0]
        batch = env.flights.batch
        rows.append([batch.read("position"), batch.read("estimated_position")])
    return env.flights.batch, np.moveaxis(np.array(rows), 2, 0)


def check(pair):
    """Fly a pair, or see it refused; return its mean NEES, None without a covariance."""
    keywords = keywords_of(pair)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of starts and rates that are vague or slow
        if pair in REFUSED:
            with pytest.raises(ValueError, match=r"faults|GnssOutage|CameraOcclusion|innovations"):
                fly(1, keywords)
            return None
        batch, many = fly(FLIGHTS, keywords)
        _, few = fly(FEW, keywords)
    assert np.isfinite(many).all()
    np.testing.assert_array_equal(few, many[:FEW])
    if "own" in (part and part[1] for part in pair):
        return None
    assert not batch.record("filter_status").any()
    return float(nees(batch).mean())


@pytest.mark.parametrize("pair", SAMPLE, ids=name_of)
def test_pair_of_options_is_consistent_and_independent_of_batch_size_or_refused(pair):
    found = check(pair)
    assert found is None or abs(found - 15.0) < MAX_NEES


@pytest.mark.slow  # some 400 pairs
@pytest.mark.parametrize("pair", PAIRS, ids=name_of)
def test_every_pair_of_options_is_consistent_and_independent_of_batch_size_or_refused(pair):
    found = check(pair)
    assert found is None or abs(found - 15.0) < MAX_NEES

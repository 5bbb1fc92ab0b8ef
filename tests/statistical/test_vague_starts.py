"""Consistency after vague starts; docs/sensors-and-filter.md, Initialization, has the bounds."""

import pytest

import quad_gym
from tests.vague_starts import BAND, KINDS, largest_tilt, mean_nees, of_kind, vague_suites

TIMES = (0.2, 0.5, 1.0, 10.0)
COUNT = 1024


def assert_nees_in_band(label, suite, **keywords):
    """Check that the mean NEES is in its band at 0.5 s and 10 s, otherwise at most 1 above it."""
    found = dict(zip(TIMES, mean_nees(suite, TIMES, COUNT, **keywords), strict=True))
    print(f"\n{label}: " + ", ".join(f"{n:.1f} at {time:g} s" for time, n in found.items()))
    assert BAND[0] < min(found.values())
    assert max(found[0.5], found[10.0]) < BAND[1]
    assert max(found.values()) < BAND[1] + 1.0


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("vague", vague_suites())
def test_filter_is_consistent_at_bound_of_start_uncertainty(vague, kind):
    assert_nees_in_band(f"{vague}, {kind}", of_kind(vague_suites()[vague], kind))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["standard", "rtk", "consumer", "indoor"])
def test_a_suite_is_consistent_at_the_largest_tilt(name, kind):
    suite = of_kind(quad_gym.sensor_suite(name), kind)
    assert_nees_in_band(f"tilt, {name}, {kind}", suite, randomization=largest_tilt(name))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["standard", "rtk", "consumer", "indoor"])
def test_a_warm_start_is_consistent_at_any_tilt(name, kind):
    tilts = {tilt: quad_gym.Uniform(-0.8, 0.8) for tilt in ("start_roll", "start_pitch")}
    suite = of_kind(quad_gym.sensor_suite(name), kind)
    assert_nees_in_band(f"warm, {name}, {kind}", suite, randomization=tilts, filter_start="warm")

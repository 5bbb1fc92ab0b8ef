"""Rows of the table of aiding sensors: incomplete or inconsistent classes are refused."""

from types import SimpleNamespace

import numpy as np
import pytest

import quad_gym
from quad_gym.estimation.inputs import (
    checked_measurement,
    measured_blocks,
    sigmas_of,
)
from quad_gym.logs.replaying.measurements import lacks_position
from quad_gym.packing import pack_aids, slow_states
from quad_gym.params.aids import AidParams, SlowError
from quad_gym.params.sensor_table import AID_PARAMS, READINGS, SENSOR_OF, _shape_of
from quad_gym.records import PARAMS

UWB = quad_gym.sensor_suite("uwb")
LACKING_ALL = UWB.replace(uwb_range=None)
COMPLETE = {"observes": ("height",), "unit": "m", "frame": "-", "meaning": "depth"}
COMPLETE |= {"raw": ("m", "-", 10.0)}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"observes": ("hight",)}, "observes must be one of position, .* did you mean height"),
        ({"length": 4}, "length must be at most 3, got 4"),
        ({"raw": None}, "Depth must have raw"),
        ({"slow_skalar": property(lambda self: None)}, "slow_skalar is not read; .* slow_scalar"),
    ],
)
def test_class_of_a_sensor_that_is_wrong_is_refused_by_its_member(change, message):
    members = {name: value for name, value in (COMPLETE | change).items() if value is not None}
    with pytest.raises(ValueError, match=message):
        _shape_of("depth", type("Depth", (AidParams,), members))
    assert _shape_of("depth", type("Depth", (AidParams,), COMPLETE)).readings[0].length == 1


@pytest.mark.parametrize(
    ("sensor", "words"),
    [
        ("gnss", "GNSS"),
        ("camera", "a camera"),
        ("optical_flow", "optical flow"),
        ("range_finder", "a range finder"),
        ("uwb_range", "ranges to anchors"),
    ],
)
def test_sensor_that_a_suite_lacks_is_named_in_words(sensor, words):
    with pytest.raises(ValueError, match=f"{sensor}_rate must not be given without {words}, got"):
        LACKING_ALL.with_rates(**{sensor: 10.0})


def test_numbers_beyond_the_rows_of_a_sensor_are_refused(monkeypatch):
    record = np.zeros(1, PARAMS)[0]
    pack_aids(record, UWB)
    monkeypatch.setattr(quad_gym.UwbRangeParams, "rows", 5)
    with pytest.raises(ValueError, match=r"UwbRangeParams.numbers must have at most 5 .* got 6"):
        pack_aids(record, UWB)


def test_more_slow_errors_than_a_filter_has_states_for_are_refused(monkeypatch):
    suite = quad_gym.sensor_suite("consumer").replace(uwb_range=UWB.uwb_range)
    assert slow_states(suite).estimated == 8
    monkeypatch.setattr(quad_gym.UwbRangeParams, "assumed_vector", SlowError(0.1))
    with pytest.raises(ValueError, match=r"at most 9 time-correlated errors .* got 11"):
        slow_states(suite)


def test_sensor_of_positions_replaces_a_fictitious_position(monkeypatch):
    assert lacks_position(SimpleNamespace(streams={"barometer"}), UWB)
    monkeypatch.setattr(quad_gym.UwbRangeParams, "observes", ("position", "height"))
    assert not lacks_position(SimpleNamespace(streams={"uwb_range"}), UWB)


def suite_with(sensor):
    """A suite that has a sensor, with its default parameters."""
    suite = quad_gym.sensor_suite("rtk")
    return suite.replace(**{sensor: AID_PARAMS[sensor]()}) if sensor in AID_PARAMS else suite


@pytest.mark.parametrize("name", READINGS)
def test_wrong_measurement_of_any_reading_is_refused_by_its_keyword(name):
    """The compiled check finds the number, and Python names the argument."""
    keyword, sigma = READINGS[name].keyword, READINGS[name].sigma
    suite = suite_with(SENSOR_OF[name])
    right = np.ones(suite.shape_of(name))
    wrong = right.copy()
    wrong[(0,) * wrong.ndim] = np.inf
    with pytest.raises(ValueError, match=f"{keyword} must be finite"):
        checked_measurement(suite, {keyword: wrong})
    for value, message in ((0.0, "at least"), (-0.1, "at least"), (np.nan, "finite")):
        with pytest.raises(ValueError, match=f"{sigma} must be .*{message}"):
            checked_measurement(suite, {keyword: right, sigma: value})
    with pytest.raises(ValueError, match=f"{sigma} must come with its measurement"):
        checked_measurement(suite, {sigma: 0.1})
    found = checked_measurement(suite, {keyword: right, sigma: 0.1})
    np.testing.assert_array_equal(sigmas_of(found, name), 0.1)
    assert len(measured_blocks(found)) == suite.blocks_of(name)

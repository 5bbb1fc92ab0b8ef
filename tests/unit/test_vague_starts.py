"""Starts with large uncertainty: an error, a warning, or a filter that stays consistent."""

import warnings

import numpy as np
import pytest

import quad_gym
from quad_gym import Normal, Uniform
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.records import Source
from tests.field_flights import fly, steps
from tests.vague_starts import (
    BAND,
    KINDS,
    largest_tilt,
    mean_nees,
    of_kind,
    one_antenna,
    vague_suites,
    with_baseline,
    with_mark,
)

SUITES = ("standard", "rtk", "consumer", "indoor")
POSES = ("heading, indoor", "heading and position, indoor")
VAGUE = ("baseline, standard", *POSES, "hard iron, consumer")


def warnings_of(suite, **keywords):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        FlightBatch(1, sensors=suite, **keywords)
    return [str(warning.message) for warning in caught if warning.category is UserWarning]


def test_accelerometer_in_hover_measures_force_along_body_z_at_any_tilt():
    suite = quad_gym.sensor_suite("consumer").simplified()
    anywhere = {"start_roll": Uniform(-0.8, 0.8), "start_pitch": Uniform(-0.8, 0.8)}
    batch = fly(suite, 64, start="hover", filter_start="warm", randomization=anywhere)
    steps(batch, 1.0 / suite.imu.rate)
    force = batch.read("accel") - batch.read("accel_bias")
    angles = np.arccos(force[:, 2] / np.linalg.norm(force, axis=1))
    assert angles.max() < 0.02


@pytest.mark.parametrize("name", SUITES)
@pytest.mark.parametrize("drawn", ["start_roll", "start_pitch"])
def test_a_cold_filter_refuses_large_tilts_by_name(name, drawn):
    wide = {drawn: Uniform(-0.8, 0.8)}
    with pytest.raises(ValueError, match=rf"^{drawn} must have .* got 0.462 rad.*'warm'"):
        FlightBatch(1, sensors=name, randomization=wide)
    FlightBatch(1, sensors=name, randomization=wide, source=Source.TRUTH)  # runs no filter
    FlightBatch(1, sensors=name, randomization=wide, filter_start="warm")


def test_tilt_limit_is_lower_with_magnetic_heading():
    tilt = {"start_roll": Normal(0.0, 0.12)}
    FlightBatch(1, sensors="standard", randomization=tilt)
    with pytest.raises(ValueError, match=r"at most 0\.0913 rad \(uniform within \+-0\.158 rad\)"):
        FlightBatch(1, sensors="consumer", randomization=tilt)
    FlightBatch(1, sensors="consumer", randomization={"start_roll": Uniform(-0.158, 0.158)})


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", SUITES)
def test_the_largest_tilt_leaves_the_filter_consistent(name, kind):
    suite = of_kind(quad_gym.sensor_suite(name), kind)
    (found,) = mean_nees(suite, (0.5,), 512, randomization=largest_tilt(name))
    assert BAND[0] < found < BAND[1]


@pytest.mark.parametrize("name", quad_gym.params.suites.ALL_SUITES)
def test_named_suites_raise_no_warning(name):
    assert not warnings_of(quad_gym.sensor_suite(name))


@pytest.mark.parametrize(
    ("suite", "message"),
    [
        (with_baseline("standard", 0.2), "GnssParams.baseline_sigma is 0.2 rad, more than 0.15 r"),
        (with_mark("indoor", heading_sigma=1.1), "InitialPoseParams.heading_sigma is 1.1 rad, mor"),
        (with_mark("indoor", position_sigma=2.0), "InitialPoseParams.position_sigma is 2 m, more"),
        (one_antenna(with_mark("rtk", heading_sigma=0.3)), "InitialPoseParams.heading_sigma is 0."),
        (vague_suites(2.0)["hard iron, consumer"], "MagnetometerParams.hard_iron_sigma is 4.81e-0"),
    ],
)
def test_excessive_start_uncertainty_warns_once_and_names_parameter(suite, message):
    (found,) = warnings_of(suite)
    assert found.startswith(message)
    assert warnings_of(suite, source=Source.TRUTH) == []  # runs no filter


@pytest.mark.parametrize("vague", vague_suites())
def test_start_uncertainty_at_bound_does_not_warn(vague):
    assert not warnings_of(vague_suites()[vague])


def test_partly_vertical_baseline_allows_less_noise():
    suite = with_baseline("standard", 0.1)
    half_up = suite.gnss.replace(
        primary_antenna_B=(0.0, 0.0, 0.0), secondary_antenna_B=(0.1, 0.0, 0.1 * np.sqrt(3.0))
    )
    assert not warnings_of(suite)
    (found,) = warnings_of(suite.replace(gnss=half_up))
    assert found.startswith("GnssParams.baseline_sigma is 0.1 rad, more than 0.075 rad")
    assert not warnings_of(with_baseline("standard", 0.25), filter_start="warm")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("vague", VAGUE)
def test_filter_with_large_start_uncertainty_is_consistent(vague, kind):
    for found in mean_nees(of_kind(vague_suites()[vague], kind), (0.2, 0.5)):
        assert BAND[0] < found < BAND[1]


def test_coarse_baselines_leave_the_filter_consistent():
    """Noise of 0.3 rad shortens the component along the baseline by 0.09."""
    with pytest.warns(UserWarning, match="baseline_sigma"):
        means = mean_nees(with_baseline("standard", 0.3), (0.2, 0.5))
    for found in means:
        assert BAND[0] < found < BAND[1]

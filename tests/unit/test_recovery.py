"""Divergence of the filter: detection, false alarms, and recovery after faults."""

import math

import numpy as np
import pytest

import quad_gym
import quad_gym.frames
from quad_gym.envs.vector import QuadVectorEnv
from quad_gym.faults import AccelBiasStep, GnssRamp, GyroBiasStep
from quad_gym.records import Ending, Source
from tests.field_flights import fly, state_errors, steps

FLIGHTS = 256
STEP = GyroBiasStep(start=3.0, size=math.radians(1.0))


def flown(name, fault, seconds, **choices):
    suite = quad_gym.sensor_suite(name)
    suite = suite.replace(estimator=suite.estimator.replace(**choices))
    batch = fly(suite, FLIGHTS, task="circle", start="hover", filter_start="warm", faults=fault)
    steps(batch, seconds)
    return batch


def beyond(batch, deviations):
    """Flights (n,) in which any of the fifteen errors exceeds so many standard deviations."""
    sigma = np.sqrt(np.einsum("nii->ni", batch.covariance()))
    return (np.abs(state_errors(batch)) > deviations * sigma).any(axis=1)


@pytest.mark.parametrize("fault", [STEP, AccelBiasStep(start=3.0, size=0.5)], ids=["gyro", "accel"])
def test_filter_is_consistent_or_flagged_diverged_10_s_after_a_bias_step(fault):
    batch = flown("rtk", fault, 13.0)
    wrong, lost = beyond(batch, 6.0), batch.record("diverged") > 0.0
    assert wrong.mean() <= 0.01, wrong.mean()
    assert not (wrong & ~lost).any()


def test_filter_is_flagged_diverged_within_1_s_of_a_bias_step():
    batch = flown("rtk", STEP, 3.25)
    assert beyond(batch, 6.0).mean() > 0.9
    steps(batch, 0.75)
    wrong, lost = beyond(batch, 6.0), batch.record("diverged") > 0.0
    assert lost.mean() > 0.95
    assert (wrong & ~lost).mean() <= 0.01


def test_filter_with_magnetometer_recovers_from_a_gyro_bias_step():
    """No other sensor measures the heading; its innovations drift before any is rejected."""
    batch = fly("consumer", 128, task="circle", filter_start="warm", faults=STEP)
    steps(batch, 4.0)
    assert beyond(batch, 6.0).mean() > 0.9
    steps(batch, 9.0)
    assert beyond(batch, 6.0).mean() <= 0.01


def test_camera_alone_detects_a_small_gyro_step():
    """Errors of attitude and position compensate each other, so innovations are hardly larger."""
    fault = GyroBiasStep(start=3.0, size=math.radians(0.4))
    batch = fly("indoor", 128, filter_start="warm", faults=fault)
    told = np.zeros(128, bool)
    for _ in range(40):
        steps(batch, 0.2)
        told |= batch.record("diverged") > 0.0
    assert told.mean() > 0.95
    steps(batch, 5.0)
    assert beyond(batch, 6.0).mean() <= 0.01


def test_filter_without_a_gate_is_flagged_diverged_and_not_inflated():
    """The gyro bias is wrong for long, as nothing is inflated."""
    found = []
    for start in (0.5, 1e6):
        fault = GyroBiasStep(start=start, size=math.radians(3.0))
        on_truth = {"task": "hover", "source": Source.TRUTH, "run_filter": True}
        batch = fly("standard", 32, **on_truth, filter_start="warm", faults=fault)
        steps(batch, 3.0)
        found.append(np.sqrt(np.einsum("nij,nij->ni", batch.record("L"), batch.record("L"))))
        assert (batch.record("diverged") > 0.0).mean() == (1.0 if start == 0.5 else 0.0)
    np.testing.assert_allclose(*found, rtol=0.2)  # inflated, they would be four times as large


@pytest.mark.parametrize("speed", [pytest.param(0.1, marks=pytest.mark.slow), 0.5])
def test_gnss_ramp_causes_no_divergence_while_markers_are_seen(speed):
    batch = flown("rtk", GnssRamp(start=3.0, speed=speed), 23.0)
    assert batch.record("rejections")[:, 0].min() > 50
    assert np.linalg.norm(state_errors(batch)[:, :3], axis=1).max() < 0.05
    assert not (batch.record("diverged") > 0.0).any()


@pytest.mark.parametrize("name", ["rtk", "indoor", "consumer"])
def test_consistent_filter_is_rarely_flagged_diverged(name):
    """At one false alarm per hour, 256 flights of 10 s have three or more with 4 % probability."""
    batch = fly(quad_gym.sensor_suite(name), FLIGHTS, start="hover", filter_start="warm")
    alarms = np.zeros(FLIGHTS, bool)
    for _ in range(40):
        steps(batch, 0.25)
        alarms |= batch.record("diverged") > 0.0
    assert alarms.sum() <= 2, alarms.sum()


def test_info_reports_divergence_and_episodes_can_end_with_it():
    keywords = {"sensors": "rtk", "faults": GyroBiasStep(start=0.5, size=math.radians(3.0))}
    keywords |= {"start": "hover", "filter_start": "warm", "duration": 4.0}
    told, endings = QuadVectorEnv(32, "hover", **keywords), []
    told.reset(seed=0)
    ended = QuadVectorEnv(32, "hover", truncate_when_diverged=True, **keywords)
    ended.reset(seed=0)
    lost = np.zeros(32, bool)
    for _ in range(150):
        _, _, _, truncated, info = told.step(np.zeros((32, 4)))
        lost |= info["filter_diverged"]
        *_, truncated, info = ended.step(np.zeros((32, 4)))
        endings += info["ending"][truncated].tolist()
    assert lost.mean() > 0.9
    assert endings.count(Ending.FILTER_DIVERGED) > 16

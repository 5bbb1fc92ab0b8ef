"""The UKF agrees with a plain augmented filter, computed from the equations in 40 digits."""

import decimal
from decimal import Decimal

import numpy as np
import pytest

import quad_gym
from quad_gym.estimation import UnscentedKalmanFilter
from tests.circle_flight import record_circle
from tests.reference_ukf import PlainUKF, array_of

LAB = quad_gym.sensor_suite("lab")
QUANTITIES = ("position", "velocity", "R_BI", "accel_bias", "gyro_bias")


def estimator(**choices):
    return LAB.replace(estimator=LAB.estimator.replace(**choices))


def distance(value, truth):
    """Return the largest difference, computed in 40 digits."""
    return float(abs(array_of(Decimal, value) - truth).max())


def compare(
    sensors, ticks, seed, *, present=0.8, filter_class=UnscentedKalmanFilter, plain_class=PlainUKF
):
    """Find the largest differences from the reference over a flight with intermittent measurements.

    Returns:
        Differences by name, for the covariance relative to the standard deviations; the number of
        cycles with each combination of measurements, by (position, baseline, features).
    """
    recording = record_circle(sensors, ticks, seed)
    has = np.random.default_rng(seed).random((ticks, 2)) < present
    ours, cases = filter_class(sensors), {}
    worst = dict.fromkeys((*QUANTITIES, "covariance"), 0.0)
    with decimal.localcontext() as context:
        context.prec = 40
        reference = plain_class(sensors, Decimal)
        for ukf in (ours, reference):
            ukf.initialize(recording.gnss_position[0], recording.gnss_baseline[0])
        for k in range(ticks):
            image = recording.pixels[k]
            case = (*has[k].tolist(), int(np.isfinite(image[:, 0]).sum()))
            cases[case] = cases.get(case, 0) + 1
            for ukf in (ours, reference):
                ukf.update(
                    recording.gnss_position[k] if case[0] else None,
                    recording.gnss_baseline[k] if case[1] else None,
                    image,
                )
            note_deviations(ours, reference, worst)
            for ukf in (ours, reference):
                ukf.predict(recording.gyro[k], recording.accel[k])
            note_deviations(ours, reference, worst)
    return worst, cases


def note_deviations(ours, reference, worst):
    for name in QUANTITIES:
        gap = distance(getattr(ours, name), getattr(reference, name))
        worst[name] = max(worst[name], gap)
    P = reference.covariance.astype(float)
    sigma = np.sqrt(np.diag(P))
    gap = abs(ours.covariance - P) / np.outer(sigma, sigma)
    worst["covariance"] = max(worst["covariance"], gap.max())


def assert_equal(worst):
    """Check bounds at or below the requirement: 1e-10 m, 1e-10 in R_BI, 1e-8 in the covariance."""
    bounds = (3e-11, 3e-10, 1e-10, 3e-9, 3e-12, 1e-9)
    for name, bound in zip((*QUANTITIES, "covariance"), bounds, strict=True):
        assert worst[name] < bound, name


@pytest.mark.parametrize("cycles", [100, pytest.param(1000, marks=pytest.mark.slow)])
def test_filter_over_many_cycles_equals_the_plain_filter(cycles):
    worst, cases = compare(LAB, cycles, seed=3)
    assert_equal(worst)
    if cycles == 1000:  # half a circle
        assert {features for *_, features in cases} == {0, 1, 2}
    assert len({(position, baseline) for position, baseline, _ in cases}) == 4


@pytest.mark.parametrize(
    "choices",
    [
        {"alpha": 1.0, "beta": 0.0, "kappa": -12.0},
        {"alpha": 0.1, "kappa": 1.0, "gravity": 9.81},
        {"alpha": 1e-2, "beta": 3.0, "kappa": -5.0, "bearing_noise_at": "predicted"},
        {"direction_variance_floor": 1e-6, "initial_covariance_scale": 5.0},
        {"initial_velocity_variance": 0.5, "integration": "midpoint"},
        {"attitude_reset": True},
        {"integration": "midpoint", "attitude_reset": True, "alpha": 0.7},
    ],
    ids=str,
)
def test_filter_with_other_choices_equals_the_plain_filter(choices):
    assert_equal(compare(estimator(**choices), 20, seed=4)[0])


def test_filter_of_other_measurements_equals_the_plain_filter():
    """Cases: no camera and a rate of 100 Hz; all measurements; few measurements."""
    assert_equal(compare(LAB.replace(camera=None).with_rates(imu=100.0), 50, seed=5)[0])
    assert_equal(compare(LAB, 30, seed=6, present=1.1)[0])
    assert_equal(compare(LAB, 30, seed=7, present=0.1)[0])


def test_filter_of_many_features_equals_the_plain_filter():
    rng = np.random.default_rng(8)
    features = tuple(map(tuple, rng.uniform((-1, -1, 0), (1, 1, 1), (16, 3))))
    sensors = LAB.replace(camera=LAB.camera.replace(features_I=features))
    worst, cases = compare(sensors, 12, seed=9)
    assert_equal(worst)
    assert max(features for *_, features in cases) > 8

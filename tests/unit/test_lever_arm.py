"""An accelerometer away from the center of mass: the filters take its lever arm into account."""

import numpy as np
import pytest

import quad_gym
from quad_gym.estimation import ExtendedKalmanFilter, UnscentedKalmanFilter
from tests.field_flights import fly, nees, steps
from tests.filter_states import set_at_rest

FLIGHTS = 400
BAND = 5 * np.sqrt(2 * 15 / FLIGHTS)
"""Five deviations of the mean of that many NEES of 15 degrees of freedom."""


def mounted(name, lever_arm, **choices):
    suite = quad_gym.sensor_suite(name)
    estimator = suite.estimator.replace(**choices)
    return suite.replace(imu=suite.imu.replace(lever_arm_B=lever_arm), estimator=estimator)


def means(batch, seconds=3):
    found = []
    for _ in range(seconds):
        steps(batch, 1.0)
        found.append(nees(batch).mean())
    return np.array(found)


@pytest.mark.parametrize("kind", ["ukf", "ekf"])
@pytest.mark.parametrize("arm", [0.01, pytest.param(0.02, marks=pytest.mark.slow), 0.05])
@pytest.mark.parametrize("name", ["rtk", "indoor"])
def test_a_known_lever_arm_leaves_the_filter_consistent(name, arm, kind):
    found = means(fly(mounted(name, (arm, -arm, arm), kind=kind), FLIGHTS, start="hover"))
    assert np.abs(found - 15.0).max() < BAND, found


@pytest.mark.parametrize("latencies", [{"gnss": 0.2, "camera": 0.08}, {"gnss": 0.1}])
def test_a_lever_arm_and_late_measurements(latencies):
    suite = mounted("rtk", (0.05, 0.05, -0.05))
    for sensor, latency in latencies.items():
        suite = suite.replace(**{sensor: getattr(suite, sensor).replace(latency=latency)})
    found = means(fly(suite, FLIGHTS, start="hover", filter_start="warm"))
    assert np.abs(found - 15.0).max() < BAND, found


def test_known_drawn_center_of_mass_leaves_the_filter_consistent():
    drawn = {"center_of_mass_B": quad_gym.Uniform(-0.03, 0.03)}
    known = {"randomization": quad_gym.Randomization(drawn, known=True)}
    suite = quad_gym.sensor_suite("rtk").simplified()
    found = means(fly(suite, FLIGHTS, start="hover", **known))
    assert np.abs(found - 15.0).max() < BAND, found


@pytest.mark.parametrize(
    ("kind", "tolerance"), [(ExtendedKalmanFilter, 1e-9), (UnscentedKalmanFilter, 1e-5)]
)
def test_a_vehicle_that_spins_up_on_the_spot_stays_there(kind, tolerance):
    """The closed form: f = dw x l + w x (w x l) + g e3, with w = (0, 0, a t) about the vertical.

    The UKF's mean has a second order: the gyro's noise makes the force point up a little less.
    """
    arm, rate = np.array([0.3, -0.2, 0.1]), 4.0
    suite = mounted("lab", tuple(arm))
    kalman = kind(sensors=suite)
    set_at_rest(kalman, 1e-14 * np.eye(15))
    w_before = None
    for tick in range(200):
        w = np.array([0.0, 0.0, rate * tick * suite.imu.dt])
        dw = np.array([0.0, 0.0, rate if tick else 0.0])
        force = np.cross(dw, arm) + np.cross(w, np.cross(w, arm)) + [0.0, 0.0, 9.8]
        kalman.predict(w, force)
        w_before = w
    assert w_before[2] > 3.9
    np.testing.assert_allclose(kalman.velocity, 0.0, atol=tolerance)
    np.testing.assert_allclose(kalman.position, 0.0, atol=tolerance)

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


def late_arm(**latencies):
    suite = mounted("rtk", (0.05, 0.05, -0.05))
    changes = {name: getattr(suite, name).replace(latency=t) for name, t in latencies.items()}
    return suite.replace(**changes)


CENTER = {"center_of_mass_B": quad_gym.Uniform(-0.03, 0.03)}
MOUNTED = {
    **{
        f"{name}, {kind}": (mounted(name, (0.05, -0.05, 0.05), kind=kind), {})
        for name in ("rtk", "indoor")
        for kind in ("ukf", "ekf")
    },
    "late": (late_arm(gnss=0.1), {"filter_start": "warm"}),
    "latest": (late_arm(gnss=0.2, camera=0.08), {"filter_start": "warm"}),
    "known drawn center of mass": (
        quad_gym.sensor_suite("rtk").simplified(),
        {"randomization": quad_gym.Randomization(CENTER, known=True)},
    ),
}


@pytest.mark.parametrize("name", MOUNTED)
def test_a_known_lever_arm_leaves_the_filter_consistent(name):
    suite, options = MOUNTED[name]
    batch = fly(suite, FLIGHTS, start="hover", **options)
    for _ in range(3):
        steps(batch, 1.0)
        assert abs(nees(batch).mean() - 15.0) < BAND


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

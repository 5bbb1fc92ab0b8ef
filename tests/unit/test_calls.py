"""The calls of a replay, repeated with a filter of one's own, give the estimates of the replay."""

import numpy as np
import pytest

import quad_gym
from quad_gym.estimation import UnscentedKalmanFilter, replay
from tests.logged_flights import Recorded, flown

RTK = quad_gym.sensor_suite("rtk").replace(camera=None)
TURNED = RTK.replace(
    log_rotation=(0.05, 0.02, 0.1),
    log_delays=RTK.log_delays.replace(gnss=0.12),
    imu=RTK.imu.replace(lever_arm_B=(0.05, -0.02, 0.03)),
)


def repeated(rows, suite):
    """Estimates (n, 6) of position and velocity by the calls in rows."""
    kf, found = UnscentedKalmanFilter(suite, window=0.62), []

    def three(numbers, place):
        return None if np.isnan(numbers[place]) else numbers[place : place + 3]

    for row in rows:
        name, *cells = row.strip().split(",")
        x = np.array([float(cell) for cell in cells])
        if name == "origin":
            np.testing.assert_array_equal(x, suite.gnss.reference_antenna_G)
        elif name == "start":
            assert np.isnan(x[[4, 13, 14, 15, 19, 20]]).all()  # none but the fix
            kf.initialize(x[1:4], three(x, 7), gnss_velocity_G=three(x, 10), time=x[0])
        elif name == "imu":
            kf.predict(x[:3], x[3:6], x[6])
        elif name == "gnss":
            kf.update(three(x, 1), three(x, 7), None, three(x, 10), time=x[0])
        else:
            assert name == "estimate"
            found.append(np.concatenate([kf.position, kf.velocity]))
    return np.array(found)


@pytest.mark.parametrize("suite", [RTK, TURNED], ids=["plain", "calibrated"])
def test_calls_of_a_replay_give_its_estimates(suite, tmp_path):
    flight = flown(RTK, 2.0)
    table = Recorded(flight, RTK, max_ticks=1).table()
    table = {name: values for name, values in table.items() if not name.startswith("pixel")}
    result = replay(table, sensors=suite, samples=tmp_path / "samples.csv")
    rows = (tmp_path / "samples.csv").read_text().splitlines()
    assert {row.split(",")[0] for row in rows} == {"origin", "start", "imu", "gnss", "estimate"}
    found = repeated(rows, suite)
    np.testing.assert_array_equal(found, np.hstack([result.position, result.velocity]))
    plain = replay(table, sensors=RTK)
    assert (suite is RTK) == np.array_equal(plain.position, result.position)


def test_calls_of_an_own_estimator_are_refused(tmp_path):
    with pytest.raises(ValueError, match="samples must not be given with an estimator"):
        replay({}, sensors=RTK, estimator="tests.estimators:Simple", samples=tmp_path / "it.csv")

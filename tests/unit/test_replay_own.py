"""Replays with a user's estimator."""

import json

import numpy as np
import pytest

import quad_gym
from quad_gym.estimation import replay
from tests.console_commands import run
from tests.estimators import Certain, Simple, gallery
from tests.logged_flights import RTK, Recorded, errors_in_flight, errors_in_replay, flown

EKF = gallery("invariant_ekf").InvariantEKF


@pytest.fixture(scope="module")
def flight():
    """A flight on the estimate of the invariant EKF."""
    return flown(seconds=6.0, estimator=EKF())


@pytest.fixture(scope="module")
def table(flight):
    return Recorded(flight, lost=0.0, jitter=0.0, max_ticks=1).table()


def test_regular_log_gives_the_estimates_of_the_flight(flight, table):
    """Estimates agree after 3 s; the starts differ, as a flight begins without a velocity."""
    result = replay(table, sensors=RTK, estimator=EKF())
    rows = np.searchsorted(flight["time"], result.time - 1e-6)
    late = result.time > 3.0
    for name, tolerance in (("position", 1e-4), ("velocity", 2e-4), ("quaternion", 1e-5)):
        found, flown = getattr(result, name), flight[f"estimated_{name}"][rows]
        if name == "quaternion":  # q and -q are one attitude
            flown = flown * np.sign((found * flown).sum(axis=1, keepdims=True))
        assert np.abs(found - flown)[late].max() < tolerance
    sigma = np.sqrt(np.diagonal(flight["covariance"][rows], axis1=1, axis2=2))
    np.testing.assert_allclose(result.sigma[late], sigma[late], rtol=0.01)


def test_irregular_log_gives_the_errors_of_the_flight(flight):
    """Samples are means over one to three ticks, with 1 % losses and 50 ms of jitter."""
    recorded = Recorded(flight)
    result = replay(recorded.table(), sensors=RTK, estimator=EKF)
    assert result.estimator == "InvariantEKF"
    k = np.searchsorted(flight["time"], result.time - 1e-6)
    late = result.time > 2.0
    found, expected = (
        np.sqrt(np.square(errors[late].reshape(-1, 3, 3)).mean(axis=(0, 2)))
        for errors in (errors_in_replay(recorded, result, k), errors_in_flight(recorded, k))
    )
    assert np.abs(found / expected - 1.0).max() < 0.3
    counts = {name: kind["count"] for name, kind in result.summary()["measurements"].items()}
    assert counts["gnss_position"] == len(recorded.gnss) - 1  # the first one starts the filter
    assert not result.problems


class Seen(Simple):
    """An estimator that records its measurements, in its class: instances are copied."""

    seen = []  # noqa: RUF012

    def reset(self, view, mask):
        self.seen.append(view)
        return super().reset(view, mask)

    def update(self, measurements):
        self.seen.append(measurements)
        return super().update(measurements)


def test_measurements_arrive_with_their_ages_and_samples_are_averaged():
    gnss = quad_gym.sensor_suite("consumer").gnss.replace(rate=5.0)
    suite = quad_gym.sensor_suite("consumer").replace(gnss=gnss, barometer=None)
    n, accel = 11, np.tile([0.0, 0.0, 9.8], (11, 1))
    time = 0.02 * np.arange(n)
    log = {
        "time": np.append(time, [0.0, 0.05, 0.06]),
        "received": np.append(time, [0.0, 0.093, 0.093]),
        "gyro": np.vstack([np.outer(np.arange(n), [0.0, 0.0, 1.0]), np.full((3, 3), np.nan)]),
        "accel": np.vstack([accel, np.full((3, 3), np.nan)]),
        "gnss_enu": np.vstack([np.full((n, 3), np.nan), [[0, 0, 0], [1, 2, 3], [4, 5, 6]]]),
    }
    Seen.seen.clear()
    result = replay(log, sensors=suite, estimator=Seen, start={"heading": 0.3})
    start, *ticks = Seen.seen
    assert (start.gnss_position.new.any(), start.barometer) == (False, None)
    assert len(ticks) == len(result) - 1 == 40
    np.testing.assert_allclose([m.gyro[0, 2] for m in ticks], np.repeat(np.arange(1, n), 4))
    np.testing.assert_allclose([m.time[0] for m in ticks], 0.005 * np.arange(1, 41))
    new = {k: m.gnss_position for k, m in enumerate(ticks, 1) if m.gnss_position.new[0]}
    assert list(new) == [19, 20]  # two at once: the second waits for a tick
    np.testing.assert_allclose(new[19].value, [[1.0, 2.0, 3.0]], atol=1e-9)
    np.testing.assert_allclose([new[19].age, new[20].age], [0.045, 0.04], atol=1e-9)
    assert not ticks[0].magnetometer.new.any()
    assert np.isnan(result.sigma).all()
    assert result.too_late == 0
    narrow = replay(log, sensors=suite, estimator=Seen, start={"heading": 0.3}, window=0.01)
    np.testing.assert_allclose(narrow.late["gnss"], [0.043, 0.033])


def test_invalid_starts_and_estimates_are_refused(table):
    no_baseline = {name: v for name, v in table.items() if "baseline" not in name}
    with pytest.raises(ValueError, match="start must have a heading, or the log a baseline"):
        replay(no_baseline, sensors=RTK, estimator=Simple)
    with pytest.raises(ValueError, match="estimator must name a quad_gym"):
        replay(table, sensors=RTK, estimator="tests.estimators:Nothing")
    with pytest.raises(ValueError, match=r"Diverges\.update must return finite numbers"):
        replay(table, sensors=RTK, estimator="tests.estimators:Diverges")


def test_command_writes_the_estimates_of_an_own_estimator(flight, table, tmp_path):
    pytest.importorskip("matplotlib")
    Recorded(flight, lost=0.0, jitter=0.0, max_ticks=1).write_csv(tmp_path / "flight.csv")
    options = ("flight.csv", "--sensors", "rtk", "--output", "out")
    own = ("--estimator", "tests.estimators:Certain")
    ended = run("replay", *options, *own, where=tmp_path)
    assert ended.returncode == 0, ended.stderr
    assert "gyro: estimated bias 0.02 rad/s" in ended.stdout  # a note
    names = {"estimates.csv", "innovations.csv", "replay.json", "replay.png", "replay.svg"}
    assert {file.name for file in (tmp_path / "out").iterdir()} == names
    rows = np.genfromtxt(tmp_path / "out/estimates.csv", delimiter=",", names=True)
    direct = replay(table, sensors=RTK, estimator=Certain())
    np.testing.assert_allclose(rows["position_x"], direct.position[:, 0], atol=1e-9)
    np.testing.assert_allclose(rows["position_sigma_y"], 2.0)
    found = json.loads((tmp_path / "out/replay.json").read_text())
    assert found["measurements"]["gnss_baseline"]["mean_nis"] is None
    refused = run("replay", *options, *own, "--smooth", "--overwrite", where=tmp_path)
    assert refused.returncode == 2
    assert "--smooth must not be given with an --estimator" in refused.stderr

"""Repeated values and batches of stamps in logs, on rows made with NumPy."""

import numpy as np
import pytest

from quad_gym.estimation import read_log, replay
from quad_gym.logs.formats.clocks import repeats
from quad_gym.rotations import quaternion_to_dcm
from tests import foreign_logs


@pytest.fixture(scope="module")
def table():
    return foreign_logs.flight(20.0).table()


def test_repeats_by_chance_are_measurements():
    """Of 300 sensors whose values repeat by their resolution, at most a few have a long run."""
    rng = np.random.default_rng(0)
    for levels in (2, 3, 10, 1000):
        found = [repeats(rng.integers(0, levels, 1000).astype(float)).any() for _ in range(300)]
        assert np.mean(found) < 0.03, levels


def test_a_frozen_sensor_repeats_from_its_second_row_on():
    rng = np.random.default_rng(1)
    values = rng.integers(0, 5, (1000, 3)).astype(float)
    values[400:430] = values[400]
    values[700:800] = values[700]
    values[::7] = np.nan
    rows = np.flatnonzero(repeats(values))
    measured = np.arange(1000) % 7 > 0
    wanted = [k for k in (*range(402, 430), *range(702, 800)) if measured[k]]
    assert set(wanted) - set(rows) == set()
    assert len(rows) <= len(wanted) + 3


def test_constant_values_of_a_whole_log_are_kept():
    assert not repeats(np.zeros((500, 3))).any()


@pytest.mark.parametrize("name", ["magnetometer", "barometer", "gnss_enu", "gnss_velocity_enu"])
def test_a_sensor_that_hangs_counts_once_and_is_named(table, name):
    """It repeats its value for three seconds, in the middle of a flight."""
    changed = table | {name: table[name].copy()}
    time, own = table["time"], np.isfinite(table[name].reshape(len(table["time"]), -1)[:, 0])
    hangs = np.flatnonzero(own & (time > 10.0) & (time < 13.0))
    changed[name][hangs] = changed[name][hangs[0]]
    without = table | {name: table[name].copy()}
    without[name][hangs[1:]] = np.nan
    result = replay(changed, sensors="field")
    wanted = replay(without, sensors="field")
    np.testing.assert_array_equal(result.position, wanted.position)
    np.testing.assert_array_equal(result.quaternion, wanted.quaternion)
    word = {"gnss_enu": "position of GNSS", "gnss_velocity_enu": "velocity of GNSS"}.get(name, name)
    assert any(note.startswith(f"{word} (table) repeats one") for note in result.notes)


def batched(time, size, apart):
    """Stamps of samples that arrive in batches, at the time of the last one."""
    stamps = time.copy()
    for k in range(0, len(time), size):
        part = time[k : k + size]
        stamps[k : k + size] = part[-1] - apart * np.arange(len(part))[::-1]
    return stamps


@pytest.mark.parametrize(("size", "apart"), [(5, 0.0), (10, 1e-5), (4, 2e-3), (2, 1e-5)])
def test_samples_in_batches_are_spread_to_their_times(size, apart):
    """The samples of 200 Hz are at most a tenth of a step from their true times."""
    time, rng = 0.005 * np.arange(1, 2001), np.random.default_rng(2)
    gyro, accel = rng.normal(0, 0.01, (2000, 3)), rng.normal([0, 0, 9.8], 0.05, (2000, 3))
    given = {"time": batched(time, size, apart), "gyro": gyro, "accel": accel}
    log = read_log(given)
    np.testing.assert_allclose(log.imu.time, time, atol=5e-4)
    np.testing.assert_array_equal(log.imu.values["gyro"], gyro)
    assert any(f"stamped in batches of {size}" in note for note in log.notes)


@pytest.mark.parametrize("jitter", ["none", "uniform", "late", "lost", "several steps"])
def test_jittered_and_lost_samples_are_no_batches(jitter):
    rng = np.random.default_rng(3)
    time = 0.005 * np.arange(1, 2001)
    if jitter == "uniform":
        time = time + rng.uniform(0.0, 0.004, len(time))
    elif jitter == "late":
        time = np.sort(time + rng.exponential(0.004, len(time)))
    elif jitter == "lost":
        time = time[rng.random(len(time)) < 0.5]
    elif jitter == "several steps":
        time = np.cumsum(0.005 * rng.integers(1, 4, 1000))
    n = len(time)
    given = {"time": time, "gyro": rng.normal(0, 0.01, (n, 3)), "accel": np.ones((n, 3)) * 5.7}
    log = read_log(given)
    np.testing.assert_array_equal(log.imu.time, time)


def test_replay_of_batches_has_the_attitude_of_the_unchanged_log(table):
    """Without spreading, the attitude is off by several degrees."""
    rows = np.isfinite(table["gyro"][:, 0])
    changed = table | {"time": table["time"].copy()}
    changed["time"][rows] = batched(table["time"][rows], 5, 1e-5)
    order = np.argsort(changed["time"], kind="stable")
    result = replay({k: v[order] for k, v in changed.items()}, sensors="field")
    wanted = replay(table, sensors="field")
    k = np.searchsorted(wanted.time, result.time - 1e-6).clip(0, len(wanted) - 1)
    R = quaternion_to_dcm(result.quaternion) @ quaternion_to_dcm(wanted.quaternion[k]).swapaxes(
        1, 2
    )
    angles = np.arccos(np.clip(0.5 * (np.trace(R, axis1=1, axis2=2) - 1.0), -1.0, 1.0))
    assert np.degrees(np.sqrt((angles[len(angles) // 2 :] ** 2).mean())) < 1.0


def test_ranges_of_some_anchors_may_be_given_together(table):
    """As columns for each anchor, and as one array of as many columns as there are anchors."""
    n = len(table["time"])
    ranges = np.where(np.isfinite(table["gyro"]), np.nan, 4.0)[:, :1] + np.arange(4.0)
    ranges[:, :] += np.random.default_rng(4).normal(0, 0.1, (n, 4))
    together = read_log(table | {"uwb_range": ranges})
    apart = read_log(table | {f"uwb_range_{k}": ranges[:, k] for k in range(4)})
    for log in (together, apart):
        assert log.uwb_range.values["uwb_range"].shape[1] == 4
    np.testing.assert_array_equal(
        together.uwb_range.values["uwb_range"], apart.uwb_range.values["uwb_range"]
    )
    with pytest.raises(ValueError, match="column uwb_range must have shape"):
        read_log(table | {"uwb_range": np.zeros((n, 9))})

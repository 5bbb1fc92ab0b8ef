"""Ranges to anchors: measurements by formula, updates by numerical derivatives, consistency."""

import numpy as np
import pytest

import quad_gym
import quad_gym.frames
from quad_gym.analysis.consistency import InnovationRecorder
from quad_gym.estimation import ExtendedKalmanFilter, UnscentedKalmanFilter
from quad_gym.estimation.inputs import measured_blocks
from quad_gym.logs.formats import read_log
from quad_gym.logs.replaying.measurements import LogMeasurements, MisfitError
from quad_gym.params.portable import euler_dcm
from quad_gym.records import AID_BLOCK, AID_GROUPS, Aid, Control, GateDecision
from quad_gym.rotations import quaternion_to_dcm
from tests.builders import batch as flights_of
from tests.field_flights import fly, nees, steps
from tests.filter_states import set_at_rest

UWB = quad_gym.sensor_suite("uwb")
TAG = (0.1, -0.05, 0.08)
FIRST = AID_BLOCK[Aid.UWB_RANGE]


def suite_with(**changes):
    """The suite with other ranges."""
    return UWB.replace(uwb_range=UWB.uwb_range.replace(**changes))


def distances(r, R_BI, params):
    """Distances (..., anchors) of the antenna from the anchors."""
    antenna = r + np.einsum("...ij,i->...j", R_BI, params.tag_B)
    return np.linalg.norm(antenna[..., np.newaxis, :] - params.anchors_I, axis=-1)


def test_ranges_have_the_closed_form_their_noise_and_outliers():
    suite = suite_with(rate=200.0, tag_B=TAG, outlier_probability=0.2, outlier_size=3.0)
    batch, errors = fly(suite, 100, task="circle", start="hover"), []
    for _ in range(20):
        batch.step()
        truth = distances(batch.record("r"), quaternion_to_dcm(batch.record("q")), suite.uwb_range)
        np.testing.assert_array_equal(batch.read("uwb_range").shape, (100, 4))
        errors.append(batch.read("uwb_range") - truth)
    errors = np.concatenate(errors)
    far = errors > 0.5  # detours beyond the noise: 0.2 (3 - 0.5) / 3 of all, 8,000 ranges
    assert far.mean() == pytest.approx(0.2 * 2.5 / 3.0, abs=4.0 * np.sqrt(0.14 / 8000))
    assert errors[far].mean() == pytest.approx(1.75, abs=0.1)
    short = errors[errors < 0.0]  # half a normal distribution
    assert np.sqrt(np.mean(short**2)) == pytest.approx(0.1, rel=0.1)
    assert abs(np.corrcoef(errors.T)[np.triu_indices(4, 1)]).max() < 0.1


def test_true_sensors_have_as_many_anchors_as_the_filter_assumes():
    fewer = suite_with(anchors_I=UWB.uwb_range.anchors_I[:3])
    with pytest.raises(ValueError, match="number of uwb_range measurements of sensors, 4, got 3"):
        UWB.require_like(fewer)


def test_anchors_beyond_the_longest_range_are_not_measured():
    suite = suite_with(max_range=3.0, outlier_probability=0.0)
    batch = fly(suite, 1, task="hover", start="hover")
    snapshot = batch.snapshot()
    snapshot["r"][0, :, 0], snapshot["wait"] = (-4.5, -4.5, 1.0), 0.0
    batch.restore(snapshot)
    batch.step()
    valid = batch.record("block_valid")[0, FIRST : FIRST + 8]
    np.testing.assert_array_equal(valid, [1, 0, 0, 0, 0, 0, 0, 0])
    assert np.isfinite(batch.read("uwb_range")[0]).tolist() == [True, False, False, False]


def filter_in_flight(kind):
    """A filter with GNSS and ranges, whose state is tilted and turned."""
    suite = quad_gym.sensor_suite("rtk").simplified()
    suite = suite.replace(
        gnss=suite.gnss.replace(position_sigma_I=(0.1, 0.1, 0.15)),
        uwb_range=quad_gym.UwbRangeParams(tag_B=TAG),
    )
    kf = kind(suite)
    kf.initialize((0.0, 0.0, 0.0), suite.gnss.baseline_B, heading=0.3)
    kf._engine.fill("r_hat", np.array([0.4, -0.7, 1.2]))
    kf.predict((0.1, -0.2, 0.3), (0.5, 1.0, 9.5), 0.005)
    return kf, suite.uwb_range


def numerical_update(kf, params, given):
    """The linear update with numerical derivatives."""
    r, R_BI, P = kf.position, kf.R_BI, kf.covariance
    known = np.isfinite(given)

    def predicted(dx):
        return distances(r + dx[:3], euler_dcm(dx[6:9]) @ R_BI, params)[known]

    H = np.zeros((known.sum(), 15))
    for i in range(9):
        step = 1e-5 * np.eye(15)[i]
        H[:, i] = (predicted(step) - predicted(-step)) / 2e-5
    mean = center = predicted(np.zeros(15))
    if kf._kind == "ukf":  # the mean of the sigma points, to second order
        for column in 1e-2 * np.linalg.cholesky(P).T:
            mean = mean + 0.5 * (predicted(column) + predicted(-column) - 2.0 * center) / 1e-4
    S = H @ P @ H.T + params.noise_sigma**2 * np.eye(known.sum())
    K = P @ H.T @ np.linalg.inv(S)
    return r, K @ (given[known] - mean), P - K @ S @ K.T


@pytest.mark.parametrize("missing", [(), (1,), (0, 2, 3)])
@pytest.mark.parametrize("kind", [UnscentedKalmanFilter, ExtendedKalmanFilter])
def test_update_agrees_with_a_linear_update_by_numerical_derivatives(kind, missing):
    kf, params = filter_in_flight(kind)
    given = distances(kf.position, kf.R_BI, params) + np.array([0.05, -0.08, 0.03, 0.06])
    given[list(missing)] = np.nan
    r, dx, P = numerical_update(kf, params, given)
    kf.update(uwb_range=given)
    tolerance = 1e-6 if kind is ExtendedKalmanFilter else 1e-2  # higher-order terms
    scale = np.sqrt(np.diag(P))
    np.testing.assert_allclose((kf.position - r - dx[:3]) / scale[:3], 0.0, atol=tolerance)
    difference = (kf.covariance - P) / np.outer(scale, scale)
    np.testing.assert_allclose(difference[:6, :6], 0.0, atol=tolerance)
    assert abs(dx[:3]).max() > 1e-3  # there was something to correct


def test_rows_of_a_log_without_some_of_the_ranges_are_kept():
    n = 400
    table = {"time": 0.01 * np.arange(n), "gyro": np.zeros((n, 3)), "accel": np.zeros((n, 3))}
    table["accel"][:, 2] = 9.8
    ranges = np.full((4, n), np.nan)
    ranges[:, 10::10] = np.array([[6.0], [np.nan], [7.0], [8.0]])
    table |= {f"uwb_range_{anchor}": ranges[anchor] for anchor in range(4)}
    stream = read_log(table).streams["uwb_range"]
    np.testing.assert_array_equal(stream.time, table["time"][10::10])
    first = LogMeasurements(read_log(table), UWB, False).at("uwb_range", 0)
    assert measured_blocks(first) == [FIRST, FIRST + 2, FIRST + 3]
    more = table | {"uwb_range_4": np.where(np.arange(n) % 10 == 5, 9.0, np.nan)}
    measured = LogMeasurements(read_log(more), UWB, False)
    of_fifth = measured.streams["uwb_range"].values["uwb_range"][:, 4] > 0.0
    rows = np.arange(len(of_fifth))  # the suite has no fifth anchor
    np.testing.assert_array_equal(measured.present(measured.number("uwb_range"), rows), ~of_fifth)
    fewer = {name: column for name, column in table.items() if name != "uwb_range_3"}
    with pytest.raises(MisfitError, match=r"must have the 4 blocks of uwb_range .* got 3"):
        LogMeasurements(read_log(fewer), UWB, False)


@pytest.mark.parametrize("kind", [UnscentedKalmanFilter, ExtendedKalmanFilter])
def test_only_the_wrong_range_is_rejected(kind):
    kf, params = filter_in_flight(kind)
    given = distances(kf.position, kf.R_BI, params)
    other, _ = filter_in_flight(kind)
    other.update(uwb_range=[given[0], np.nan, *given[2:]])
    given[1] += 5.0
    kf.update(uwb_range=given)
    gates = kf._engine.read("gate")[0, FIRST : FIRST + 4]
    accepted, rejected = GateDecision.ACCEPTED, GateDecision.REJECTED
    assert gates.tolist() == [accepted, rejected, accepted, accepted]
    # the spread of the sigma points was chosen for all measurements
    np.testing.assert_allclose(kf.position, other.position, atol=1e-9)
    np.testing.assert_allclose(kf.covariance, other.covariance, rtol=1e-6, atol=1e-12)


def test_ranges_that_are_no_ranges_to_the_anchors_are_refused():
    kf, _ = filter_in_flight(UnscentedKalmanFilter)
    with pytest.raises(ValueError, match=r"uwb_range must have shape \(4,\), got \(3,\)"):
        kf.update(uwb_range=[1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="anchors_I must have 1 to 8 positions, got 9"):
        quad_gym.UwbRangeParams(anchors_I=np.zeros((9, 3)))


def test_suite_with_more_blocks_than_an_update_has_room_for_is_refused():
    camera = quad_gym.sensor_suite("indoor").camera  # sixteen features
    eight = UWB.uwb_range.replace(anchors_I=np.arange(24.0).reshape(8, 3))
    with pytest.raises(ValueError, match=r"at most 20 camera features and measurements .* got 24"):
        UWB.replace(camera=camera, uwb_range=eight)


@pytest.mark.parametrize(
    ("kind", "start", "late"),
    [("ukf", "cold", False), ("ukf", "warm", True), ("ekf", "cold", True), ("ekf", "warm", False)],
)
def test_filters_are_consistent(kind, start, late):
    """The mean of 200 NEES has a standard deviation of 0.39; each NIS, of the last ranges, 0.1."""
    suite = suite_with(latency=0.04 * late, outlier_probability=0.0)
    suite = suite.replace(estimator=suite.estimator.replace(kind=kind)).simplified()
    suite = suite.replace(uwb_range=suite.uwb_range.replace(latency=0.04 * late))
    batch = fly(suite, 200, task="circle", filter_start=start)
    steps(batch, 3.0)
    assert not batch.record("filter_status").any()
    assert nees(batch).mean() == pytest.approx(15.0, abs=1.6)
    nis = batch.record("block_nis")[:, FIRST : FIRST + 4].mean(axis=0)
    np.testing.assert_allclose(nis, 1.0, atol=0.4)


@pytest.mark.slow  # 400 flights of 20 s
@pytest.mark.parametrize("kind", ["ukf", "ekf"])
def test_flights_with_outliers_have_white_innovations_and_a_consistent_estimate(kind):
    """Outliers are rejected, or are within the noise."""
    suite = UWB.replace(estimator=UWB.estimator.replace(kind=kind))
    batch = fly(suite, 400, task="random_trajectory", filter_start="cold", start="hover")
    recorder, means = InnovationRecorder(batch, [0.0, 20.0], settle=5.0), []
    for k in range(4000):
        batch.step()
        recorder.add(batch, (k + 1) / 200.0)
        if k % 1000 == 999:
            means.append(nees(batch).mean())
    assert recorder.whiteness()["uwb_range"].white
    np.testing.assert_allclose(means, 15.0, atol=1.2)


def test_loss_of_ranges_leaves_none_and_recovers():
    loss = quad_gym.faults.SensorLoss(sensor="uwb_range", start=1.0, duration=1.0)
    batch = fly(UWB, 8, task="hover", start="hover", faults=(loss,))
    counts = []
    for _ in range(3):
        counts.append(0)
        for _ in range(200):
            batch.step()
            counts[-1] += int(batch.record("block_valid")[:, FIRST].sum())
    assert counts[1] == 0
    assert counts[0] == counts[2] == 8 * 25


def test_a_crazyflie_hovers_on_its_ranges():
    task = quad_gym.TaskParams(kind="hover", start="hover")
    made = {"vehicle": quad_gym.vehicle_params("crazyflie"), "sensors": "uwb", "task": task}
    batch = flights_of(16, control=Control.VELOCITY, **made)
    for _ in range(600):
        batch.step(np.zeros((16, 4)))
    assert (np.linalg.norm(batch.record("v"), axis=1) < 0.3).all()
    assert (quaternion_to_dcm(batch.record("q"))[:, 2, 2] > 0.99).all()


def mirrored(place, anchors):
    """A place at the same distances from three anchors: its mirror image in their plane."""
    normal = np.cross(anchors[1] - anchors[0], anchors[2] - anchors[0])
    normal = normal / np.linalg.norm(normal)
    return place - 2.0 * (normal @ (place - anchors[0])) * normal


def seconds_until_flagged(suite, kind, ranges_at):
    """Time until a filter at rest at PLACE is flagged [s]; infinite after two seconds.

    Before, it has the right ranges for longer than its initial position counts as measured.
    """
    kf, rng = kind(suite), np.random.default_rng(3)
    P = np.diag(np.repeat([0.05, 0.05, 0.01, 0.02, 0.001], 3) ** 2)
    set_at_rest(kf, P, position=PLACE)
    for step in range(-30, 50):  # at 25 Hz
        ranges = (HERE if step < 0 else ranges_at(step)) + suite.uwb_range.noise_sigma * rng.normal(
            size=5
        )
        given = {"uwb_range": ranges[: suite.uwb_range.blocks]}
        if suite.gnss is not None:
            R_IG = quad_gym.frames.ecef_to_enu(suite.gnss.reference_antenna_G)
            given["gnss_position_G"] = R_IG.T @ (PLACE + suite.gnss.primary_antenna_B)
            given["gnss_velocity_G"] = np.zeros(3)
        kf.update(**given)
        if kf.diverged:
            return 0.04 * (step + 1)
        for _ in range(8):
            kf.predict(np.zeros(3), (0.0, 0.0, 9.8), 0.005)
    return np.inf


FIVE = suite_with(anchors_I=(*UWB.uwb_range.anchors_I, (0.0, 0.0, 6.0)))
PLACE = np.array([1.0, 0.5, 1.5])
HERE = distances(PLACE, np.eye(3), FIVE.uwb_range)


@pytest.mark.parametrize("kind", [UnscentedKalmanFilter, ExtendedKalmanFilter])
def test_filter_is_flagged_where_three_ranges_agree_with_a_wrong_place(kind):
    """Three of four ranges are those of the estimate, so only the fourth one shows the error."""
    place = mirrored(PLACE, np.array(FIVE.uwb_range.anchors_I))
    there = distances(place, np.eye(3), FIVE.uwb_range)
    np.testing.assert_allclose(there[:3], HERE[:3], rtol=1e-12)
    assert abs(there[3] - HERE[3]) > 1.0
    assert seconds_until_flagged(UWB, kind, lambda _: there) < 0.5


WITH_GNSS = quad_gym.sensor_suite("rtk").simplified().replace(uwb_range=UWB.uwb_range)


@pytest.mark.parametrize(
    ("suite", "detours"),
    [
        (FIVE, lambda _: 3.0 * np.eye(5)[4]),
        (WITH_GNSS, lambda _: 3.0 * np.eye(5)[3]),
        (UWB, lambda step: 2.0 * np.eye(5)[step % 4]),
    ],
    ids=["four others", "gnss", "each in turn"],
)
def test_filter_is_not_flagged_where_others_contradict_a_range(suite, detours):
    kind = UnscentedKalmanFilter
    assert seconds_until_flagged(suite, kind, lambda step: HERE + detours(step)) == np.inf


def test_reset_to_ranges_is_as_large_as_the_largest_innovation_of_those_measured():
    """An anchor without a range has the innovation of an earlier one."""
    kf, group = ExtendedKalmanFilter(UWB), AID_GROUPS + Aid.UWB_RANGE
    set_at_rest(kf, 1e-6 * np.eye(15))
    blocks = kf._engine.blocks
    blocks["tick"] += 60.0 * UWB.imu.rate
    blocks["rejected_in_row"][:, group] = 20.0
    blocks["innovation"][:, FIRST + 2, 0] = 50.0
    off = np.array([2.0, -5.0, np.nan, 3.0])
    kf.update(uwb_range=distances(kf.position, kf.R_BI, UWB.uwb_range) + off)
    assert kf._engine.read("resets")[0, group] == 1.0
    np.testing.assert_allclose(kf.covariance[:3, :3], 25.0 * np.eye(3), rtol=1e-3, atol=1e-3)

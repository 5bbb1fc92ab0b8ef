"""Innovations of each block against a plain filter; the gate, and its reopening."""

import math

import numpy as np
import pytest
from scipy import stats

import quad_gym
from quad_gym.estimation import UnscentedKalmanFilter
from quad_gym.frames import ecef_to_enu
from quad_gym.packing import params_record
from quad_gym.params.suites import ALL_SUITES
from quad_gym.records import (
    BASELINE_BLOCK,
    FEATURE_BLOCKS,
    POSITION_BLOCK,
    FilterStatus,
    GateDecision,
)
from tests.circle_flight import record_circle
from tests.field_flights import fly, measured_now, state_errors, steps
from tests.filter_states import set_at_rest, set_like
from tests.lane_filter import EIGHT, STATE, LaneFilter
from tests.reference_ukf import PlainUKF, block_diagonal
from tests.unit.alarms import ALARM

LAB = quad_gym.sensor_suite("lab")
CONSISTENT = LAB.replace(estimator=LAB.estimator.replace(bearing_noise_at="predicted"))
GATED = LAB.replace(
    estimator=LAB.estimator.replace(
        bearing_noise_at="predicted", false_alarm_probability=1e-4, max_rejections=5
    )
)
GRADUAL = GATED.replace(
    estimator=GATED.estimator.replace(kind="ekf", recursive_update_threshold=0.3)
)
RECORDING = record_circle(CONSISTENT, 400, 11)
FIX = slice(0, 3)


def warm(sensors, ticks):
    """A filter after the first `ticks` ticks of the recording."""
    ukf = UnscentedKalmanFilter(sensors)
    ukf.initialize(RECORDING.gnss_position[0], RECORDING.gnss_baseline[0])
    for k in range(ticks):
        cycle(ukf, k)
    return ukf


def cycle(ukf, k, **changes):
    measurements = {
        "gnss_position_G": RECORDING.gnss_position[k],
        "gnss_baseline_G": RECORDING.gnss_baseline[k],
        "pixels": RECORDING.pixels[k],
    }
    ukf.update(**{**measurements, **changes})
    ukf.predict(RECORDING.gyro[k], RECORDING.accel[k])


class InnovatingUKF(PlainUKF):
    """The plain filter, with the NIS of each block."""

    def update(self, *measurements):
        super().update(*measurements)
        z, S, self.nis, parts = self.innovation, self.innovation_covariance, [], []
        names = ["position", "baseline"] + ["feature"] * (len(z) // 3 - 2)
        for k, name in enumerate(names):
            part = np.eye(len(z))[3 * k : 3 * k + 3]
            if name != "position":  # across the predicted direction
                u = self.prediction[3 * k : 3 * k + 3]
                part = np.linalg.svd(u[np.newaxis])[2][1:] @ part
            self.nis.append(normalized_square(part, z, S))
            parts.append(part)
        self.joint = normalized_square(np.vstack(parts), z, S), len(np.vstack(parts))


def normalized_square(part, nu, S):
    return part @ nu @ np.linalg.solve(part @ S @ part.T, part @ nu)


@pytest.mark.parametrize("across", ["measured", "predicted", "pinhole"])
def test_nis_of_each_block_and_of_all_agrees_with_a_plain_filter(across):
    sensors = LAB.replace(estimator=LAB.estimator.replace(bearing_noise_at=across))
    ours, plain = UnscentedKalmanFilter(sensors), InnovatingUKF(sensors)
    for ukf in (ours, plain):
        ukf.initialize(RECORDING.gnss_position[0], RECORDING.gnss_baseline[0])
    for k in range(60):
        seen = np.flatnonzero(np.isfinite(RECORDING.pixels[k][:, 0]))
        fix = RECORDING.gnss_position[k], RECORDING.gnss_baseline[k], RECORDING.pixels[k]
        for ukf in (ours, plain):
            ukf.update(*fix)
        blocks = [POSITION_BLOCK, BASELINE_BLOCK, *(FEATURE_BLOCKS + seen)]
        np.testing.assert_allclose(ours.block_nis[blocks], plain.nis, rtol=1e-4, atol=1e-4)
        assert ours.nis[1] == plain.joint[1]
        if k >= 30 and across != "measured":  # else components along directions are correlated
            np.testing.assert_allclose(ours.nis[0], plain.joint[0], rtol=0.15)
        assert (ours.gate_decisions[blocks] == GateDecision.ACCEPTED).all()
        for ukf in (ours, plain):
            ukf.predict(RECORDING.gyro[k], RECORDING.accel[k])


@pytest.mark.parametrize("azimuth", [0.0, 1.0, 2.5])
def test_innovation_of_a_vertical_direction_has_the_size_of_its_angle(azimuth):
    """A vertical direction has no horizontal one across it: any two axes do, of length one."""
    gnss = LAB.gnss.replace(primary_antenna_B=(0.0, 0.0, 0.0), secondary_antenna_B=(0.0, 0.0, 0.2))
    ukf = UnscentedKalmanFilter(LAB.replace(gnss=gnss))
    set_at_rest(ukf, 1e-6 * np.eye(15))
    angle, R_IG = 2e-3, ecef_to_enu(gnss.reference_antenna_G)
    across = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    u = math.sin(angle) * across + [0.0, 0.0, math.cos(angle)]
    ukf.update(gnss_position_G=np.zeros(3), gnss_baseline_G=R_IG.T @ (0.2 * u))
    size = np.linalg.norm(ukf._engine.read("innovation")[0, BASELINE_BLOCK, :2])
    assert size == pytest.approx(math.sin(angle), rel=1e-6)


@pytest.mark.parametrize("wrong", ["gnss_position_G", "gnss_baseline_G", "pixels"])
def test_a_rejected_block_is_as_good_as_not_measured(wrong):
    k = int(np.flatnonzero(np.isfinite(RECORDING.pixels).all(axis=(1, 2)))[-1])
    assert k > 100
    without = warm(CONSISTENT, k)
    gated = UnscentedKalmanFilter(GATED)
    set_like(gated, without)
    baseline, pixels = RECORDING.gnss_baseline[k], RECORDING.pixels[k]
    block, value, lacking = {
        "gnss_position_G": (POSITION_BLOCK, RECORDING.gnss_position[k] + 0.5, None),
        "gnss_baseline_G": (BASELINE_BLOCK, baseline @ np.diag([-1.0, -1.0, 1.0]), None),
        "pixels": (
            FEATURE_BLOCKS,
            pixels + np.array([[600.0, 0.0], [0.0, 0.0]]),
            np.where([[True], [False]], np.nan, pixels),
        ),
    }[wrong]
    cycle(gated, k, **{wrong: value})
    cycle(without, k, **{wrong: lacking})
    assert gated.gate_decisions[block] == GateDecision.REJECTED
    assert (gated.gate_decisions == GateDecision.REJECTED).sum() == 1
    assert gated.status == FilterStatus(0)
    np.testing.assert_allclose(gated.position, without.position, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(gated.R_BI, without.R_BI, rtol=0.0, atol=1e-9)
    sigma = np.sqrt(np.diag(without.covariance))
    gap = (gated.covariance - without.covariance) / np.outer(sigma, sigma)
    assert abs(gap).max() < 1e-6


def test_gate_threshold_is_the_chi_square_quantile_of_its_false_alarm_probability():
    record = params_record(quad_gym.VehicleParams(), GATED)
    assert record["gate"][0, POSITION_BLOCK] == pytest.approx(stats.chi2.isf(1e-4, 3), rel=1e-12)
    assert record["gate"][0, BASELINE_BLOCK] == pytest.approx(stats.chi2.isf(1e-4, 2), rel=1e-12)
    assert (params_record(quad_gym.VehicleParams(), LAB)["gate"] == np.inf).all()


def test_a_lane_gates_for_itself():
    """The neighbors of a flight with a rejected position have the estimates of ungated filters."""
    filters, free = LaneFilter(GATED), LaneFilter(CONSISTENT)
    for lanes in (filters, free):
        for lane in range(EIGHT):
            lanes.measure(lane, RECORDING, 0)
        lanes.initialize()
        if lanes is filters:
            lanes.put(3, gnss_position=RECORDING.gnss_position[0] + 5.0)
        lanes.update()
    others = [0, 1, 2, 4, 5, 6, 7]
    for name in STATE:
        np.testing.assert_array_equal(filters.get(name)[others], free.get(name)[others])
    np.testing.assert_array_equal(filters.get("gate")[:, POSITION_BLOCK], [1, 1, 1, 2, 1, 1, 1, 1])


@pytest.mark.parametrize("suite", [CONSISTENT, GRADUAL])
def test_nis_and_estimate_of_a_lane_do_not_depend_on_others(suite):
    # neither on what others measure, nor on their steps
    names = (*STATE, "nis", "nis_dimension", "block_nis", "innovation_sigma", "gate")

    def updated(lanes):
        filters = LaneFilter(suite)
        for lane in range(EIGHT):
            filters.measure(lane, RECORDING, 0)
        filters.initialize()
        for lane, (doubt, position, baseline, camera) in enumerate(lanes):
            filters.put(lane, P=doubt**2 * filters.get("P")[lane])
            seen = {"position": position, "baseline": baseline, "camera": camera}
            filters.measure(lane, RECORDING, 0, **seen)
        filters.update()
        return {name: filters.get(name) for name in names}

    sensors = [
        (0, 0, 1),
        (1, 0, 1),
        (0, 1, 1),
        (0, 0, 1),
        (1, 0, 0),
        (0, 1, 1),
        (1, 1, 1),
        (0, 0, 1),
    ]
    lanes = [(0.1 if k % 2 else 10.0, *seen) for k, seen in enumerate(sensors)]
    mixed = updated(lanes)
    in_steps = np.isnan(mixed["nis"])
    assert in_steps.any() == (suite is GRADUAL)
    assert not in_steps.all()
    for lane, chosen in enumerate(lanes):
        alike = updated([chosen] * EIGHT)
        for name, values in mixed.items():
            np.testing.assert_array_equal(values[lane], alike[name][lane], err_msg=name)


def test_valid_measurements_are_rejected_at_the_false_alarm_probability():
    suite = quad_gym.sensor_suite("consumer").simplified()
    two = suite.gnss.replace(secondary_antenna_B=(0.1, 0.0, 0.0472), baseline_sigma=0.035)
    suite = suite.replace(gnss=two, estimator=suite.estimator.replace(false_alarm_probability=0.01))
    batch = fly(suite, 400, task="hover")
    steps(batch, 5.0)  # until the larger uncertainty of the start is over
    blocks = measured_now(batch).shape[1]  # GNSS and camera; the blocks of other sensors follow
    before, taken = batch.record("rejections").sum(axis=0)[:blocks], 0
    for _ in range(1000):
        batch.step()
        taken = taken + measured_now(batch).sum(axis=0)
    share = (batch.record("rejections").sum(axis=0)[:blocks] - before) / np.maximum(taken, 1)
    assert taken[BASELINE_BLOCK] == 400 * 50
    # independent in time, so a binomial's sigma is 0.0007
    assert 0.006 < share[BASELINE_BLOCK] < 0.014


def shifted(batch, **changes):
    """Change the estimate, so that it is wrong."""
    flights = batch.snapshot()
    for name, change in changes.items():
        flights[name] = change(flights[name])
    batch.restore(flights)


@pytest.mark.parametrize("name", ["rtk", "consumer"])
def test_a_jump_does_not_lock_the_filter_out_for_ever(name):
    suite = quad_gym.sensor_suite(name)
    if name == "consumer":  # with a drift, a jump of the vehicle looks like a GNSS jump
        suite = suite.replace(gnss=suite.gnss.replace(drift_sigma_I=(0.0, 0.0, 0.0)))
    batch = fly(suite.replace(camera=None), 200, task="hover")
    steps(batch, 5.0)
    jump = np.array([4.0, -3.0, 2.0])[np.newaxis, :, np.newaxis]
    shifted(batch, r_hat=lambda r: r + jump)
    steps(batch, suite.estimator.glitch_timeout + 3.0)  # it may be a step of the fixes
    errors = np.linalg.norm(state_errors(batch)[:, FIX], axis=1)
    assert errors.max() < 1.0
    assert (batch.record("resets")[:, 0] >= 1.0).all()
    assert not batch.record("filter_status").any()
    sigma = np.sqrt(np.einsum("nii->ni", batch.covariance()))[:, FIX]
    assert (abs(state_errors(batch)[:, FIX]) < 5 * sigma).all()


def test_a_wrong_heading_does_not_lock_the_baseline_out_for_ever():
    suite = quad_gym.sensor_suite("rtk").simplified().replace(camera=None)
    batch = fly(suite, 200, task="hover")
    steps(batch, 5.0)
    c, s = np.cos(0.7), np.sin(0.7)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    shifted(batch, R_hat=lambda R: np.einsum("nijl,jk->nikl", R, turn))
    steps(batch, suite.estimator.glitch_timeout + 10.0)  # it may be a step of the baseline
    yaw = np.degrees(abs(state_errors(batch)[:, 8]))
    since = batch.record("tick") - batch.record("accepted_tick")[:, BASELINE_BLOCK]
    assert (since < suite.imu.rate).all()  # by a reset, or as bounded weights corrected it
    assert np.quantile(yaw, 0.99) < 5.0


def test_one_wrong_feature_stays_out_while_the_others_agree():
    batch = fly("rtk", 50, task="hover")
    steps(batch, 3.0)
    flights = batch.snapshot()
    before = flights["rejections"].copy()
    batch.restore(flights)
    batch._model["features"][0, 1] += 0.5  # the filter's map is wrong by half a meter
    steps(batch, 2.0)
    more = batch.record("rejections") - before.transpose(0, 2, 1).reshape(-1, before.shape[1])[:50]
    seen = batch.record("gate")[:, FEATURE_BLOCKS + 1] > 0
    assert seen.any()
    assert (more[seen, FEATURE_BLOCKS + 1] > 10).all()
    assert more[:, POSITION_BLOCK].max() <= 2
    assert (np.linalg.norm(state_errors(batch)[:, FIX], axis=1) < 0.05).all()


@pytest.mark.parametrize("kind", ["ukf", "ekf"])
@pytest.mark.parametrize("name", sorted(set(ALL_SUITES) - {"lab", "stale"}))
def test_mean_nis_of_an_update_is_its_dimension_with_each_suite(name, kind):
    """`lab` is overconfident, and `stale` ignores its delays.

    Constant errors of a flight, which a filter models as noise, change the mean by a few percent.
    """
    suite = quad_gym.sensor_suite(name)
    batch = fly(suite.replace(estimator=suite.estimator.replace(kind=kind)), 48, task="circle")
    steps(batch, 0.5)
    nis, dimension = np.zeros(48), np.zeros(48)
    for _ in range(200):
        batch.step()
        whole = np.isfinite(batch.record("nis"))  # not processed in steps
        nis += np.where(whole, batch.record("nis"), 0.0)
        dimension += np.where(whole, batch.record("nis_dimension"), 0.0)
    excess = (nis - dimension) / dimension.mean()
    deviation = excess.std(ddof=1) / np.sqrt(len(excess))
    assert abs(excess.mean()) < 0.05 + stats.t.isf(ALARM / 2, 47) * deviation
    assert deviation < 0.03


@pytest.mark.parametrize("error", [None, 0.0], ids=["heading error", "none"])
def test_nis_of_rtk_is_below_its_dimension_by_the_baselines_with_a_heading_error_alone(error):
    """A constant error that is modeled as white noise takes nearly all of the two of a baseline.

    Their noise is so large that they are nearly independent of other measurements.
    """
    suite = quad_gym.sensor_suite("rtk")
    if error is not None:
        suite = suite.replace(gnss=suite.gnss.replace(heading_error_sigma=error))
    batch = fly(suite, 64, task="circle", filter_start="warm")
    whole, of_baselines = np.zeros(2), np.zeros(2)
    for _ in range(600):
        batch.step()
        measured = measured_now(batch)
        any_measured = measured.any(axis=1)
        dimension = batch.record("nis_dimension")
        whole += [batch.record("nis")[any_measured].sum(), dimension[any_measured].sum()]
        baseline = measured[:, BASELINE_BLOCK]
        square = batch.record("block_nis")[baseline, BASELINE_BLOCK]
        of_baselines += [square.sum(), 2.0 * baseline.sum()]
    limit = stats.norm.isf(ALARM / 2) * np.sqrt(2.0 / whole[1])
    others = whole - of_baselines
    assert others[0] / others[1] == pytest.approx(1.0, abs=1.1 * limit)
    if error is None:
        assert of_baselines[0] / of_baselines[1] < 0.05
        assert 0.92 < whole[0] / whole[1] < 0.95
    else:
        assert whole[0] / whole[1] == pytest.approx(1.0, abs=limit)


class DirectionUKF(InnovatingUKF):
    """The plain filter, with the NIS along directions, of their noise and their second order."""

    def _condition(self, z, noise, models):
        x0 = np.concatenate([self._state(), self._array(np.zeros(len(z)))])
        points, _, w_cov = self._sigma_points(x0, block_diagonal(self.P, noise))
        Z, n = self._predicted(models, points) + points[:, self.states :], len(x0)
        plus, minus = (Z[1 + part * n : 1 + part * n + self.states] for part in (0, 1))
        super()._condition(z, noise, models)
        odd = 0.5 * (plus - minus)  # of the states; those of the noise are part of it
        rest = self.innovation_covariance - 2.0 * w_cov[1] * odd.T @ odd
        rows = np.zeros((len(z) // 3 - 1, len(z)))
        for k, row in enumerate(rows, 1):  # all but the position
            row[3 * k : 3 * k + 3] = self.prediction[3 * k : 3 * k + 3]
        self.along = normalized_square(rows, self.innovation, rest)
        whole = np.eye(len(z))
        self.whole = normalized_square(whole, self.innovation, self.innovation_covariance)


def test_nis_of_uncertain_directions_is_without_their_joint_part_along_them():
    """From the first update on, when the second order of the prior is common to all directions."""
    ours, plain, joint = UnscentedKalmanFilter(CONSISTENT), DirectionUKF(CONSISTENT), []
    for ukf in (ours, plain):
        ukf.initialize(RECORDING.gnss_position[0], RECORDING.gnss_baseline[0])
    for k in range(12):
        for ukf in (ours, plain):
            ukf.update(RECORDING.gnss_position[k], RECORDING.gnss_baseline[k], RECORDING.pixels[k])
        expected = plain.whole - plain.along
        np.testing.assert_allclose(ours.nis[0], expected, rtol=1e-5, atol=1e-5)
        joint.append(plain.along)
        for ukf in (ours, plain):
            ukf.predict(RECORDING.gyro[k], RECORDING.accel[k])
    assert max(joint) > 1.0

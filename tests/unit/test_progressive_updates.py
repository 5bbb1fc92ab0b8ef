"""Measurements of a wide prior, against iterated Gauss-Newton steps from the same prior."""

import numpy as np
import pytest
from scipy import stats

import quad_gym
from quad_gym.estimation import ExtendedKalmanFilter, UnscentedKalmanFilter
from quad_gym.faults import SensorLoss
from quad_gym.kernels.filter.progressive import MOST_STEPS, factor_of
from quad_gym.records import FEATURE_SLICE, GateDecision, Source
from quad_gym.rotations import euler_to_dcm
from quad_gym.sensors import Camera
from tests.field_flights import fly, nees, small_euler_angles, state_errors, steps
from tests.filter_states import set_at_rest
from tests.unit.alarms import ALARM
from tests.unit.compiled import Compiled

SUITE = quad_gym.sensor_suite("uwb").simplified()
ANCHORS, NOISE = np.array(SUITE.uwb_range.anchors_I), SUITE.uwb_range.noise_sigma
FILTERS = {"ukf": UnscentedKalmanFilter, "ekf": ExtendedKalmanFilter}
PLACE = np.array([0.0, 0.0, 1.5])


def in_one_step(suite):
    return suite.replace(estimator=suite.estimator.replace(recursive_update_threshold=None))


def gauss_newton(ranges, sigma):
    """Most likely position, and its covariance, from a prior about PLACE with variance sigma^2."""
    r = PLACE.copy()
    for _ in range(15):
        offset = r - ANCHORS
        length = np.linalg.norm(offset, axis=1)
        H = offset / length[:, np.newaxis]
        information = np.eye(3) / sigma**2 + H.T @ H / NOISE**2
        gradient = H.T @ (ranges - length) / NOISE**2 + (PLACE - r) / sigma**2
        r = r + np.linalg.solve(information, gradient)
    return r, np.linalg.inv(information)


def draws(sigma, count):
    """Positions of the prior, with ranges measured there."""
    rng = np.random.default_rng(4)
    positions = PLACE + sigma * rng.normal(size=(count, 3))
    lengths = np.linalg.norm(positions[:, np.newaxis] - ANCHORS, axis=2)
    return positions, lengths + NOISE * rng.normal(size=lengths.shape)


def squares(errors, covariances):
    return np.einsum("ni,ni->n", errors, np.linalg.solve(covariances, errors[..., None])[..., 0])


def estimates(suite, kind, sigma, ranges):
    """Positions and covariances after one update from the prior, for each set of ranges."""
    kalman, found = FILTERS[kind](suite), []
    P = np.diag(np.repeat([sigma, 0.5, 0.01, 0.05, 0.002], 3) ** 2)
    for values in ranges:
        set_at_rest(kalman, P, position=PLACE)
        kalman.update(uwb_range=values)
        found.append((kalman.position, kalman.covariance[:3, :3]))
    return (np.array(part) for part in zip(*found, strict=True))


@pytest.mark.parametrize("kind", FILTERS)
@pytest.mark.parametrize("sigma", [1.0, 1.5])
def test_ranges_of_a_wide_prior_agree_with_gauss_newton(kind, sigma):
    truth, ranges = draws(sigma, 150)
    positions, covariances = estimates(SUITE, kind, sigma, ranges)
    best, its = (np.array(x) for x in zip(*(gauss_newton(z, sigma) for z in ranges), strict=True))
    apart = squares(positions - best, its)
    assert np.median(apart) < 0.3
    ratio = np.linalg.det(covariances) / np.linalg.det(its)
    assert 0.9 < np.median(ratio) < 3.0
    limits = stats.chi2.ppf([ALARM / 2, 1.0 - ALARM / 2], 3 * 150) / 150
    assert limits[0] < squares(truth - best, its).mean() < limits[1]
    assert limits[0] < squares(truth - positions, covariances).mean() < limits[1]
    plain, believed = estimates(in_one_step(SUITE), kind, sigma, ranges)
    assert squares(truth - plain, believed).mean() > limits[1]


RTK = quad_gym.sensor_suite("rtk").simplified()
FEATURES, HOVER = np.array(RTK.camera.features_I), np.array([0.3, -0.2, 2.5])
POSE_SIGMA = np.repeat([0.02, 0.15, 0.04], [3, 2, 1])  #: of position [m], tilt and heading [rad]


def pixels_at(x, features):
    """Pixels at the errors x of position and attitude (error Euler angles) about a level HOVER."""
    camera = RTK.camera
    rays_B = (features - HOVER - x[:3]) @ euler_to_dcm(x[3:]).T - camera.position_B
    rays_C = rays_B @ euler_to_dcm(np.array(camera.attitude)).T
    return (camera.focal_length * rays_C[:, :2] / rays_C[:, 2:]).ravel()


def most_likely_pose(pixels, features):
    """The most likely errors x with the prior POSE_SIGMA, and their information, by iteration."""
    x, variance = np.zeros(6), RTK.camera.pixel_sigma**2
    for _ in range(20):
        H = np.empty((len(pixels), 6))
        for j, d in enumerate(1e-6 * np.eye(6)):
            H[:, j] = (pixels_at(x + d, features) - pixels_at(x - d, features)) / 2e-6
        information = np.diag(POSE_SIGMA**-2) + H.T @ H / variance
        gradient = H.T @ (pixels - pixels_at(x, features)) / variance - x / POSE_SIGMA**2
        x = x + np.linalg.solve(information, gradient)
    return x, information


@pytest.mark.parametrize("gate", [0.0, 1e-4], ids=["without gate", "gate"])
@pytest.mark.parametrize("kind", FILTERS)
def test_images_at_a_vague_tilt_agree_with_gauss_newton(kind, gate):
    """The sum of all variances of attitude exceeds the bound on a direction's, which has two."""
    suite = RTK.replace(estimator=RTK.estimator.replace(false_alarm_probability=gate))
    assert (POSE_SIGMA[3:] ** 2).sum() > RTK.estimator.max_direction_sigma**2
    P = np.diag(np.concatenate([POSE_SIGMA[:3], [0.03] * 3, POSE_SIGMA[3:], [0.02] * 6]) ** 2)
    rng, kalman, whole, best = np.random.default_rng(7), FILTERS[kind](suite), [], []
    camera, pose = Camera(suite.camera, rng=rng), [0, 1, 2, 6, 7, 8]
    for _ in range(80):
        truth = POSE_SIGMA * rng.normal(size=6)
        pixels = camera.measure(HOVER + truth[:3], euler_to_dcm(truth[3:]))
        set_at_rest(kalman, P, position=HOVER)
        kalman.update(pixels=pixels)
        used = kalman.gate_decisions[FEATURE_SLICE][: len(pixels)] == GateDecision.ACCEPTED
        if not used.any():
            continue
        x, information = most_likely_pose(pixels[used].ravel(), FEATURES[used])
        turn = small_euler_angles(kalman.R_BI[np.newaxis])[0]
        apart = np.concatenate([kalman.position - HOVER, turn]) - x
        best.append(apart @ information @ apart)
        left = small_euler_angles((euler_to_dcm(truth[3:]) @ kalman.R_BI.T)[np.newaxis])[0]
        error = np.concatenate([HOVER + truth[:3] - kalman.position, left])
        whole.append(error @ np.linalg.solve(kalman.covariance[np.ix_(pose, pose)], error))
    assert len(whole) > 60
    assert np.median(best) < 0.3
    limits = stats.chi2.ppf([ALARM / 2, 1.0 - ALARM / 2], 6 * len(whole)) / len(whole)
    assert limits[0] < np.mean(whole) < limits[1]


def flown_without_ranges(suite, duration, count):
    """Flights half a second after a loss of ranges.

    The controller has the truth and stays among the anchors. Far away they are nearly in a plane,
    so that a vague position has a mirror image.
    """
    loss = SensorLoss(sensor="uwb_range", start=1.0, duration=duration)
    vehicle = {"vehicle": quad_gym.vehicle_params("crazyflie"), "faults": (loss,)}
    batch = fly(suite, count, source=Source.TRUTH, run_filter=True, **vehicle)
    steps(batch, duration + 1.5)
    assert (batch.record("filter_status") == 0).all()
    return batch


@pytest.mark.parametrize(
    ("kind", "duration"), [("ukf", 8.0), ("ukf", 10.0), ("ukf", 15.0), ("ekf", 10.0)]
)
def test_ranges_after_an_outage_leave_a_filter_consistent(kind, duration):
    suite = SUITE.replace(estimator=SUITE.estimator.replace(kind=kind))
    batch = flown_without_ranges(suite, duration, 64)
    limit = stats.chi2(15 * 64).ppf(1.0 - ALARM) / 64
    assert nees(batch).mean() < limit
    limits = stats.chi2(3 * 64).ppf([ALARM, 1.0 - ALARM]) / 64
    assert limits[0] < nees(batch, slice(0, 3)).mean() < limits[1]
    error = np.sqrt((state_errors(batch)[:, :3] ** 2).mean())
    assert error < 0.15


def test_outliers_of_ranges_after_an_outage_affect_few_flights():
    """A vague position rejects no outlier among the first ranges, and the filter models none."""
    found = nees(flown_without_ranges(quad_gym.sensor_suite("uwb"), 10.0, 256), slice(0, 3))
    assert np.median(found) == pytest.approx(stats.chi2(3).median(), abs=0.5)
    assert (found > stats.chi2(3).ppf(0.9973)).mean() < 0.04


@pytest.mark.parametrize("kind", FILTERS)
def test_optical_flow_at_a_vague_height_leaves_a_filter_consistent(kind):
    suite = quad_gym.sensor_suite("field").simplified()
    suite = suite.replace(
        optical_flow=quad_gym.OpticalFlowParams(rate=50.0),
        estimator=suite.estimator.replace(kind=kind),
    )
    batch = fly(suite, 128, task="lemniscate", start="hover")
    steps(batch, 0.5)
    assert nees(batch).mean() < stats.chi2(15 * 128).ppf(1.0 - ALARM) / 128


def factor(f, step):
    f.factor = factor_of(f.further, step)


factors = Compiled(factor, further=(), factor=())


def test_steps_of_an_update_share_the_information_of_one():
    """A measurement with k times the noise has 1 / k of the information."""
    for further in range(MOST_STEPS + 1):
        parts = [
            1.0 / getattr(factors, instance)(step, further=[float(further)])["factor"][0]
            for step in range(further + 1)
            for instance in ("on_floats", "on_lanes")
        ]
        assert sum(parts) == pytest.approx(2.0, rel=1e-12)
        assert (np.diff(parts[::2]) > 0.0).all()  # the first steps, far from the truth, count least

"""First estimates from a baseline or a magnetic field, `initialize` in
`quad_gym.kernels.filter.starts` and `_align` in `quad_gym.kernels.sensors.magnetometer`."""

import math

import numpy as np
import pytest
from scipy import optimize
from scipy.spatial.transform import Rotation

from quad_gym.kernels.entries import start_filter
from quad_gym.kernels.stages import Stage
from quad_gym.records import AID_BLOCK, BASELINE_BLOCK, POSITION_BLOCK, Act, Aid
from quad_gym.rotations import euler_to_dcm
from tests.lane_rules import LaneRules
from tests.level_flights import MAGNETIC, R_IG

PLACE = np.array([3.0, -1.0, 2.0])
UNKNOWN = math.pi / math.sqrt(3.0)


def started(baseline, heading, arm=(0.2, -0.1, 0.3), ahead=(0.0, 0.0, 0.0), **estimator):
    """Filters of a level vehicle with this heading, which start from its first fix."""
    suite = MAGNETIC.replace(magnetometer=None)
    secondary = tuple(np.add(arm, baseline))
    gnss = suite.gnss.replace(primary_antenna_B=arm, secondary_antenna_B=secondary)
    suite = suite.replace(gnss=gnss, estimator=suite.estimator.replace(**estimator))
    rules, R_BI = LaneRules(suite), euler_to_dcm([0.0, 0.0, heading])
    rules.set(
        P=np.tril(np.ones((15, 15))),
        P_slow=1.0,
        slow_hat=9.0,
        r_hat=9.0,
        v_hat=9.0,
        b_a_hat=9.0,
        b_g_hat=9.0,
    )
    rules.measured(POSITION_BLOCK, (PLACE + R_BI.T @ arm) @ R_IG)
    rules.measured(BASELINE_BLOCK, (R_BI.T @ np.array(baseline)) @ R_IG)
    rules.settings["heading_sensor"] = -1
    for block, params, settings, work in rules._each((True,) * 8):
        start_filter(block, params, settings, work, np.array(ahead))
    return suite, rules, R_BI


@pytest.mark.parametrize("heading", [0.0, 1.2, -2.5])
@pytest.mark.parametrize(
    ("baseline", "share"),
    [((0.4, 0.0, 0.0), 1.0), ((-0.1, 0.3, 0.0), 1.0), ((0.3, 0.0, 0.4), 0.6)],
    ids=["ahead", "aside", "steep"],
)
def test_level_start_has_the_heading_of_the_baseline_and_its_covariance(heading, baseline, share):
    """The steeper the baseline, the less certain the heading. The antenna ties the
    position to it."""
    scale = 2.0
    suite, rules, R_BI = started(baseline, heading, initial_covariance_scale=scale)
    gnss, estimator, imu = suite.gnss, suite.estimator, suite.imu
    np.testing.assert_allclose(rules.get("R_hat")[0], R_BI, atol=1e-12)
    np.testing.assert_allclose(rules.get("r_hat")[0], PLACE, atol=1e-12)
    np.testing.assert_array_equal(rules.get("slow_hat")[:, :3], 0.0)
    for name in ("v_hat", "b_a_hat", "b_g_hat"):
        np.testing.assert_array_equal(rules.get(name), 0.0)
    first = float(rules.params["first_baseline_sigma"][0, 0])
    P = np.zeros((15, 15))
    P[3:6, 3:6] = estimator.initial_velocity_variance * np.eye(3)
    tilt, psi = estimator.initial_tilt_sigma**2, scale * (first / share) ** 2
    P[6:9, 6:9] = np.diag([tilt, tilt, psi])
    P[9:12, 9:12] = imu.accel_bias_sigma**2 * np.eye(3)
    P[12:, 12:] = imu.gyro_bias_sigma**2 * np.eye(3)
    # r = antenna - R^T l, with R = R(e) R_hat, where R(e) = I - [e x] to first order
    axes = np.eye(3)
    J = np.column_stack([R_BI.T @ np.cross(gnss.primary_antenna_B, axis) for axis in axes])
    P[:3, 6:9] = J @ P[6:9, 6:9]
    P[6:9, :3] = P[:3, 6:9].T
    P[:3, :3] = scale * np.diag(np.square(gnss.position_sigma_I)) + J @ P[6:9, 6:9] @ J.T
    found = rules.covariance()[0]
    np.testing.assert_allclose(found[:15, :15], P, rtol=1e-9, atol=1e-15)
    # the error of the barometer, and two states that fill a block
    slow = np.diag([suite.barometer.bias_sigma**2, 1.0, 1.0])
    np.testing.assert_allclose(found[15:], np.hstack([np.zeros((3, 15)), slow]), rtol=1e-12)


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("share", [0.19, 0.21])
def test_baseline_within_12_degrees_of_the_vertical_needs_another_heading(share, known):
    """The place of the start shows it, with its own standard deviation, or nothing does."""
    baseline = 0.5 * np.array([share, 0.0, math.sqrt(1.0 - share**2)])
    ahead = (math.cos(0.7), math.sin(0.7), 0.0) if known else (0.0, 0.0, 0.0)
    suite, rules, _ = started(tuple(baseline), 0.3, ahead=ahead)
    placed = known and share < 0.2
    heading = 0.7 if placed else 0.3
    np.testing.assert_allclose(rules.get("R_hat")[0], euler_to_dcm([0.0, 0.0, heading]), atol=1e-12)
    first = float(rules.params["first_baseline_sigma"][0, 0])
    sigma = min(first / share, UNKNOWN)
    if placed:
        sigma = suite.initial_pose.heading_sigma
    sigma *= math.sqrt(suite.estimator.initial_covariance_scale)
    np.testing.assert_allclose(np.sqrt(rules.covariance()[:, 8, 8]), sigma, rtol=1e-9)


@pytest.mark.parametrize("known", [True, False])
def test_vertical_baseline_shows_no_heading(known):
    ahead = (math.cos(0.7), math.sin(0.7), 0.0) if known else (0.0, 0.0, 0.0)
    for tilt in (None, MAGNETIC.estimator.initial_tilt_sigma):
        suite, rules, _ = started((0.0, 0.0, 0.4), 0.3, ahead=ahead, initial_tilt_sigma=tilt)
        scale = math.sqrt(suite.estimator.initial_covariance_scale)
        sigma = scale * suite.initial_pose.heading_sigma if known else UNKNOWN
        np.testing.assert_allclose(np.sqrt(rules.covariance()[:, 8, 8]), sigma, rtol=1e-9)
        if known:
            R_BI = euler_to_dcm([0.0, 0.0, 0.7])
            np.testing.assert_allclose(rules.get("R_hat")[0], R_BI, atol=1e-9)
        attitude = scale * float(rules.params["first_baseline_sigma"][0, 0])
        np.testing.assert_allclose(
            np.sqrt(rules.covariance()[:, 6, 6]), tilt or attitude, rtol=1e-9
        )


@pytest.mark.parametrize("heading", [0.3, -2.0])
def test_level_start_has_the_heading_of_the_field_and_its_covariance(heading):
    """Errors of tilt, declination, hard iron and noise move the heading, and all the position.

    The field of the truth has no part across the field that the estimate expects. The expected
    covariance has numerical derivatives of this condition.
    """
    scale, arm, compass = 2.0, np.array([0.2, -0.1, 0.3]), MAGNETIC.magnetometer
    gnss = MAGNETIC.gnss.replace(primary_antenna_B=tuple(arm), secondary_antenna_B=None)
    estimator = MAGNETIC.estimator.replace(initial_covariance_scale=scale)
    suite = MAGNETIC.replace(gnss=gnss, estimator=estimator)
    rules, R_BI = LaneRules(suite), euler_to_dcm([0.0, 0.0, heading])
    m, k = np.array(compass.field_I), np.array([0.0, 0.0, 1.0])
    level = np.append(m[:2], 0.0)
    rules.set(P=np.tril(np.ones((15, 15))), P_slow=1.0)
    rules.measured(POSITION_BLOCK, (PLACE + R_BI.T @ arm) @ R_IG)
    rules.measured(AID_BLOCK[Aid.MAGNETOMETER], R_BI @ (1.3 * level - [0.0, 0.0, 2e-5]))
    rules.initialize()
    rules.run(Stage.MAGNETOMETER, flag=int(Act.ALIGN))
    np.testing.assert_allclose(rules.get("R_hat")[0], R_BI, atol=1e-12)
    np.testing.assert_allclose(rules.get("r_hat")[0], PLACE, atol=1e-12)

    aside = np.cross(k, R_BI @ level)

    def attitude(x):
        """The true attitude: its heading is such that the field has no part aside."""

        def part(e_z):
            R = Rotation.from_rotvec([-x[0], -x[1], -e_z]).as_matrix() @ R_BI
            return aside @ (R @ (m + x[2] * np.cross(m, k)) + x[3:6] + x[6:9])

        e_z = optimize.brentq(part, -1.0, 1.0, xtol=1e-15)
        return np.array([x[0], x[1], e_z])

    def truth(x):
        e = attitude(x)
        R = Rotation.from_rotvec(-e).as_matrix() @ R_BI
        return np.concatenate([PLACE + R_BI.T @ arm + x[9:12] - R.T @ arm, e, x[3:6], x[2:3]])

    n = math.sqrt(scale)
    unit = compass.strength  # of small steps
    sigma = np.concatenate(
        [
            np.full(2, estimator.initial_tilt_sigma),
            [compass.declination_sigma],
            np.full(3, compass.hard_iron_sigma),
            np.full(3, n * compass.noise_sigma),
            n * np.array(gnss.position_sigma_I),
        ]
    )
    steps = 1e-4 * np.diag([1.0] * 3 + [unit] * 6 + [1.0] * 3)
    J = np.column_stack([(truth(h) - truth(-h)) / (2.0 * h.max()) for h in steps])
    iron = 15 + int(rules.settings["aid_vector"][0, Aid.MAGNETOMETER])
    turn = 15 + int(rules.settings["aid_scalar"][0, Aid.MAGNETOMETER])
    height = 15 + int(rules.settings["aid_scalar"][0, Aid.BAROMETER])
    found = rules.covariance()[0]
    expected = np.eye(len(found))  # one for the states that fill a block
    blocks = {3: math.sqrt(estimator.initial_velocity_variance), 9: suite.imu.accel_bias_sigma}
    for row, value in (blocks | {12: suite.imu.gyro_bias_sigma}).items():
        expected[row : row + 3, row : row + 3] *= value**2
    expected[height, height] = suite.barometer.bias_sigma**2
    rows = [0, 1, 2, 6, 7, 8, iron, iron + 1, iron + 2, turn]
    expected[np.ix_(rows, rows)] = J @ np.diag(sigma**2) @ J.T
    scaled = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        found / np.outer(scaled, scaled), expected / np.outer(scaled, scaled), atol=1e-6
    )

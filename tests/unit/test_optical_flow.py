"""Optical flow and range finder: measurements by formula, updates by numerical derivatives."""

import numpy as np
import pytest

import quad_gym
from quad_gym.estimation import ExtendedKalmanFilter, UnscentedKalmanFilter
from quad_gym.packing import params_record
from quad_gym.params.portable import euler_dcm
from quad_gym.params.vehicle import vehicle_params
from quad_gym.records import AID_BLOCKS, Aid, Control, GateDecision
from quad_gym.rotations import quaternion_to_dcm
from tests.builders import batch as flights_of
from tests.field_flights import fly, nees, steps
from tests.filter_states import set_at_rest

CRAZYFLIE = quad_gym.sensor_suite("crazyflie").simplified()
FLOW, RANGE = int(Aid.OPTICAL_FLOW), int(Aid.RANGE_FINDER)
GROUND = quad_gym.WorldParams().ground_height


def expected(r, v, R_BI, w, ground=GROUND):
    """Flow, distance and cosine of the tilt of a state (4,), without noise."""
    cosine = R_BI[2, 2]
    distance = (r[2] - ground) / cosine
    x, y, _ = R_BI @ v / distance
    return np.array([x - w[1], y + w[0], distance, cosine])


def test_measurements_have_the_closed_form_and_their_noise():
    suite = CRAZYFLIE.replace(
        optical_flow=CRAZYFLIE.optical_flow.replace(rate=200.0),
        range_finder=CRAZYFLIE.range_finder.replace(rate=200.0),
    )
    batch, noise = fly(suite, 100, task="circle", start="hover"), []
    for _ in range(50):
        batch.step()
        names = ("r", "v", "w")
        states = [batch.record(name) for name in names]
        R_BI = quaternion_to_dcm(batch.record("q"))
        rows = zip(*states, R_BI, strict=True)
        truth = np.array([expected(r, v, R, w)[:3] for r, v, w, R in rows])
        measured = batch.record("measurement")[:, AID_BLOCKS:]
        valid = batch.record("block_valid")[:, AID_BLOCKS + FLOW : AID_BLOCKS + RANGE + 1].all(
            axis=1
        )  # flow in range
        error = np.column_stack([measured[:, FLOW, :2], measured[:, RANGE, :1]]) - truth
        noise.append(error[valid])
    sigma = np.sqrt(np.mean(np.concatenate(noise) ** 2, axis=0))
    np.testing.assert_allclose(sigma, (0.2, 0.2, 0.01), rtol=0.06)  # 4 sigma of 2,500 samples


@pytest.mark.parametrize(("height", "flow", "distance"), [(0.0, True, True), (-0.07, False, False)])
def test_nothing_is_measured_below_the_least_height(height, flow, distance):
    batch = fly(CRAZYFLIE, 8, task="hover", start="hover")
    snapshot = batch.snapshot()
    snapshot["r"][:, 2], snapshot["v"], snapshot["wait"] = height, 0.0, 0.0
    batch.restore(snapshot)
    batch.step()
    valid = batch.record("block_valid")[0, AID_BLOCKS:] > 0.0
    assert (valid[FLOW], valid[RANGE]) == (flow, distance)


def filter_in_flight(kind, ground=GROUND):
    """A filter with GNSS, flow and range finder, whose state is moving, tilted and turned."""
    suite = quad_gym.sensor_suite("rtk").simplified()
    suite = suite.replace(
        optical_flow=quad_gym.OpticalFlowParams(),
        range_finder=quad_gym.RangeFinderParams(),
        estimator=suite.estimator.replace(ground_height=ground),
    )
    kf = kind(suite)
    kf.initialize((0.0, 0.0, 0.0), suite.gnss.baseline_B, heading=0.3)
    kf._engine.fill("r_hat", np.array([1.0, -2.0, ground + 1.4]))
    kf._engine.fill("v_hat", np.array([0.8, -0.5, 0.3]))
    kf.predict((0.1, -0.2, 0.3), (0.5, 1.0, 9.5), 0.005)
    return kf, suite


def numerical_update(kf, suite, flow, distance):
    """The linear update with numerical derivatives."""
    state = [kf._engine.read(name)[0] for name in ("r_hat", "v_hat", "R_hat")]
    P = kf.covariance.copy()
    w = kf._engine.read("w_meas")[0] - kf._engine.read("b_g_hat")[0]

    def predicted(dx):
        R_BI = euler_dcm(dx[6:9]) @ state[2]
        ground = suite.estimator.ground_height
        return expected(state[0] + dx[:3], state[1] + dx[3:6], R_BI, w, ground)[:3]

    H = np.zeros((3, 15))
    for i in range(9):
        step = np.zeros(15)
        step[i] = 1e-5
        H[:, i] = (predicted(step) - predicted(-step)) / 2e-5
    gyro = params_record(quad_gym.VehicleParams(), suite)["gyro_noise"][0]
    rate = 0.2**2 + gyro**2
    S = H @ P @ H.T + np.diag([rate, rate, 0.01**2])
    K = P @ H.T @ np.linalg.inv(S)
    mean = predicted(np.zeros(15))
    if kf._kind == "ukf":  # the mean of the sigma points, to second order
        for column in 1e-2 * np.linalg.cholesky(P).T:
            curved = predicted(column) + predicted(-column) - 2.0 * predicted(np.zeros(15))
            mean = mean + 0.5 * curved / 1e-4
    dx = K @ (np.array([*flow, distance]) - mean)
    return state, dx, P - K @ S @ K.T


@pytest.mark.parametrize("ground", [GROUND, -1.0, 2.5])
@pytest.mark.parametrize("kind", [UnscentedKalmanFilter, ExtendedKalmanFilter])
def test_update_agrees_with_a_linear_update_by_numerical_derivatives(kind, ground):
    kf, suite = filter_in_flight(kind, ground)
    flow, distance = (0.6, -0.2), 1.43
    (r, v, _), dx, P = numerical_update(kf, suite, flow, distance)
    kf.update(optical_flow=flow, range_finder=distance)
    tolerance = 1e-6 if kind is ExtendedKalmanFilter else 3e-2  # higher-order terms
    scale = np.sqrt(np.diag(P))
    np.testing.assert_allclose((kf.position - r - dx[:3]) / scale[:3], 0.0, atol=tolerance)
    np.testing.assert_allclose((kf.velocity - v - dx[3:6]) / scale[3:6], 0.0, atol=tolerance)
    np.testing.assert_allclose(
        (kf.covariance - P)[:6, :6] / np.outer(scale, scale)[:6, :6], 0.0, atol=tolerance
    )
    assert abs(dx[:6]).max() > 1e-3  # there was something to correct


@pytest.mark.parametrize("kind", [UnscentedKalmanFilter, ExtendedKalmanFilter])
def test_wrong_measurements_are_rejected(kind):
    kf, _ = filter_in_flight(kind)
    before = kf.position
    kf.update(optical_flow=(6.0, 0.0), range_finder=3.0)
    np.testing.assert_array_equal(kf.position, before)
    gates = kf._engine.read("gate")[0, AID_BLOCKS + FLOW : AID_BLOCKS + RANGE + 1]
    np.testing.assert_array_equal(gates, GateDecision.REJECTED)


@pytest.mark.parametrize(
    ("kind", "start", "late"),
    [("ukf", "cold", False), ("ukf", "warm", True), ("ekf", "cold", True), ("ekf", "warm", False)],
)
def test_filters_are_consistent(kind, start, late):
    """The mean of 150 NEES has a standard deviation of 0.45. NIS is of the last measurements."""
    suite = CRAZYFLIE.replace(estimator=CRAZYFLIE.estimator.replace(kind=kind))
    if late:
        suite = suite.replace(
            optical_flow=suite.optical_flow.replace(latency=0.02),
            range_finder=suite.range_finder.replace(latency=0.04),
        )
    batch = fly(suite, 150, task="circle", filter_start=start)
    steps(batch, 4.0)
    assert not batch.record("filter_status").any()
    assert nees(batch).mean() == pytest.approx(15.0, abs=1.8)
    nis = batch.record("block_nis")[:, AID_BLOCKS:].mean(axis=0)
    assert nis[FLOW] == pytest.approx(2.0, abs=0.7)
    assert nis[RANGE] == pytest.approx(1.0, abs=0.5)


@pytest.mark.parametrize("start", ["cold", "warm"])
@pytest.mark.parametrize("ground", [0.4, -1.0])
def test_filters_are_consistent_over_ground_of_any_height(ground, start):
    """The mean of 100 NEES has a standard deviation of 0.55."""
    world = quad_gym.WorldParams(ground_height=ground)
    batch = fly(CRAZYFLIE, 100, task="circle", start="hover", world=world, filter_start=start)
    steps(batch, 1.5)
    assert not batch.record("filter_status").any()
    assert nees(batch).mean() == pytest.approx(15.0, abs=2.2)
    assert batch.record("block_valid")[:, AID_BLOCKS + RANGE].any()


def test_warm_start_on_ground_of_any_height_is_the_same():
    """Heights above the ground are the same, and so are covariances."""
    found = []
    for height in (GROUND, 1.9):
        world = quad_gym.WorldParams(ground_height=height, ground=quad_gym.GroundParams())
        batch = fly(CRAZYFLIE, 2, task="hover", start="ground", world=world, filter_start="warm")
        found.append(batch.covariance())
    np.testing.assert_allclose(found[0], found[1], rtol=1e-6, atol=1e-12)


def test_a_crazyflie_hovers_on_its_estimate():
    task = quad_gym.TaskParams(kind="hover", start="hover")
    made = {"vehicle": vehicle_params("crazyflie"), "sensors": "crazyflie", "task": task}
    batch = flights_of(16, control=Control.VELOCITY, **made)
    for _ in range(400):
        batch.step(np.zeros((16, 4)))
    assert (np.linalg.norm(batch.record("v"), axis=1) < 0.3).all()
    assert (quaternion_to_dcm(batch.record("q"))[:, 2, 2] > 0.99).all()


def test_expected_flow_is_the_mean_of_sigma_points():
    """Also of a vehicle whose height and tilt have correlated errors.

    A correction is linear in the measurement, and zero at the expected one.
    """
    suite = quad_gym.sensor_suite("rtk").simplified()
    suite = suite.replace(optical_flow=quad_gym.OpticalFlowParams())
    choice = {"recursive_update_threshold": None, "false_alarm_probability": 0.0}
    estimator = suite.estimator.replace(ground_height=GROUND, **choice)
    kf = UnscentedKalmanFilter(suite.replace(estimator=estimator))
    position, velocity = np.array([1.0, -2.0, GROUND + 1.7]), np.array([9.0, -6.0, 0.5])
    R_BI, sigma = euler_dcm((0.3, -0.25, 0.5)), np.repeat([0.1, 0.1, 0.05, 0.01], [3, 3, 3, 6])
    P = np.diag(sigma**2)
    for tilt, share in ((6, 0.7), (7, -0.6)):
        P[2, tilt] = P[tilt, 2] = share * sigma[2] * sigma[tilt]
    corrections = []
    for flow in np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]):
        set_at_rest(kf, P, position=position, velocity=velocity, R_BI=R_BI)
        kf.update(optical_flow=flow)
        corrections.append(np.concatenate([kf.position - position, kf.velocity - velocity]))
    gain = np.transpose(corrections[1:]) - np.transpose(corrections[:1])
    found = -np.linalg.lstsq(gain, corrections[0], rcond=None)[0]

    def flow_at(dx):
        R = euler_dcm(dx[6:9]) @ R_BI
        return expected(position + dx[:3], velocity + dx[3:6], R, np.zeros(3))[:2]

    c = estimator.alpha * np.sqrt(estimator.kappa + 15 + 2)  # with the two numbers measured
    mean = center = flow_at(np.zeros(15))
    for column in c * np.linalg.cholesky(P).T:
        mean = mean + (flow_at(column) + flow_at(-column) - 2.0 * center) / (2.0 * c**2)
    assert np.abs(mean - center).max() > 2e-3
    np.testing.assert_allclose(found, mean, rtol=0.0, atol=1e-9)

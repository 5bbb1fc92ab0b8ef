"""An update with a late position by itself: back to its time stamp, and forward again.

Flights are given the sums of their IMU, now and then. The expected estimate follows from the
equations of `quad_gym/kernels/filter/preintegration.py`, whose derivatives are numerical.
"""

import math

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from quad_gym.kernels.entries import FILTER_ENTRIES, FILTER_STAGES, linked_table
from quad_gym.kernels.stages import Stage, needed_stages
from quad_gym.packing import lever_form
from quad_gym.records import POSITION_BLOCK, Sensor
from quad_gym.rotations import euler_to_dcm
from tests.lane_filter import EIGHT
from tests.lane_rules import LaneRules
from tests.level_flights import GRAVITY, MAGNETIC, R_IG

OPEN = MAGNETIC.replace(
    gnss=MAGNETIC.gnss.replace(secondary_antenna_B=None, primary_antenna_B=(0.0, 0.0, 0.0)),
    magnetometer=None,
    barometer=None,
    estimator=MAGNETIC.estimator.replace(kind="ekf", false_alarm_probability=0.0),
)
DRIFTING = OPEN.replace(gnss=OPEN.gnss.replace(drift_sigma_I=(0.5, 0.6, 0.7), drift_tau=20.0))
DELAY, SLOT = 160, 2
"""Ticks since the time stamp, and place of the measurement among those in transit."""
NOISE = {
    "accel_noise": 0.5, "accel_thrust_noise": 0.1, "accel_error_noise": 0.2, "gyro_noise": 0.02,
    "gyro_thrust_noise": 0.001,
}  # fmt: skip


class LateRules(LaneRules):
    """Flights in which a position arrives that was taken DELAY ticks ago."""

    def __init__(self, suite):
        super().__init__(suite)
        self.form |= int(lever_form(suite.imu))
        self.settings["form"] = self.form
        self.settings["sensor_delay"][0, Sensor.GNSS] = DELAY
        self.settings["under_way"][0, Sensor.GNSS] = SLOT + 1
        self.settings["late"] = self.settings["rewinds"] = True
        stages = needed_stages(self.settings[0])
        mine = (*FILTER_STAGES, Stage.INCREMENT, Stage.LATE_UPDATE)
        chosen = [s for s in mine if s in stages]
        self._table = linked_table({s: stages[s] for s in chosen}, FILTER_ENTRIES)

    def put_sums(self, number, now, then):
        """Give a flight the sums (C, V, X, B) of its IMU, now and at the time stamp."""
        names = ("imu_turn", "imu_velocity", "imu_position", "imu_bias_gain")
        self.put(number, **dict(zip(names, now, strict=True)))
        stamps = np.full(self.get("stamps").shape[1:], 7.0)
        stamps[:, :, 0] = self.tick - DELAY - 1.0 + np.arange(stamps.shape[1])[::-1]
        row = row_of(self.tick - DELAY, then)
        stamps[Sensor.GNSS, :, 0] = np.nan
        stamps[Sensor.GNSS, SLOT, : len(row)] = row
        self.put(number, stamps=stamps)


def row_of(tick, sums):
    """A time stamp with the sums (C, V, X, B) at that tick."""
    return np.concatenate([[tick], *(np.ravel(part) for part in sums)])


def skew(v):
    return np.cross(np.eye(3), v)


def turned(v):
    """The rotation matrix exp(-[v x])."""
    return Rotation.from_rotvec(-np.asarray(v)).as_matrix()


def since(now, then, b_a, b_g, T):
    """(dR, dv, dr) without the biases."""
    C, V, X, B = (a - b for a, b in zip(now, then, strict=True))
    C = now[0] @ then[0].T
    V, X, B = then[0] @ V, then[0] @ (X - then[1] * T), then[0] @ B
    beta = np.cross(B @ b_g, V)
    return (
        C @ turned(-B @ b_g),
        V - B @ b_a - beta / 2.0,
        X - T * (B @ b_a + T * b_a / 2.0) / 3.0 - T * beta / 6.0,
    )


def taken_back(state, now, then, T):
    """The state (r, v, R, b_a, b_g) at the time stamp, from the present one."""
    r, v, R, b_a, b_g = state
    dR, dv, dr = since(now, then, b_a, b_g, T)
    g, R = np.array([0.0, 0.0, GRAVITY]), dR.T @ R
    v = v + g * T - R.T @ dv
    return r - v * T + g * T**2 / 2.0 - R.T @ dr, v, R, b_a, b_g


def moved(state, x):
    """The state with an error x."""
    r, v, R, b_a, b_g = state
    return r + x[:3], v + x[3:6], turned(x[6:9]) @ R, b_a + x[9:12], b_g + x[12:15]


def error(state, other):
    """The error x of a state that is almost another one."""
    e = -Rotation.from_matrix(state[2] @ other[2].T).as_rotvec()
    parts = [a - b for a, b in zip(state, other, strict=True)]
    return np.concatenate([*parts[:2], e, *parts[3:]])


def noise_since(T, dt, R_s, dR, dv):
    """Covariance of the IMU's noise over T, which acts at half time."""
    f, more = dv / T, dv @ dv / T**2 - GRAVITY**2
    off = f - np.array([0.0, 0.0, GRAVITY])
    n = NOISE
    accel = n["accel_noise"] ** 2 + n["accel_thrust_noise"] ** 2 * more
    accel += n["accel_error_noise"] ** 2 * off @ off
    gyro = n["gyro_noise"] ** 2 + n["gyro_thrust_noise"] ** 2 * more
    G, leaned = np.zeros((15, 6)), -R_s.T @ skew(dv)
    G[3:6, :3], G[:3, :3] = np.eye(3), T / 2.0 * np.eye(3)
    G[6:9, 3:], G[3:6, 3:], G[:3, 3:] = dR, leaned / 2.0, T / 6.0 * leaned
    return dt * T * G @ np.diag([accel] * 3 + [gyro] * 3) @ G.T


@pytest.mark.parametrize("drifts", [False, True])
def test_late_position_is_used_where_it_was_taken(drifts):
    """The noise of the IMU since then is removed, and added again, where the covariance has it.

    In the first four flights it does; in two the noise is larger than the uncertainty, and in two
    nothing arrives.
    """
    suite, rng = DRIFTING if drifts else OPEN, np.random.default_rng(0)
    rules = LateRules(suite)
    T, n = DELAY * rules.dt, 18 if drifts else 15
    R, V, d = np.square(suite.gnss.position_sigma_I), [], np.square(suite.gnss.drift_sigma_I)
    alpha = math.exp(-T / suite.gnss.drift_tau) if drifts else 1.0
    # the sigma of states as large as what the biases do to velocity and position within T
    sigma = np.repeat([0.8, 1.5, 0.3, 0.7, 0.3], 3)
    joint, expected, states, slow = np.zeros((EIGHT, n, n)), [], [], 0.3 * rng.normal(size=(8, 3))
    for k in range(EIGHT):
        rules.put_params(k, **NOISE)
        mixed = rng.normal(size=(n, 2 * n)) / math.sqrt(2 * n)
        scale = np.concatenate([sigma, 0.8 * np.sqrt(d)]) if drifts else sigma
        joint[k] = mixed @ mixed.T * np.outer(scale, scale) * (1e-4 if k in (4, 5) else 1.0)
        turns = Rotation.random(3, random_state=rng).as_matrix()
        then = (turns[0], rng.normal(size=3), rng.normal(size=3), 0.1 * rng.normal(size=(3, 3)))
        B = turns[0].T @ (T * np.eye(3) + 0.1 * rng.normal(size=(3, 3)))
        now = (
            turns[1],
            then[1] + 8.0 * rng.normal(size=3),
            then[2] + then[1] * T + 4.0 * rng.normal(size=3),
            then[3] + B,
        )
        biases = 1e-4 * rng.normal(size=3), 1e-5 * rng.normal(size=3)
        states.append((rng.normal(size=3), rng.normal(size=3), turns[2], *biases))
        rules.put_sums(k, now, then)
        names = ("r_hat", "v_hat", "R_hat", "b_a_hat", "b_g_hat")
        rules.put(k, **dict(zip(names, states[k], strict=True)))
        if drifts:
            hat = np.zeros(rules.get("slow_hat").shape[1:])
            hat[:3] = slow[k]
            rules.put(k, slow_hat=hat)

        back = taken_back(states[k], now, then, T)
        A, h = np.eye(n) / alpha, 1e-6
        for j in range(15):
            x = h * np.eye(15)[j]
            plus, minus = (taken_back(moved(states[k], s * x), now, then, T) for s in (1, -1))
            A[:15, j] = (error(plus, back) - error(minus, back)) / (2.0 * h)
        dR, dv, _ = since(now, then, *biases, T)
        Q = noise_since(T, rules.dt, back[2], dR, dv)
        Q = block_diag(Q, np.diag(d * (1.0 - alpha**2))) if drifts else Q
        least = np.linalg.eigvalsh(joint[k] - Q)[0]
        assert (least > 0.0) == (k not in (4, 5))
        Q = Q if least > 0.0 else np.zeros_like(Q)
        P, H = A @ (joint[k] - Q) @ A.T, np.zeros((3, n))
        H[:, :3] = np.eye(3)
        if drifts:
            H[:, 15:] = np.eye(3)
        gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.diag(R))
        nu = 1e-4 * rng.normal(size=3)
        z = back[0] + nu + (slow[k] / alpha if drifts else 0.0)
        V.append(R_IG.T @ z)
        P = (np.eye(n) - gain @ H) @ P
        F = np.linalg.inv(A)
        expected.append((F @ gain @ nu, F @ P @ F.T + Q))
    rules.set_covariance(joint)
    rules.measured(POSITION_BLOCK, np.array(V))
    rules.change("block_valid", POSITION_BLOCK, [1.0] * 6 + [0.0] * 2)
    rules.set(w_meas=[0.1, 0.2, 0.3])
    before = [rules.get(name) for name in (*names, "slow_hat", "P", "P_slow")]
    rules.run(Stage.LATE_UPDATE)
    after = [rules.get(name) for name in (*names, "slow_hat", "P", "P_slow")]
    covariance = rules.covariance()
    for k, (x, P) in enumerate(expected[:6]):
        scale = np.sqrt(np.diag(P))
        np.testing.assert_allclose(
            covariance[k] / np.outer(scale, scale), P / np.outer(scale, scale), atol=1e-3
        )
        found = error(tuple(part[k] for part in after[:5]), states[k])
        if drifts:
            found = np.append(found, after[5][k, :3] - slow[k])
        np.testing.assert_allclose(found, x, atol=3e-7)
    assert np.abs([x[:15] for x, _ in expected]).max() > 3e-5  # far beyond the tolerance
    for one, other in zip(before, after, strict=True):
        np.testing.assert_array_equal(one[6:], other[6:])
    np.testing.assert_array_equal(rules.get("w_meas"), np.tile([0.1, 0.2, 0.3], (EIGHT, 1)))
    np.testing.assert_array_equal(rules.get("update_failures"), 0.0)


@pytest.mark.parametrize("samples", ["instant", "average"])
def test_sums_since_a_time_stamp_do_not_depend_on_the_instant_that_they_count_from(samples):
    """That instant is moved every 32 ticks. The sums are the filter's own integration of a tick.

    C <- turn C, V <- V + C^T f dt, X <- X + V dt + C^T f dt^2 / 2 and B <- B + C^T dt, where C of
    averaged samples is halfway, and the accelerometer is mounted elsewhere.
    """
    arm, average, rng = (
        np.array([0.05, -0.03, 0.02]),
        samples == "average",
        np.random.default_rng(1),
    )
    imu = OPEN.imu.replace(samples=samples, lever_arm_B=tuple(arm))
    integration = "midpoint" if average else "euler"
    estimator = OPEN.estimator.replace(integration=integration)
    rules = LateRules(OPEN.replace(imu=imu, estimator=estimator))
    dt, first, b_g = rules.dt, 64.0 * 1563 - 23.0, 0.01 * rng.normal(size=3)
    zero = (np.eye(3), np.zeros(3), np.zeros(3), np.zeros((3, 3)))
    rules.put_sums(0, zero, zero)
    rules.set(b_g_hat=b_g, tick=first)
    stamps = rules.get("stamps")[0]
    stamps[:, :, 0] = np.nan
    stamps[Sensor.GNSS, SLOT, : len(row_of(first, zero))] = row_of(first, zero)
    w_before = rng.normal(size=3)
    C, V, X, B = zero
    for k in range(100):
        gyro, accel, w = 3.0 * rng.normal(size=(3, 3))
        if k == 0:
            rules.put(0, stamps=stamps)
        rules.set(gyro=gyro, accel=accel, w_before=w_before, w_meas=w, tick=first + k)
        rules.run(Stage.INCREMENT)
        turn = euler_to_dcm(dt * gyro)
        half, a, b = np.eye(3), w_before - b_g, w - b_g
        if average:
            half = turned(dt * gyro / 2.0)
            turn = half @ half
            accel = accel - (half.T @ np.cross(b, arm) - half @ np.cross(a, arm)) / dt
        else:
            accel = accel - np.cross((b - a) / dt, arm) - np.cross(b, np.cross(b, arm))
        at = (half @ C).T
        C, V, X, B = (
            turn @ C,
            V + dt * at @ accel,
            X + dt * V + dt**2 / 2.0 * at @ accel,
            B + dt * at,
        )
        w_before = w
    now = tuple(rules.get(f"imu_{n}")[0] for n in ("turn", "velocity", "position", "bias_gain"))
    row, T = rules.get("stamps")[0, Sensor.GNSS, SLOT], 100 * dt
    then = (row[1:10].reshape(3, 3), row[10:13], row[13:16], row[16:25].reshape(3, 3))
    assert row[0] == first
    assert then[1].any()  # the instant has moved
    C_s = then[0]
    np.testing.assert_allclose(now[0] @ C_s.T, C, atol=1e-9)
    np.testing.assert_allclose(C_s @ (now[1] - then[1]), V, atol=1e-9)
    np.testing.assert_allclose(C_s @ (now[2] - then[2] - then[1] * T), X, atol=1e-9)
    np.testing.assert_allclose(C_s @ (now[3] - then[3]), B, atol=1e-9)

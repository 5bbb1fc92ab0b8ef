"""The Kalman filter of the heading by motion, and its level frame N, against plain references."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quad_gym.estimation import UnscentedKalmanFilter
from quad_gym.kernels.stages import Stage
from quad_gym.records import AID_GROUPS, VELOCITY_BLOCK, Aid
from quad_gym.rotations import euler_to_dcm
from tests.filter_states import set_at_rest
from tests.lane_filter import EIGHT
from tests.lane_rules import NEVER, LaneRules
from tests.level_flights import GRAVITY, MAGNETIC, R_IG
from tests.reference_motion import PlainMotion

SUITE = MAGNETIC.replace(gnss=MAGNETIC.gnss.replace(secondary_antenna_B=None))
NOISE = 2.0 * SUITE.gnss.velocity_sigma**2
COMPASS = AID_GROUPS + Aid.MAGNETOMETER
NOW = LaneRules.tick
ENTRIES = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]
"""Rows and columns of `level_P`: vv, uu, dd, vu, vd, ud."""


def complex_of(pairs):
    return pairs[..., 0::2] + 1j * pairs[..., 1::2]


def covariance(rules):
    """Covariances (EIGHT, 3, 3) of v, u and d."""
    packed, P = rules.get("level_P"), np.zeros((EIGHT, 3, 3), dtype=complex)
    values = [*packed[:, :3].T, *complex_of(packed[:, 3:]).T]
    for (i, j), value in zip(ENTRIES, values, strict=True):
        P[:, j, i], P[:, i, j] = np.conj(value), value
    return P


def random_covariance(rng):
    root = rng.standard_normal((2, 3, 3)) @ np.diag([0.3, 0.6, 0.4])
    return (root[0] + 1j * root[1]) @ (root[0] + 1j * root[1]).conj().T


def packed(P):
    """A covariance as `level_P` has it."""
    cross = [(P[i, j].real, P[i, j].imag) for i, j in ENTRIES[3:]]
    return [*np.diag(P).real, *np.ravel(cross)]


def followed(rules, sums, velocities):
    """Give all flights a fix of the velocity (EIGHT, 2) at the sums (EIGHT, 3)."""
    v_I = np.column_stack([velocities, np.zeros(EIGHT)])
    rules.measured(VELOCITY_BLOCK, v_I @ R_IG)
    rules.set(level_sum=sums)
    rules.run(Stage.MOTION)


def begun(rng, **fields):
    """Flights whose filters have begun, with random states; and plain ones with the same."""
    rules, plain = LaneRules(SUITE), []
    for number in range(EIGHT):
        P, x = random_covariance(rng), rng.standard_normal(6)
        last = [*rng.standard_normal(2), 20.0]
        rules.put(number, level_P=packed(P), level_state=x, level_last=last)
        plain.append(PlainMotion(0.0, 1.0, 1.0))
        plain[-1].x, plain[-1].P = complex_of(x), P
    rules.set(**{"level_phase": 2.0} | fields)
    return rules, plain


def assert_same(rules, plain, **tolerance):
    x = complex_of(rules.get("level_state"))
    np.testing.assert_allclose(x, [f.x for f in plain], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(covariance(rules), [f.P for f in plain], rtol=1e-9, atol=1e-12)


def test_velocity_heading_and_leveling_agree_with_a_plain_kalman_filter():
    """A sequence of fixes, from random states. The last axis of a covariance may be complex."""
    rng = np.random.default_rng(0)
    rules, plain = begun(rng)
    sums = rules.get("level_last")
    for T in (0.1, 0.4, 1.9, 0.2):
        added = np.column_stack([rng.standard_normal((EIGHT, 2)), np.full(EIGHT, T)])
        near = []
        for f, (x, y, _) in zip(plain, added, strict=True):
            f.predict(x + 1j * y, T)
            near.append(f.x[0] + rng.normal(0.0, 0.3) + 1j * rng.normal(0.0, 0.3))
        near, sums = np.array(near), sums + added
        followed(rules, sums, np.column_stack([near.real, near.imag]))
        for f, z in zip(plain, near, strict=True):
            f.update(z, NOISE)
        assert_same(rules, plain)
        np.testing.assert_array_equal(rules.get("level_last"), sums)
        np.testing.assert_array_equal(rules.get("level_misses"), 0.0)
        np.testing.assert_array_equal(rules.get("level_fresh"), 1.0)


@pytest.mark.parametrize("factor", [1.0, 4.0])
def test_velocity_beyond_its_gate_is_left_out_and_counts_as_a_miss(factor):
    """The gate of the NIS is 20. The noise is as large as the filter's factor has it."""
    rng = np.random.default_rng(1)
    rules, plain = begun(rng, noise_factor=factor, level_misses=1.0)
    before, sums, z = rules.get("level_P"), rules.get("level_last"), []
    sums = sums + np.array([0.3, -0.2, 0.1])
    nis = np.repeat([19.8, 20.2], 4)
    for f, value in zip(plain, nis, strict=True):
        f.predict(0.3 - 0.2j, 0.1)
        size = math.sqrt(0.5 * value * (f.P[0, 0].real + factor * NOISE))
        z.append(f.x[0] + size * np.exp(1j * rng.uniform(0.0, 6.0)))
        assert f.nis(z[-1], factor * NOISE) == pytest.approx(value)
        f.update(z[-1], factor * NOISE)
    W, z = rules.get("level_turn"), np.array(z)
    followed(rules, sums, np.column_stack([z.real, z.imag]))
    used = nis < 20.0
    x = complex_of(rules.get("level_state"))
    np.testing.assert_allclose(x[used], [f.x for f in plain[:4]], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(covariance(rules)[used], [f.P for f in plain[:4]], rtol=1e-9)
    np.testing.assert_array_equal(rules.get("level_P")[~used], before[~used])
    np.testing.assert_array_equal(rules.get("level_misses"), np.where(used, 0.0, 2.0))
    np.testing.assert_array_equal(rules.get("level_fresh"), used)
    np.testing.assert_array_equal(rules.get("level_turn")[~used], W[~used])
    np.testing.assert_array_equal(rules.get("level_last")[used], sums[used])


@pytest.mark.parametrize(
    ("phase", "misses"), [(1.0, 0.0), (2.0, 3.0), (2.0, 4.0)], ids=["first", "three", "four"]
)
def test_first_fix_and_three_misses_in_a_row_begin_velocity_heading_and_leveling(phase, misses):
    """u = 0 with P_uu = 1. The variance of d is gravity times the filter's tilt, and 0.3 m/s^2."""
    rng = np.random.default_rng(2)
    rules, _ = begun(rng, level_phase=phase, level_misses=misses, level_loose=0.2)
    R_BI, covariances = euler_to_dcm([0.5, -0.4, 1.0]), rules.covariance()
    axes = np.column_stack([*np.linalg.svd(R_BI[np.newaxis, :, 2])[2][1:], R_BI[:, 2]])
    covariances[:, 6:9, 6:9] = axes @ np.diag([0.2, 0.03, 0.5]) ** 2 @ axes.T
    rules.set_covariance(covariances)
    rules.set(R_hat=R_BI)
    velocities = rng.standard_normal((EIGHT, 2))
    sums = rules.get("level_last") + np.array([1.0, 2.0, 0.3])
    followed(rules, sums, velocities)
    d = GRAVITY**2 * (0.2**2 + 0.03**2) + 2.0 * 0.3**2
    plain = [PlainMotion(z[0] + 1j * z[1], NOISE, d) for z in velocities]
    assert_same(rules, plain)
    for field, value in {
        "level_phase": 2.0, "level_misses": 0.0, "level_fresh": 1.0, "level_loose": 1.0,
        "level_last": sums,
    }.items():  # fmt: skip
        np.testing.assert_array_equal(
            rules.get(field), np.broadcast_to(value, rules.get(field).shape)
        )


def test_first_tilt_beyond_the_usual_one_and_a_large_bias_make_leveling_uncertain():
    """The tilt of N is the larger one of both; its bias may exceed 0.3 m/s^2."""
    rng = np.random.default_rng(2)
    rules, _ = begun(rng, level_misses=3.0, level_first=0.04, level_force=[0.0, 0.0, 5.0])
    rules.set_sigma(6, 0.01)
    rules.set_sigma(7, 0.01)
    for number in range(EIGHT):
        rules.put_params(number, accel_bias_sigma=0.4)
    followed(rules, rules.get("level_last"), np.zeros((EIGHT, 2)))
    tilt = 2.0 * 0.04 * math.exp(-2.0 * 0.06 * 5.0)
    expected = GRAVITY**2 * tilt + 2.0 * 0.4**2
    np.testing.assert_allclose(rules.get("level_P")[:, 2], expected, rtol=1e-9)


@pytest.mark.parametrize(
    "fields",
    [{"level_phase": 0.0}, {"block_valid": 0.0}, {"level_last": [0.0, 0.0, 21.0]}],
    ids=["no level frame", "no velocity", "before the last one"],
)
def test_nothing_is_measured_without_a_velocity_or_a_level_frame(fields):
    rules, _ = begun(np.random.default_rng(3), **{"level_misses": 1.0, **fields})
    before = rules.get("level_P"), rules.get("level_state")
    if "block_valid" in fields:
        rules.set(level_sum=[0.0, 0.0, 20.5])
        rules.run(Stage.MOTION)
    else:
        followed(rules, np.tile([0.0, 0.0, 20.5], (EIGHT, 1)), np.zeros((EIGHT, 2)))
    np.testing.assert_array_equal(rules.get("level_P"), before[0])
    np.testing.assert_array_equal(rules.get("level_state"), before[1])
    np.testing.assert_array_equal(rules.get("level_fresh"), 0.0)
    np.testing.assert_array_equal(rules.get("level_misses"), 1.0)


@pytest.mark.parametrize("T", [1.99, 2.01])
def test_velocity_begins_after_two_seconds_without_a_fix_and_the_heading_stays(T):
    """The variance has the drift of the gyro, and is at most one. Leveling has decayed."""
    rng = np.random.default_rng(4)
    rules, plain = begun(rng, level_loose=0.2)
    drift = (0.03, 0.05, 0.02)
    for axis, sigma in enumerate(drift):
        rules.set_sigma(12 + axis, sigma)
    sums = rules.get("level_last") + np.array([0.0, 0.0, T])
    velocities = rng.standard_normal((EIGHT, 2))
    followed(rules, sums, velocities)
    x, z = complex_of(rules.get("level_state")), complex_of(velocities)[:, 0]
    if T < 2.0:
        assert not np.isclose(x[:, 0], z).any()
        return
    for k, f in enumerate(plain):
        u = f.x[1]
        f.predict(0.0, T)
        f.x[0] = z[k]
        turned = 2.0 * T**2 * np.square(drift).sum() * abs(u) ** 2
        f.P = np.diag([NOISE, min(f.P[1, 1].real + turned, 1.0), f.P[2, 2].real])
    assert any(f.P[1, 1] == 1.0 for f in plain)
    assert any(f.P[1, 1] < 1.0 for f in plain)
    assert_same(rules, plain)
    np.testing.assert_array_equal(rules.get("level_loose"), 1.0)
    np.testing.assert_array_equal(rules.get("level_misses"), 0.0)
    np.testing.assert_array_equal(rules.get("level_fresh"), 1.0)
    np.testing.assert_array_equal(rules.get("level_last"), sums)


@pytest.mark.parametrize("T", [0.5, 2.5])
def test_vertical_of_the_level_frame_turns_to_the_force_that_no_change_of_velocity_explains(T):
    """By 0.1 per second if the heading is known, and else, by the whole force, by 0.06.

    A known one has 0.6 < |u| < 1.5 and less than 0.26 rad. After more than 2 s without a fix,
    nothing turns.
    """
    rng = np.random.default_rng(5)
    rules, plain = begun(rng)
    W = Rotation.random(EIGHT, random_state=rng).as_matrix()
    rules.set(level_turn=W)
    lengths = [0.9, 0.9, 0.59, 0.61, 1.49, 1.51, 1.0, 1.0]
    sigmas = [0.255, 0.265, 0.2, 0.2, 0.2, 0.2, 0.2, 0.3]
    for number, (length, sigma) in enumerate(zip(lengths, sigmas, strict=True)):
        u = length * np.exp(1j * rng.uniform(0.0, 6.0))
        P = np.diag([0.1, 2.0 * (sigma * length) ** 2, 0.01])
        rules.put(number, level_state=[0.5, 0.2, u.real, u.imag, 0.0, 0.0], level_P=packed(P))
        plain[number].x, plain[number].P = np.array([0.5 + 0.2j, u, 0.0]), P.astype(complex)
    A, before, z = 0.05 * rng.standard_normal((EIGHT, 2)), 0.5 + 0.2j, []  # u changes hardly
    for f, (x, y) in zip(plain, A, strict=True):
        f.predict(x + 1j * y, T)
        z.append(f.x[0] + 0.05 * (rng.standard_normal() + 1j * rng.standard_normal()))
        f.update(z[-1], NOISE)
    z = np.array(z)
    sums = rules.get("level_last") + np.column_stack([A, np.full(EIGHT, T)])
    followed(rules, sums, np.column_stack([z.real, z.imag]))
    for k, f in enumerate(plain):
        rest, rate = complex_of(A[k])[0], 0.06
        if k in (0, 3, 4, 6):
            rest, rate = rest - (f.x[0] - before) / f.x[1], 0.1
        turn = rate * rest / GRAVITY if T < 2.0 else 0.0j
        # R_BN' = R_BN R_NN', where the axis of N' leans toward the force as seen in N
        tilt = Rotation.from_rotvec([-turn.imag, turn.real, 0.0]).as_matrix()
        np.testing.assert_allclose(rules.get("level_turn")[k], W[k] @ tilt, atol=1e-9)


ROW = {"rejected": 2.0, "out": 0.0, "leapt": 0.0, "since": 0.99}


@pytest.mark.parametrize(
    ("changes", "loose"),
    [
        ({}, True),
        ({"rejected": 1.0}, False),
        ({"out": 1.0}, False),
        ({"leapt": 1.0}, False),
        ({"since": 1.01}, False),
    ],
)
def test_gyro_whose_bias_may_have_changed_makes_the_heading_by_motion_uncertain(changes, loose):
    """After two rejected fields in a row, if the heading was confirmed in the last second.

    A gyro that drifts since the last fix gives the variance; a smaller one does not count.
    """
    case = ROW | changes
    rng = np.random.default_rng(6)
    variance, T = np.array([0.1, 0.3, 0.5, 0.7] * 2), 0.2
    rules, plain = begun(rng, level_loose=variance, compass_out=case["out"])
    rules.set(compass_leapt=case["leapt"], level_tick=NOW - case["since"] / rules.dt)
    rules.change("rejected_in_row", COMPASS, case["rejected"])
    A, z = rng.standard_normal((EIGHT, 2)), []
    for f, (x, y), own in zip(plain, A, variance, strict=True):
        f.predict(x + 1j * y, T)
        grown = own + 2.0 * 0.1**2 * T
        if loose:
            f.P[1, 1] = max(f.P[1, 1].real, grown)
        before = f.P[1, 1].real
        z.append(f.x[0] + 0.1)
        f.update(z[-1], NOISE)
        # what the fix tells about u reduces the variance of one that drifts, too
        gained = 1.0 / f.P[1, 1].real - 1.0 / before
        own_after = 1.0 / (1.0 / grown + gained)
        z[-1] = (z[-1].real, z[-1].imag, own_after)
    z = np.array(z)
    followed(rules, rules.get("level_last") + np.column_stack([A, np.full(EIGHT, T)]), z[:, :2])
    assert_same(rules, plain)
    np.testing.assert_allclose(rules.get("level_loose"), z[:, 2], rtol=1e-9)


@pytest.mark.parametrize("confirmed", [True, False])
def test_level_frame_turns_with_the_gyro_and_adds_up_the_force(confirmed):
    """Against rotations of SciPy, with the estimated biases as far as they are plausible.

    An accelerometer's bias counts up to twice its standard deviation. A gyro's counts up to five
    times until the heading is confirmed, and then up to 0.12 rad/s.
    """
    arm = np.array([0.05, -0.02, 0.1])
    suite = SUITE.replace(gnss=SUITE.gnss.replace(primary_antenna_B=tuple(arm)))
    kf, rng, dt, imu = UnscentedKalmanFilter(suite), np.random.default_rng(7), 0.01, suite.imu
    W = euler_to_dcm([0.1, -0.2, 0.7])
    b_a, b_g = np.array([0.5, -0.01, -0.6]), np.array([0.2, -0.3, 0.001])
    set_at_rest(kf, 1e-6 * np.eye(15), R_BI=W, accel_bias=b_a, gyro_bias=b_g)
    kf._engine.blocks["level_tick"][:] = 0.0 if confirmed else NEVER
    most = 2.0 * imu.accel_bias_sigma
    clipped_a = np.clip(b_a, -most, most)
    most = 0.12 if confirmed else 5.0 * imu.gyro_bias_sigma
    # the filter rotates by the gyro without the whole bias, and N by what is implausible more
    more, sums = b_g - np.clip(b_g, -most, most), np.zeros(2)
    for _ in range(5):
        gyro, accel = rng.normal(0.0, 1.0, 3), rng.normal(0.0, 3.0, 3)
        b_a, b_g = kf.accel_bias, kf.gyro_bias
        kf.predict(gyro, accel, dt=dt)
        half = Rotation.from_rotvec(-0.5 * dt * (gyro - b_g)).as_matrix()
        W = half @ W
        sums += dt * (W.T @ (accel - clipped_a))[:2]
        W = Rotation.from_rotvec(-dt * more).as_matrix() @ half @ W
    read = kf._engine.read
    np.testing.assert_allclose(read("level_turn")[0], W, atol=1e-5)
    np.testing.assert_allclose(read("level_force")[0], [*sums, 0.05], rtol=1e-4)
    turned = W.T @ np.cross(gyro - kf.gyro_bias, arm)
    np.testing.assert_allclose(read("level_sum")[0, :2], sums + turned[:2], rtol=1e-4)
    assert read("level_phase")[0] == 1.0
    assert read("level_last")[0, 2] == pytest.approx(dt)  # earlier velocities do not count

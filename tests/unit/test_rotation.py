"""Attitude conversions against SciPy's rotations; even and odd parts of rotations."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from quad_gym import rotations
from quad_gym.kernels import exported
from quad_gym.kernels.compiling import kernel
from quad_gym.kernels.numbers.linalg import load3, load4, store
from quad_gym.kernels.numbers.rotation import (
    dcm_to_quaternion,
    euler_to_dcm,
    mean_quaternion,
    quaternion_rate,
    quaternion_to_dcm,
    rotation_between,
    split_rotation,
    split_turn,
    turn_pair,
    turn_pair_back,
)
from tests.unit.compiled import Compiled


@kernel
def store_rows(array, matrix):
    """Store a matrix in which some entries are plain zeros."""
    store(array[0], matrix[0])
    store(array[1], matrix[1])
    store(array[2], matrix[2])


def attitude(f, option):
    e = load3(f.e)
    R_BI = euler_to_dcm(e)
    store(f.R, R_BI)
    q = dcm_to_quaternion(R_BI)
    store(f.q, q)
    store(f.R_again, quaternion_to_dcm(q))
    store(f.q_rate, quaternion_rate(q, load3(f.w)))
    even, odd, parts = split_rotation(e)
    store_rows(f.even, even)
    store_rows(f.odd, odd)
    store(f.parts, parts)
    x, d = load3(f.x), load3(f.d)
    there = turn_pair(even, odd, x, d)
    store(f.pair[0], there[0])
    store(f.pair[1], there[1])
    back = turn_pair_back(even, odd, x, d)
    store(f.pair_back[0], back[0])
    store(f.pair_back[1], back[1])


FIELDS = {"e": (3,), "w": (3,), "q": (4,), "q_rate": (4,), "parts": (4,), "x": (3,), "d": (3,)}
FIELDS |= {"pair": (2, 3), "pair_back": (2, 3)}
FIELDS |= dict.fromkeys(("R", "R_again", "even", "odd"), (3, 3))
kernels = Compiled(attitude, **FIELDS)


def two_attitudes(f, option):
    a, b = load4(f.a), load4(f.b)
    store(f.halfway, mean_quaternion(a, b))
    store(f.turn, rotation_between(a, b))
    even, odd = split_turn(load3(f.d))
    store_rows(f.even, even)
    store_rows(f.odd, odd)


def quaternion_of_library(f, option):
    q, length = exported._quaternion(f.R)
    for k in range(4):
        f.q[k] = q[k] / length


libraries = Compiled(quaternion_of_library, R=(9,), q=(4,))
fours = {"a": (4,), "b": (4,), "halfway": (4,), "turn": (3,)}
pairs = Compiled(two_attitudes, **fours, d=(3,), even=(3, 3), odd=(3, 3))
INSTANCES = ("on_floats", "on_lanes")

angles = st.floats(-np.pi, np.pi)
eulers = st.tuples(angles, angles, angles).map(np.array)
unit_quaternions = (
    st.tuples(*[st.floats(-1.0, 1.0)] * 4)
    .map(np.array)
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: q / np.linalg.norm(q))
)


def scipy_dcm(e):
    """R_BI of 3-1-2 Euler angles: SciPy's intrinsic z-x-y rotation takes body to inertial."""
    roll, pitch, yaw = np.moveaxis(np.asarray(e), -1, 0)
    turn = Rotation.from_euler("ZXY", np.stack([yaw, roll, pitch], axis=-1))
    return np.swapaxes(turn.as_matrix(), -1, -2)


def random_eulers(seed, count):
    return np.random.default_rng(seed).uniform(-np.pi, np.pi, (count, 3))


def test_euler_angles_are_yaw_then_roll_then_pitch():
    e = random_eulers(1, 500)
    np.testing.assert_allclose(rotations.euler_to_dcm(e), scipy_dcm(e), rtol=0.0, atol=2e-15)


@pytest.mark.parametrize(
    ("e", "x_I", "x_B"),
    [
        ((0.0, 0.0, np.pi / 2), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)),  # heading north, north is ahead
        ((np.pi / 2, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),  # left side up
        ((0.0, np.pi / 2, 0.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0)),  # nose down
    ],
)
def test_each_euler_angle_has_its_documented_sign(e, x_I, x_B):
    np.testing.assert_allclose(rotations.euler_to_dcm(e) @ x_I, x_B, rtol=0.0, atol=1e-15)


@given(eulers)
def test_a_rotation_survives_the_way_through_euler_angles(e):
    R = rotations.euler_to_dcm(e)
    back = rotations.dcm_to_euler(R)
    assert abs(back[0]) <= np.pi / 2
    assert np.abs(back[1:]).max() <= np.pi
    np.testing.assert_allclose(rotations.euler_to_dcm(back), R, rtol=0.0, atol=3e-12)


@given(eulers)
def test_euler_angles_survive_the_way_through_a_rotation(e):
    e[0] /= 2.0
    assume(abs(e[0]) < 1.57 and np.abs(e[1:]).max() < 3.14)
    back = rotations.dcm_to_euler(rotations.euler_to_dcm(e))
    np.testing.assert_allclose(back, e, rtol=0.0, atol=1e-12)


@given(st.sampled_from([-1.0, 1.0]), angles, angles)
def test_at_a_roll_of_a_quarter_turn_the_pitch_is_zero(side, pitch, yaw):
    R = scipy_dcm([side * np.pi / 2, pitch, yaw])
    back = rotations.dcm_to_euler(R)
    assert back[0] == pytest.approx(side * np.pi / 2, abs=1e-15)
    assert back[1] == 0.0
    np.testing.assert_allclose(rotations.euler_to_dcm(back), R, rtol=0.0, atol=1e-15)


@given(unit_quaternions)
def test_a_quaternion_survives_the_way_through_a_rotation(q):
    R = rotations.quaternion_to_dcm(q)
    back = rotations.dcm_to_quaternion(R)
    assert np.linalg.norm(back) == pytest.approx(1.0, abs=1e-15)
    assert back[np.argmax(np.abs(back))] > 0.0
    np.testing.assert_allclose(back * np.sign(back @ q), q, rtol=0.0, atol=1e-15)


@given(unit_quaternions)
def test_quaternions_are_hamiltons_from_body_to_inertial(q):
    R_IB = Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix()
    stacked = rotations.quaternion_to_dcm([[q, 1e-3 * q]])  # q need not be normalized
    np.testing.assert_allclose(stacked, np.tile(R_IB.T, (1, 2, 1, 1)), rtol=0.0, atol=1e-15)
    assert rotations.dcm_to_euler(stacked).shape == (1, 2, 3)
    assert rotations.dcm_to_quaternion(stacked).shape == (1, 2, 4)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (-1, 1, 1)])
def test_half_turns_have_well_conditioned_quaternions(axis):
    R = Rotation.from_rotvec(np.pi * np.array(axis) / np.linalg.norm(axis)).as_matrix().T
    q = rotations.dcm_to_quaternion(R)
    np.testing.assert_allclose(rotations.quaternion_to_dcm(q), R, rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("instance", INSTANCES)
@pytest.mark.parametrize("size", [1e-8, 1e-3, 0.04, 0.5, np.pi])
def test_the_even_and_odd_parts_add_up_to_the_rotation(instance, size):
    e = size / np.pi * random_eulers(3, 200)
    got, mirrored = (getattr(kernels, instance)(e=sign * e) for sign in (1.0, -1.0))
    whole = np.eye(3) + got["even"] + got["odd"]
    np.testing.assert_allclose(whole, scipy_dcm(e), rtol=0.0, atol=2e-15)
    np.testing.assert_array_equal(mirrored["even"], got["even"])
    np.testing.assert_array_equal(mirrored["odd"], -got["odd"])
    roll, pitch = e[:, 0], e[:, 1]
    parts = [np.sin(roll), -2 * np.sin(roll / 2) ** 2, np.sin(pitch), -2 * np.sin(pitch / 2) ** 2]
    np.testing.assert_allclose(got["parts"], np.transpose(parts), rtol=2e-15)


@pytest.mark.parametrize("instance", INSTANCES)
@pytest.mark.parametrize("size", [0.02, np.pi])
def test_turned_pair_agrees_with_scipy_rotations(instance, size):
    e, rng = size / np.pi * random_eulers(8, 200), np.random.default_rng(9)
    x, d = rng.normal(size=(2, 200, 3))
    got = getattr(kernels, instance)(e=e, x=x, d=d)
    for name, axes in (("pair", "kij,kj->ki"), ("pair_back", "kji,kj->ki")):
        plus = np.einsum(axes, scipy_dcm(e), x - d)
        minus = np.einsum(axes, scipy_dcm(-e), x + d)
        np.testing.assert_allclose(got[name][:, 0], (plus - minus) / 2, rtol=0.0, atol=5e-15)
        np.testing.assert_allclose(got[name][:, 1], (plus + minus) / 2 - x, rtol=0.0, atol=5e-15)


@pytest.mark.parametrize("instance", INSTANCES)
def test_even_part_of_a_small_rotation_keeps_its_accuracy(instance):
    # to second order: -1/2 [e x]^2 with the order of the rotations, here about one axis at a time
    for axis, (i, j) in enumerate([(1, 2), (0, 2), (0, 1)]):
        e = np.zeros((1, 3))
        e[0, axis] = 1e-7
        even = getattr(kernels, instance)(e=e)["even"][0]
        for k in (i, j):
            assert even[k, k] == pytest.approx(-0.5e-14, rel=1e-13)


@pytest.mark.parametrize("instance", INSTANCES)
def test_a_quaternion_turns_at_the_body_rates(instance):
    rng = np.random.default_rng(4)
    e, w = random_eulers(5, 50), rng.normal(size=(50, 3))
    got = getattr(kernels, instance)(e=e, w=w)
    np.testing.assert_allclose(got["R_again"], got["R"], rtol=0.0, atol=2e-15)
    now = Rotation.from_quat(got["q"][:, [1, 2, 3, 0]])
    h = 1e-5
    ahead, behind = (
        (now * Rotation.from_rotvec(s * h * w)).as_quat()[:, [3, 0, 1, 2]] for s in (1, -1)
    )
    ahead *= np.sign((ahead * got["q"]).sum(axis=1, keepdims=True))
    behind *= np.sign((behind * got["q"]).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(got["q_rate"], (ahead - behind) / (2 * h), rtol=0.0, atol=1e-9)


def test_quaternion_of_a_filter_library_agrees_with_scipy():
    rng = np.random.default_rng(14)
    axes = np.concatenate([np.eye(3), -np.eye(3), rng.normal(size=(100, 3))])
    axes /= np.linalg.norm(axes, axis=1)[:, np.newaxis]
    turn = Rotation.from_rotvec(np.concatenate([np.pi * axes, 3.0 * axes, 0.3 * axes]))
    R = np.swapaxes(turn.as_matrix(), 1, 2)
    q = libraries.on_floats(R=R.reshape(-1, 9))["q"]
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, rtol=1e-15)
    left = turn.inv() * Rotation.from_quat(q[:, [1, 2, 3, 0]])
    np.testing.assert_allclose(left.magnitude(), 0.0, atol=1e-14)


@pytest.mark.parametrize("instance", INSTANCES)
@pytest.mark.parametrize("sign", [1.0, -1.0])  # both are the same attitude
def test_halfway_between_two_attitudes_agrees_with_scipy(instance, sign):
    rng = np.random.default_rng(12)
    turn = rng.normal(size=(100, 3))
    turn *= rng.uniform(1e-3, 0.98 * np.pi, (100, 1)) / np.linalg.norm(turn, axis=1)[:, None]
    first = Rotation.random(100, rng=rng)
    last = first * Rotation.from_rotvec(turn)
    a, b = (x.as_quat(canonical=True)[:, [3, 0, 1, 2]] for x in (first, last))
    b *= sign * np.sign(np.sum(a * b, axis=1, keepdims=True))
    got = getattr(pairs, instance)(a=a, b=b)
    np.testing.assert_allclose(got["turn"], turn, rtol=0.0, atol=1e-12)
    halfway = Rotation.from_quat(got["halfway"][:, [1, 2, 3, 0]])
    left = (first * Rotation.from_rotvec(turn / 2)).inv() * halfway
    np.testing.assert_allclose(left.magnitude(), 0.0, atol=1e-13)


@pytest.mark.parametrize("instance", INSTANCES)
@pytest.mark.parametrize("size", [1e-9, 1e-3, 0.5, np.pi])
def test_even_and_odd_parts_of_a_rotation_vector_add_up_to_the_rotation(instance, size):
    d = size * np.random.default_rng(13).normal(size=(50, 3))
    d[0] = 0.0
    got, mirrored = (getattr(pairs, instance)(d=x) for x in (d, -d))
    R = np.swapaxes(Rotation.from_rotvec(d).as_matrix(), 1, 2)
    whole = np.eye(3) + got["even"] + got["odd"]
    np.testing.assert_allclose(whole, R, rtol=0.0, atol=2e-15 * (1.0 + size))
    np.testing.assert_array_equal(mirrored["even"], got["even"])
    np.testing.assert_array_equal(mirrored["odd"], -got["odd"])


@given(eulers, eulers)
def test_floats_and_lanes_give_the_same_attitude(e, w):
    plain, lanes = kernels.on_floats(e=[e], w=[w]), kernels.on_lanes(e=[e], w=[w])
    for name in FIELDS:
        np.testing.assert_allclose(plain[name], lanes[name], rtol=0.0, atol=2e-15, err_msg=name)


@pytest.mark.parametrize(
    ("function", "name", "good_shape"),
    [
        (rotations.euler_to_dcm, "e", (3,)),
        (rotations.dcm_to_euler, "R_BI", (3, 3)),
        (rotations.quaternion_to_dcm, "q", (4,)),
        (rotations.dcm_to_quaternion, "R_BI", (3, 3)),
    ],
)
def test_bad_input_is_refused_by_name(function, name, good_shape):
    arrays = (np.zeros((*good_shape[:-1], 5)), *(np.full(good_shape, x) for x in (np.nan, np.inf)))
    for bad in (0.0, [], "north", [[1.0], [1.0, 2.0]], None, *arrays):
        with pytest.raises(ValueError, match=rf"^{name} must"):
            function(bad)
    with pytest.raises(ValueError, match=r"^q must not be zero"):
        rotations.quaternion_to_dcm([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]])


@pytest.mark.parametrize(
    "convert", [rotations.dcm_to_euler, rotations.dcm_to_vector, rotations.dcm_to_quaternion]
)
def test_matrices_that_are_no_rotations_are_refused(convert):
    turn = Rotation.from_rotvec([0.3, -0.2, 1.0]).as_matrix()
    convert(np.round(turn, 3))  # written with three digits
    for bad in (np.zeros((3, 3)), 1.01 * turn, -turn, turn[[1, 0, 2]], [turn, np.ones((3, 3))]):
        with pytest.raises(ValueError, match=r"^R_BI must be a rotation.* got \[\["):
            convert(bad)

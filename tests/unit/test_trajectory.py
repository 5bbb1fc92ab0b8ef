"""Trajectories: minimum snap and jerk, choice of times, functions, tables, headings."""

import pickle

import numpy as np
import pytest
from numpy.polynomial import legendre

from quad_gym import Trajectory
from quad_gym.params.task import figure_of_eight

FIVE = np.array([(0, 0, 1.5), (3, 1.5, 2), (3, -1.5, 1), (-3, 1.5, 2), (-3, -1.5, 1)], float)
TIMES = np.array([0.0, 1.5, 3.5, 5.0, 8.0])


def random_points(n, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n, 3)) * 2.0, np.cumsum(rng.uniform(0.5, 2.0, n + 1)) - 0.5


def row(order, x, length, degree):
    """Return a derivative of a segment's Legendre series at x in [-1, 1], as a row."""
    basis = legendre.legder(np.eye(degree + 1), order) if order else np.eye(degree + 1)
    return legendre.legval(x, basis) * (2.0 / length) ** order


def minimum(points, times, order, closed, at_rest, degree=9):
    """Solve the KKT system of min c'Qc under Ac = b; return positions halfway and at a third. The
    basis is larger than the minimum needs, and only derivatives below `order` are required to be
    continuous: the continuity of higher ones follows from the minimum."""
    lengths = np.diff(times)
    m, n = len(lengths), degree + 1
    x, weights = legendre.leggauss(12)
    Q = np.zeros((m * n, m * n))
    A, b = [], []

    def constrain(value, *parts):
        line = np.zeros(m * n)
        for j, factor, part in parts:
            line[j * n : (j + 1) * n] += factor * part
        A.append(line)
        b.append(value)

    for j, length in enumerate(lengths):
        rows = np.array([row(order, at, length, degree) for at in x])
        block = slice(j * n, (j + 1) * n)
        Q[block, block] = np.einsum("q,qi,qk->ik", weights * length / 2.0, rows, rows)
        constrain(points[j], (j, 1.0, row(0, -1.0, length, degree)))
        constrain(points[j + 1], (j, 1.0, row(0, 1.0, length, degree)))
    for j in range(m if closed else m - 1):
        after = (j + 1) % m
        for k in range(1, order):
            end, begin = row(k, 1.0, lengths[j], degree), row(k, -1.0, lengths[after], degree)
            constrain(np.zeros(3), (j, 1.0, end), (after, -1.0, begin))
    if at_rest and not closed:
        for k in range(1, order):
            constrain(np.zeros(3), (0, 1.0, row(k, -1.0, lengths[0], degree)))
            constrain(np.zeros(3), (m - 1, 1.0, row(k, 1.0, lengths[-1], degree)))
    A, b = np.array(A), np.array(b)
    kkt = np.block([[Q, A.T], [A, np.zeros((len(A), len(A)))]])
    right = np.concatenate([np.zeros((m * n, 3)), b])
    scale = 1.0 / np.sqrt(np.abs(kkt).max(axis=1))  # rows and columns of similar size
    solution = np.linalg.solve(kkt * np.outer(scale, scale), right * scale[:, np.newaxis])
    c = (solution * scale[:, np.newaxis])[: m * n].reshape(m, n, 3)
    return np.array([[legendre.legval(at, c[j]) for at in (0.0, -1.0 / 3.0)] for j in range(m)])


@pytest.mark.parametrize("minimize", ["snap", "jerk"])
@pytest.mark.parametrize("ends", ["rest", "free", "closed"])
@pytest.mark.parametrize("count", [2, 3, 5, 8])
def test_trajectory_minimizes_snap_or_jerk(minimize, ends, count):
    points, times = random_points(count, seed=count)
    closed = ends == "closed"
    times = (times if closed else times[:count]) - times[0]
    order = {"snap": 4, "jerk": 3}[minimize]
    options = {"minimize": minimize, "closed": closed, "at_rest": ends == "rest"}
    if ends == "free" and count < order:  # many polynomials have zero cost
        with pytest.raises(ValueError, match=f"fewer than {order} points"):
            Trajectory.through(points, times, **options)
        return
    path = Trajectory.through(points, times, **options)
    around = np.vstack([points, points[:1]]) if closed else points
    expected = minimum(around, times, order, closed, ends == "rest")
    begin, length = path.times[:-1], np.diff(path.times)
    got = np.stack([path(begin + length / 2.0), path(begin + length / 3.0)], axis=1)
    np.testing.assert_allclose(got, expected, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(path(path.times[: len(points)]), points, rtol=0.0, atol=1e-12)


def test_derivatives_are_continuous_and_match_position():
    path, h = Trajectory.through(FIVE, TIMES), 1e-4
    inner = np.linspace(0.01, path.duration - 0.01, 301)
    for k in range(4):
        slope = (path(inner + h, k) - path(inner - h, k)) / (2.0 * h)
        np.testing.assert_allclose(path(inner, k + 1), slope, rtol=0.0, atol=3e-5)
    for k in range(7):  # minimum snap has six continuous derivatives
        before, after = path(TIMES[1:-1] - 1e-9, k), path(TIMES[1:-1] + 1e-9, k)
        np.testing.assert_allclose(before, after, rtol=0.0, atol=1e-5)
    for k in (1, 2, 3):
        assert np.abs(path([0.0, path.duration], k)).max() < 1e-11


def test_trajectory_holds_its_ends_or_repeats_if_closed():
    path = Trajectory.through(FIVE, TIMES)
    np.testing.assert_array_equal(path([-1.0, 0.0]), FIVE[[0, 0]])
    np.testing.assert_allclose(path([8.0, 99.0]), FIVE[[4, 4]], rtol=0.0, atol=1e-12)
    assert (path([-1.0, 99.0], 1) == 0.0).all()
    around = Trajectory.through(FIVE, np.append(TIMES, 10.0), closed=True)
    t = np.linspace(0.0, 10.0, 77)
    for k in range(3):
        np.testing.assert_allclose(around(t - 10.0, k), around(t + 20.0, k), rtol=0.0, atol=1e-11)
    assert around(3.0).shape == (3,)
    assert around(np.zeros((2, 5)), 2).shape == (2, 5, 3)


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("bounds", [(2.5, 3.0), (2.0, 50.0), (50.0, 4.0)])
@pytest.mark.parametrize("minimize", ["snap", "jerk"])
def test_speed_or_acceleration_reaches_its_bound_and_none_is_exceeded(closed, bounds, minimize):
    points, _ = random_points(6, seed=3)
    path = Trajectory.through(
        points, max_speed=bounds[0], max_acceleration=bounds[1], closed=closed, minimize=minimize
    )
    t = np.linspace(0.0, path.duration, 100_001)
    shares = [
        np.linalg.norm(path(t, k), axis=1).max() / bound for k, bound in enumerate(bounds, start=1)
    ]
    assert max(shares) <= 1.0
    assert max(shares) > 0.999


def test_optimized_times_are_shorter_than_times_proportional_to_distance():
    for closed in (False, True):
        path = Trajectory.through(FIVE, closed=closed)
        around = np.vstack([FIVE, FIVE[:1]]) if closed else FIVE
        times = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(around, axis=0), axis=1)))
        plain = Trajectory.through(FIVE, times, closed=closed)
        t = np.linspace(0.0, plain.duration, 20_001)
        speed, acceleration = (np.linalg.norm(plain(t, k), axis=1).max() for k in (1, 2))
        needed = plain.duration * max(speed / 2.5, np.sqrt(acceleration / 3.0))
        assert path.duration < 0.999 * needed


@pytest.mark.parametrize("closed", [False, True])
def test_yaw_derivatives_match_yaw(closed):
    angles = np.array([0.0, 1.0, 2.5, 4.0, 5.0])
    when = np.append(TIMES, 10.0) if closed else TIMES
    t, h = np.linspace(0.3, when[-1] - 0.3, 200), 1e-5
    for options in ({"yaw": angles}, {"yaw": "along"}, {"look_at": (0.3, 9.0)}, {"yaw": 0.7}, {}):
        path = Trajectory.through(FIVE, when, closed=closed, **options)
        for k in (0, 1):
            gap = path.yaw(t + h, k) - path.yaw(t - h, k)
            gap = (gap + np.pi) % (2 * np.pi) - np.pi if k == 0 else gap
            slope = gap / (2.0 * h)
            np.testing.assert_allclose(path.yaw(t, k + 1), slope, rtol=2e-5, atol=2e-5)
    path = Trajectory.through(FIVE, when, closed=closed, yaw=angles)
    np.testing.assert_allclose(path.yaw(TIMES), angles, rtol=0.0, atol=1e-9)
    path = Trajectory.through(FIVE, when, closed=closed, look_at=(0.3, 9.0, 1.0))
    gap = [0.3, 9.0] - path(t)[:, :2]
    np.testing.assert_allclose(path.yaw(t), np.arctan2(gap[:, 1], gap[:, 0]), rtol=0, atol=1e-12)


def test_yaw_of_closed_trajectory_accumulates_full_turns():
    path = Trajectory.through(FIVE, np.append(TIMES, 10.0), closed=True, yaw=[0, 1.3, 2.6, 4, 5.2])
    np.testing.assert_allclose(path.yaw(23.0) - path.yaw(3.0), 4.0 * np.pi, rtol=1e-12)
    for k in range(3):  # no jump from one round to the next, in the angle and its derivatives
        np.testing.assert_allclose(path.yaw(9.9999999, k), path.yaw(10.0, k), rtol=0.0, atol=1e-5)


def test_a_heading_along_the_path_is_held_at_rest():
    path = Trajectory.through([(0, 0, 1), (0, 2, 1), (-2, 2, 1)], [0, 2, 4], yaw="along")
    assert path.yaw([-1.0, 0.0, 0.01]) == pytest.approx(path.yaw(0.02), abs=0.01)
    assert path.yaw([3.99, 4.0, 9.0]) == pytest.approx(path.yaw(3.98), abs=0.01)
    straight = Trajectory.through([(0, 0, 1), (0, 2, 1)], yaw="along")
    assert straight.yaw([-1.0, 0.0, 1.0, 99.0]) == pytest.approx(np.pi / 2)


def eight(t):
    return 3.0 * np.sin(t), 1.5 * np.sin(2.0 * t), 1.5 + 0.3 * np.cos(t)


def eight_velocity(t):
    return 3.0 * np.cos(t), 3.0 * np.cos(2.0 * t), -0.3 * np.sin(t)


def eight_acceleration(t):
    return -3.0 * np.sin(t), -6.0 * np.sin(2.0 * t), -0.3 * np.cos(t)


@pytest.mark.parametrize("closed", [False, True])
def test_trajectory_of_function_matches_function_and_its_derivatives(closed):
    path = Trajectory.of(eight, 2.0 * np.pi, closed=closed, yaw=lambda t: t)
    t = np.linspace(0.0, path.duration, 1003)[:-1]
    for k, (function, miss) in enumerate(
        ((eight, 2e-6), (eight_velocity, 2e-4), (eight_acceleration, 1e-2))
    ):
        np.testing.assert_allclose(path(t, k), np.transpose(function(t)), rtol=0.0, atol=miss)
    np.testing.assert_allclose(path.yaw(t), t, rtol=0.0, atol=1e-6)
    finer = Trajectory.of(eight, 2.0 * np.pi, closed=closed, tolerance=1e-9)
    np.testing.assert_allclose(finer(t), np.transpose(eight(t)), rtol=0.0, atol=2e-9)


def test_trajectory_from_csv_passes_points_at_given_times(tmp_path):
    file = tmp_path / "path.csv"
    lines = ["Time, X, y, z, note, yaw"]
    for t, p in zip(TIMES + 12.3, FIVE, strict=True):
        lines.append(f"{t}, {p[0]}, {p[1]}, {p[2]}, hello, {0.1 * t}")
    file.write_text("\n".join([*lines, ""]))
    path = Trajectory.from_csv(file)
    expected = Trajectory.through(FIVE, TIMES, yaw=0.1 * (TIMES + 12.3))
    t = np.linspace(0.0, 8.0, 50)
    np.testing.assert_allclose(path(t), expected(t), rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(path.yaw(t), expected.yaw(t), rtol=0.0, atol=1e-12)
    along = Trajectory.from_csv(file, yaw="along", minimize="jerk", at_rest=False)
    assert along == Trajectory.through(
        FIVE, TIMES + 12.3, yaw="along", minimize="jerk", at_rest=False
    )
    file.write_text("\n".join([*lines, "22.3, 0, 0, 1.5, back, 1.23"]))
    closed = Trajectory.from_csv(file, closed=True)
    assert closed.closed
    assert closed.duration == pytest.approx(10.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "must name the columns time, x, y, z"),
        ("time,x,y\n0,0,0", "must name the columns"),
        ("time,x,y,z\n0,0,0,1", "at least two rows"),
        ("time,x,y,z\n0,0,0,1\n1,0,zero,1", "line 3: y must be a finite number, got 'zero'"),
        ("time,x,y,z\n0,0,0,1\n1,0,nan,1", "line 3: y must be a finite number, got 'nan'"),
        ("time,x,y,z\n0,0,0,1\n1,0,1", "line 3: z must be a finite number, got ''"),
        ("time,x,y,z\n0,0,0,1\n1,1,1,1\n1,2,1,1", "increasing times.* rows 2 and 3"),
    ],
)
def test_bad_tables_are_refused(tmp_path, text, message):
    file = tmp_path / "path.csv"
    file.write_text(text)
    with pytest.raises(ValueError, match=message):
        Trajectory.from_csv(file)


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        (([(0, 0, 1)],), {}, "points must be at least two, got 1"),
        (([(0, 0, 1), (1, np.nan, 1)],), {}, "points must be finite"),
        (([(0, 0), (1, 1)],), {}, r"points must have shape \(n, 3\)"),
        (("abc",), {}, "points must be an array"),
        (([(0, 0, 1), (0, 0, 1), (1, 1, 1)],), {}, "differ.* as points 0 and 1"),
        (([(0, 0, 1), (1, 0, 1), (0, 0, 1)],), {"closed": True}, "returns by itself"),
        ((FIVE, TIMES[::-1]), {}, "times must increase, got 8 s and then 5 s"),
        ((FIVE, [0, 1, 1, 2, 3]), {}, "times must increase"),
        ((FIVE, TIMES[:3]), {}, "times must be 5, one for each point"),
        ((FIVE, TIMES), {"closed": True}, "times must be 6.*return"),
        ((FIVE, [0, 1, np.inf, 3, 4]), {}, "times must be finite"),
        ((FIVE, TIMES), {"max_speed": 1.0}, "max_speed must not be given with times"),
        ((FIVE,), {"max_speed": -1.0}, "max_speed must be greater"),
        ((FIVE,), {"max_acceleration": np.nan}, "max_acceleration must be finite"),
        ((FIVE,), {"minimize": "crackle"}, "minimize must be one of snap, jerk"),
        ((FIVE,), {"yaw": "north"}, "yaw must be one of along"),
        ((FIVE,), {"yaw": 90}, r"yaw must be in rad, .*, got 90; did you mean 1\.571\?"),
        ((FIVE,), {"yaw": [0, 90, 180, 270, 360]}, "yaw must be in rad, .*got 0 and then 90: in d"),
        ((FIVE,), {"yaw": [90.0] * 5}, r"yaw must be in rad, .*did you mean 1\.571\?"),
        ((FIVE,), {"yaw": [0.0, 1.0]}, r"yaw must have shape|yaw must"),
        ((FIVE,), {"yaw": 0.0, "look_at": (0, 0)}, "yaw must not be given with look_at"),
        ((FIVE,), {"look_at": (0.0,)}, "look_at must have shape"),
        ((FIVE,), {"closed": 1}, "closed must be True or False"),
    ],
)
def test_hostile_points_are_refused(arguments, options, message):
    with pytest.raises(ValueError, match=message):
        Trajectory.through(*arguments, **options)


@pytest.mark.parametrize(
    ("function", "options", "message"),
    [
        (None, {}, "function must be a function"),
        (lambda t: (t, t), {}, r"function\(0\) must have shape \(3,\)"),
        (lambda t: (t, t, np.nan), {}, r"function\(0\) must be finite"),
        (lambda t: (abs(t - 1.0), 0, 1), {}, "function must be smooth"),
        (lambda t: (t, 0, 1), {"closed": True}, "must return to its start"),
        (eight, {"duration": 0.0}, "duration must be"),
        (eight, {"yaw": [0.0, 1.0]}, "got an array"),
    ],
)
def test_hostile_functions_are_refused(function, options, message):
    with pytest.raises(ValueError, match=message):
        Trajectory.of(function, **{"duration": 2.0, **options})


def test_bad_coefficients_are_refused():
    for options, message in (
        ({"times": [1.0, 2.0]}, "begin with 0"),
        ({"times": [0.0, 1.0, 1.0]}, "increase"),
        ({"times": [0.0]}, "at least two"),
        ({"times": [0.0, 1.0, 2.0]}, "2 segments"),
        ({"coefficients": np.zeros((7, 1, 4))}, "shape"),
        ({"heading": "up"}, "one of given, along, toward"),
    ):
        with pytest.raises(ValueError, match=message):
            Trajectory(**{"times": [0.0, 1.0], "coefficients": np.zeros((8, 1, 4)), **options})
    path = figure_of_eight()
    for options, message in (
        ({"t": np.nan}, "t must be finite"),
        ({"t": 0.0, "derivative": -1}, "at least 0"),
        ({"t": 0.0, "derivative": 1.5}, "whole number"),
    ):
        with pytest.raises(ValueError, match=message):
            path(**options)


def test_trajectories_are_immutable_and_compare_by_value():
    path = figure_of_eight()
    copy = pickle.loads(pickle.dumps(path))
    assert copy == path
    assert hash(copy) == hash(path)
    assert path != path.turned(0.1)
    for one in (path, copy):
        with pytest.raises(ValueError, match="read-only"):
            one.coefficients[0] = 1.0
    with pytest.raises(AttributeError):
        path.closed = False
    given = np.zeros((8, 1, 4))
    own = Trajectory(times=[0.0, 1.0], coefficients=given)
    given[:] = 7.0
    assert (own(0.5) == 0.0).all()


def test_turned_trajectory_rotates_position_and_yaw():
    path = Trajectory.through(FIVE, look_at=(1.0, 2.0))
    turned, t = path.turned(np.pi / 2), np.linspace(0.0, 5.0, 20)
    x, y, z = path(t).T
    np.testing.assert_allclose(turned(t).T, [-y, x, z], rtol=0.0, atol=1e-12)
    for options in ({"look_at": (1.0, 9.0)}, {"yaw": "along"}, {"yaw": 0.3}):
        path = Trajectory.through(FIVE, **options)
        gap = path.turned(0.5).yaw(t) - path.yaw(t) - 0.5
        np.testing.assert_allclose((gap + np.pi) % (2 * np.pi), np.pi, rtol=0.0, atol=1e-9)

"""Draws of random numbers: no two quantities share a draw, so they are independent."""

import ast
import importlib
import itertools
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

import quad_gym
import quad_gym.kernels
from quad_gym.faults import GnssJump, GnssOutage
from quad_gym.kernels.entries import linked_table, run_stage
from quad_gym.kernels.stages import STAGES_OF, Stage, needed_stages
from quad_gym.packing import params_block, params_record, sensor_settings
from quad_gym.params.randomization import Normal, Uniform
from quad_gym.params.task import TaskParams
from quad_gym.records import (
    AID_MOST,
    AIDS,
    BASELINE_BLOCK,
    DRAW_FAULTS,
    DRAW_RANGES,
    DRAWS_OF_FAULT,
    FAULT_KINDS,
    FEATURE_SLICE,
    FLIGHT_BLOCK,
    MAX_FEATURES,
    MAX_OBSTACLES,
    MAX_SLOW,
    POSITION_BLOCK,
    WIDTH,
    WORK_BLOCK,
    Act,
    Aid,
    FaultKind,
    aligned_zeros,
    streams,
)
from quad_gym.records.streams import _claim
from tests.builders import batch as begun
from tests.unit.alarms import alarm_score

COUNT = 10_000
OUTAGE, JUMP = int(FaultKind.GNSS_OUTAGE), int(FaultKind.GNSS_JUMP)
KERNELS = Path(quad_gym.kernels.__file__).parent


def test_sensor_with_many_blocks_has_draws_for_each(monkeypatch):
    ranges = list(DRAW_RANGES)
    monkeypatch.setattr(streams, "DRAW_RANGES", ranges)
    monkeypatch.setattr(streams, "AID_MOST", (*AID_MOST[:-1], 500))
    (last,) = streams._claim_aids("a test", 30_000, 2, 40, each_block=True)[-1:]
    assert ranges[-1] == (f"a test: {list(Aid)[-1].name}", last, 1000)
    assert all(r.first + r.draws <= last or last + 1000 <= r.first for r in ranges[:-1])


def test_no_two_ranges_share_a_draw():
    owners = {}
    for quantity, first, count in DRAW_RANGES:
        assert count > 0
        for draw in range(first, first + count):
            assert owners.setdefault(draw, quantity) == quantity
    assert len({quantity for quantity, _, _ in DRAW_RANGES}) == len(DRAW_RANGES)


@pytest.mark.parametrize("end", ["first", "last"])
def test_overlapping_range_of_draws_raises_value_error(end):
    before, taken = list(DRAW_RANGES), DRAW_RANGES[0]
    first = taken.first - 2 if end == "first" else taken.first + taken[2] - 1
    with pytest.raises(ValueError, match="'a test' overlap those of 'driving noise"):
        _claim("a test", first, 3)
    assert before == DRAW_RANGES


DRAWS_OF = {
    "uniform_pair": 1,
    "normal_pair": 1,
    "six_normals": 3,
    "any_direction": 1,
    "_signed_pair": 1,
}
"""Number of draws that a function takes, starting with the draw in its second argument."""
LARGEST = {
    "feature_count": MAX_FEATURES,
    "settings.feature_count": MAX_FEATURES,
    "settings.obstacle_count": MAX_OBSTACLES,
    "slow.slow_states": MAX_SLOW,
}
"""Largest values of arguments that kernels read at run time."""
FAULTS = range(FAULT_KINDS)


def loops_around(function, call):
    """Yield the loops of a function that enclose a call: (variable, end as source)."""
    for node in ast.walk(function):
        if isinstance(node, ast.For) and call in ast.walk(node):
            yield node.target.id, ast.unparse(node.iter.args[-1])


def draws_of_kernels():
    """Yield each place where a kernel draws: (place, list of its possible sets of draws)."""
    for file in sorted(KERNELS.rglob("*.py")):
        name = ".".join(file.relative_to(KERNELS.parents[1]).with_suffix("").parts)
        for function in ast.walk(ast.parse(file.read_text())):
            if not isinstance(function, ast.FunctionDef) or function.name in DRAWS_OF:
                continue
            for call in ast.walk(function):
                known = isinstance(call, ast.Call) and isinstance(call.func, ast.Name)
                if known and call.func.id in DRAWS_OF:
                    yield f"{name}:{call.lineno}", draws_of_call(name, function, call)


def draws_of_call(name, function, call):
    """Return the set of draws of a call for each value of the variables around it."""
    scope = dict(vars(importlib.import_module(name)))
    if "draw_of" in scope:
        scope["draw_of"] = scope["draw_of"].py_func
    source, values = ast.unparse(call.args[1]), {}
    for variable, end in loops_around(function, call):
        values[variable] = range(LARGEST.get(end) or eval(end, scope))
    if "draw_of(k" in source:
        values["k"] = FAULTS
        assert len(values) == 1  # one set of draws for each kind of fault
    elif ".sensors." in name:  # sensor s, block i, or slow state k
        names = {node.id for node in ast.walk(call.args[1]) if isinstance(node, ast.Name)}
        values |= (
            {"i": range(AID_MOST[scope["_S"]] if "_S" in scope else MAX_FEATURES)}
            if "i" in names - set(values)
            else {}
        )
        values |= {"s": range(AIDS)} if "s" in names else {}
        values |= {"k": range(0, MAX_SLOW, 3)} if "k" in names else {}
    assert len(values) < 3
    scopes = [dict(zip(values, each, strict=True)) for each in itertools.product(*values.values())]
    firsts = [int(eval(source, scope | each)) for each in scopes]
    return [set(range(first, first + DRAWS_OF[call.func.id])) for first in firsts]


PLACES = dict(draws_of_kernels())


def range_of(draw):
    (found,) = [r for r in DRAW_RANGES if draw in range(r.first, r.first + r[2])]
    return found


@pytest.mark.parametrize("place", PLACES)
def test_a_kernel_draws_within_the_range_of_one_quantity(place):
    ranges = {range_of(draw) for draws in PLACES[place] for draw in draws}
    assert len({quantity.partition(":")[0] for quantity, *_ in ranges}) == 1  # of some sensors
    if "faults:" in place and ranges.pop().first == DRAW_FAULTS:  # each kind in its own range
        for kind, draws in enumerate(PLACES[place]):
            first = DRAW_FAULTS + DRAWS_OF_FAULT * kind
            assert draws <= set(range(first, first + DRAWS_OF_FAULT))


def test_every_range_is_drawn_from():
    drawn = {draw for sets in PLACES.values() for draws in sets for draw in draws}
    for quantity, first, count in DRAW_RANGES:
        taken = drawn & set(range(first, first + count))
        assert first in taken, quantity
        least = 0.5 if ":" in quantity else 0.6  # a sensor of one number uses half of a pair
        assert len(taken) >= least * count, quantity  # most faults do not use all draws


def quantities_of(batch):
    """Return each number that an episode draws at its start, by name: (COUNT,)."""
    R = Rotation.from_quat(batch.record("q")[:, [1, 2, 3, 0]]).as_matrix()  # body to inertial
    gates = batch.record("gates")
    turns = np.diff(np.unwrap(np.arctan2(gates[..., 1], gates[..., 0]), axis=1))
    drawn = {
        "tilt": R[:, 2, :2],
        "yaw": np.arctan2(R[:, 1, :1], R[:, 0, :1]),
        "distance": np.linalg.norm(gates[:, :5, :2], axis=2),
        "height": gates[:, :5, 2],
        "turn": turns[:, :4],
        "start": batch.record("r") - gates[:, 0] * [0.25, 0.25, 0.0],
        "velocity": batch.record("v"),
        "accelerometer bias": batch.record("b_a"),
        "gyro bias": batch.record("b_g"),
        "gyro noise": batch.record("gyro") - batch.record("b_g"),
        "mass": batch.read("mass")[:, np.newaxis],
        "wind": np.stack([batch.read("wind_east"), batch.read("wind_up")], axis=1),
        "outage and jump begin": batch.record("fault_from")[:, [OUTAGE, JUMP]],
        "outage lasts": (batch.record("fault_until") - batch.record("fault_from"))[:, [OUTAGE]],
        "jump": batch.record("fault_vector")[:, JUMP],
        "first measurements": batch.record("wait"),
    }
    each = {f"{name} {i}": v for name, values in drawn.items() for i, v in enumerate(values.T)}
    return {name: values for name, values in each.items() if np.ptp(values) > 0.0}


def features_of(quantities):
    """Return functions of the ranks of each quantity, centered, of unit length: (COUNT, n, 4). They
    are correlated if one quantity is a function of another, even of an angle or twice an angle."""
    columns = []
    for values in quantities.values():
        u = (stats.rankdata(values) - 0.5) / len(values)
        turns = 2.0 * np.pi * u
        columns.append([u - 0.5, np.sin(turns), np.cos(turns), np.cos(2.0 * turns)])
    features = np.moveaxis(np.array(columns), -1, 0)
    features = features - features.mean(axis=0)
    return features / np.linalg.norm(features, axis=0)


def assert_independent(one, other, names, same):
    """Check that features of quantities are uncorrelated; `same`: leave out each with itself."""
    scores = np.einsum("nia,njb->ijab", one, other) * np.sqrt(COUNT)
    if same:
        scores[np.arange(len(names)), np.arange(len(names))] = 0.0
    worst = np.unravel_index(np.abs(scores).argmax(), scores.shape)
    pair = f"{names[worst[0]]} and {names[worst[1]]}"
    assert np.abs(scores).max() < alarm_score(scores.size), pair


def test_initial_values_of_episodes_are_independent():
    batch = begun(
        COUNT,
        sensors="consumer",
        task=TaskParams(kind="waypoints", randomize_reference=True, start="hover"),
        randomization={
            "mass": Uniform(0.8, 1.2, relative=True),
            "wind_east": Normal(0.0, 1.0),
            "wind_up": Uniform(-0.5, 0.5),
        },
        faults=(GnssOutage(start=(1.0, 5.0), duration=(1.0, 2.0)), GnssJump(start=(1.0, 5.0))),
        threads=2,
    )
    first = quantities_of(batch)
    batch.reset()
    second = quantities_of(batch)
    assert first.keys() == second.keys()
    assert len(first) > 35
    names, now, later = list(first), features_of(first), features_of(second)
    assert_independent(now, now, names, same=True)
    assert_independent(now, later, names, same=False)


def test_draws_do_not_depend_on_the_length_of_the_last_episode():
    found = []
    for steps in (0, 1, 37):
        batch = begun(9, task=TaskParams(kind="waypoints", randomize_reference=True, start="hover"))
        for _ in range(steps):
            batch.step()
        batch.reset()
        np.testing.assert_array_equal(batch.record("instant"), np.uint64(2 * 2**32))
        found.append([batch.record(name).tobytes() for name in ("r", "gates", "b_a", "gyro", "q")])
    assert found[0] == found[1] == found[2]


INSTANTS = 10_000


@pytest.fixture(scope="module")
def readings():
    """Return standardized sensor readings and biases of one flight at rest: (INSTANTS, n)."""
    # features spread over the image, straight ahead of a camera that looks along x
    features = [(10.0, y, z) for y in (-3.0, -1.0, 1.0, 3.0) for z in (-2.0, 0.0, 1.0, 2.0)]
    camera = quad_gym.CameraParams(attitude=np.radians((90.0, 0.0, 90.0)), features_I=features)
    suite = quad_gym.SensorSuite(camera=camera)
    params = params_block(params_record(quad_gym.VehicleParams(), suite))
    settings, work = sensor_settings(suite), aligned_zeros(1, WORK_BLOCK)
    needed, used = needed_stages(settings[0]), ("imu", "gnss", "camera")
    stages = {s: needed[s] for name in used for s in STAGES_OF[name] if s in needed}
    others = (params, params, settings, work, linked_table(stages, (run_stage.name,)))
    flight = aligned_zeros(1, FLIGHT_BLOCK)
    flight["q"][0, 0], flight["key"][0], work["mask"] = 1.0, [[12], [34]], 1.0
    rows = []
    for first in range(0, INSTANTS, WIDTH):
        flight["instant"], flight["b_a"], flight["b_g"] = first + np.arange(WIDTH), 0.0, 0.0
        for stage in (Stage.SAMPLE, Stage["GNSS"], Stage["CAMERA"], Stage.DRIFT_BIASES):
            flag = Act.SAMPLE if stage.name.lower() in used else 0
            run_stage(flight.ctypes.data, 0, 1, stage, *others, flag)
        z = flight["measurement"][0]
        fix = [z[POSITION_BLOCK], z[BASELINE_BLOCK]]
        numbers = [*(flight[name][0] for name in ("accel", "gyro", "b_a", "b_g")), *fix]
        rows.append(np.concatenate([*numbers, *z[FEATURE_SLICE, :2]]).T)
    assert flight["block_valid"][0, FEATURE_SLICE].sum() == WIDTH * len(features)
    noise = np.concatenate(rows)
    return (noise - noise.mean(axis=0)) / noise.std(axis=0)


def test_different_noises_are_independent(readings):
    correlation = readings.T @ readings / INSTANTS
    # components of one GNSS vector are correlated in G, where its covariance is not diagonal
    same = np.eye(len(correlation), dtype=bool)
    same[12:15, 12:15] = same[15:18, 15:18] = True
    scores = correlation[~same] * np.sqrt(INSTANTS)
    assert np.abs(scores).max() < alarm_score(scores.size)


def test_noises_of_successive_instants_are_independent(readings):
    scores = readings[1:].T @ readings[:-1] / np.sqrt(INSTANTS)
    assert np.abs(scores).max() < alarm_score(scores.size)

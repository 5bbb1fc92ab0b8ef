"""Fields of a view, against closed forms and the records of the flights."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import quad_gym
from quad_gym.params.sensor_table import AID_PARAMS
from quad_gym.records import FEATURE_SLICE
from quad_gym.tasks.view import VIEW_FIELDS
from tests.builders import flown, vec_env

FLIGHTS = 5


def view_of(base="circle", **keywords):
    """Return a batch of flights after some steps, and its view."""
    batch = flown(base, task=quad_gym.Task(), **keywords).flights.batch
    return batch, batch.view


def begun(base="circle", count=FLIGHTS, **keywords):
    """Return an environment after its reset."""
    return vec_env(base, count, seed=1, task=quad_gym.Task(), **keywords)


def value_of(view, name):
    for part in name.split("."):
        view = getattr(view, part)
    return view


@pytest.mark.parametrize("task", ["circle", "waypoints"])
def test_fields_have_the_shape_and_type_of_the_table(task):
    batch, view = view_of(task, sensors="rtk", randomization={"mass": quad_gym.Uniform(0.7, 0.8)})
    lengths = {"n": FLIGHTS, "m": len(batch.sensors.camera.features_I), "k": 28}
    lengths["o"], lengths["gates"] = 0, 5 if task == "waypoints" else 0
    for field in VIEW_FIELDS:
        if field.name.removeprefix("measured.") in AID_PARAMS:  # as without the sensor
            lengths["blocks"] = AID_PARAMS[field.name.removeprefix("measured.")].most_blocks
        value = value_of(view, field.name)
        if not field.shape or field.shape.startswith("dict"):
            continue
        letters = re.fullmatch(r"\((.*)\)( \w+)?", field.shape)
        shape = [x.strip() for x in letters[1].split(",") if x.strip()]
        assert value.shape == tuple(lengths.get(x) or (int(x) if x.isdigit() else 0) for x in shape)
        kind = {" int": "i", " bool": "b", None: "f"}[letters[2]]
        assert value.dtype.kind == kind, field.name
        assert not value.flags.writeable, field.name
    assert set(view.truth.drawn) == {"mass"}


def test_truth_equals_the_records():
    batch, view = view_of(world="breeze")
    for name, field in {
        "position": "r",
        "velocity": "v",
        "quaternion": "q",
        "body_rates": "w",
        "rotor_speeds": "rotor_speeds",
        "accel_bias": "b_a",
        "gyro_bias": "b_g",
        "wind": "wind",
        "position_error": "position_error",
        "estimation_error": "estimation_error",
    }.items():
        np.testing.assert_array_equal(getattr(view.truth, name), batch.record(field))
    R_IB = Rotation.from_quat(view.quaternion, scalar_first=True).as_matrix()
    np.testing.assert_allclose(view.R_BI, R_IB.transpose(0, 2, 1), atol=1e-12)
    np.testing.assert_array_equal(view.truth.forward, view.R_BI[:, 0])
    np.testing.assert_array_equal(view.truth.up, view.R_BI[:, :, 2])
    assert view.position is view.truth.position


def test_estimate_equals_the_state_of_the_filter():
    batch, view = view_of()
    estimate, P = view.estimate, batch.covariance()
    for name, field in {
        "position": "r_hat",
        "velocity": "v_hat",
        "R_BI": "R_hat",
        "accel_bias": "b_a_hat",
        "gyro_bias": "b_g_hat",
        "factor": "L",
    }.items():
        np.testing.assert_array_equal(getattr(estimate, name), batch.record(field))
    np.testing.assert_allclose(estimate.covariance, P, rtol=1e-12, atol=1e-18)
    sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    np.testing.assert_allclose(estimate.sigma, sigma, rtol=1e-12)
    names = ("position", "velocity", "attitude", "accel_bias", "gyro_bias")
    for k, name in enumerate(names):
        rows = slice(3 * k, 3 * k + 3)
        block = getattr(estimate, f"{name}_covariance")
        np.testing.assert_allclose(block, P[:, rows, rows], rtol=1e-9, atol=1e-18)
        np.testing.assert_array_equal(getattr(estimate, f"{name}_sigma"), estimate.sigma[:, rows])
    error = np.zeros((FLIGHTS, 15))
    error[:, :3] = batch.record("r") - batch.record("r_hat")
    error[:, 3:6] = batch.record("v") - batch.record("v_hat")
    turn = Rotation.from_matrix(view.R_BI @ estimate.R_BI.transpose(0, 2, 1))
    error[:, 6:9] = -turn.as_rotvec()  # e for small angles
    error[:, 9:12] = batch.record("b_a") - batch.record("b_a_hat")
    error[:, 12:] = batch.record("b_g") - batch.record("b_g_hat")
    expected = np.einsum("ni,nij,nj->n", error, np.linalg.inv(P), error)
    np.testing.assert_allclose(view.truth.nees, expected, rtol=0.02)


def test_reference_of_a_circle_is_its_closed_form():
    _, view = view_of(steps=30)
    t, w, z = 30 / 50.0, 2.0 * np.pi / 10.0, 1.0
    assert view.time == pytest.approx(np.full(FLIGHTS, t), abs=1e-12)
    assert list(view.step) == [30] * FLIGHTS

    def position(t):
        return np.array([4.0 * np.cos(w * t), 4.0 * np.sin(w * t), z])

    c, s = np.cos(w * t), np.sin(w * t)
    for value, expected in (
        (view.reference_position, position(t)),
        (view.reference_velocity, 4.0 * w * np.array([-s, c, 0.0])),
        (view.reference_acceleration, -4.0 * w * w * np.array([c, s, 0.0])),
        (view.reference_heading, np.array([-c, -s, 0.0])),
        (view.preview[:, 0], position(t + 0.2)),
        (view.preview[:, 1], position(t + 0.4)),
    ):
        np.testing.assert_allclose(value, np.tile(expected, (FLIGHTS, 1)), atol=1e-12)


def test_observed_errors_equal_the_builtin_observation():
    batch, view = view_of("lemniscate", randomize_reference=True)
    layout = {field.name: field.slice for field in quad_gym.observation_layout()}
    for name in ("position_error", "velocity_error", "up", "heading", "reference_acceleration"):
        shipped = view.observation[:, layout[name]]
        np.testing.assert_allclose(getattr(view.observed, name), shipped, atol=1e-6)
    R, gap = batch.record("R_hat"), view.reference_position - batch.record("r_hat")
    np.testing.assert_allclose(
        view.observed.position_error, np.einsum("nij,nj->ni", R, gap), atol=1e-12
    )
    ahead = np.einsum("nij,nkj->nki", R, view.preview - view.reference_position[:, np.newaxis])
    np.testing.assert_allclose(view.observed.preview, ahead, atol=1e-12)
    np.testing.assert_array_equal(view.observed.position, batch.record("r_seen"))
    np.testing.assert_array_equal(view.observed.body_rates, batch.record("w_seen"))


def test_features_in_view_equal_features_measured_by_camera():
    seen = np.zeros(2, int)
    env = begun("hover", start="hover")
    view = env.flights.batch.view
    rng = np.random.default_rng(3)
    for _ in range(40):
        env.step(rng.uniform(-0.8, 0.8, (FLIGHTS, 4)))
        flying = ~view.is_first
        np.testing.assert_array_equal(
            view.truth.features_in_view[flying],
            env.flights.batch.record("block_valid")[:, FEATURE_SLICE][flying, :2],
        )
        seen += np.bincount(view.truth.features_in_view[flying].ravel(), minlength=2)
    assert (seen > 20).all()  # both cases occurred


def test_measurements_not_taken_are_nan():
    suite = quad_gym.sensor_suite("rtk").with_rates(gnss=10.0, camera=10.0)
    _, view = view_of(sensors=suite, steps=7, start="hover")
    measured = np.isfinite(view.measured.gnss_position)
    assert not measured.all()
    np.testing.assert_array_equal(measured.all(axis=1), measured.any(axis=1))
    batch, view = view_of(steps=10, start="hover")
    assert np.isfinite(view.measured.gnss_position).all()
    gap = np.linalg.norm(view.measured.gnss_position - view.position, axis=1)
    assert (gap < 0.5).all()  # the antenna is on the vehicle
    np.testing.assert_array_equal(view.measured.gyro, batch.record("gyro"))
    np.testing.assert_array_equal(view.measured.accel, batch.record("accel"))
    seen = np.isfinite(view.measured.pixels[:, :, 0])
    pixels = batch.record("pixels")[:, :2]
    np.testing.assert_array_equal(view.measured.pixels[seen], pixels[seen])
    assert np.isnan(view.measured.pixels[~seen]).all()
    assert np.isnan(view.measured.barometer).all()  # the suite has none


def test_gates_and_progress_of_a_course_match_the_positions():
    env = begun("waypoints", autoreset_mode="Disabled")
    env.reset(seed=2)
    batch = env.flights.batch
    first = batch.view.gates[:, 0]
    np.testing.assert_array_equal(batch.view.reference_position, first)
    np.testing.assert_array_equal(batch.view.preview, batch.view.gates[:, 1:3])
    env.reset(
        seed=2,
        options={"position": first + (0.6, 0.0, 0.0), "velocity": np.array([-1.0, 0.0, 0.0])},
    )
    gates, passed = batch.view.gates, np.zeros(FLIGHTS, bool)
    for _ in range(40):
        target = gates[np.arange(FLIGHTS), batch.view.gates_passed]
        before = np.linalg.norm(target - batch.record("r"), axis=1)
        env.step(np.zeros((FLIGHTS, 4)))
        after = np.linalg.norm(target - batch.record("r"), axis=1)
        np.testing.assert_allclose(
            batch.view.truth.progress, (before - after) / 0.02, rtol=1e-9, atol=1e-9
        )
        np.testing.assert_array_equal(batch.view.gate_passed, after < 0.3)
        passed |= batch.view.gate_passed
    assert passed.any()


def test_estimate_without_a_filter_is_refused():
    _, view = view_of(observation="truth")
    with pytest.raises(ValueError, match=r"view.estimate needs a filter"):
        _ = view.estimate.sigma
    with pytest.raises(ValueError, match=r"view.measured needs simulated sensors"):
        _ = view.measured.gyro
    np.testing.assert_array_equal(view.observed.position, view.position)


def test_view_at_an_autoreset_shows_the_episode_of_the_step():
    said = []

    def reward(view):
        said.append((view.step.copy(), view.is_first.copy()))
        return view.step * 1.0

    task = quad_gym.Task.of(reward=reward)
    for mode, began in (("SameStep", 0), ("NextStep", 1)):
        said.clear()
        env = vec_env(count=1, seed=0, task=task, max_episode_steps=3, autoreset_mode=mode)
        rewards = [float(env.step(np.zeros((1, 4)))[1][0]) for _ in range(5)]
        assert sum(b.sum() for _, b in said) == began
        assert rewards == ([1.0, 2.0, 3.0, 1.0, 2.0] if not began else [1.0, 2.0, 3.0, 0.0, 1.0])


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
@pytest.mark.parametrize("task", ["circle", "waypoints"])
def test_view_after_a_restore_shows_the_restored_instant(task, mode):
    env = begun(task, sensors="rtk", max_episode_steps=20, autoreset_mode=mode)
    batch, actions = env.flights.batch, np.full((FLIGHTS, 4), 0.1)
    names = [f.name for f in VIEW_FIELDS if f.shape and not f.shape.startswith("dict")]
    of_a_step = ("builtin.", "truth.progress", "gate_passed")
    names = [name for name in names if not name.startswith(of_a_step)]
    assert {"time", "is_first", "truth.position", "truth.position_error"} <= set(names)

    def shown():
        return {name: np.array(value_of(batch.view, name)) for name in names}

    for steps in (0, 13, 7 + (mode == "NextStep")):  # start, later, new episodes
        for _ in range(steps):
            batch.step(actions)
        instant, before = batch.snapshot(), shown()
        batch.step(actions)
        batch.step(actions)
        kept = batch.view.position
        while_away = kept.copy()
        batch.restore(instant)
        for name, values in shown().items():
            np.testing.assert_array_equal(values, before[name], name)
        np.testing.assert_array_equal(batch.view.truth.progress, np.zeros(FLIGHTS))
        np.testing.assert_array_equal(kept, while_away)
        assert batch.snapshot().tobytes() == instant.tobytes()


@pytest.mark.parametrize("count", [1, 5, 8, 9])
def test_arrays_of_a_view_share_no_memory_with_the_records(count):
    drawn = {"mass": quad_gym.Uniform(0.7, 0.8)}
    env = begun("waypoints", count, sensors="rtk", randomization=drawn)
    batch, kept = env.flights.batch, []
    for k in range(3):
        env.step(np.full((count, 4), 0.1 * k))
        for field in VIEW_FIELDS:
            value = value_of(batch.view, field.name)
            arrays = value if field.shape.startswith("dict") else {"": value}
            if field.shape:
                kept += [(field.name, array, np.array(array)) for array in arrays.values()]
    env.reset(seed=2)
    for name, array, before in kept:
        assert not np.may_share_memory(array, batch._blocks), name
        np.testing.assert_array_equal(array, before, name)
    for name in batch._blocks.dtype.names:  # including fields that this view does not show
        for values in (batch.rows(name, np.float64), batch.record(name)):
            assert not np.may_share_memory(values, batch._blocks), name


def test_covariance_has_the_same_bits_in_any_batch():
    found = {}
    for count in (1, 8, 16):
        env = begun(count=count)
        for _ in range(5):
            env.step(np.full((count, 4), 0.1))
        view = env.flights.batch.view
        estimate = view.estimate
        found[count] = (estimate.factor, estimate.sigma, estimate.covariance, view.truth.nees)
    for count in (1, 8):
        for one, other in zip(found[count], found[16], strict=True):
            np.testing.assert_array_equal(one, other[:count])


def test_fields_of_a_view_cannot_be_written_or_deleted():
    _, view = view_of(steps=1)
    for group, name in ((view, "gates"), (view.truth, "position"), (view, "position")):
        with pytest.raises(ValueError, match="read-only"):
            getattr(group, name)[0] = 1.0
        with pytest.raises(AttributeError, match=f"view.{name} is read-only"):
            setattr(group, name, 1.0)
        with pytest.raises(AttributeError, match=f"view.{name} .*cannot be deleted"):
            delattr(group, name)

"""Tests of a user's estimator in place of the built-in filter."""

import copy
import json
import pickle
import sys

import gymnasium
import numpy as np
import pytest

import quad_gym
from quad_gym.analysis.consistency import flight_errors
from quad_gym.analysis.metrics import nees
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.envs.config import TASK_DEFAULTS
from quad_gym.records import Control, Source
from tests import console_commands
from tests.builders import batch, single_env, vec_env
from tests.contract.configurations import LATE
from tests.estimators import FOLDER, Certain, Given, Simple, gallery

UKF = gallery("ukf").PlainUKF
RATES = np.array([0.3, -0.2, 0.1])


def differences(one, other, *names):
    return [np.abs(one.read(name) - other.read(name)).max() for name in names]


@pytest.mark.parametrize("ticks", [500, pytest.param(2000, marks=pytest.mark.slow)])
def test_ukf_in_numpy_gives_the_flights_of_the_built_in_one(ticks):
    """A circle, or a quarter of it, is flown by PD control on the estimate of each filter."""
    built_in, own = (batch(2, 3, sensors="lab", estimator=given) for given in (None, UKF()))
    names = [
        f"{of}{name}" for of in ("", "estimated_") for name in ("position", "velocity", "R_BI")
    ]
    for _ in range(ticks):
        built_in.step()
        own.step()
        assert max(differences(built_in, own, *names)) < 1e-9
    assert not built_in.result("terminated").any()
    assert max(differences(built_in, own, "estimated_accel_bias")) < 1e-9
    np.testing.assert_allclose(own.covariance(), built_in.covariance(), rtol=0.0, atol=1e-9)


def test_error_state_ekf_is_as_accurate_as_the_built_in_filter():
    """Errors are RMS values of four flights over 2 s of the circle, without latency."""
    errors = []
    for estimator in (None, gallery("error_state_ekf").ErrorStateEKF):
        made = batch(4, sensors="standard", control_rate=50.0, gains="tuned", estimator=estimator)
        squares = []
        for _ in range(100):
            made.step()
            squares.append(made.result("estimation_error") ** 2)
        errors.append(np.sqrt(np.mean(squares)))
    assert errors[1] < 1.1 * errors[0]


def test_updates_of_filterpy_give_the_flights_of_the_error_state_ekf():
    pytest.importorskip("filterpy")
    folder = "docs.gallery.estimators"
    names = (f"{folder}.error_state_ekf:ErrorStateEKF", f"{folder}.filterpy_update:FilterpyEKF")
    numpy, filterpy = (batch(2, sensors="rtk", estimator=name) for name in names)
    for _ in range(60):
        numpy.step()
        filterpy.step()
    compared = ("position", "estimated_position", "estimated_velocity", "estimated_R_BI")
    assert max(differences(numpy, filterpy, *compared)) < 1e-9


def test_complementary_filter_refuses_sensors_without_gnss():
    given = gallery("complementary").Complementary
    with pytest.raises(ValueError, match="Complementary needs sensors with GNSS"):
        vec_env(estimator=given, sensors="indoor", count=2, seed=0)


@pytest.mark.parametrize("sensors", ["standard", "rtk"])
def test_invariant_ekf_is_consistent_and_as_accurate_as_the_built_in_filter(sensors):
    """Errors are from 1 s to 2.5 s on the circle; `rtk` has a latency of 0.1 s.

    At one instant, the mean NEES of 40 flights is 15 with a standard deviation of 0.9.
    """
    errors, squares = [], []
    for estimator in (None, gallery("invariant_ekf").InvariantEKF):
        made = batch(
            40,
            sensors=sensors,
            control_rate=50.0,
            gains="tuned",
            source=Source.TRUTH,
            run_filter=True,
            estimator=estimator,
        )
        own = []
        for step in range(125):
            made.step()
            if step >= 50:
                error = flight_errors(made)
                own.append(np.square(error[:, :9]).mean(axis=0))
                squares.append(nees(error, made.covariance()).mean())
        errors.append(np.sqrt(np.mean(own, axis=0)))
    assert (errors[1] < 1.1 * errors[0]).all()
    assert 12.0 < np.mean(squares[75:]) < 18.0


def test_learned_estimator_has_documented_accuracy():
    """Errors are from 2 s to 4 s; the built-in filter without a camera has an error of 6 mm."""
    learned, squares = gallery("learned"), []
    made = batch(
        32,
        sensors="rtk",
        control_rate=50.0,
        gains="tuned",
        source=Source.TRUTH,
        run_filter=True,
        estimator=learned.Learned,
        task=TASK_DEFAULTS["random_trajectory"],
    )
    for step in range(200):
        made.step()
        if step >= 100:
            error, P = flight_errors(made)[:, :9], made.covariance()
            squares.append([error**2, error**2 / np.einsum("nii->ni", P)[:, :9]])
    errors, ratios = np.mean(squares, axis=(0, 2)).reshape(2, 3, 3).mean(axis=2)
    assert (np.sqrt(errors) < [0.015, 0.03, 0.015]).all()
    assert (ratios < 2.0).all()
    with pytest.raises(ValueError, match="Learned needs sensors with GNSS velocities"):
        vec_env(estimator=learned.Learned, sensors="standard", count=2, seed=0)


def test_learned_estimator_is_trained_on_logged_flights():
    pytest.importorskip("torch")
    learned, losses = gallery("learned"), []
    suite = quad_gym.sensor_suite("rtk")
    trained = learned.train(suite, 16, 1.0, 21, 16, report=losses.append)
    first, last = (float(text.rpartition(" ")[2]) for text in losses)
    assert last < first - 1.0
    assert trained.keys() == dict(np.load(learned.FILE)).keys()


def test_quantities_of_the_built_in_filter_are_nan():
    made = batch(2, sensors="rtk", estimator=Simple)
    made.step()
    for name in ("nis", "estimated_gnss_drift"):
        assert np.isnan(made.read(name)).all()


@pytest.mark.parametrize("form", ["R_BI", "quaternion"])
@pytest.mark.parametrize("layout", ["relative", "absolute"])
def test_controller_observes_the_estimate(form, layout):
    attitude = {"quaternion": lambda n: np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)), "R_BI": None}
    given = Given(**(attitude if form == "quaternion" else {}))
    env = vec_env(estimator=given, layout=layout, seed=0)
    flights = env.unwrapped.flights
    parts = {field.name: field.slice for field in flights.table}
    for _ in range(3):
        observations, *_, info = env.step(np.zeros((5, 4)))
        read = flights.batch.read
        np.testing.assert_array_equal(read("observed_position"), np.tile([1.0, 2.0, 3.0], (5, 1)))
        np.testing.assert_array_equal(read("observed_R_BI"), np.tile(np.eye(3), (5, 1, 1)))
        gap = read("reference_position") - [1.0, 2.0, 3.0]
        if layout == "relative":
            np.testing.assert_allclose(observations[:, parts["position_error"]], gap, rtol=1e-6)
        else:
            expected = np.tile([1.0, 2.0, 3.0], (5, 1))
            np.testing.assert_array_equal(observations[:, parts["position"]], expected)
        error = np.linalg.norm(read("position") - [1.0, 2.0, 3.0], axis=1)
        np.testing.assert_allclose(info["estimation_error"], error, rtol=1e-12)
    np.testing.assert_array_equal(flights.batch.read("accel_bias") * 0.0, 0.0)
    np.testing.assert_array_equal(flights.batch.read("estimated_gyro_bias"), 0.0)
    assert np.isnan(flights.batch.covariance()).all()


def test_body_rates_default_to_the_gyro_minus_its_bias():
    made = batch(estimator=Certain(), control=Control.CTBR, control_rate=50.0)
    made.step(np.zeros((5, 4)))
    expected = made.record("w_meas") - 0.02
    np.testing.assert_array_equal(made.read("estimated_body_rates"), expected)
    np.testing.assert_array_equal(made.read("observed_body_rates"), expected)
    rates = Given(body_rates=lambda n: np.tile(RATES, (n, 1)))
    task = quad_gym.TaskParams(kind="hover", start="hover")
    made = batch(estimator=rates, control=Control.CTBR, control_rate=50.0, task=task)
    for _ in range(5):
        made.step(np.zeros((5, 4)))  # the inner loop counteracts estimated rates that are not real
    np.testing.assert_array_equal(made.read("observed_body_rates"), np.tile(RATES, (5, 1)))
    assert (made.read("body_rates")[:, 0] < -0.05).all()


def test_covariance_is_observed_and_evaluated():
    env = vec_env(estimator=Certain, include_std=True, seed=0)
    observations, *_ = env.step(np.zeros((5, 4)))
    flights, made = env.unwrapped.flights, env.unwrapped.flights.batch
    sigmas = next(f.slice for f in flights.table if f.name == "position_sigma")
    np.testing.assert_allclose(observations[:, sigmas], np.tile([1.0, 2.0, 3.0], (5, 1)))
    expected = np.tile(np.diag(np.arange(1.0, 16.0) ** 2), (5, 1, 1))
    np.testing.assert_allclose(made.covariance(), expected)
    errors = made.read("position") - made.read("estimated_position")
    recorder = quad_gym.FlightRecorder(made, 2)
    recorder.keep()
    assert recorder.flight["nees"][0] > nees(errors[2:3], expected[2:3, :3, :3])[0]
    with pytest.raises(
        ValueError, match=r'include_std=True needs a "covariance", and Simple.reset'
    ):
        vec_env(estimator=Simple, include_std=True, seed=0)


class Log(Simple):
    """Estimator that stores measurements as they arrive."""

    def __init__(self):
        self.seen = []

    def reset(self, view, mask):
        self.seen.append(("start", view.pixels.new.any(), view.gnss_position.new.any()))
        return super().reset(view, mask)

    def update(self, measurements):
        m = measurements
        self.seen.append((m, m.gyro[0], m.accel[0], m.gnss_position, m.pixels, m.gnss_velocity))
        return super().update(m)


@pytest.mark.parametrize("sensors", ["lab", LATE])
def test_measurements_arrive_as_the_sensors_deliver_them(sensors):
    """Measurements equal the values of `read` in flights that are stepped tick by tick."""
    seen = Log()
    made = FlightBatch(3, sensors=sensors, estimator=seen, source=Source.TRUTH, run_filter=True)
    plain = FlightBatch(3, sensors=sensors, source=Source.TRUTH, run_filter=True)
    seen = made._own_filter.estimator.seen
    arrivals = 0
    for flights in (made, plain):
        flights.reset(seeds=range(3))
    assert seen.pop(0)[0] == "start"
    average = made.sensors.imu.samples == "average"
    for _ in range(60):
        before = plain.read("gyro"), plain.read("accel")
        for flights in (made, plain):
            flights.step()
        m, gyro, accel, fix, pixels, _ = seen.pop()
        sample = (plain.read("gyro"), plain.read("accel")) if average else before
        np.testing.assert_array_equal(gyro, sample[0][0])
        np.testing.assert_array_equal(accel, sample[1][0])
        np.testing.assert_array_equal(m.time, plain.read("time"))
        np.testing.assert_allclose(fix.value, plain.read("gnss_position"), atol=1e-14)
        np.testing.assert_array_equal(pixels.value, plain.read("pixels"))
        np.testing.assert_array_equal(fix.new, np.isfinite(fix.value).all(axis=1))
        np.testing.assert_array_equal(pixels.new, np.isfinite(pixels.value).all(axis=2))
        assert fix.age == made.sensors.gnss.latency
        arrivals += fix.new.sum()
        assert m.barometer is None
    assert arrivals >= 3


@pytest.mark.parametrize("source", [{"task": None}, {"task": "tests.tasks.tasks:Chase"}])
def test_state_is_saved_restored_copied_and_pickled(source):
    env = vec_env(estimator=Simple, sensors="rtk", seed=0, **source)
    made = env.unwrapped.flights.batch
    actions = np.random.default_rng(0).uniform(-0.1, 0.2, (20, 5, 4))
    for action in actions[:5]:
        made.step(action)
    kept = made.snapshot()
    copies = [copy.deepcopy(made), pickle.loads(pickle.dumps(made))]
    for action in actions:
        expected = made.step(action)
    for other in copies:
        for action in actions:
            found = other.step(action)
        np.testing.assert_array_equal(found, expected)
    made.restore(kept)
    for action in actions:
        found = made.step(action)
    np.testing.assert_array_equal(found, expected)
    assert (made._own_filter.state.ticks == 4 * 25).all()
    with pytest.raises(ValueError, match=r"snapshot must be one of a batch with (Simple|Chase)"):
        made.restore(np.zeros(1))


class Counting(Simple):
    """Estimator with the number of ticks as position; `reset` writes to all flights."""

    def reset(self, view, mask):
        assert (view.time[mask] == 0.0).all()
        self.state.ticks = 100
        return self.estimate()

    def estimate(self):
        position = np.repeat(self.state.ticks[:, np.newaxis], 3, axis=1).astype(float)
        return super().estimate() | {
            "position": position,
            "R_BI": np.tile(np.eye(3), (len(position), 1, 1)),
        }


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize("task", [None, "tests.tasks.tasks:Chase"])
def test_new_episode_resets_estimator_of_its_flight_only(mode, task):
    made = gymnasium.make_vec(
        "QuadGym/Hover-v0",
        num_envs=3,
        estimator=Counting(),
        autoreset_mode=mode,
        task=task,
        max_episode_steps=4,
        sensors="rtk",
    )
    made.reset(seed=0)
    flights = made.unwrapped.flights.batch
    flights.reset(mask=[False, True, False], seeds=[None, 5, None])
    made.step(np.zeros((3, 4)))
    flights.reset(mask=[False, True, False], seeds=[None, 5, None])
    counts = []
    for _ in range(8):
        *_, info = made.step(np.zeros((3, 4)))
        counts.append(flights.read("estimated_position")[:, 0])
        error = np.linalg.norm(
            flights.read("position") - flights.read("estimated_position"), axis=1
        )
        np.testing.assert_allclose(info["estimation_error"], error, rtol=1e-12)
    first, second = np.array(counts)[:, 0], np.array(counts)[:, 1]
    if mode == "NextStep":
        np.testing.assert_array_equal(first, [108, 112, 116, 100, 104, 108, 112, 116])
        np.testing.assert_array_equal(second, [104, 108, 112, 116, 100, 104, 108, 112])
    else:
        np.testing.assert_array_equal(first, [108, 112, 100, 104, 108, 112, 100, 104])
        np.testing.assert_array_equal(second, [104, 108, 112, 100, 104, 108, 112, 100])


def test_without_a_reset_episodes_begin_with_the_built_in_start():
    class Start(Given):
        def reset(self, view, mask):
            return None

    made, plain = batch(estimator=Start(), sensors="rtk"), batch(sensors="rtk")
    names = ("estimated_position", "estimated_R_BI", "observed_body_rates")
    assert differences(made, plain, *names) == [0.0, 0.0, 0.0]
    np.testing.assert_allclose(made.covariance(), plain.covariance(), atol=1e-15)


WRONG = [
    ({"position": None}, r'must return "position"'),
    ({"R_BI": None}, r'must return either "R_BI" or "quaternion"'),
    ({"positon": lambda n: np.zeros((n, 3))}, r"got 'positon'; did you mean position\?"),
    ({"velocity": lambda n: np.zeros((n, 2))}, r'shape \(3, 3\) for "velocity", got \(3, 2\)'),
    ({"velocity": lambda n: "fast"}, r"must return real numbers for \"velocity\", got 'fast'"),
    ({"accel_bias": lambda n: np.full((n, 3), np.nan)}, r'finite numbers for "accel_bias"'),
    ({"R_BI": lambda n: np.zeros((n, 3, 3))}, r'rotations for "R_BI".* for flight 0 and 2 more'),
    ({"covariance": lambda n: np.zeros((n, 15, 15))}, r'positive definite "covariance"'),
    ({"covariance": lambda n: np.zeros((n, 3, 3))}, r'shape \(3, 15, 15\) for "covariance"'),
]


@pytest.mark.parametrize(("changes", "message"), WRONG)
def test_wrong_estimates_are_refused_by_name(changes, message):
    with pytest.raises(ValueError, match=rf"^Given\.reset .*{message}"):
        vec_env(estimator=Given(**changes), count=3, seed=0)


class Breaks(Simple):
    def update(self, measurements):
        if (self.state.ticks > 10).all():
            raise ZeroDivisionError("own")
        return super().update(measurements)


def test_flights_must_be_reset_after_a_failed_update():
    made = batch(estimator=Breaks())
    for _ in range(11):
        made.step()
    with pytest.raises(ZeroDivisionError, match="own"):
        made.step()
    with pytest.raises(ValueError, match=r"call reset\(\) before step\(\): a method of Breaks"):
        made.step()
    made.reset(seeds=range(5))
    made.step()


REFUSED = [
    ({"innovations": True}, "innovations has no effect with an own estimator"),
    ({"truncate_when_diverged": True}, "truncate_when_diverged has no effect"),
    ({"observation": "truth"}, "estimator has no effect where no filter runs"),
    (
        {
            "sensors": quad_gym.SensorSuite(
                estimator=quad_gym.FilterParams(alpha=0.5, initial_velocity_variance=0.1)
            )
        },
        r"SensorSuite\.estimator\.alpha has no effect with an own estimator.* got 0\.5",
    ),
    ({"estimator": 3}, r'estimator must be a quad_gym\.Estimator or its "module:name", got 3'),
    ({"estimator": "kf"}, "estimator must be one of"),
    ({"estimator": "tests.estimators:Nothing"}, "estimator must name a quad_gym.Estimator"),
    ({"estimator": quad_gym.Task}, "estimator must be a quad_gym.Estimator"),
]


@pytest.mark.parametrize(("keywords", "message"), REFUSED)
def test_keywords_without_effect_are_refused_by_name(keywords, message):
    with pytest.raises(ValueError, match=message):
        single_env(**{"estimator": Simple(), **keywords})


def test_an_instance_flies_in_several_environments_at_once():
    estimator = Simple()
    one, other = vec_env(estimator=estimator, seed=0), vec_env(estimator=estimator, count=2, seed=7)
    one.step(np.zeros((5, 4)))
    other.step(np.zeros((2, 4)))
    again = vec_env(estimator=Simple(), count=2, seed=7)
    again.step(np.zeros((2, 4)))
    a, b = other.unwrapped.flights.batch, again.unwrapped.flights.batch
    assert differences(a, b, "estimated_position", "position") == [0.0, 0.0]
    assert estimator.state is Simple.state


@pytest.fixture
def named(monkeypatch):
    """Yield the name of an estimator in the import path of commands."""
    monkeypatch.syspath_prepend(str(FOLDER))
    yield "complementary:Complementary"
    sys.modules.pop("complementary", None)


def test_commands_fly_on_an_estimator(named, tmp_path):
    own = ("--estimator", named)
    line = ("evaluate", "hover", "--policy", "pd", "--episodes", 3, "--env", "duration=3.0")
    evaluated = console_commands.run(*line, "--output", tmp_path / "e", *own)
    assert evaluated.returncode == 0, evaluated.stderr
    cases = json.loads((tmp_path / "e" / "summary.json").read_text())["cases"]
    built_in = console_commands.run(*line, "--output", tmp_path / "b", "--observation", "estimate")
    assert built_in.returncode == 0
    (other,) = json.loads((tmp_path / "b" / "summary.json").read_text())["cases"]
    assert cases[1]["estimation_error"] > 1.5 * other["estimation_error"]
    flown = console_commands.run(
        "fly", "hover", "--duration", 0.5, "--output", tmp_path / "flight.npz", *own
    )
    assert flown.returncode == 0, flown.stderr
    assert np.isnan(quad_gym.Flight.load(tmp_path / "flight.npz")["nees"][1:]).all()
    film = console_commands.run(
        "fly", "hover", "--duration", 0.2, "--output", tmp_path / "film.gif", *own
    )
    assert film.returncode == 0, film.stderr
    wrong = console_commands.run("fly", "hover", *own, "--env", "estimator=ekf")
    assert "--env must not contain estimator: use --estimator instead" in wrong.stderr


def test_consistency_command_uses_own_estimator(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    options = ("--sensors", "lab", "--episodes", 2, "--duration", 0.1, "--output", tmp_path)
    done = console_commands.run("consistency", *options, "--estimator", "ukf:PlainUKF")
    assert done.returncode == 0, done.stderr
    own = json.loads((tmp_path / "consistency.json").read_text())
    done = console_commands.run("consistency", *options)
    built_in = json.loads((tmp_path / "consistency.json").read_text())
    assert own["overall"]["state"] == pytest.approx(built_in["overall"]["state"], rel=1e-6)
    done = console_commands.run(
        "consistency", *options, "--estimator", "ukf:PlainUKF", "--form", "report"
    )
    message = " ".join(done.stderr.replace("│", " ").split())
    assert "--form report has no effect with an own --estimator" in message


def test_train_command_uses_own_estimator(named, tmp_path):
    done = console_commands.run(
        "train",
        "hover",
        "--engine",
        "compiled",
        "--steps",
        4096,
        "--n-envs",
        8,
        "--set",
        "n_steps=32",
        "batch_size=64",
        "--evaluations",
        1,
        "--episodes",
        2,
        "--estimator",
        named,
        "--output",
        tmp_path / "run",
        "--no-progress",
    )
    assert done.returncode == 0, done.stderr
    plan = json.loads((tmp_path / "run" / "training.json").read_text())
    assert "complementary:Complementary" in json.dumps(plan)


def test_restored_flights_have_every_bit_of_flights_with_another_history():
    """Three flights leave lanes of a block empty, in which estimates must be restored, too."""

    def made():
        return vec_env("look_around", 3, sensors="standard", estimator=Simple)

    env, other = made(), made()
    env.reset(seed=1)
    other.reset(seed=2)
    other.step(np.zeros((3, 4), np.float32))
    kept = env.flights.batch.snapshot()
    other.flights.batch.restore(kept)
    for flown in (env, other):
        flown.step(np.zeros((3, 4), np.float32))
    assert other.flights.batch.snapshot().tobytes() == env.flights.batch.snapshot().tobytes()

"""Promises of version 1.x: the public interface, and files that version 1.0 wrote."""

import difflib
import json
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import quad_gym
from baselines import PDPolicy
from baselines.mlp import MlpPolicy
from baselines.policies import load_policy
from docs.renewal import release
from quad_gym import records
from quad_gym.commands import sweep
from quad_gym.faults import MagnetometerDisturbance, SensorLoss, named_faults
from quad_gym.logs.formats.reading import read_log
from tests import console_commands, interface

FILES = Path(__file__).parents[1] / "data" / "version_1_0"
HOVER = "QuadGym/Hover-v0"


def test_public_interface_equals_its_list():
    pytest.importorskip("torch")
    pytest.importorskip("stable_baselines3")
    kept = interface.FILE.read_text(encoding="utf-8").splitlines()
    changes = [
        line
        for line in difflib.unified_diff(kept, interface.interface(), "list", "code", n=0)
        if line[0] in "+-"
    ]
    assert not changes, "python -m tests.interface; removed lines break programs of users"


def test_list_keeps_a_removed_name_unless_asked(tmp_path, monkeypatch, capsys):
    file = tmp_path / "interface.txt"
    monkeypatch.setattr(interface, "FILE", file)
    monkeypatch.setattr(interface, "interface", lambda: ["b", "c"])
    file.write_text("a\nb\n")
    assert interface.main([]) == 1
    assert file.read_text() == "a\nb\nc\n"
    assert "gone: a" in capsys.readouterr().out
    assert interface.main(["--remove"]) == 0
    assert file.read_text() == "b\nc\n"


def test_files_show_the_facts_of_the_release():
    """Pages are compared with the other results."""
    for file, text in release.files(release.facts()).items():
        assert file.read_text(encoding="utf-8") == text, "python -m docs.renewal.release"


def test_filled_facts_of_a_release_appear_in_all_files():
    names = ("date", "repository", "index", "site", "doi")
    given = {name: f"the-{name}" for name in names} | {"version": "1.2.3"}
    citation, changes = release.files(given).values()
    assert 'version: 1.2.3\ndate-released: "the-date"\ndoi: "the-doi"\nurl: "the-site"' in citation
    assert 'repository-code: "the-repository"\nkeywords:' in citation
    assert "\n## 1.2.3 (the-date)\n" in changes
    texts = release.texts(given)
    assert 'pip install "the-index[plot,render,train]"' in texts["release.install"]
    assert "quad_gym-1.2.3-py3" in texts["release.wheel"]
    assert "(the-site)" in texts["release.site"]
    assert "(https://doi.org/the-doi)" in texts["release.doi"]


@pytest.mark.parametrize("name", ["field", "uwb", "indoor"])
def test_suite_of_1_0_is_the_built_in_one(name):
    assert quad_gym.sensor_suite(FILES / f"{name}.toml") == quad_gym.sensor_suite(name)


def test_vehicle_and_world_of_1_0_have_the_same_numbers():
    vehicle = quad_gym.vehicle_params(FILES / "vehicle.toml")
    assert vehicle == quad_gym.vehicle_params("crazyflie").replace(mass=0.031)
    world = quad_gym.world_params(FILES / "world.toml")
    ground = quad_gym.GroundParams()
    assert world == quad_gym.WorldParams(wind_I=(1.0, -2.0, 0.0), ground=ground)


def test_flight_of_1_0_is_read_with_the_same_numbers():
    flight = quad_gym.Flight.load(FILES / "flight.npz")
    assert len(flight["time"]) == 21
    np.testing.assert_array_equal(flight["time"], np.arange(21) / 50.0)
    assert flight["covariance"].shape == (21, 15, 15)
    stored = np.load(FILES / "flight.npz")
    for name in ("position", "estimated_position", "quaternion", "action"):
        np.testing.assert_array_equal(flight[name], stored[f"columns/{name}"])


def test_members_of_1_0_keep_their_numbers():
    """Recorded flights, `info` in stored data and users of exported filters contain the numbers."""
    for kind, numbers in json.loads((FILES / "numbers.json").read_text()).items():
        now = getattr(records, kind).__members__
        assert {name: int(now[name]) for name in numbers} == numbers
        assert len(set(now.values())) == len(now), "two members have the same number"


def test_faults_of_a_flight_of_1_0_are_read_by_their_names():
    """The barometer was lost from 0.1 to 0.3 s, the magnetometer disturbed from 0.2 to 0.6 s."""
    flight = quad_gym.Flight.load(FILES / "faults.npz")
    steps = np.rint(50.0 * flight["time"])
    kinds = (SensorLoss(sensor="barometer"), MagnetometerDisturbance())
    active = named_faults(kinds, flight["faults"])
    np.testing.assert_array_equal(active["barometer_loss"], (steps >= 5) & (steps < 15))
    np.testing.assert_array_equal(active["magnetometer_disturbance"], (steps >= 10) & (steps < 30))


@pytest.mark.parametrize(
    ("file", "action"),
    [
        ("training_compiled/best.npz", (0.01823702, -0.00076725, 0.00598595, 0.00075535)),
        ("training_sb3/best.zip", (-0.00672271, -0.00585087, 0.00695828, -0.00462489)),
    ],
)
def test_policy_of_1_0_acts_as_it_did(file, action):
    if file.endswith(".zip"):
        pytest.importorskip("stable_baselines3")
    env = gymnasium.make_vec(HOVER, num_envs=2, duration=0.5)
    seen = np.tile(np.linspace(-1.0, 1.0, env.observation_space.shape[1], dtype=np.float32), (2, 1))
    actions, _ = load_policy(str(FILES / file), env).predict(seen, deterministic=True)
    np.testing.assert_allclose(actions, [action, action], atol=1e-6)


def test_normalization_and_gains_of_1_0_are_read():
    env = gymnasium.make_vec(HOVER, num_envs=2, duration=0.5)
    policy = FILES / "training_compiled" / "best.npz"
    given = str(FILES / "normalization.npz")
    normalized = load_policy(str(policy), env, normalization=given)
    seen = np.full(env.observation_space.shape, 3.0, np.float32)
    mean = np.arange(seen.shape[1]) / 10.0
    expected = MlpPolicy.load(policy).predict(np.clip((seen - mean) / 2.0, -5.0, 5.0))[0]
    np.testing.assert_allclose(normalized.predict(seen)[0], expected, atol=1e-5)
    gains = json.loads((FILES / "gains.json").read_text())["gains"]
    assert PDPolicy(env, gains=quad_gym.PDGains(**gains)) is not None
    assert load_policy(f"pd:{FILES / 'gains.json'}", env) is not None


def test_log_and_map_of_columns_of_1_0_are_read():
    plain = read_log(FILES / "log.csv")
    mapped = read_log(FILES / "log.csv", columns=FILES / "columns.toml")
    assert len(plain.imu.time) > 25
    np.testing.assert_allclose(mapped.imu.values["gyro"], 2.0 * plain.imu.values["gyro"])


def test_sweep_and_trajectory_of_1_0_are_read():
    assert len(sweep.expand(sweep.read(FILES / "sweep.toml"), Path("unused"))) == 4
    path = quad_gym.Trajectory.from_csv(FILES / "trajectory.csv")
    assert path.duration == pytest.approx(3.0)


@pytest.mark.parametrize("engine", ["compiled", "sb3"])
def test_record_of_a_training_of_1_0_is_known_as_finished(engine):
    record = json.loads((FILES / f"training_{engine}" / "training.json").read_text())
    assert record["finished"]
    assert record["plan"]["engine"] == engine
    assert record["versions"]["quad_gym"] == "1.0.0"


def test_report_names_what_a_bug_report_needs(monkeypatch):
    monkeypatch.setenv("QUAD_GYM_SECRET_OPTION", "7")
    plain = console_commands.run("version")
    assert plain.stdout.strip().startswith(quad_gym.__version__)
    found = console_commands.run("version", "--report")
    assert found.returncode == 0, found.stderr
    for text in (
        f"numpy {np.__version__}",
        f"gymnasium {gymnasium.__version__}",
        "precision",
        "lanes",
        "kernels",
        "cores available",
        "QUAD_GYM_SECRET_OPTION=7",
    ):
        assert text in found.stdout

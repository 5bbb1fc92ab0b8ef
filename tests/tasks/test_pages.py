"""The page about tasks names every reward term, and the tutorials of tasks run."""

import contextlib
import re
import runpy
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import quad_gym
from tests.builders import part

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "tasks.md").read_text(encoding="utf-8")


def test_the_page_names_every_reward_term():
    terms = [
        name
        for name, kind in vars(quad_gym.rewards).items()
        if isinstance(kind, type) and issubclass(kind, quad_gym.rewards.Term)
    ]
    inner = {"Term", "Sum", "Constant", "FunctionTerm"}
    assert set(re.findall(r"\| `(\w+)\(", PAGE)) >= set(terms) - inner


GALLERY = DOCS / "gallery"


def run(name, folder=GALLERY):
    """Run an example in a folder; return its names."""
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    with contextlib.chdir(folder):
        return runpy.run_path(str(GALLERY / name))


TRAINED = ("landing.py", "moving_target.py", "slalom.py")


@pytest.mark.parametrize("name", TRAINED)
def test_policy_of_example_reaches_result_stated_there(name):
    run(name)  # it asserts the result


@pytest.mark.slow  # half a minute of training each, on two idle cores
@pytest.mark.parametrize("name", TRAINED)
def test_an_example_trains_its_policy(name, tmp_path):
    (tmp_path / "policies").mkdir()
    run(name, tmp_path)
    assert (tmp_path / "policies" / name).with_suffix(".npz").exists()


def test_trajectory_example_follows_its_trajectory():
    names = run("own_trajectory.py")
    assert names["info"]["position_error"].max() < 0.1
    assert np.linalg.norm(names["path"](names["t"], 1), axis=1).max() <= 2.5


def test_reward_is_higher_when_looking_at_markers():
    names = run("look_at_markers.py")
    toward, away = (line.get_ydata() for line in names["of_reward"].lines)
    assert toward[:20].mean() > away[:20].mean() + 0.2


def test_foreign_policy_adapts_to_unknown_mass():
    pytest.importorskip("foundation_policy")
    pytest.importorskip("matplotlib").use("Agg")
    text, names = (GALLERY / "foreign_policy.py").read_text(), {}
    for old, few in (
        ("EPISODES = 100", "EPISODES = 20"),
        ('("Hover", "Circle", "Lemniscate", "LookAround")', '("LookAround",)'),
    ):
        assert old in text
        text = text.replace(old, few)
    exec(text, names)
    assert max(names["errors"][:5]) < 40.0  # mm, half to twice the assumed mass


BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


def run_block(name, start=""):
    """Run the page's block that defines a name, after another block; return its names."""
    names = {"quad_gym": quad_gym, "gymnasium": gymnasium}
    for text in (start, name):
        exec(next(block for block in BLOCKS if text in block) if text else "", names)
    return names


def test_reward_of_page_charges_the_change_of_the_action():
    charged = run_block("rewards.ActionRate")["envs"]
    task = quad_gym.Task.of(reward=quad_gym.rewards.Tracking())
    free = gymnasium.make_vec("QuadGym/Circle-v0", num_envs=charged.num_envs, task=task)
    action = np.full((charged.num_envs, 4), 0.5, np.float32)
    costs = []
    for envs in (free, charged):
        envs.reset(seed=0)
        costs.append([envs.step(action)[1] for _ in range(2)])
    first, again = np.subtract(*costs)
    np.testing.assert_allclose(first, 0.05 * 4 * 0.5**2, atol=1e-9)  # from an action of zero
    np.testing.assert_allclose(again, 0.0, atol=1e-9)


def test_observation_of_page_is_the_distance_of_the_nearest_marker():
    env = run_block("class NearestMarker")["env"]
    observation, _ = env.reset(seed=0)
    batch = env.unwrapped.flights.batch
    gaps = batch.feature_places() - batch.record("r_seen")[0]
    expected = np.linalg.norm(gaps, axis=-1).min()
    seen = part(env, observation, "marker_distance")
    np.testing.assert_allclose(seen, expected, rtol=1e-5)


def test_trajectory_of_page_passes_through_its_points():
    names = run_block("Trajectory.through(points")
    path = names["path"]
    flown = path(np.linspace(0.0, path.duration, 20_001))
    for point in names["points"]:
        assert np.linalg.norm(flown - point, axis=1).min() < 1e-3

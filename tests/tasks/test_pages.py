"""The page about tasks names every reward term, and the tutorials of tasks run."""

import contextlib
import re
import runpy
from pathlib import Path

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
    names = run("foreign_policy.py")
    assert max(names["errors"][:5]) < 40.0  # mm, half to twice the assumed mass


TASKS = Path(__file__).resolve().parents[2] / "docs" / "tasks.md"
BLOCKS = re.findall(r"```python\n(.*?)```", TASKS.read_text(encoding="utf-8"), re.DOTALL)[:3]


def test_examples_of_page_give_stated_results():
    names, envs = {}, []
    for block in BLOCKS:
        exec(block, names)
        envs.append(names["env"])
    reward, path, wall = envs
    reward.reset(seed=0)
    first = reward.step(np.full(4, 0.5, np.float32))[1]
    again = reward.step(np.full(4, 0.5, np.float32))[1]
    assert again > first + 0.05, "a change of the action costs 0.1 times its square"
    flown = names["path"]
    times = np.linspace(0.0, flown.duration, 20_001)
    for point in names["points"]:
        assert np.linalg.norm(flown(times) - point, axis=1).min() < 1e-3
    path.reset(seed=0)
    observation, _ = wall.reset(seed=0)
    batch = wall.unwrapped.flights.batch
    seen = batch.record("r_seen")[0]
    level = np.maximum(np.abs(seen[:2] - [6.0, 0.0]) - [2.0, 0.1], 0.0)
    above = max(abs(seen[2] - 1.5) - 1.5, 0.0)
    expected = np.linalg.norm([*level, above])
    np.testing.assert_allclose(part(wall, observation, "wall"), expected, rtol=1e-5)

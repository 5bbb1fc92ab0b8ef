"""The page about tasks names every reward term, and the tutorials of tasks run."""

import contextlib
import re
import runpy
from pathlib import Path

import numpy as np
import pytest

import quad_gym

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
    """The names of an example that has run in a folder."""
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    with contextlib.chdir(folder):
        return runpy.run_path(str(GALLERY / name))


TRAINED = ("landing.py", "moving_target.py", "slalom.py")


@pytest.mark.parametrize("name", TRAINED)
def test_the_policy_of_an_example_does_what_the_example_says(name):
    run(name)  # it asserts the result


@pytest.mark.slow  # half a minute of training each, on two idle cores
@pytest.mark.parametrize("name", TRAINED)
def test_an_example_trains_its_policy(name, tmp_path):
    (tmp_path / "policies").mkdir()
    run(name, tmp_path)
    assert (tmp_path / "policies" / name).with_suffix(".npz").exists()


def test_the_trajectory_is_followed():
    names = run("own_trajectory.py")
    assert names["info"]["position_error"].max() < 0.1
    assert np.linalg.norm(names["path"](names["t"], 1), axis=1).max() <= 2.5


def test_looking_at_markers_pays():
    names = run("look_at_markers.py")
    toward, away = (line.get_ydata() for line in names["of_reward"].lines)
    assert toward[:20].mean() > away[:20].mean() + 0.2


def test_a_foreign_policy_adapts_to_a_mass_that_it_is_not_given():
    pytest.importorskip("foundation_policy")
    names = run("foreign_policy.py")
    assert max(names["errors"][:5]) < 40.0  # mm, half to twice the assumed mass

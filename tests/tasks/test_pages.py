"""The table of the page about tasks is that of the view, and the tutorials of tasks run."""

import re
import runpy
from pathlib import Path

import numpy as np
import pytest

import quad_gym
from quad_gym.tasks.fields import VIEW_FIELDS

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "tasks.md").read_text(encoding="utf-8")


def view_table():
    rows = ["| `view.` | shape | unit | frame | meaning |", "|---|---|---|---|---|"]
    rows += [
        f"| `{f.name}` | {f.shape or '-'} | {f.unit} | {f.frame} | {f.meaning} |"
        for f in VIEW_FIELDS
    ]
    return "\n".join(rows)


def test_the_table_of_the_page_is_that_of_the_view():
    assert PAGE.split("<!-- view -->")[1].split("<!-- /view -->")[0].strip() == view_table()


def test_the_page_names_every_piece_of_rewards():
    pieces = [
        name
        for name, kind in vars(quad_gym.rewards).items()
        if isinstance(kind, type) and issubclass(kind, quad_gym.rewards.Piece)
    ]
    inner = {"Piece", "Sum", "Constant", "OfFunction"}
    assert set(re.findall(r"\| `(\w+)\(", PAGE)) >= set(pieces) - inner


def run(name):
    """The names of an example that has run."""
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    file = DOCS / "gallery" / name
    assert len(file.read_text(encoding="utf-8").splitlines()) <= 60
    return runpy.run_path(str(file))


def test_the_moving_target_is_followed():
    names = run("moving_target.py")
    assert np.mean(names["mean_rewards"]) > 0.3


def test_the_trajectory_is_followed():
    names = run("own_trajectory.py")
    assert names["info"]["position_error"].max() < 0.1
    assert np.linalg.norm(names["path"](names["t"], 1), axis=1).max() <= 2.5


def test_looking_at_markers_pays():
    names = run("look_at_markers.py")
    toward, away = (line.get_ydata() for line in names["of_reward"].lines)
    assert toward[:20].mean() > away[:20].mean() + 0.2

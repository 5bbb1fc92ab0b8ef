"""The page about tasks runs, and its table is that of the view; so do the examples."""

import importlib.util
import re
from pathlib import Path

import pytest

import quad_gym
from quad_gym.tasks.fields import VIEW_FIELDS

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "tasks.md").read_text(encoding="utf-8")
GALLERY = sorted((DOCS / "gallery").glob("*.py"))


def view_table():
    rows = ["| `view.` | shape | unit | frame | meaning |", "|---|---|---|---|---|"]
    rows += [
        f"| `{f.name}` | {f.shape or '-'} | {f.unit} | {f.frame} | {f.meaning} |"
        for f in VIEW_FIELDS
    ]
    return "\n".join(rows)


def test_every_code_block_of_the_page_runs():
    names = {}
    blocks = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    assert len(blocks) == 6
    for block in blocks:
        exec(block, names)
    envs = names["envs"]
    envs.reset(seed=0)
    envs.step(envs.action_space.sample())
    env = names["env"]
    env.reset(seed=0)
    env.step(env.action_space.sample())
    assert env.spec.id == "Mine/Touch-v0"


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


@pytest.mark.parametrize("file", GALLERY, ids=lambda file: file.stem)
def test_the_examples_run(file):
    assert len(file.read_text(encoding="utf-8").splitlines()) <= 60
    spec = importlib.util.spec_from_file_location(file.stem, file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    found = module.main()
    if file.stem == "look_at_markers":
        assert found[0] > found[1] + 0.2
    else:
        assert found > 0.2

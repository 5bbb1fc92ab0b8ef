"""`make demo`: its commands, and its last lines."""

import shutil
import subprocess
from pathlib import Path

import pytest

from quad_gym.commands.main import main, subcommands
from quad_gym.commands.options import parse

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="needs make")


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """Lines that `make demo` prints, with a program that only prints its arguments."""
    folder = tmp_path_factory.mktemp("bin")
    program = folder / "quad-gym"
    program.write_text('#!/bin/sh\necho called quad-gym "$@"\n')
    program.chmod(0o755)
    line = ["make", "-s", "-o", ".venv/.viewer", "demo", f"BIN={folder}"]
    done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.replace(f"{folder}/", "").splitlines()


def commands(lines):
    """Options of the lines that are commands of `quad-gym`, parsed."""
    for line in lines:
        words = line.split()
        if words[:1] == ["quad-gym"]:
            yield parse(subcommands(words[1:]), words[1:])


def test_demo_shows_the_difference_first_and_then_the_control(demo):
    called = list(commands(line.removeprefix("called ") for line in demo))[:2]
    assert [args.env_id for args in called] == ["QuadGym/LookAround-v0", "QuadGym/Circle-v0"]
    difference, control = called
    assert difference.policy == ("pd", "pretrained:truth", "pretrained")
    assert control.train_on == ("truth", "estimate")
    assert control.seeds >= 5  # three give an interval that is twice as wide
    assert control.set == {}  # the recipe's settings, as in the study of the same question
    text = " ".join(demo)
    assert text.index("LookAround") < text.index("control experiment")
    words = " ".join(text.split())
    assert "expected to make no difference" in words
    assert "95 % interval of about 4 mm" in words  # what to expect, and that it can be otherwise
    assert "by chance" in words


def test_demo_ends_with_files_to_open_and_three_commands(demo):
    ending = demo[demo.index("Open:") :]
    following = ending[ending.index("Next:") + 1 :]
    assert len(list(commands(following))) == len(following) == 3
    shown = [Path(line.split()[0]) for line in ending[1 : ending.index("Next:")]]
    folders = {str(args.output) for args in commands(x.removeprefix("called ") for x in demo[:-3])}
    assert {str(path.parent) for path in shown} == folders
    assert [path.name for path in shown] == ["video.webp", "errors.png", "report.html"]


def test_evaluation_of_the_demo_writes_the_files(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    pytest.importorskip("pygame")
    policies = "--policy pd pretrained:truth pretrained"
    short = f"--episodes 2 --env duration=0.3 --video webp --output {tmp_path}"
    main(["evaluate", "look_around", *policies.split(), *short.split()])
    assert {"video.webp", "errors.png", "paths.png"} <= {file.name for file in tmp_path.iterdir()}
    assert "pretrained:truth on estimate" in capsys.readouterr().out

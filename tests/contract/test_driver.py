"""The driver of trainings: failures, deaths, stops, and equal tables after them."""

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

from quad_gym.experiments.driver import train_all
from quad_gym.experiments.sweep_plan import expand, read
from quad_gym.experiments.sweep_table import FILES, row_of, write_tables
from tests import console_commands
from tests.contract.test_sweep import SMALL

GROUP = "circle,compiled_ppo,gamma={}"


def small(folder):
    (folder / "small.toml").write_text(SMALL)
    return expand(read(folder / "small.toml"), folder / "out")


def tables(folder):
    write_tables([row_of(training) for training in small(folder)], folder)
    return [(folder / name).read_bytes() for name in FILES]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """Tables of a sweep without disturbances."""
    folder = tmp_path_factory.mktemp("undisturbed")
    assert train_all(small(folder), folder / "out", 2, hidden=True).exit_code() == 0
    found = folder / "out/runs" / GROUP.format(0.9) / "seed_0"
    names = ["best.npz", "evaluations.csv", "last.npz", "training.json"]
    assert sorted(path.name for path in found.iterdir()) == names
    return tables(folder)


def worker_of(process):
    """The process that trains for a sweep."""
    children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    commands = {int(child): Path(f"/proc/{child}/cmdline").read_bytes() for child in children}
    return next(child for child, command in commands.items() if b"spawn_main" in command)


def start(where):
    line = console_commands.line("sweep", "small.toml", "--output", "out", "--jobs", "1")
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(line, cwd=where, text=True, **pipes)


def wait_for(process, folder, rows=3):
    limit = time.monotonic() + 600.0
    file = folder / "evaluations.csv"
    while not file.exists() or len(file.read_text().splitlines()) <= rows:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < limit
        time.sleep(0.005)


@pytest.mark.slow  # processes
@pytest.mark.skipif(not Path("/proc").exists(), reason="no /proc")
def test_other_trainings_go_on_after_a_death_and_a_full_disk(tmp_path, undisturbed, capsys):
    """The first training is killed, and the second finds the disk full."""
    trainings = small(tmp_path)
    full = trainings[1].folder
    full.mkdir(parents=True)
    (full / "evaluations.csv.part").symlink_to("/dev/full")
    process = start(tmp_path)
    wait_for(process, trainings[0].folder)
    os.kill(worker_of(process.pid), signal.SIGKILL)
    said, _ = process.communicate(timeout=600)
    assert process.returncode == 1
    assert f"{trainings[0].folder.relative_to(tmp_path)}: died: signal 9" in said
    assert f"  {full.relative_to(tmp_path)}: OSError: [Errno 28] No space left on device" in said
    assert [bool(training.record()) for training in trainings] == [False, False, True]
    (full / "evaluations.csv.part").unlink()
    assert train_all(trainings, tmp_path / "out", 2, hidden=True).exit_code() == 0
    assert tables(tmp_path) == undisturbed


@pytest.mark.slow  # processes
def test_terminated_sweep_continues_with_unfinished_trainings(tmp_path, undisturbed):
    first = small(tmp_path)[0].folder
    process = start(tmp_path)
    wait_for(process, first)
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=600)
    assert process.returncode == 130
    assert "Start the same command again to continue" in err
    assert not json.loads((first / "training.json").read_text())["finished"]
    assert train_all(small(tmp_path), tmp_path / "out", 2, hidden=True).exit_code() == 0
    assert tables(tmp_path) == undisturbed

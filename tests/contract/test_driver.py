"""Tests of the driver of trainings: restarts, failures, stops, locks, tables after kills."""

import contextlib
import json
import os
import signal
import subprocess
import time

import pytest

from baselines.keeping import BusyError, holder, is_locked, locked
from quad_gym.commands.sweep import FILES, expand, read
from quad_gym.experiments import Driver, Ended, work
from tests import console_commands
from tests.contract.test_sweep import SMALL, TRUTH, pretend

GROUP = "circle,compiled_ppo,gamma={}"


class Bar:
    """Progress bar that stores its messages."""

    n, total = 0, 10**9

    def __init__(self):
        self.lines = []

    def write(self, line):
        self.lines.append(line)

    def set_postfix_str(self, text):
        pass


class Scripted:
    """Executor whose jobs end as given for each training."""

    def __init__(self, script):
        self.script, self.started, self.running, self.most = script, [], 0, 0

    def __call__(self, training):
        self.started.append(training.name)
        end = self.script[training.name].pop(0)
        if isinstance(end, Exception):
            raise end
        self.running += 1
        self.most = max(self.most, self.running)
        return ScriptedJob(self, end)


class ScriptedJob:
    def __init__(self, executor, end):
        self.executor, self.end, self.stops = executor, end, 0

    def ended(self):
        self.executor.running -= 1
        return self.end

    def stop(self):
        raise AssertionError


def test_died_trainings_restart_and_failed_ones_do_not(tmp_path):
    *trainings, finished = expand({"seeds": 7, "env": TRUTH}, tmp_path)
    pretend(finished, 0.1)
    fine, died = Ended("finished"), Ended("died", "signal 9")
    ends = [
        [fine],
        [died, Ended("stopped", "asked to stop"), fine],
        [died, died, died],
        [Ended("failed", "OSError: no space")],
        [Ended("busy"), Ended("busy"), Ended("busy"), Ended("busy"), fine],
        [OSError("no processes")],
    ]
    executor = Scripted({t.name: end for t, end in zip(trainings, ends, strict=True)})
    bar = Bar()
    driver = Driver([*trainings, finished], executor, 2, 2, bar)
    driver.run()
    assert not driver.stopped
    assert [executor.started.count(t.name) for t in trainings] == [1, 3, 3, 1, 5, 1]
    assert finished.name not in executor.started
    assert executor.most == 2
    assert driver.failed == {
        trainings[2]: "died 3 times, lastly: signal 9",
        trainings[3]: "OSError: no space",
        trainings[5]: "no processes",
    }
    name = trainings[1].name
    assert f"{name}: died (signal 9); restarts from its checkpoint (1 of 2)" in bar.lines
    assert driver.exit_code() == 1


def test_signals_stop_all_trainings_and_start_no_others(tmp_path):
    trainings = expand({"seeds": 3, "env": TRUTH}, tmp_path)
    stops = []

    class Patient(Scripted):
        def __call__(self, training):
            self.started.append(training.name)
            os.kill(os.getpid(), signal.SIGTERM if len(self.started) == 1 else signal.SIGINT)
            return PatientJob(self, Ended("stopped", "asked to stop"))

    class PatientJob(ScriptedJob):
        def ended(self):
            return self.end if self.stops else None

        def stop(self):
            self.stops += 1
            stops.append(self)

    driver = Driver(trainings, executor := Patient({}), 1, 2, Bar())
    driver.run()
    assert driver.stopped
    assert driver.exit_code() == 130
    assert (len(executor.started), len(stops)) == (1, 1)
    assert not driver.failed


def test_locked_folder_is_busy(tmp_path):
    training = small(tmp_path)[0]
    training.folder.mkdir(parents=True)
    assert not is_locked(training.folder)
    with locked(training.folder):
        assert is_locked(training.folder)
        assert f"process {os.getpid()} on " in holder(training.folder)
        with pytest.raises(BusyError, match="is in use by process"), locked(training.folder):
            pass
        assert work(training.plan, training.folder).kind == "busy"
        files = sorted(path.name for path in training.folder.iterdir())
        assert files == ["training.lock", "training.process"]
    assert not is_locked(training.folder)


def small(tmp_path):
    (tmp_path / "small.toml").write_text(SMALL)
    return expand(read(tmp_path / "small.toml"), tmp_path / "out")


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """Tables of a sweep without disturbances."""
    folder = tmp_path_factory.mktemp("undisturbed")
    end(start(folder))
    assert not list(folder.glob("out/**/*.part"))
    found = folder / "out/runs" / GROUP.format(0.9) / "seed_0"
    names = ["best.npz", "evaluations.csv", "last.npz"]
    names += ["training.json", "training.lock", "training.process"]
    assert sorted(path.name for path in found.iterdir()) == names
    return tables(folder)


def tables(where):
    return [(where / "out" / name).read_bytes() for name in FILES]


def start(where, *options):
    (where / "small.toml").write_text(SMALL)
    line = console_commands.line("sweep", "small.toml", "--output", "out", *options)
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(line, cwd=where, text=True, **pipes)


def end(process, code=0):
    out, err = process.communicate(timeout=600)
    assert process.returncode == code, out + err
    return out, err


def worker_at(process, folder, rows=3):
    """Return the id of the process that trains in a folder, after some evaluations."""
    limit = time.monotonic() + 600.0
    while time.monotonic() < limit:
        assert process.poll() is None, process.communicate()
        with contextlib.suppress(OSError):
            if len((folder / "evaluations.csv").read_text().splitlines()) > rows:
                return int(holder(folder).split()[1])
        time.sleep(0.005)
    raise AssertionError("no evaluations")


@pytest.mark.slow  # processes
def test_tables_are_the_same_after_kills(tmp_path, undisturbed):
    """A worker is killed, and then the sweep itself."""
    runs = tmp_path / "out/runs"
    process = start(tmp_path, "--jobs", "1")
    os.kill(worker_at(process, runs / GROUP.format(0.97) / "seed_0"), signal.SIGKILL)
    second = runs / GROUP.format(0.9) / "seed_0"
    worker = worker_at(process, second)
    process.kill()
    said, _ = process.communicate()
    assert "restarts from its checkpoint (1 of 2)" in said
    end(start(tmp_path))
    assert int(holder(second).split()[1]) == worker  # which survives the sweep
    assert tables(tmp_path) == undisturbed


@pytest.mark.slow  # processes
def test_terminated_sweep_leaves_checkpoints_and_continues(tmp_path, undisturbed):
    process = start(tmp_path, "--jobs", "1")
    first = tmp_path / "out/runs" / GROUP.format(0.97) / "seed_0"
    worker_at(process, first)
    process.send_signal(signal.SIGTERM)
    _, err = end(process, 130)
    assert "Start the same command again to continue" in err
    assert not is_locked(first)
    assert not json.loads((first / "training.json").read_text())["finished"]
    end(start(tmp_path))
    assert tables(tmp_path) == undisturbed


@pytest.mark.slow  # processes
def test_two_sweeps_in_one_folder_share_the_work(tmp_path, undisturbed):
    for process in [start(tmp_path, "--jobs", "1") for _ in range(2)]:
        end(process)
    assert tables(tmp_path) == undisturbed


@pytest.mark.slow  # processes
def test_full_disk_fails_one_training_only(tmp_path, undisturbed):
    full = tmp_path / "out/runs" / GROUP.format(0.97) / "seed_0"
    full.mkdir(parents=True)
    (full / "evaluations.csv.part").symlink_to("/dev/full")
    said, _ = end(start(tmp_path), 1)
    assert f"  {full.relative_to(tmp_path)}: OSError: [Errno 28] No space left on device" in said
    (full / "evaluations.csv.part").unlink()
    end(start(tmp_path))
    assert tables(tmp_path) == undisturbed

"""Sweeps whose workers, drivers and nodes are killed: the same tables, bit for bit."""

import contextlib
import importlib.util
import json
import os
import signal
import subprocess
import time

import pytest

from baselines.locks import holder, is_locked
from quad_gym.experiments import sweep_executors
from quad_gym.experiments.sweep_table import FILES
from tests import console_commands
from tests.contract.test_sweep import SMALL

GROUP = "circle,compiled_ppo,gamma={}"


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The tables of a sweep that nothing has happened to."""
    folder = tmp_path_factory.mktemp("undisturbed")
    (folder / "small.toml").write_text(SMALL)
    done = console_commands.run("sweep", "small.toml", "--output", "out", where=folder)
    assert done.returncode == 0, done.stderr
    assert not list(folder.glob("out/**/*.part"))
    found = folder / "out/runs" / GROUP.format(0.9) / "seed_0"
    names = ["best.npz", "evaluations.csv", "last.npz", "training.json", "training.lock"]
    assert sorted(path.name for path in found.iterdir()) == names
    return tables(folder)


def tables(where):
    return [(where / "out" / name).read_bytes() for name in FILES]


def start(where, *options):
    (where / "small.toml").write_text(SMALL)
    line = console_commands.line("sweep.py", "small.toml", "--output", "out", *options)
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(line, cwd=where, text=True, **pipes)


def end(process, code=0):
    out, err = process.communicate(timeout=600)
    assert process.returncode == code, out + err
    return out, err


def worker_at(process, folder, rows=3):
    """The process that trains in a folder, once there are some evaluations."""
    limit = time.monotonic() + 600.0
    while time.monotonic() < limit:
        assert process.poll() is None, process.communicate()
        with contextlib.suppress(OSError):
            if len((folder / "evaluations.csv").read_text().splitlines()) > rows:
                return int(holder(folder).split()[1])
        time.sleep(0.005)
    raise AssertionError("no evaluations")


@pytest.mark.slow  # seven processes; what the driver does is in test_sweep.py
def test_workers_and_the_sweep_itself_may_be_killed(tmp_path, undisturbed):
    runs = tmp_path / "out/runs"
    process = start(tmp_path, "--jobs", "1")
    os.kill(worker_at(process, runs / GROUP.format(0.97) / "seed_0"), signal.SIGKILL)
    lives_on = runs / GROUP.format(0.9) / "seed_0"
    worker = worker_at(process, lives_on)
    process.kill()
    said, _ = process.communicate()
    assert "died (signal 9); starts again from its checkpoint (1 of 2)" in said
    end(start(tmp_path, "--jobs", "2"))
    assert int(holder(lives_on).split()[1]) == worker  # nobody else has trained in its folder
    assert tables(tmp_path) == undisturbed


@pytest.mark.slow  # a sweep of processes each
def test_two_sweeps_in_one_folder_share_the_work(tmp_path, undisturbed):
    for process in [start(tmp_path, "--jobs", "1") for _ in range(2)]:
        end(process)
    assert tables(tmp_path) == undisturbed


@pytest.mark.slow  # a sweep of processes each
def test_a_full_disk_stops_one_training_and_a_signal_stops_all(tmp_path, undisturbed):
    runs = tmp_path / "out/runs"
    full = runs / GROUP.format(0.97) / "seed_0"
    full.mkdir(parents=True)
    (full / "evaluations.csv.part").symlink_to("/dev/full")
    process = start(tmp_path, "--jobs", "1")
    worker_at(process, runs / GROUP.format(0.9) / "seed_0")
    process.send_signal(signal.SIGTERM)
    said, err = end(process, 130)
    assert f"{GROUP.format(0.97)}/seed_0: OSError: [Errno 28] No space left on device" in said
    assert "start the same command again to go on" in err.lower()
    stopped = runs / GROUP.format(0.9) / "seed_0"
    assert not is_locked(stopped)
    assert not json.loads((stopped / "training.json").read_text())["finished"]
    assert f"  {full.relative_to(tmp_path)}: OSError" in said  # again at the end
    (full / "evaluations.csv.part").unlink()
    end(start(tmp_path))
    assert tables(tmp_path) == undisturbed


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("submitit") is None, reason="needs submitit")
def test_jobs_of_submitit_may_be_killed(tmp_path, undisturbed):
    options = ["--executor", "slurm", "--options", "cluster=local", "--jobs", "1"]
    process = start(tmp_path, *options)
    runs = tmp_path / "out/runs"
    os.kill(worker_at(process, runs / GROUP.format(0.97) / "seed_0"), signal.SIGKILL)
    worker_at(process, runs / GROUP.format(0.9) / "seed_0")
    process.kill()
    said, _ = process.communicate()
    assert "starts again from its checkpoint (1 of 2)" in said
    end(start(tmp_path, *options))
    assert tables(tmp_path) == undisturbed


@pytest.mark.slow  # needs submitit, which `make test-slow` installs
@pytest.mark.skipif(importlib.util.find_spec("submitit") is None, reason="needs submitit")
def test_parameters_that_submitit_does_not_know_are_refused(tmp_path):
    with pytest.raises(ValueError, match="--options do not fit submitit"):
        sweep_executors.SubmititExecutor(tmp_path, 1, {"cluster": "local", "cores": 3})
    with pytest.raises(ValueError, match="--options do not fit submitit"):
        sweep_executors.SubmititExecutor(tmp_path, 1, {"cluster": "moon"})


@pytest.fixture
def nodes(monkeypatch):
    """A cluster of Ray with two nodes on this machine, and the second one."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    yield cluster, cluster.add_node(num_cpus=1)
    cluster.shutdown()


@pytest.mark.slow
def test_workers_of_ray_may_be_killed_and_so_may_a_node(tmp_path, undisturbed, nodes):
    cluster, second = nodes
    options = ["--executor", "ray", "--options", f"address={cluster.address}"]
    runs = tmp_path / "out/runs"
    process = start(tmp_path, *options, "--jobs", "1")
    os.kill(worker_at(process, runs / GROUP.format(0.97) / "seed_0"), signal.SIGKILL)
    worker_at(process, runs / GROUP.format(0.9) / "seed_0")
    process.kill()
    said, _ = process.communicate()
    assert "starts again from its checkpoint (1 of 2)" in said
    process = start(tmp_path, *options)
    worker_at(process, runs / GROUP.format(0.8) / "seed_0")
    cluster.remove_node(second, allow_graceful=False)
    end(process)
    assert tables(tmp_path) == undisturbed


@pytest.mark.slow
def test_a_request_to_terminate_ends_trainings_on_ray_with_a_checkpoint(
    tmp_path, undisturbed, monkeypatch
):
    pytest.importorskip("ray")
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    options = ["--executor", "ray", "--options", "num_cpus=1"]  # Ray on this machine alone
    process = start(tmp_path, *options)
    first = tmp_path / "out/runs" / GROUP.format(0.9) / "seed_0"
    worker_at(process, first)
    process.send_signal(signal.SIGTERM)
    _, err = end(process, 130)
    assert "start the same command again to go on" in err.lower()
    assert not is_locked(first)
    stopped = [path.parent for path in tmp_path.glob("out/runs/*/*/training.json")]
    records = [json.loads((folder / "training.json").read_text()) for folder in stopped]
    assert any(not record["finished"] and "steps" in record for record in records)
    end(start(tmp_path, *options))
    assert tables(tmp_path) == undisturbed

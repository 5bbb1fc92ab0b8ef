"""Processes that compile at the same time: shared parts, and the state after one of them dies."""

import signal
import sys

import pytest

from tests.unit.compiling.parts import PREPARE, RIGHT, Parts, alive, wait_until

linux = pytest.mark.skipif(sys.platform != "linux", reason="it reads /proc")
MANY = """
import os
from multiprocessing import get_context
import parts_of_test as parts
from quad_gym.kernels.compiling.workers import prepare

def work(barrier, answers):
    barrier.wait()
    {what}
    answers.put(str(parts.results()))

context = get_context("fork")
barrier, answers = context.Barrier(6), context.Queue()
many = [context.Process(target=work, args=(barrier, answers)) for _ in range(6)]
for process in many:
    process.start()
found = [answers.get() for _ in many]
for process in many:
    process.join()
print(*sorted(set(found)))
"""


@pytest.fixture
def parts(tmp_path):
    return Parts(tmp_path)


def test_parts_are_compiled_once_and_by_worker_processes(parts):
    output, said = parts.run()
    assert output == RIGHT
    assert parts.compiled() == ["a", "b", "c"]
    assert len(parts.compilers()) in (1, 2)  # the first may be done before the second has begun
    assert len(parts.files("code")) == 3
    assert not parts.files("tmp")
    assert [line.split(" (")[0] for line in said.splitlines()][:1] == [
        "quad_gym: compiling 3 kernels for this machine"
    ]
    assert "compiled 3 of 3 kernels" in said.splitlines()[-1]
    assert parts.run() == (RIGHT, "")  # all of it comes from the cache
    assert parts.compiled() == ["a", "b", "c"]


@linux
def test_workers_of_other_systems_are_not_copies_of_one_process(parts):
    without = "from quad_gym.kernels.compiling import workers\nworkers._FORKS = False\n"
    process = parts.start(PREPARE.replace("prepare(parts", without + "prepare(parts"))
    output, said = process.communicate(timeout=600)
    assert (process.returncode, output.strip()) == (0, RIGHT), said
    assert parts.compiled() == ["a", "b", "c"]
    assert process.pid not in parts.compilers()
    assert len(parts.files("code")) == 3


@pytest.mark.slow
@pytest.mark.parametrize("what", ["prepare(parts.NAMES, processes=2)", "pass"])
def test_six_processes_that_begin_at_once_compile_each_part_once(parts, what):
    """Parts are compiled by `prepare`, or by calls without it."""
    output, said = parts.run(MANY.replace("{what}", what))
    assert output == RIGHT
    assert parts.compiled() == ["a", "b", "c"]
    assert len(parts.files("code")) == 3
    lines = said.splitlines()
    assert len([line for line in lines if "quad_gym: compiling" in line]) in (1, 3)


@pytest.mark.slow  # a worker that fails is tested below
def test_parts_of_killed_workers_are_compiled_by_the_parent(parts):
    output, _ = parts.run(MOOD="die")
    assert output == RIGHT
    assert parts.compiled() == ["a", "a", "b", "b", "c"]  # two workers died over a and b
    assert len(parts.files("code")) == 3
    assert not parts.files("tmp")
    assert parts.run() == (RIGHT, "")  # nothing is missing


def test_a_part_that_cannot_be_compiled_raises_in_the_parent(parts):
    process = parts.start(MOOD="raise")
    _, said = process.communicate(timeout=600)
    assert process.returncode == 1
    assert "this part cannot be compiled" in said
    assert not parts.files("code")
    assert parts.run(processes=1)[0] == RIGHT


@linux
@pytest.mark.parametrize(
    "how",
    [
        signal.SIGINT,
        *(pytest.param(n, marks=pytest.mark.slow) for n in (signal.SIGTERM, signal.SIGKILL)),
    ],
)
def test_no_worker_outlives_a_parent_ended_by_a_signal(parts, how):
    """SIGINT (Ctrl-C), SIGTERM and SIGKILL leave no process and no damaged file."""
    process = parts.start(MOOD="dawdle")
    wait_until(lambda: len(parts.compilers()) == 2)
    workers = parts.compilers()
    process.send_signal(how)
    _, said = process.communicate(timeout=600)
    assert process.returncode != 0
    wait_until(lambda: not any(alive(worker) for worker in workers))
    if how == signal.SIGINT:
        assert said.rstrip().endswith("KeyboardInterrupt")
        assert said.count("Traceback") == 1  # workers print nothing
    assert not parts.files("code")
    assert not parts.files("tmp")
    assert parts.run(processes=1)[0] == RIGHT

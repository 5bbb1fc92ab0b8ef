"""Flights on a GPU: device code on this processor flies as the batch does."""

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

import quad_gym
from quad_gym import device as emission
from quad_gym.device import plan_of, ptx_of
from quad_gym.envs.config import TASK_DEFAULTS
from quad_gym.kernels.compiling.building import PROCESSORS
from quad_gym.kernels.library import machine
from quad_gym.kernels.sources import sources_digest
from quad_gym.params.suites import SUITES
from tests.builders import run_python, vec_env
from tests.golden import device, ptx, sass
from tests.golden.flights import trajectories

torch = pytest.importorskip("torch")
from quad_gym.envs.torch_env import QuadDeviceVecEnv  # noqa: E402
from tests.contract.test_consistency_script import Held  # noqa: E402
from tests.contract.test_torch_env import (  # noqa: E402
    assert_flights_equal,
    assert_mask_begins_one_episode,
    assert_written_steps_move_the_time_limits,
)

COUNT = 40  # a block, and a part of one
TRUTH = {"observation": "truth", "max_episode_steps": 25, "max_tilt": 0.6}
SINGLE = {"QUAD_GYM_PRECISION": "single"}
pytestmark = pytest.mark.skipif(machine() not in PROCESSORS, reason="no code for this processor")


def launcher_of_ptx(plan):
    """Return the launcher of a plan's PTX, translated to C."""
    return ptx.PtxLauncher(ptx_of(plan).decode())


def device_env(base, count=COUNT, launcher=device.launcher_of, **keywords):
    return QuadDeviceVecEnv(count, device="cpu", base=base, launcher=launcher, **keywords)


def episodes_of(base, mode, launcher=device.launcher_of, **keywords):
    """Fly device code and the batch with the same actions; return the number of episodes."""
    envs = device_env(base, launcher=launcher, autoreset_mode=mode, **keywords)
    others = vec_env(base, COUNT, autoreset_mode=mode, **keywords)
    episodes = assert_flights_equal(envs, others, steps=60, last=True)
    for name in envs.batch.plan.fields:
        values = others.flights.batch.record(name)
        assert np.array_equal(envs.batch.record(name).numpy().view(values.dtype), values, True), (
            name
        )
    return episodes


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_flights_of_device_code_equal_those_of_the_batch(mode):
    assert episodes_of("circle", mode, **TRUTH) > COUNT


@pytest.mark.parametrize(
    "chosen",
    [
        "test_flights_of_ptx_equal_those_of_the_batch",
        pytest.param("equal_those_of_the_batch and not ptx and not gpu", marks=pytest.mark.slow),
        pytest.param("test_filtered_flights_of_ptx", marks=pytest.mark.slow),
    ],
)
def test_flights_of_device_code_in_single_precision_equal_those_of_the_batch(chosen):
    words = ("-m", "pytest", "-q", "-n", "0", "-m", "slow or not slow", "-k")
    done = run_python(*words, f"({chosen}) and not single_precision", __file__, **SINGLE)
    assert done.returncode == 0, done.stdout + done.stderr
    assert " passed" in done.stdout


def test_flights_of_ptx_equal_those_of_the_batch():
    assert episodes_of("circle", "NextStep", launcher_of_ptx, **TRUTH) > COUNT


class Drawing(quad_gym.Task):
    """Draws starts, a target in each step, and ends; observes the target and the step."""

    state: ClassVar = {"target": np.zeros(3), "gates_passed": 0}
    observes: ClassVar = {"target": quad_gym.ObservationSpec("m", "B", -5.0, 5.0)}

    def reset(self, view, rng):
        view.state.target = view.position
        position = view.reference_position + rng.uniform(-0.2, 0.2, (view.count, 3))
        return {"position": position, "yaw": rng.uniform(-1.0, 1.0)}

    def update(self, view, rng):
        view.state.target = view.state.target + rng.normal(0.0, 0.1, (view.count, 3))
        view.state.gates_passed = view.state.gates_passed + rng.integers(2)

    def reward(self, view):
        gap = np.abs(view.state.target - view.position).sum(axis=1)
        return {"near": -gap, "progress": view.truth.progress}

    def terminated(self, view):
        return view.builtin.terminated | (view.state.gates_passed > 12)

    def truncated(self, view):
        return view.step >= 20

    def observe(self, view):
        gap = (view.state.target - view.observed.position)[:, :, np.newaxis]
        return {"target": (view.observed.R_BI @ gap)[:, :, 0], "time": view.time}


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_flights_of_device_code_with_a_task_equal_those_of_the_batch(mode):
    assert episodes_of("circle", mode, task=Drawing(), **TRUTH) > COUNT


@pytest.mark.slow  # compiles the filter
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize(
    ("base", "keywords"),
    [
        ("look_around", {"include_std": True, "max_tilt": 0.6}),
        ("stale_race", {"max_tilt": 0.6}),
        ("outage_dash", {"max_episode_steps": 25, "reward_terms": True}),
    ],
)
def test_flights_of_benchmark_tasks_equal_those_of_the_batch(base, keywords, mode):
    assert episodes_of(base, mode, **keywords) > 0


def test_reward_terms_and_endings_of_a_task_on_a_device_are_those_of_the_batch():
    made = {"task": Drawing(), "reward_terms": True, "reward_per": "second", **TRUTH}
    envs, others = device_env("circle", 3, **made), vec_env("circle", 3, **made)
    envs.reset(seed=1), others.reset(seed=1)
    for _ in range(25):
        infos, known = envs.step(torch.zeros(3, 4))[-1], others.step(np.zeros((3, 4)))[-1]
        assert set(infos["reward_terms"]) == {"near", "progress"}
        for name, term in infos["reward_terms"].items():
            assert np.array_equal(term.numpy(), known["reward_terms"][name])
        for name in ("ending", "gates_passed"):
            assert np.array_equal(envs.batch.result(name).numpy(), known[name])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize(("name", "base"), [("Circle", "circle"), ("LookAround", "look_around")])
def test_flights_on_a_gpu_equal_those_of_the_batch(name, base, mode):
    made = {"autoreset_mode": mode, "max_tilt": 0.6}
    envs = quad_gym.make_torch_vec_env(f"QuadGym/{name}-v0", COUNT, device="cuda", **made)
    assert assert_flights_equal(envs, vec_env(base, COUNT, **made), steps=60, last=True) > 0


@pytest.mark.slow  # compiles the filter
def test_filtered_flights_of_ptx_equal_those_of_the_batch():
    assert episodes_of("circle", "NextStep", launcher_of_ptx, max_tilt=0.6) > 0


@pytest.mark.slow  # compiles the filter
@pytest.mark.parametrize("keywords", [{}, {"sensors": "rtk", "faults": "gnss_outage"}])
def test_filtered_flights_of_device_code_equal_those_of_the_batch(keywords):
    assert episodes_of("circle", "NextStep", max_tilt=0.6, **keywords) > 0


def test_module_in_a_wheel_is_taken_for_its_sources_and_settings_alone(tmp_path, monkeypatch):
    plan, other = (plan_of(vec_env(task, 1, **TRUTH).flights.batch) for task in ("hover", "circle"))
    (tmp_path / "older.ptx.z").touch()
    monkeypatch.setattr(emission, "FOLDER", tmp_path)
    monkeypatch.setattr(emission, "_emitted", lambda plan: b"of the wheel")
    written = list(emission.pack([plan]))
    assert written == list(tmp_path.iterdir())
    assert written[0].name.startswith(sources_digest(Path(quad_gym.__file__).parent)[:12])
    monkeypatch.setattr(emission, "_emitted", lambda plan: b"emitted")
    assert (ptx_of(plan), ptx_of(other)) == (b"of the wheel", b"emitted")
    monkeypatch.setattr(emission, "sources_digest", lambda package: "0" * 64)
    assert ptx_of(plan) == b"emitted"


@pytest.mark.skipif(sass.tool("ptxas") is None, reason="no ptxas")
@pytest.mark.parametrize(
    ("keywords", "spills", "size"),
    [
        (TRUTH, 200, 250e3),
        pytest.param({}, 500, 900e3, marks=pytest.mark.slow),
        pytest.param(
            {"sensors": "rtk", "faults": "gnss_outage"}, 500, 1600e3, marks=pytest.mark.slow
        ),
    ],
)
def test_machine_code_of_a_gpu_keeps_its_budgets_and_its_conditions(
    keywords, spills, size, tmp_path
):
    file = tmp_path / "flights.cubin"
    said = sass.assembled(ptx_of(plan_of(vec_env("circle", 1, **keywords).flights.batch)), file)
    assert int(re.search(r"Used (\d+) registers", said)[1]) <= 255
    spilled = re.search(r"properties for qg_fly\n.*?(\d+) bytes spill stores", said)
    assert int(spilled[1]) <= spills
    assert file.stat().st_size <= size
    if sass.tool("nvdisasm") is not None:
        assert sass.overwritten_conditions(sass.disassembled(file)) == []


CARRY = "/*0650*/ @P0 IADD3 R3, P0, R11, R6, RZ ;"
"""Overwrites its condition, as the assembler of CUDA 13.0 did where there were faults."""


@pytest.mark.parametrize(
    ("lines", "count"),
    [
        (
            [
                CARRY,
                "/*0660*/ @P3 IMAD.X R2, R9, 0x1, R8, P0 ;",
                '/*06d0*/ @P0 STL [R1], R3 (*"SpillRefill"*);',
            ],
            1,
        ),
        ([CARRY, "/*0660*/ @!P0 EXIT ;"], 1),
        ([CARRY, "/*0660*/ @P3 IMAD.X R2, R9, 0x1, R8, P0 ;"], 0),
        ([CARRY, "/*0660*/ ISETP.NE.AND P0, PT, R2, R3, PT ;", "/*0670*/ @P0 EXIT ;"], 0),
        ([CARRY, ".text.next:", "/*0000*/ @P0 EXIT ;"], 0),
        ([CARRY.replace(" P0,", " P1,"), "/*0660*/ @P0 STL [R1], R3 ;"], 0),
        (["/*0650*/ @P0 ISETP.NE.AND P0, PT, R2, R3, PT ;", "/*0660*/ @P0 EXIT ;"], 0),
    ],
)
def test_condition_that_a_carry_overwrites_is_found_where_it_is_needed_later(lines, count):
    assert len(sass.overwritten_conditions("\n".join(lines))) == count


@pytest.fixture(scope="module")
def three():
    return device_env("circle", 3, autoreset_mode="Disabled", **TRUTH)


def test_observations_of_device_flights_stay_for_one_more_step(three):
    begun = three.reset(seed=0)[0]
    kept, (seen, *_) = begun.clone(), three.step(torch.zeros(3, 4))
    assert torch.equal(begun, kept)
    assert not torch.equal(seen, begun)


def test_reset_mask_of_device_flights_begins_these_episodes_alone(three):
    assert_mask_begins_one_episode(three)


def test_flights_without_a_seed_in_a_list_go_on_with_their_streams(three):
    """As in `QuadVectorEnv`: a flight whose seed is None continues, also with a mask."""
    three.reset(seed=5)
    first = three.batch.record("key").clone()
    mask = torch.tensor([True, True, False])
    three.reset(seed=[7, None, 8], options={"reset_mask": mask})
    last = three.batch.record("key")
    assert torch.equal(last[1:], first[1:])
    assert not torch.equal(last[0], first[0])
    assert three.batch.record("episode").tolist() == [1.0, 2.0, 1.0]


def test_written_steps_of_device_flights_move_the_time_limits():
    made = {"autoreset_mode": "NextStep", **TRUTH, "max_episode_steps": 5}
    assert_written_steps_move_the_time_limits(device_env("circle", 7, **made))


def test_reset_mask_of_device_flights_with_a_task_begins_these_episodes_alone():
    made = {"autoreset_mode": "Disabled", "task": Drawing(), **TRUTH}
    assert_mask_begins_one_episode(device_env("circle", 3, **made))


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (torch.ones(3), r"shape \(3,\) and booleans, got \(3,\) and torch.float32"),
        (torch.ones(2, dtype=torch.bool), r"shape \(3,\) and booleans, got \(2,\)"),
        (np.ones(2, bool), r"shape \(3,\), got \(2,\)"),
        ([True, False, True], "an array of booleans"),
    ],
)
def test_wrong_reset_mask_of_device_flights_is_refused(mask, message, three):
    with pytest.raises((ValueError, TypeError), match=message):
        three.reset(options={"reset_mask": mask})


@pytest.mark.parametrize("device", ["cuda:x", "cudas", "CUDA", "meta", 5.0])
def test_device_that_is_no_processor_or_gpu_is_refused(device):
    with pytest.raises(ValueError, match='device must be "cpu" or "cuda", got'):
        quad_gym.make_torch_vec_env("QuadGym/Circle-v0", 2, device=device)


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"render_mode": "rgb_array"}, "render_mode is of flights on the processor"),
        ({"threads": 2}, "threads is of flights on the processor"),
        ({"estimator": f"{Held.__module__}:Held"}, "an own estimator runs in Python"),
        (
            {"innovations": True, "autoreset_mode": "SameStep"},
            'innovations with autoreset_mode="SameStep" runs in Python',
        ),
    ],
)
def test_flights_that_need_python_are_refused_on_a_gpu(keywords, message):
    with pytest.raises(ValueError, match=message):
        device_env(**{"base": "circle", "count": 2} | keywords)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_missing_gpu_is_named():
    with pytest.raises(ValueError, match="needs an NVIDIA GPU and a torch with CUDA"):
        quad_gym.make_torch_vec_env("QuadGym/Circle-v0", 2, device="cuda")


@pytest.mark.slow  # compiles all kernels
@pytest.mark.parametrize("kind", [[], ["--modules", "Circle, standard", "many options"]])
@pytest.mark.parametrize("variables", [{}, SINGLE], ids=["double", "single"])
def test_golden_flights_are_the_same_by_device_code(kind, variables):
    command, env = [sys.executable, "-m", "tests.golden.device", *kind], os.environ | variables
    assert subprocess.run(command, cwd=device.ROOT, env=env, check=False).returncode == 0


@pytest.mark.slow  # compiles all kernels
@pytest.mark.parametrize("task", TASK_DEFAULTS)
@pytest.mark.parametrize("sensors", SUITES)
def test_every_suite_and_task_has_ptx(task, sensors):
    keywords = {"trajectory": trajectories()} if task == "trajectory" else {}
    batch = vec_env(task, 1, sensors=sensors, **keywords).flights.batch
    assert b"visible .entry qg_fly" in ptx_of(plan_of(batch))

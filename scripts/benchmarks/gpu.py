"""Compare golden flights on a GPU number by number; measure steps/s, memory and trainings.

    python -m scripts.benchmarks.gpu prepare FOLDER     # on any machine, in a clone with all extras
    python scripts/benchmarks/gpu.py run FOLDER         # on the GPU's machine
    python -m scripts.benchmarks.gpu evaluate FOLDER    # the trained policies, on the first machine

The first part emits a module for each golden case that a GPU can fly, which takes a quarter of an
hour on two cores. The second part needs the clone and FOLDER, and of packages NumPy, torch and
cuda-core. Both skip the results in FOLDER: if one was interrupted or ran out of time, run it again.
With `--only TEXT`, they select cases and measurements by a part of their names. Results are
in FOLDER/results.json. With `QUAD_GYM_PRECISION=single` and another FOLDER, all three parts are for
flights in single precision.
"""

import argparse
import functools
import importlib
import json
import multiprocessing
import os
import pickle
import sys
import time
import types
import zlib
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

ROOT = Path(__file__).parents[2]
SECONDS = 370.0  #: time after which no measurement begins
LONGEST = 100.0  #: about the longest training [s]
TIMED = {"observation truth": 1 << 20, "Circle, standard": 1 << 20, "LookAround": 16_384}
"""Golden cases with which steps/s are measured, and the largest number of flights."""
SIZES = (1_024, 4_096, 16_384, 65_536, 1_048_576)
"""Numbers of flights."""
DURATION = 2.0  #: of a measurement of steps/s [s]
WARM_UP = 60  #: steps before it
TICKS, FLIGHTS, STEPS, SEED = 30, 8, 300, 2026
EPISODES = 1000  #: of an evaluation


class Training(NamedTuple):
    """Flights and options of a training by `docs/examples/torch_ppo.py`."""

    env_id: str
    options: Mapping[str, Any]
    keywords: Mapping[str, Any] = {}  #: of the flights
    learning: Mapping[str, Any] = {}  #: keywords of the flights in training only


_CIRCLE = {"num_envs": 8192, "num_minibatches": 32, "total_timesteps": 20_000_000}
"""Multiples of the script's defaults."""
_LOOK = {"num_envs": 4096, "num_minibatches": 16, "total_timesteps": 40_000_000, "gamma": 0.995}
TRAININGS = {
    "training": Training("QuadGym/Circle-v0", _CIRCLE),
    "training on LookAround": Training(
        "QuadGym/LookAround-v0", _LOOK, {"include_std": True}, {"out_of_bounds": 3.0}
    ),
    "training with memory": Training("QuadGym/Circle-v0", {**_CIRCLE, "memory": True}),
}
"""The trainings by name, in the order of importance."""
Make = Callable[[bytes], Any]
"""Make the launcher of a module of PTX."""


def prepare(folder: Path, only: str = "", workers: int = 2) -> None:
    """Write a file for each case: its plan, its PTX, and the numbers of its flights here.

    Args:
        folder: Folder of the files.
        only: Part of the names of golden cases and trainings.
        workers: Number of processes.
    """
    golden: Any = importlib.import_module("tests.golden.flights")
    folder.mkdir(parents=True, exist_ok=True)
    names = [name for name in (*TRAININGS, *golden.cases()) if only in name]
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        for said in pool.map(functools.partial(_prepare, folder), names):
            print(said, flush=True)


def _prepare(folder: Path, name: str) -> str:
    """Write the file of a case or of a training; return a line about it."""
    import quad_gym

    golden: Any = importlib.import_module("tests.golden.flights")
    file = folder / f"{name}.case"
    if file.is_file():
        return f"{name}: is there"
    if name in TRAININGS:
        training = TRAININGS[name]
        env: Any = quad_gym.make_torch_vec_env(
            training.env_id,
            1,
            autoreset_mode="SameStep",
            **{**training.keywords, **training.learning},
        )
        flights = env.flights
        content: dict[str, Any] = _module_of(flights.batch)
    else:
        env = golden.made(golden.cases()[name], FLIGHTS)
        flights = env.unwrapped.flights
        content = _module_of(flights.batch)
        env.reset(seed=SEED)
        content["keys"] = flights.batch.record("key")
        names = [state for state in golden.STATES if state in content["plan"].fields]

        def step(actions: Any) -> list[Any]:
            seen, rewards, *_ = env.step(actions)
            parts = list(seen.values()) if isinstance(seen, dict) else [seen]
            return [np.concatenate(parts, axis=1), rewards]

        content |= {"names": names, "flown": list(_flown(step, flights.batch.record, names))}
    file.write_bytes(zlib.compress(pickle.dumps(content)))
    return f"{name}: PTX of {len(content['ptx']) / 1e3:.0f} kB"


def _module_of(batch: Any) -> dict[str, Any]:
    """Return what flights need on a GPU: plan, PTX, and the task in Python, if they have one."""
    from quad_gym.device import plan_of, ptx_of

    plan = plan_of(batch)
    return {"plan": plan, "ptx": ptx_of(plan), "task": getattr(batch, "made", None)}


def _flights(content: dict[str, Any], count: int, make: Make, device: str) -> Any:
    """Return the flights of a file."""
    from quad_gym.device import flights_on

    launcher = make(content["ptx"])
    return flights_on(device, content["plan"], count, launcher, content.get("task"))


def _flown(step: Any, record: Any, names: list[str]) -> Iterator[list[Any]]:
    """Fly the actions of golden flights; yield observations, rewards and states now and then."""
    rng = np.random.default_rng(SEED)
    for k in range(STEPS):
        results = step(rng.uniform(-0.1, 0.1, (FLIGHTS, 4)))
        if k % TICKS == TICKS - 1:
            yield [*results, *(record(name) for name in names)]


def run(
    folder: Path,
    make: Make,
    device: str,
    sizes: tuple[int, ...] = SIZES,
    mapped: Any = map,
    only: str = "",
) -> dict[str, Any]:
    """Fly the golden cases, then measure while there is time; return FOLDER/results.json.

    Args:
        folder: Folder of the files; results that are there are kept, but for failed ones.
        make: Makes launchers.
        device: Device of the flights.
        sizes: Numbers of flights.
        mapped: Function like `map` for the golden cases, of which any may end a GPU's context.
        only: Part of the names of measurements.
    """
    begin, file = time.monotonic(), folder / "results.json"
    found: dict[str, Any] = json.loads(file.read_text()) if file.is_file() else {}

    def is_missing(what: str) -> bool:
        return only in what and (what not in found or "failed" in found[what])

    def keep(what: str, result: Any) -> None:
        found[what] = result
        print(f"{time.monotonic() - begin:.0f} s, {what}: {result}", flush=True)
        file.write_text(json.dumps(found, indent=1) + "\n")

    paths = {path.stem: path for path in sorted(folder.glob("*.case"))}
    golden = [name for name in paths if name not in TRAININGS and is_missing(f"golden: {name}")]
    compare = functools.partial(_attempted, _differences, make, device)
    for name, result in zip(golden, mapped(compare, map(paths.get, golden)), strict=True):
        keep(f"golden: {name}", result)
    todo: list[tuple[str, Any, str, Any]] = [
        (f"{name}, {n} flights", _speed, name, n)
        for name, most in TIMED.items()
        for n in sizes
        if n <= most
    ]
    todo += [
        (name, _training, name, {**training.options, "save": folder / f"{name}.pt"})
        for name, training in TRAININGS.items()
    ]
    for what, measure, name, more in todo:
        if name in paths and is_missing(what) and time.monotonic() - begin < SECONDS:
            keep(what, _attempted(measure, make, device, paths[name], more))
    return found


def _attempted(measure: Any, make: Make, device: str, path: Path, *more: Any) -> Any:
    """Return the measurement of a file, or why it failed."""
    try:
        return measure(pickle.loads(zlib.decompress(path.read_bytes())), make, device, *more)
    except Exception as error:  # the others may work
        return {"failed": f"{type(error).__name__}: {error}"}


def _differences(content: dict[str, Any], make: Make, device: str) -> dict[str, Any]:
    """Return how many numbers of golden flights differ from those on the processor, by name."""
    import torch

    batch = _flights(content, FLIGHTS, make, device)
    batch.reset(content["keys"])

    def step(actions: Any) -> list[Any]:
        seen = batch.step(torch.from_numpy(actions).to(device))
        return [seen.cpu().numpy().copy(), batch.result("reward").cpu().numpy().copy()]

    def record(name: str) -> Any:
        return batch.record(name).cpu().numpy()

    names, wrong, count = ["observations", "rewards", *content["names"]], dict[str, int](), 0
    for here, there in zip(_flown(step, record, content["names"]), content["flown"], strict=True):
        for name, x, y in zip(names, here, there, strict=True):
            x = x.view(y.dtype)
            same = (x == y) & (np.signbit(x) == np.signbit(y)) | (x != x) & (y != y)
            wrong[name] = wrong.get(name, 0) + int((~same).sum())
            count += y.size
    return {"numbers": count, "differing": {name: n for name, n in wrong.items() if n}}


def _speed(content: dict[str, Any], make: Make, device: str, count: int) -> Any:
    """Return steps/s with random actions, and the memory of a flight [bytes]."""
    import torch

    on_gpu = device != "cpu"
    before = torch.cuda.memory_allocated() if on_gpu else 0
    batch = _flights(content, count, make, device)
    after = torch.cuda.memory_allocated() if on_gpu else 0
    _Flights(batch).reset(0)
    once = _seconds(batch, WARM_UP) / WARM_UP  # until episodes end at every step
    steps = max(8, min(1000, int(DURATION / once)))
    return {"steps/s": count * steps / _seconds(batch, steps), "bytes": (after - before) / count}


def _seconds(batch: Any, steps: int) -> float:
    """Return how long steps with random actions take [s]."""
    import torch

    actions = [0.2 * torch.randn(batch.count, 4, device=batch.device) for _ in range(8)]
    begin = time.perf_counter()
    for k in range(steps):
        batch.step(actions[k % 8])
    batch.result("reward").sum().item()  # waits
    return time.perf_counter() - begin


class _Flights:
    """Flights as an environment for the PPO of the examples, without Gymnasium."""

    def __init__(self, batch: Any) -> None:
        self._batch = batch

    def reset(self, seed: int) -> tuple[Any, dict[str, Any]]:
        from quad_gym.batch.starts import keys_of

        return self._batch.reset(keys_of(np.arange(self._batch.count, dtype=np.uint64) + seed)), {}

    def step(self, actions: Any) -> Any:
        seen, result = self._batch.step(actions), self._batch.result
        over = (result("terminated") > 0.0, result("truncated") > 0.0)
        final = {"final_obs": self._batch.final_observations}
        return seen, result("reward").float(), *over, final


def _training(content: dict[str, Any], make: Make, device: str, options: dict[str, Any]) -> Any:
    """Train, keep the weights, and return the steps and the time [s]."""
    import torch

    script = _ppo()
    args = script.Args(device=device, **options)
    batch = _flights(content, args.num_envs, make, device)
    env = _Flights(batch)
    size = env.reset(0)[0].shape[1]
    speed = args.num_envs * WARM_UP / _seconds(batch, WARM_UP)
    # updates of the networks take up to half of the time
    args.total_timesteps = min(args.total_timesteps, int(0.5 * LONGEST * speed))
    begin = time.perf_counter()
    agent = script.train(env, size, 4, args)
    seconds = time.perf_counter() - begin
    torch.save((size, agent.state_dict()), args.save)
    steps = args.total_timesteps
    return {"seconds": seconds, "steps": steps, "steps/s": steps / seconds}


def evaluate(folder: Path) -> None:
    """Evaluate the trained policies on the processor; add their summaries to results.json."""
    import torch

    from quad_gym import evaluation

    file, script = folder / "results.json", _ppo()
    for name, training in TRAININGS.items():
        if not (weights := folder / f"{name}.pt").is_file():
            continue
        size, state = torch.load(weights, map_location="cpu")
        args = script.Args(**training.options)
        agent = script.Agent(size, 4, args.units, args.memory)
        agent.load_state_dict(state)
        made: dict[str, Any] = {"observation": "estimate", **training.keywords}
        results = evaluation.evaluate(agent, training.env_id, episodes=EPISODES, **made)
        print(f"{name}: {results.summary()}", flush=True)
        found = json.loads(file.read_text()) | {f"evaluation: {name}": results.summary()}
        file.write_text(json.dumps(found, indent=1) + "\n")


def _ppo() -> Any:
    """Return the PPO of the examples, a module."""
    sys.path.insert(0, str(ROOT / "docs" / "examples"))
    return importlib.import_module("torch_ppo")


def _on_cuda(ptx: bytes) -> Any:
    """Return the launcher on the GPU."""
    import torch

    from quad_gym.device import CudaLauncher

    return CudaLauncher(ptx, torch.device("cuda"))


def _without_gymnasium() -> None:
    """Import modules of `quad_gym` without the packages of its environments and of smoothing."""
    sys.path.insert(0, str(ROOT))
    for name in ("quad_gym", "quad_gym.estimation"):
        package = types.ModuleType(name)
        package.__path__ = [str(ROOT.joinpath(*name.split(".")))]
        sys.modules[name] = package


def main() -> None:
    """Prepare, run or evaluate, as the arguments say."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("part", choices=("prepare", "run", "evaluate"))
    parser.add_argument("folder", type=Path, help="folder of the cases and of results.json")
    parser.add_argument("--only", default="", help="part of the names of cases or measurements")
    args = parser.parse_args()
    folder: Path = args.folder
    if args.part == "prepare":
        prepare(folder, args.only)
        return
    if args.part == "evaluate":
        evaluate(folder)
        return
    _without_gymnasium()
    import torch

    print(f"{torch.cuda.get_device_name()}, torch {torch.__version__}", flush=True)
    workers, spawn = min(16, os.cpu_count() or 1), multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(
        workers, spawn, initializer=_without_gymnasium, max_tasks_per_child=1
    ) as pool:
        run(folder, _on_cuda, "cuda", mapped=pool.map, only=args.only)


if __name__ == "__main__":
    main()

"""Compare golden flights on a GPU number by number; measure steps/s, memory and a training.

It has never been run on a GPU.

    python -m scripts.benchmarks.gpu prepare FOLDER     # on any machine, in a clone with all extras
    python scripts/benchmarks/gpu.py run FOLDER         # on the GPU's machine

The second part needs the clone and FOLDER, and of packages NumPy, torch and cuda-core. It writes
FOLDER/results.json after every measurement and skips those that are there: where it was interrupted
or ran out of time, run it again.
"""

import argparse
import functools
import importlib
import json
import pickle
import sys
import time
import types
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[2]
SECONDS = 400.0  #: time after which no measurement begins; the driver compiles a module in 20 s
CASES = (
    *("observation truth", "Circle, standard", "trajectories", "obstacles", "ground"),
    *("many options", "features drawn", "crazyflie, late, ekf, warm, raw", "Waypoints, rtk"),
)
"""Golden cases, in the order in which they are flown."""
TIMED = CASES[:2]
SIZES = tuple((count, share) for share in (32, 16, 8) for count in (4_096, 65_536, 1_048_576))
"""Numbers of flights, and of those that a warp flies."""
DURATION = 2.0  #: of a measurement of steps/s [s]
TICKS, FLIGHTS, STEPS, SEED = 30, 8, 300, 2026
TRAINING = {"num_envs": 8192, "num_minibatches": 32, "total_timesteps": 20_000_000}
"""Options of `docs/examples/torch_ppo.py`; they are multiples of the defaults."""
TRAINED: dict[str, Any] = {"autoreset_mode": "SameStep", "start": "mixed"}
"""Keywords of the flights of the training."""
Make = Callable[..., Any]
"""Make the launcher of a module of PTX, with a number of flights for each warp."""


def prepare(folder: Path, cases: tuple[str, ...] = CASES) -> None:
    """Write a file for each case: its plan, its PTX, and the numbers of its flights here."""
    import quad_gym
    from quad_gym.device.emission import plan_of, ptx_of

    golden: Any = importlib.import_module("tests.golden.flights")
    folder.mkdir(parents=True, exist_ok=True)
    for name in cases:
        env = golden.made(golden.cases()[name], FLIGHTS)
        flights = env.unwrapped.flights
        plan = plan_of(flights.batch)
        env.reset(seed=SEED)
        content = {"plan": plan, "ptx": ptx_of(plan), "keys": flights.batch.record("key")}
        names = [state for state in golden.STATES if state in plan.fields]

        def step(actions: Any, env: Any = env) -> list[Any]:
            seen, rewards, *_ = env.step(actions)
            parts = list(seen.values()) if isinstance(seen, dict) else [seen]
            return [np.concatenate(parts, axis=1), rewards]

        content |= {"names": names, "flown": list(_flown(step, flights.batch.record, names))}
        file = folder / f"{CASES.index(name)}.case"
        file.write_bytes(zlib.compress(pickle.dumps((name, content))))
        print(f"{name}: PTX of {len(content['ptx']) / 1e3:.0f} kB", flush=True)
    env = quad_gym.make_torch_vec_env("QuadGym/Circle-v0", 1, **TRAINED)
    plan = plan_of(env.flights.batch)
    content = {"plan": plan, "ptx": ptx_of(plan)}
    (folder / "training").write_bytes(zlib.compress(pickle.dumps(content)))


def _flown(step: Any, record: Any, names: list[str]) -> Iterator[list[Any]]:
    """Fly the actions of golden flights; yield observations, rewards and states now and then."""
    rng = np.random.default_rng(SEED)
    for k in range(STEPS):
        results = step(rng.uniform(-0.1, 0.1, (FLIGHTS, 4)))
        if k % TICKS == TICKS - 1:
            yield [*results, *(record(name) for name in names)]


def run(
    folder: Path, make: Make, device: str, sizes: tuple[tuple[int, int], ...] = SIZES
) -> dict[str, Any]:
    """Measure what is missing in FOLDER/results.json while there is time; return its content."""
    begin, file = time.monotonic(), folder / "results.json"
    found: dict[str, Any] = json.loads(file.read_text()) if file.is_file() else {}
    cases = {}
    for path in sorted(folder.glob("*.case")):
        name, content = pickle.loads(zlib.decompress(path.read_bytes()))
        cases[name] = content
    todo: dict[str, Callable[[], Any]] = {}
    for name, content in cases.items():
        todo[f"golden: {name}"] = functools.partial(_differences, content, make, device)
        for count, share in sizes if name in TIMED else ():
            what = f"{name}, {count} flights, {share} a warp"
            todo[what] = functools.partial(_speed, content, make, device, count, share)
    training = pickle.loads(zlib.decompress((folder / "training").read_bytes()))
    todo["training: Circle, standard"] = functools.partial(_training, training, make, device)
    for what, measure in todo.items():
        done = what in found and "failed" not in found[what]
        if not done and time.monotonic() - begin < SECONDS:
            try:
                found[what] = measure()
            except Exception as error:  # the others may work
                found[what] = {"failed": f"{type(error).__name__}: {error}"}
            print(f"{time.monotonic() - begin:.0f} s, {what}: {found[what]}", flush=True)
            file.write_text(json.dumps(found, indent=1) + "\n")
    return found


def _differences(content: dict[str, Any], make: Make, device: str) -> dict[str, Any]:
    """Return how many numbers of golden flights differ from those on the processor, by name."""
    import torch

    from quad_gym.device.flights import DeviceBatch

    batch = DeviceBatch(content["plan"], FLIGHTS, make(content["ptx"]), device)
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


def _speed(content: dict[str, Any], make: Make, device: str, count: int, share: int) -> Any:
    """Return steps/s with random actions, and the memory of a flight [bytes]."""
    import torch

    from quad_gym.batch.seeding import keys_of
    from quad_gym.device.flights import DeviceBatch

    on_gpu = device != "cpu"
    before = torch.cuda.memory_allocated() if on_gpu else 0
    batch = DeviceBatch(content["plan"], count, make(content["ptx"], share), device)
    after = torch.cuda.memory_allocated() if on_gpu else 0
    batch.reset(keys_of(np.arange(count, dtype=np.uint64)))
    actions = [0.2 * torch.randn(count, 4, device=device) for _ in range(8)]

    def flown(steps: int) -> float:
        begin = time.perf_counter()
        for k in range(steps):
            batch.step(actions[k % 8])
        batch.result("reward").sum().item()  # waits
        return time.perf_counter() - begin

    flown(2)
    once = flown(4) / 4
    steps = max(8, min(1000, int(DURATION / once)))
    return {"steps/s": count * steps / flown(steps), "bytes": (after - before) / count}


class _Flights:
    """Flights as an environment for the PPO of the examples, without Gymnasium."""

    def __init__(self, batch: Any) -> None:
        self._batch = batch

    def reset(self, seed: int) -> tuple[Any, dict[str, Any]]:
        from quad_gym.batch.seeding import keys_of

        return self._batch.reset(keys_of(np.arange(self._batch.count, dtype=np.uint64) + seed)), {}

    def step(self, actions: Any) -> Any:
        seen, result = self._batch.step(actions), self._batch.result
        over = (result("terminated") > 0.0, result("truncated") > 0.0)
        final = {"final_obs": self._batch.final_observations}
        return seen, result("reward").float(), *over, final


def _training(content: dict[str, Any], make: Make, device: str) -> Any:
    """Train on Circle; return seconds, steps/s, and the mean position error afterwards [m]."""
    import torch

    from quad_gym.device.flights import DeviceBatch

    sys.path.insert(0, str(ROOT / "docs" / "examples"))
    script = importlib.import_module("torch_ppo")
    args = script.Args(device=device, **TRAINING)
    batch = DeviceBatch(content["plan"], args.num_envs, make(content["ptx"]), device)
    begin, env = time.perf_counter(), _Flights(batch)
    agent = script.train(env, content["plan"].low.size, 4, args)
    seconds, seen = time.perf_counter() - begin, env.reset(0)[0]
    with torch.no_grad():
        for _ in range(STEPS):
            seen = env.step(agent.actor(seen))[0]
    error = float(batch.result("position_error").mean())
    return {"seconds": seconds, "steps/s": args.total_timesteps / seconds, "error": error}


def _on_cuda(ptx: bytes, share: int = 32) -> Any:
    """Return the launcher on the GPU."""
    import torch

    from quad_gym.device.launching import CudaLauncher

    return CudaLauncher(ptx, torch.device("cuda"), share)


def _without_gymnasium() -> None:
    """Import `quad_gym` without the packages of its environments."""
    package = types.ModuleType("quad_gym")
    package.__path__ = [str(ROOT / "quad_gym")]
    sys.modules["quad_gym"] = package


def main() -> None:
    """Prepare or run, as the arguments say."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("part", choices=("prepare", "run"))
    parser.add_argument("folder", type=Path, help="folder of the cases and of results.json")
    args = parser.parse_args()
    folder: Path = args.folder
    if args.part == "prepare":
        prepare(folder)
        return
    sys.path[0] = str(ROOT)
    _without_gymnasium()
    import torch

    print(f"{torch.cuda.get_device_name()}, torch {torch.__version__}", flush=True)
    run(folder, _on_cuda, "cuda")


if __name__ == "__main__":
    main()

"""Compilation before the first flight.

A copy of the package in a temporary folder is measured, with the cache in that folder: each
configuration begins with an empty cache, and sources can be edited.
"""

import compileall
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import quad_gym
from quad_gym.commands import benchmark
from scripts.benchmarks.scope import Scope

PACKAGE = Path(quad_gym.__file__).resolve().parent
ENVS = 1024
CIRCLE = """
import time; began = time.perf_counter()
import gymnasium, quad_gym
{before}
env = gymnasium.make_vec("QuadGym/Circle-v0", {envs}{options})
env.reset(seed=0)
{after}
print(time.perf_counter() - began)
"""
LATE_SUITE = """
suite = quad_gym.sensor_suite("rtk")
suite = suite.replace(
    gnss=suite.gnss.replace(latency=0.11), camera=suite.camera.replace(latency=0.06)
)
"""
EVERYTHING = (
    ', sensors=suite, faults="all", world="fresh_breeze", '
    'randomization={"mass": quad_gym.Uniform(0.9, 1.1, relative=True)}'
)
CONFIGURATIONS = {
    "everything: late, faults, fresh_breeze, draws": ("rtk", LATE_SUITE, EVERYTHING),
    "truth": (None, "", ', observation="truth"'),
    "default": ("standard", "", ""),
}
"""Suite, code before the environment, and its keywords; edits are measured with the last one."""

EDITED = ("kernels/task/reward_and_endings.py", "kernels/filter/predict.py")
"""Sources to which a constant is added, one after the other."""


def seconds_of(folder: Path, before: str, options: str, after: str = "") -> float:
    """Duration of a new process with the copy of the package in a folder [s]."""
    code = CIRCLE.format(before=before, envs=ENVS, options=options, after=after)
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    environment.pop("NUMBA_CACHE_DIR", None)  # the cache is beside the kernels
    environment["QUAD_GYM_KERNELS"] = "numba"
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        check=True,
    )
    return float(done.stdout)


def empty_cache(package: Path) -> None:
    """Delete all compiled code."""
    for file in package.rglob("*.code"):
        file.unlink()


def time_compile(scope: Scope) -> list[benchmark.Row]:
    """Time the first reset with an empty and a full cache, and a step after an edit.

    With `scope.quick`, only the fastest configuration and one edit are measured.
    """
    quick, rows = scope.quick, list[benchmark.Row]()

    def add(name: str, cache: str, suite: str | None, seconds: float) -> None:
        print(f"  {name}, {cache}: {seconds:.1f} s", file=sys.stderr, flush=True)
        rows.append({"name": name, "cache": cache, "suite": suite, "seconds": seconds})

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        package = folder / PACKAGE.name
        shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
        compileall.compile_dir(package, quiet=1)  # as an installation does
        for what in ("truth",) if quick else CONFIGURATIONS:
            suite, before, options = CONFIGURATIONS[what]
            empty_cache(package)
            add(what, "empty", suite, seconds_of(folder, before, options))
            warm = [seconds_of(folder, before, options) for _ in range(1 if quick else 3)]
            add(what, "full", suite, min(warm))
        # the cache now holds the last configuration, which flies on
        for source in EDITED[: 1 if quick else None]:
            with (package / source).open("a", encoding="utf-8") as file:
                file.write("\n_EDITED = 1.0\n")
            step = seconds_of(folder, before, options, "env.step(env.action_space.sample())")
            add(f"first step after an edit of {source}", "edit", suite, step)
    return rows


SECTION = benchmark.Section(
    time_compile,
    {
        f"A new process with {ENVS:,} flights of the circle": {
            "up to the first reset": benchmark.NAME,
            "suite": lambda row: row["suite"] or "-",
            "cache": benchmark.column("cache"),
            "s": benchmark.column("seconds", ".1f"),
        }
    },
)

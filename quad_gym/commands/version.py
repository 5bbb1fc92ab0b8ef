"""Print the version, and with --report what a bug report needs.

    quad-gym version --report

The report names the machine, the versions of quad_gym and of the packages that it uses, lanes and
precision of flights, where compiled kernels come from, and variables of the environment that
quad_gym reads. It contains no name of a user or machine, except in names of folders.
"""

import importlib.metadata
import os
import platform
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import quad_gym
from quad_gym.records.sizes import PRECISION, WIDTH

PACKAGES = (
    "numpy",
    "scipy",
    "gymnasium",
    "numba",
    "llvmlite",
    "tyro",
    "torch",
    "stable_baselines3",
    "sb3_contrib",
    "matplotlib",
    "pygame-ce",
    "pyulog",
    "pymavlink",
    "rosbags",
    "onnx",
    "onnxruntime",
    "cuda-core",
)
"""Packages of the report; missing ones are left out."""
_VARIABLES = ("QUAD_GYM_", "NUMBA_", "PYTHONPATH", "PYTHONOPTIMIZE")


@dataclass(frozen=True)
class VersionArgs:
    """Options of the version."""

    report: bool = False
    """describe machine, versions, lanes, precision and caches, for a bug report"""


def main(args: VersionArgs) -> None:
    """Print the version, and the precision of the flights of this process."""
    print(quad_gym.__version__ + ("" if PRECISION == "double" else f" ({PRECISION} precision)"))
    if args.report:
        for name, text in report():
            print(f"{name:<10} {text}")


def report() -> Iterator[tuple[str, str]]:
    """Yield the lines of the report, a name and a text each."""
    from quad_gym.commands.benchmark import processor

    found = processor()
    instructions = " ".join(found.get("vector_instructions", ())) or "unknown instructions"
    yield "package", f"{quad_gym.__version__}{_commit()} in {Path(quad_gym.__file__).parent}"
    yield "Python", f"{platform.python_implementation()} {platform.python_version()}"
    libc = " ".join(part for part in platform.libc_ver() if part)
    yield "system", f"{platform.platform()} {libc}".strip()
    yield "processor", f"{found['model'] or found['machine']}, {found['cores']} cores available"
    yield "", instructions
    yield "flights", f"{PRECISION} precision, {WIDTH} lanes"
    for line in _kernels():
        yield "kernels", line
    yield "packages", ", ".join(_versions())
    given = {k: v for k, v in sorted(os.environ.items()) if k.startswith(_VARIABLES)}
    yield "variables", ", ".join(f"{k}={v}" for k, v in given.items()) or "none"


def _commit() -> str:
    """Commit of a clone, with a plus sign if files were changed; nothing for installed packages."""
    root = Path(quad_gym.__file__).parents[1]
    if not (root / ".git").exists():
        return ""
    command = ["git", "-C", str(root), "describe", "--always", "--dirty=+", "--abbrev=12"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=10.0)
    except (OSError, subprocess.SubprocessError):
        return ""
    return f" at {done.stdout.strip()}" if done.returncode == 0 else ""


def _kernels() -> Iterator[str]:
    """Yield where compiled kernels come from."""
    from quad_gym.kernels.library import library

    try:
        found = library()
    except (ImportError, ValueError) as error:
        yield f"none: {error}"
        return
    if found is not None:
        yield f"library {found.file}"
        return
    from quad_gym.commands.compile import names_of_kinds
    from quad_gym.kernels.compiling.cache import where_cached
    from quad_gym.kernels.compiling.workers import dispatcher_of

    dispatchers = [dispatcher_of(name) for name in names_of_kinds(("all",))]
    cached = sum(dispatcher.is_cached() for dispatcher in dispatchers)
    yield f"compiled by Numba: {cached} of {len(dispatchers)} in the cache"
    where = where_cached(*(dispatcher._cache.folder for dispatcher in dispatchers))
    yield where.removeprefix("once; ")


def _versions() -> Iterator[str]:
    """Yield name and version of each package that is installed."""
    for name in PACKAGES:
        try:
            yield f"{name} {importlib.metadata.version(name)}"
        except importlib.metadata.PackageNotFoundError:
            continue

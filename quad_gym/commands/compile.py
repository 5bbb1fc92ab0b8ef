"""Compile the kernels into the cache before their first use.

Environments compile the parts that they use at their first reset, each part once: about 15 s on two
fast cores for the default environment, and further parts for other tasks, sensors and options. This
command compiles all of them, which takes two to three times as long. A container or a CI job that
does so beforehand starts at once:

    RUN quad-gym compile                     # in a Dockerfile: everything
    quad-gym compile --stages truth          # training on the true state: seconds
    quad-gym compile --stages plain single
    NUMBA_CACHE_DIR=/cache quad-gym compile  # set it for the environments, too

Functions that are in the cache are not compiled again. Cached code is valid only for the same
processor, versions of Python and Numba, and sources; otherwise it is compiled again on first use.

`--library` instead builds the libraries of compiled kernels, with which nothing is compiled and
Numba is not even imported, for each number of lanes that processors like this one have, or those of
another `--family`. It takes minutes, and a C compiler. Libraries belong to the sources; after an
edit, Numba compiles again. `--ptx` emits the modules for NVIDIA GPUs of the tasks with default
options, which wheels hold, too.

`--stage sensors.barometer:barometer` compiles one stage, while you write it, and says in a few
lines which kernel and line is wrong, and why.

The exit code is 1 if code cannot be written to the cache, or the stage does not compile.
"""

import itertools
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from quad_gym.commands.options import require_at_least, usage_errors
from quad_gym.kernels.library import library
from quad_gym.params import checks as check

Kind = Literal["plain", "truth", "single", "all"]


@dataclass(frozen=True)
class CompileArgs:
    """Options of the compilation."""

    stages: tuple[Kind, ...] = ("all",)
    """functions to compile: truth (for environments that observe the truth), plain (for default
    environments with sensors and filter), single (for single vehicles, such as
    UnscentedKalmanFilter), all (these, and every option of the environments)"""
    stage: str | None = None
    """a single stage, as MODULE:KERNEL of quad_gym.kernels"""
    jobs: int | None = None
    """number of processes that compile; defaults to one per core"""
    library: bool = False
    """build the libraries of compiled kernels"""
    ptx: bool = False
    """emit modules for NVIDIA GPUs"""
    lanes: tuple[int, ...] = ()
    """numbers of lanes of the libraries; defaults to all of the family of processors"""
    family: Literal["x86_64", "aarch64"] | None = None
    """family of processors of the libraries; defaults to this machine's; for another one, CC must
    name a compiler that links for it, such as aarch64-linux-gnu-gcc"""

    def __post_init__(self) -> None:
        """Check the numbers of stages and processes."""
        if not self.stages:
            raise ValueError("--stages must have at least one value, got none")
        require_at_least(self, jobs=1)
        if self.stage is not None and (self.library or self.ptx):
            raise ValueError(f"--stage must not come with --{'library' if self.library else 'ptx'}")
        if (self.lanes or self.family) and not self.library:
            name = "lanes" if self.lanes else "family"
            raise ValueError(f"--{name} must come with --library")


def names_of_kinds(kinds: Sequence[str]) -> list[str]:
    """Names of the compiled functions of some kinds, slowest to compile first."""
    from quad_gym.envs.config import EnvConfig
    from quad_gym.envs.flights import Flights
    from quad_gym.kernels.entries import (
        FILTER_ENTRIES,
        FILTER_STAGES,
        SENSORS_AND_VEHICLE,
        names_of,
    )
    from quad_gym.kernels.stages import SOURCES, STAGES_OF, needed_stages
    from quad_gym.records import Autoreset

    needed: set[str] = set()
    for kind, observation in (("plain", "estimate"), ("truth", "truth")):
        if kind in kinds:
            flights = Flights(EnvConfig.of({"observation": observation}), 1, Autoreset.NEXT_STEP)
            needed |= set(needed_stages(flights.batch._settings[0]).values())
    if "all" in kinds:
        needed = {source.name for source in SOURCES}
    names = names_of(needed) if needed else []
    if {"single", "all"} & set(kinds):
        stages = {*FILTER_STAGES, *(stage for stages in STAGES_OF.values() for stage in stages)}
        filters = names_of({s.name for s in SOURCES if s.stage in stages}, FILTER_ENTRIES)
        names = [*filters, *names, *SENSORS_AND_VEHICLE]
    return list(dict.fromkeys(names))


def main(args: CompileArgs) -> int:
    """Compile, and list on stdout the functions compiled and found in the cache.

    Returns:
        Exit code.
    """
    with usage_errors((ValueError, RuntimeError, ImportError)):
        if args.stage is not None:
            return _compile_one(args.stage)
        found = None if args.library or args.ptx else library()
        if found is not None:
            print(f"nothing to compile: {found.file.name} has all functions")
            return 0
        check.package("numba", "compiling", "compile")
        if args.library or args.ptx:
            return _build(args)
    from quad_gym.kernels.compiling.cache import where_cached
    from quad_gym.kernels.compiling.workers import dispatcher_of, prepare

    names = names_of_kinds(args.stages)
    missing = [name for name in names if not dispatcher_of(name).is_cached()]
    began = time.monotonic()
    if missing:
        prepare(missing, args.jobs)
    for name in names:
        print(f"{'compiled' if name in missing else 'in cache'}  {name}")
    lost = [name for name in missing if not _is_kept(dispatcher_of(name))]
    folders = {dispatcher_of(name)._cache.folder for name in names}
    print(
        f"{len(missing)} of {len(names)} functions compiled in {time.monotonic() - began:.0f} s "
        f"({where_cached(*folders)})"
    )
    if lost:
        print(f"error: {len(lost)} of them could not be written to the cache", file=sys.stderr)
    return 1 if lost else 0


def _compile_one(name: str) -> int:
    """Compile one stage; report its first error on stderr."""
    check.package("numba", "compiling", "compile")
    from quad_gym.kernels.compiling.diagnosis import StageError, compile_one

    try:
        print(f"compiled  {compile_one(name)}")
    except StageError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def _build(args: CompileArgs) -> int:
    """Build the libraries or the modules for GPUs, and list them with their sizes."""
    from quad_gym.device import pack
    from quad_gym.kernels.compiling.building import build

    libraries = build(args.lanes, args.jobs, args.family) if args.library else ()
    modules = pack(_default_plans()) if args.ptx else ()
    for file in itertools.chain(libraries, modules):
        print(f"{file.stat().st_size / 1e3:,.0f} kB  {file}")
    return 0


def _default_plans() -> Iterator[Any]:
    """Yield the plans of the tasks with default options, on the truth and on the estimate."""
    from quad_gym.device import plan_of
    from quad_gym.envs.config import TASK_DEFAULTS, EnvConfig
    from quad_gym.envs.flights import Flights
    from quad_gym.records import Autoreset

    for task in TASK_DEFAULTS:
        for observation in ("truth", "estimate"):
            flights = Flights(
                EnvConfig.of({"observation": observation}, task), 1, Autoreset.NEXT_STEP
            )
            yield plan_of(flights.batch)


def _is_kept(dispatcher: Any) -> bool:
    """True if the code is on disk."""
    return bool(dispatcher._cache.holds(dispatcher.signature, dispatcher.targetctx))

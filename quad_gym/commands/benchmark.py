"""Measure the speed of flights on this machine: environments, and a tick with each sensor suite.

    quad-gym benchmark
    quad-gym benchmark --only interfaces --n-envs 256

A time is the best of several repeats, because other load on the machine can only increase it. The
column "spread" is the excess of the median. The suites take a minute. Progress goes to stderr,
tables go to stdout, and everything goes to benchmark.json with the configuration, the versions and
the processor. Run it on an idle machine.
"""

import dataclasses
import itertools
import platform
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

import quad_gym
from quad_gym import sensor_suite
from quad_gym.analysis.reports import require_writable, text_table, versions, write_json
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.commands.options import require_at_least, usage_errors
from quad_gym.envs.config import DEFAULTS, TASK_DEFAULTS
from quad_gym.kernels.library import available_cores
from quad_gym.records import Source

# --------------------------------------------------------------------------------------------------
# Sections of the benchmark: timing by the best of several repeats, and tables of the results.
# --------------------------------------------------------------------------------------------------


class Effort(NamedTuple):
    """Number and length of the repeats."""

    repeats: int
    seconds: float  #: length of a repeat [s]


@dataclass(frozen=True, kw_only=True)
class Scope:
    """Extent of the measurements."""

    envs: int
    """Number of environments in batches of interfaces, and of flights in batches of suites"""
    threads: int
    """Largest number of threads"""
    effort: Effort


class Timing(NamedTuple):
    """Duration of a piece of work."""

    best: float  #: fastest repeat [s]
    spread: float  #: ratio of the median of the repeats to the best, minus one

    def per(self, count: int) -> "Timing":
        """Duration of one of `count` equal parts."""
        return Timing(self.best / count, self.spread)


Row = dict[str, Any]  #: result of a section, for the table and the file


def measure(
    work: Callable[[], Any], effort: Effort, before: Callable[[], Any] = lambda: None
) -> Timing:
    """Time a call: the best of some repeats, each of as many calls as fit in its length.

    Args:
        work: Function to time.
        effort: Repeats and their length.
        before: Function called before every repeat, not timed.
    """
    before()
    work()
    began = time.perf_counter()
    work()
    calls = max(1, round(effort.seconds / (time.perf_counter() - began)))
    times = []
    for _ in range(effort.repeats):
        before()
        times.append(lasting(work, calls))
    return _timing(times)


def by_turns(jobs: Iterable[Callable[[], float]], turns: int) -> list[Timing]:
    """Time several jobs in alternation, so that other load on the machine affects all of them.

    Args:
        jobs: Functions that do their work and return its duration [s].
        turns: Number of turns of each job.
    """
    jobs = list(jobs)
    times = [[job() for job in jobs] for _ in range(turns)]
    return [_timing(own) for own in zip(*times, strict=True)]


def lasting(work: Callable[[], Any], calls: int) -> float:
    """Mean duration of several calls [s]."""
    began = time.perf_counter()
    for _ in range(calls):
        work()
    return (time.perf_counter() - began) / calls


def _timing(times: Sequence[float]) -> Timing:
    best = min(times)
    return Timing(best, statistics.median(times) / best - 1.0)


def report(name: str, timing: Timing, **more: Any) -> Row:
    """Make a row, and print it to stderr."""
    print(f"  {name}: {1e6 * timing.best:,.2f} us", file=sys.stderr, flush=True)
    return {"name": name, "seconds": timing.best, "spread": timing.spread, **more}


CellText = Callable[[Row], str]  #: function that formats the cell of a row in one column


def column(key: str, form: str = "", scale: float = 1) -> CellText:
    """Column of texts, or of numbers multiplied by a scale; a dash for None."""

    def cell(row: Row) -> str:
        value = row[key]
        return "-" if value is None else format(scale * value if form else value, form)

    return cell


def percent(key: str) -> CellText:
    """Column of shares, in percent; a dash for None."""
    return lambda row: "-" if row[key] is None else f"{100.0 * row[key]:.1f} %"


def per_second(row: Row) -> str:
    """Number of repetitions per second."""
    return f"{1.0 / row['seconds']:,.0f}"


NAME, SPREAD = column("name"), percent("spread")


@dataclass(frozen=True)
class Section:
    """Section of the benchmark."""

    measure: Callable[[Any], list[Row]]
    groups: Mapping[str, Mapping[str, CellText]]
    """Columns of the table by heading, in groups by heading"""
    summary: Callable[[list[Row]], str] = lambda rows: ""
    """Function that returns the text below the table"""

    def table(self, rows: list[Row]) -> str:
        """Format rows for the screen."""
        columns = [cell for group in self.groups.values() for cell in group.values()]
        headings = {heading: list(group) for heading, group in self.groups.items()}
        cells = [[cell(row) for cell in columns] for row in rows]
        return text_table(headings, cells) + self.summary(rows)


def processor() -> dict[str, Any]:
    """Name and vector instructions of the processor, as far as the system reports them."""
    found: dict[str, Any] = {"machine": platform.machine(), "cores": available_cores()}
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return found | {"model": platform.processor()}
    fields: dict[str, str] = {}
    for line in lines:
        name, _, value = line.partition(":")
        fields.setdefault(name.strip(), value.strip())
    flags = fields.get("flags", fields.get("Features", "")).split()
    vector = [flag for flag in flags if flag.startswith(("avx", "fma", "sse4", "asimd", "sve"))]
    return found | {"model": fields.get("model name", ""), "vector_instructions": vector}


# --------------------------------------------------------------------------------------------------
# Steps per second of all interfaces.
# --------------------------------------------------------------------------------------------------

SLOW = sensor_suite("standard").with_rates(gnss=10.0, camera=25.0)
"""Sensors at low rates; 30 Hz does not divide 200 Hz."""


def random_actions(count: int) -> Iterator[NDArray[np.float32]]:
    """Random actions around hover with a standard deviation of 0.05, repeated after sixteen."""
    rng = np.random.default_rng(0)
    draws = np.clip(rng.normal(0.0, 0.05, (16, count, 4)), -1.0, 1.0).astype(np.float32)
    return itertools.cycle(list(draws))


def time_batch(interface: str, count: int, effort: Effort, threads: int, **options: Any) -> Row:
    """Time steps of many flights with the interface "vector" (Gymnasium) or "sb3"."""
    options.update(threads=threads)
    env: Any
    if interface == "sb3":
        env = quad_gym.make_sb3_vec_env("QuadGym/Hover-v0", n_envs=count, seed=0, **options)
        batch = env.flights.batch
        env.reset()
    else:
        env = gymnasium.make_vec("QuadGym/Hover-v0", num_envs=count, **options)
        batch = env.unwrapped.flights.batch
        env.reset(seed=0)
    actions, steps = random_actions(count), 0
    began = batch.record("episode").sum()

    def step() -> None:
        nonlocal steps
        env.step(next(actions))
        steps += count

    timed = measure(step, effort).per(count)
    resets = float((batch.record("episode").sum() - began) / steps)
    env.close()
    return _row(interface, count, threads, timed, resets, options)


def time_single(effort: Effort, **options: Any) -> Row:
    """Time steps of one flight made by `gymnasium.make`, including its wrappers."""
    env = gymnasium.make("QuadGym/Hover-v0", **options)
    actions = [action[0] for action in itertools.islice(random_actions(1), 16)]
    return _row("single", 1, 1, *time_env(env, itertools.cycle(actions), effort), options)


def time_env(env: Any, actions: Iterator[Any], effort: Effort) -> tuple[Timing, float]:
    """Time steps of a single environment, and count the share of steps that end an episode."""
    steps, resets = 0, 0

    def some_steps() -> None:
        nonlocal steps, resets
        for _ in range(50):
            _, _, terminated, truncated, _ = env.step(next(actions))
            steps += 1
            if terminated or truncated:
                resets += 1
                env.reset()

    env.reset(seed=0)
    timed = measure(some_steps, effort).per(50)
    env.close()
    return timed, resets / steps


def _row(
    interface: str,
    count: int,
    threads: int,
    timed: Timing,
    resets: float,
    options: dict[str, Any],
) -> Row:
    """Row of an interface of this package."""
    names = ("observation", "control_rate", "sensors")
    observation, rate, suite = (options.get(name, DEFAULTS[name]) for name in names)
    suite = "standard, GNSS 10 Hz, camera 25 Hz" if suite is SLOW else suite
    return report(
        f"{interface}, {observation}, {rate:g} Hz, {suite}",
        timed,
        interface=interface,
        envs=count,
        threads=threads,
        reset_share=resets,
        suite=suite,
        options=options | {"sensors": suite},
    )


def time_others(envs: int, effort: Effort) -> list[Row]:
    """Time Gymnasium's pendulum and cart-pole, which have neither sensors nor a filter."""
    alike: dict[str, Any] = {"threads": 1, "suite": None, "options": {}}
    rest = itertools.repeat(np.zeros(1, np.float32))
    timed, resets = time_env(gymnasium.make("Pendulum-v1"), rest, effort)
    what = {"interface": "single", "envs": 1, "reset_share": resets}
    rows = [report("Pendulum-v1", timed, **what, **alike)]
    for env_id, mode, actions in (
        ("Pendulum-v1", "sync", np.zeros((envs, 1), np.float32)),
        ("CartPole-v1", "vector_entry_point", np.zeros(envs, np.int64)),
    ):
        many: Any = gymnasium.make_vec(env_id, envs, vectorization_mode=mode)
        many.reset(seed=0)
        timed = measure(partial(many.step, actions), effort).per(envs)
        what = {"interface": mode, "envs": envs, "reset_share": None}
        rows.append(report(f"{env_id}, {mode}", timed, **what, **alike))
        many.close()
    return rows


def time_interfaces(scope: Scope) -> list[Row]:
    """Time steps of all interfaces with random actions."""
    envs, cores, effort = scope.envs, scope.threads, scope.effort
    rows: list[Row] = []
    for rate in (200, 50):
        for observation in ("estimate", "truth", "noisy", "measurements"):
            what = {"observation": observation, "control_rate": rate}
            for threads in dict.fromkeys((1, cores)):
                rows.append(time_batch("vector", envs, effort, threads, **what))
            try:
                rows.append(time_batch("sb3", envs, effort, cores, **what))
            except ImportError as error:
                print(f"  sb3: {error}", file=sys.stderr)
            rows.append(time_single(effort, **what))
        for sensors in (SLOW, "lab", "rtk"):
            more = {"control_rate": rate, "sensors": sensors}
            rows.append(time_batch("vector", envs, effort, cores, **more))
            rows.append(time_single(effort, **more))
    for count in (1, 8, 64, 256, 1024, 4096):
        rows.append(time_batch("vector", count, effort, cores, control_rate=50))
    return rows + time_others(envs, effort)


INTERFACE_SECTION = Section(
    time_interfaces,
    {
        "Random actions around hover": {
            "interface, observation, control, suite": NAME,
            "envs": column("envs", ","),
            "threads": column("threads"),
            "steps/s": per_second,
            "spread": SPREAD,
            "resets": percent("reset_share"),
        }
    },
)


# --------------------------------------------------------------------------------------------------
# A tick with each sensor suite, by number of flights and threads.
# --------------------------------------------------------------------------------------------------

SUITES = ("standard", "rtk", "consumer", "indoor", "field", "crazyflie")
TRUTH = "truth"  #: row of flights without sensors and filter
MANY = 64  #: ratio of the large to the small number of flights


def hovering(count: int, threads: int = 1, **options: Any) -> FlightBatch:
    """Batch that hovers by PD control, half a second after its start."""
    task = TASK_DEFAULTS["hover"].replace(duration=0.0)
    batch = FlightBatch(count, task=task, gains="tuned", threads=threads, **options)
    batch.reset(seeds=range(count))
    for _ in range(round(0.5 * batch.clocks.control_rate)):
        batch.step()
    return batch


def flying(count: int, threads: int, suite: str) -> FlightBatch:
    """Batch that hovers at 50 Hz with a suite, or on the true state."""
    source = Source.TRUTH if suite == TRUTH else Source.ESTIMATE
    sensors = "standard" if suite == TRUTH else suite
    return hovering(count, threads, sensors=sensors, source=source, control_rate=50.0)


def ticks_of(batch: FlightBatch) -> int:
    """Number of ticks of all flights in a step."""
    return batch.count * batch.clocks.ticks_per_step


def time_suites(scope: Scope) -> list[Row]:
    """Time a tick with each suite, with one thread and with all."""
    rows = list[Row]()
    for count in (scope.envs, MANY * scope.envs):
        for threads in dict.fromkeys((1, scope.threads)):
            found = list[Row]()
            for suite in (*SUITES, TRUTH):
                batch = flying(count, threads, suite)
                timed = measure(batch.step, scope.effort).per(ticks_of(batch))
                what = {"suite": suite, "flights": count, "threads": threads}
                name = f"{suite}, {count} flights, {threads} threads"
                found.append(report(name, timed, **what))
            rows += [row | {"speed": found[0]["seconds"] / row["seconds"]} for row in found]
    few = {(row["suite"], row["threads"]): row["seconds"] for row in rows[: len(rows) // 2]}
    return [row | {"times_few": row["seconds"] / few[row["suite"], row["threads"]]} for row in rows]


SUITE_SECTION = Section(
    time_suites,
    {
        "One flight's tick at 50 Hz, by sensor suite": {
            "suite": column("suite"),
            "flights": column("flights", ","),
            "threads": column("threads"),
            "us": column("seconds", ".3f", 1e6),
            "spread": SPREAD,
            "x speed of standard": column("speed", ".2f"),
            "x few flights": column("times_few", ".2f"),
        }
    },
)


# --------------------------------------------------------------------------------------------------
# Measure the speed of flights on this machine: environments, and a tick with each sensor suite.
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class BenchmarkArgs:
    """Options of the benchmark."""

    only: Literal["all", "interfaces", "suites"] = "all"
    """section to run"""
    n_envs: int = 1024
    """number of environments in the batches of interfaces, of flights in suites"""
    threads: int | None = None
    """largest number of threads; defaults to one per core"""
    quick: bool = False
    """two short repeats of each measurement, to check that it runs"""
    output: Path = Path("results/benchmark")
    """folder for benchmark.json; an earlier one there is replaced"""

    def __post_init__(self) -> None:
        """Check the numbers."""
        require_at_least(self, n_envs=1, threads=1)

    @property
    def extent(self) -> dict[str, Any]:
        """Fields of the `Scope`."""
        threads = available_cores() if self.threads is None else self.threads
        effort = Effort(2, 0.01) if self.quick else Effort(7, 0.3)
        return {"envs": self.n_envs, "threads": threads, "effort": effort}


SECTIONS = {"interfaces": INTERFACE_SECTION, "suites": SUITE_SECTION}


def main(args: BenchmarkArgs) -> None:
    """Run the chosen sections."""
    names = list(SECTIONS) if args.only == "all" else [args.only]
    with usage_errors():
        require_writable("--output", args.output)
    run_sections({name: SECTIONS[name] for name in names}, Scope(**args.extent), args)


def run_sections(sections: Mapping[str, Section], scope: Scope, args: BenchmarkArgs) -> None:
    """Run sections, print their tables, and write benchmark.json."""
    cpu = processor()
    print(f"{cpu['model']}, {cpu['cores']} cores for this process.\n")
    rows: dict[str, list[Row]] = {}
    for name, section in sections.items():
        print(f"{name}:", file=sys.stderr, flush=True)
        rows[name] = section.measure(scope)
        print(section.table(rows[name]), end="\n\n", flush=True)
    found = {
        "sections": rows,
        "configuration": dataclasses.asdict(args),
        "processor": cpu,
        "versions": versions("numpy", "numba", "gymnasium", "stable-baselines3", "filterpy"),
    }
    print(f"Wrote {write_json(args.output / 'benchmark.json', found)}.")

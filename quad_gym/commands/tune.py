"""Tune the gains of PD control on its observations: the estimate or the truth, with any sensors.

    quad-gym tune                                         # all tracking tasks
    quad-gym tune --env-ids circle --sensors consumer
    quad-gym evaluate QuadGym/Circle-v0 --policy pd pd:results/tune/gains.json

Differential evolution (scipy.optimize) searches gains between a third of the initial gains and
three times these, for the smallest true position error: for each task relative to the initial
gains, then the geometric mean over the tasks, where a crash counts as a large error. Every
candidate flies the same episodes. At the end, the best gains and the initial gains fly new
episodes. Prints both, and writes gains.json and search.csv.
"""

import math
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import gymnasium
import numpy as np
from numpy.typing import NDArray
from tyro.conf import arg

from baselines.pd import PDPolicy
from baselines.seeds import first_seed
from quad_gym import PDGains, pd_gains
from quad_gym.analysis.intervals import in_brackets, paired_difference
from quad_gym.analysis.reports import (
    columns_of,
    require_writable,
    text_table,
    versions,
    write_csv,
    write_json,
)
from quad_gym.commands.options import (
    TRACKING,
    Keywords,
    SuiteName,
    Threads,
    flying_options,
    full_id,
    known_id,
    leave,
    one_of,
    refuse_overwriting,
    require_at_least,
    usage_errors,
)
from quad_gym.evaluation import roll_out

Floats = NDArray[np.float64]

CRASH_FACTOR = 10.0
"""An episode that crashed counts as this many times the error at the start."""
RANGE = 3.0
"""Gains are searched from 1 / RANGE to RANGE times those at the start."""
POPULATION = 8
"""Candidates of a generation, for each gain."""


@dataclass(frozen=True)
class TuneArgs:
    """Options of the search."""

    env_ids: Annotated[
        tuple[str, ...],
        arg(help=f"{one_of(TRACKING)}; if not given, all of them", help_behavior_hint=""),
    ] = TRACKING
    observation: Literal["estimate", "truth", "noisy"] = "estimate"
    """observation of the controller"""
    sensors: SuiteName = "standard"
    env: Keywords = field(default_factory=dict)
    """further keywords of the environment, such as action=wrench control_rate=200"""
    gains: Literal["lab", "tuned"] = "lab"
    """gains to start from"""
    candidates: int = 400
    """gains to fly, those at the start among them"""
    episodes: int = 32
    """that each candidate flies on each task"""
    fresh_episodes: int = 500
    """flown at the end, with seeds that the search never saw"""
    seed: int = 0
    """of the search, whose episodes follow from it, and of the first fresh episode"""
    threads: Threads = None
    output: Path = Path("results/tune")
    """folder for gains and numbers"""
    overwrite: bool = False
    """replace the gains in the folder, if there are any"""


@dataclass(frozen=True)
class Knobs:
    """Gains to search, as logarithms of factors on the initial gains."""

    start: PDGains
    torques: bool
    """True if Kd has a separate effect; with commands of rates or tilt, only K / Kd has one"""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the searched gains."""
        names = ("position", "velocity", "attitude, tilt", "attitude, yaw")
        return (*names, "body rates, tilt", "body rates, yaw") if self.torques else names

    def gains(self, x: Floats) -> PDGains:
        """The gains at a point of the search."""
        f = np.exp(np.concatenate([x, np.zeros(6 - len(x))]))
        tilt_yaw = np.array([f[2], f[2], f[3]]), np.array([f[4], f[4], f[5]])
        return PDGains(
            position=f[0] * self.start.position,
            velocity=f[1] * self.start.velocity,
            attitude=tuple(tilt_yaw[0] * self.start.attitude),
            body_rates=tuple(tilt_yaw[1] * self.start.body_rates),
        )


@dataclass
class Search:
    """Evaluation of candidates, and its history."""

    envs: dict[str, Any]
    knobs: Knobs
    first_seed: int
    """of the episodes that every candidate flies"""
    rows: list[dict[str, Any]] = field(default_factory=list)
    flown: list[PDGains] = field(default_factory=list)
    """the gains of each row"""
    yardstick: dict[str, float] = field(default_factory=dict)
    """mean error of each task with the gains at the start [m]"""

    def cost(self, x: Floats) -> float:
        """Logarithm of the mean error relative to that at the start, mean over tasks."""
        gains = self.knobs.gains(np.asarray(x))
        logs = []
        for env_id, env in self.envs.items():
            episodes = roll_out(PDPolicy(env, gains=gains), env, seed=self.first_seed)
            fine = np.where(episodes.crashed, np.nan, episodes.mean_error)
            if env_id not in self.yardstick:  # the first candidate is the start itself
                if episodes.crashed.all():
                    raise ValueError(
                        f"every episode of {env_id} crashes with the gains at the start"
                    )
                self.yardstick[env_id] = float(np.nanmean(fine))
            scale = self.yardstick[env_id]
            logs.append(
                math.log(float(np.nan_to_num(fine, nan=CRASH_FACTOR * scale).mean() / scale))
            )
        cost = float(np.mean(logs))
        self.rows.append({"relative_error": math.exp(cost), **_flat(gains)})
        self.flown.append(gains)
        return cost

    @property
    def best(self) -> PDGains:
        """The gains with the smallest error so far."""
        return min(zip(self.rows, self.flown, strict=True), key=_error_of_row)[1]


def _error_of_row(candidate: tuple[dict[str, Any], PDGains]) -> float:
    return float(candidate[0]["relative_error"])


class _AllFlownError(Exception):
    """As many candidates as were asked for."""


def _flat(gains: PDGains) -> dict[str, float]:
    names = {"attitude": gains.attitude, "body_rates": gains.body_rates}
    return {
        "position": gains.position,
        "velocity": gains.velocity,
        **{
            f"{name}_{axis}": v
            for name, k in names.items()
            for axis, v in zip("xyz", k, strict=True)
        },
    }


def make_envs(args: TuneArgs, episodes: int) -> dict[str, Any]:
    """The environment of each task."""
    return {
        env_id: gymnasium.make_vec(
            env_id,
            num_envs=episodes,
            observation=args.observation,
            sensors=args.sensors,
            threads=args.threads,
            **args.env,
        )
        for env_id in map(full_id, args.env_ids)
    }


def configure(args: TuneArgs) -> Search:
    """Check all options before anything flies."""
    for env_id in args.env_ids:
        known_id("--env-ids", env_id, TRACKING)
    require_at_least(args, candidates=1, episodes=1, fresh_episodes=2, seed=0, threads=1)
    names = ("observation", "sensors", "threads")
    leave(args.env, {name: f"--{name}" for name in names})
    refuse_overwriting(args.output / "gains.json", args.overwrite)
    envs = make_envs(args, args.episodes)
    for env in envs.values():
        PDPolicy(env, gains=args.gains)  # refuses actions and layouts that do not admit it
    require_writable("--output", args.output)
    torques = args.env.get("action") in ("motor", "wrench")
    first = first_seed("training", args.seed, args.episodes)
    first_seed("test", args.seed, args.fresh_episodes)  # refuses too large seeds before the search
    return Search(envs, Knobs(pd_gains(args.gains), torques), first)


def search(args: TuneArgs, found: Search) -> PDGains:
    """The best gains that differential evolution finds with `--candidates` of them."""
    from scipy.optimize import differential_evolution
    from tqdm import tqdm

    n = len(found.knobs.names)
    at_start = found.cost(np.zeros(n))  # the yardstick
    with tqdm(total=args.candidates, initial=1, desc="tuning", unit=" candidates") as bar:

        def cost(x: Floats) -> float:
            if not x.any():
                return at_start
            if len(found.rows) == args.candidates:
                raise _AllFlownError
            value = found.cost(x)
            bar.update()
            bar.set_postfix(error=f"{min(row['relative_error'] for row in found.rows):.1%}")
            return value

        with suppress(_AllFlownError):
            differential_evolution(
                cost,
                [(-math.log(RANGE), math.log(RANGE))] * n,
                x0=np.zeros(n),
                popsize=POPULATION,
                maxiter=args.candidates,
                rng=args.seed,
                polish=False,
                tol=0.0,
            )
    return found.best


def judge(args: TuneArgs, gains: dict[str, PDGains]) -> tuple[str, dict[str, Any]]:
    """Fly gains on fresh episodes: a table, and the numbers."""
    first = first_seed("test", args.seed, args.fresh_episodes)
    rows, numbers = [], {}
    for env_id, env in make_envs(args, args.fresh_episodes).items():
        flown = {k: roll_out(PDPolicy(env, gains=g), env, seed=first) for k, g in gains.items()}
        start, tuned = flown.values()
        both = ~(start.crashed | tuned.crashed)
        change = paired_difference(tuned.mean_error[both], start.mean_error[both])
        row = [env_id]
        for episodes in (start, tuned):
            row += [f"{1e3 * episodes.mean_error.mean():.1f}", f"{episodes.crashed.mean():.1%}"]
        row.append(in_brackets(change.spread.mean, change.interval, "+.1f", 1e3))
        rows.append(row)
        numbers[env_id] = {name: episodes.summary() for name, episodes in flown.items()}
    cells = ["error [mm]", "crashed"]
    groups = {"": ["task"], **{name: list(cells) for name in gains}, "change": ["[mm]"]}
    return text_table(groups, rows), numbers


def main(args: TuneArgs) -> None:
    """Tune."""
    began = time.perf_counter()
    with usage_errors():
        found = configure(args)
    tuned = search(args, found)
    start = f"gains at the start ({args.gains})"
    text, numbers = judge(args, {start: found.knobs.start, "tuned gains": tuned})
    print(
        f"\nPD on the {args.observation}, sensors {args.sensors}; "
        f"{args.fresh_episodes:,} fresh episodes of each task.\n\n{text}\n"
        "Change: mean over pairs of episodes that did not crash, with its 95 % interval\n"
        "(Student's t)."
    )
    print("\n" + "\n".join(f"{name:14} {value:.3g}" for name, value in _flat(tuned).items()))
    record = {
        "gains": tuned,
        "start": found.knobs.start,
        "candidates": len(found.rows),
        "fresh_episodes": numbers,
        "arguments": args,
        "versions": versions("numpy", "scipy", "numba"),
    }
    written = [
        write_json(args.output / "gains.json", record),
        write_csv(args.output / "search.csv", columns_of(found.rows)),
    ]
    seconds = time.perf_counter() - began
    print(f"\nWrote {len(written)} files to {args.output} after {seconds:.0f} s; fly them with")
    same = flying_options({"sensors": args.sensors, **args.env})
    print(f"quad-gym evaluate {full_id(args.env_ids[0])} --policy pd pd:{written[0]}{same}")

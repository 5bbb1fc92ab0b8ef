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
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import gymnasium
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm
from tyro.conf import arg

from baselines.pd import PDPolicy
from baselines.recipes import first_seed
from quad_gym import PDGains, pd_gains
from quad_gym.analysis.metrics import in_brackets, paired_difference
from quad_gym.analysis.reports import (
    columns_of,
    require_writable,
    text_table,
    versions,
    write_csv,
    write_json,
)
from quad_gym.commands import options
from quad_gym.evaluation import roll_out

# --------------------------------------------------------------------------------------------------
# Search for the gains of PD control, and test flights of the gains that were found.
# --------------------------------------------------------------------------------------------------

Floats = NDArray[np.float64]

CRASH_FACTOR = 10.0  #: error of an episode that crashed, relative to the initial error
RANGE = 3.0  #: gains are searched from 1 / RANGE to RANGE times the initial gains
POPULATION = 8  #: candidates of a generation, for each gain


class _AllFlownError(Exception):
    """All candidates have flown."""


class Search:
    """Search by differential evolution for the logarithms of factors on the initial gains.

    `torques` is True if Kd has a separate effect; with commands of rates or tilt, only K / Kd has.
    Every candidate flies the same episodes, from `seed` on.
    """

    def __init__(self, envs: Mapping[str, Any], start: PDGains, torques: bool, seed: int) -> None:
        self.start, self.rows = start, list[dict[str, float]]()
        self._envs, self._seed, self._size = envs, seed, 6 if torques else 4
        self._flown: list[PDGains] = []
        self._initial: dict[str, float] = {}
        """Mean error of each task with the initial gains [m]"""

    def gains(self, x: Floats) -> PDGains:
        """Gains at a point: position, velocity, attitude (tilt, yaw), body rates (tilt, yaw)."""
        f, start = np.exp(np.append(x, np.zeros(6 - len(x)))), self.start
        return PDGains(
            position=f[0] * start.position,
            velocity=f[1] * start.velocity,
            attitude=tuple(f[[2, 2, 3]] * start.attitude),
            body_rates=tuple(f[[4, 4, 5]] * start.body_rates),
        )

    def cost(self, x: Floats) -> float:
        """Logarithm of the mean error relative to the initial one, mean over tasks."""
        gains, logs = self.gains(np.asarray(x)), []
        for env_id, env in self._envs.items():
            episodes = roll_out(PDPolicy(env, gains=gains), env, seed=self._seed)
            errors = np.where(episodes.crashed, np.nan, episodes.mean_error)
            if env_id not in self._initial:  # the first candidate
                if episodes.crashed.all():
                    raise ValueError(f"every episode of {env_id} crashes with the initial gains")
                self._initial[env_id] = float(np.nanmean(errors))
            scale = self._initial[env_id]
            logs.append(math.log(np.nan_to_num(errors, nan=CRASH_FACTOR * scale).mean() / scale))
        cost = float(np.mean(logs))
        self.rows.append({"relative_error": math.exp(cost), **flat(gains)})
        self._flown.append(gains)
        return cost

    def run(self, candidates: int, seed: int) -> PDGains:
        """Fly a number of candidates; returns the gains with the smallest error."""
        from scipy.optimize import differential_evolution

        initial = self.cost(np.zeros(self._size))
        with tqdm(total=candidates, initial=1, desc="tuning", unit=" candidates") as bar:

            def cost(x: Floats) -> float:
                if not x.any():
                    return initial
                if len(self.rows) == candidates:
                    raise _AllFlownError
                value = self.cost(x)
                bar.update()
                bar.set_postfix(error=f"{min(row['relative_error'] for row in self.rows):.1%}")
                return value

            limits = [(-math.log(RANGE), math.log(RANGE))] * self._size
            options = {"popsize": POPULATION, "maxiter": candidates, "polish": False, "tol": 0.0}
            with suppress(_AllFlownError):
                differential_evolution(cost, limits, x0=np.zeros(self._size), rng=seed, **options)
        return self._flown[int(np.argmin([row["relative_error"] for row in self.rows]))]


def flat(gains: PDGains) -> dict[str, float]:
    """Gains by name, with the axes of vectors."""
    found = {"position": gains.position, "velocity": gains.velocity}
    for name in ("attitude", "body_rates"):
        found |= {f"{name}_{axis}": k for axis, k in zip("xyz", getattr(gains, name), strict=True)}
    return found


def compare_gains(
    envs: Mapping[str, Any], gains: Mapping[str, PDGains], seed: int
) -> tuple[str, dict[str, Any]]:
    """Fly two gains in new episodes; returns a table and the numbers."""
    rows, numbers = [], {}
    for env_id, env in envs.items():
        flown = {k: roll_out(PDPolicy(env, gains=g), env, seed=seed) for k, g in gains.items()}
        start, tuned = flown.values()
        change = paired_difference(tuned.mean_error, start.mean_error)
        row = [env_id]
        for episodes in (start, tuned):
            row += [f"{1e3 * episodes.mean_error.mean():.1f}", f"{episodes.crashed.mean():.1%}"]
        rows.append([*row, in_brackets(change.spread.mean, change.interval, "+.1f", 1e3)])
        numbers[env_id] = {name: episodes.summary() for name, episodes in flown.items()}
    groups = {name: ["error [mm]", "crashed"] for name in gains}
    return text_table({"": ["task"], **groups, "change": ["[mm]"]}, rows), numbers


# --------------------------------------------------------------------------------------------------
# Tune the gains of PD control on its observations: the estimate or the truth, with any sensors.
# --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TuneArgs:
    """Options of the search."""

    env_ids: Annotated[
        tuple[str, ...],
        arg(
            help=f"{options.one_of(options.TRACKING)}; defaults to all of them",
            help_behavior_hint="",
        ),
    ] = options.TRACKING
    observation: Literal["estimate", "truth", "noisy"] = options.OBSERVATION
    """observation of the controller"""
    sensors: options.SuiteName = options.SENSORS
    env: options.Keywords = field(default_factory=dict)
    """further keywords of the environment, such as action=wrench control_rate=200"""
    gains: Literal["lab", "tuned"] = "lab"
    """gains to start from"""
    candidates: int = 400
    """number of candidate gain sets, including the initial one"""
    episodes: int = 32
    """number of episodes of each candidate on each task"""
    held_out_episodes: int = 500
    """number of episodes at the end, with seeds that the search does not use"""
    seed: int = 0
    """seed of the search, which determines its episodes, and of the first held-out episode"""
    threads: options.Threads = None
    output: Path = Path("results/tune")
    """folder for gains and numbers"""
    overwrite: bool = False
    """replace earlier gains in the folder"""


def make_envs(args: TuneArgs, episodes: int) -> dict[str, Any]:
    """Environment of each task."""
    keywords = options.environment_of(args)
    return {
        env_id: gymnasium.make_vec(env_id, num_envs=episodes, threads=args.threads, **keywords)
        for env_id in map(options.full_id, args.env_ids)
    }


def configure(args: TuneArgs) -> Search:
    """Check all options before the search."""
    for env_id in args.env_ids:
        options.known_id("--env-ids", env_id, options.TRACKING)
    options.require_at_least(args, candidates=1, episodes=1, held_out_episodes=2, seed=0, threads=1)
    options.refuse_overwriting(args.output / "gains.json", args.overwrite)
    first_seed("test", args.seed, args.held_out_episodes)  # rejects seeds that are too large
    envs = make_envs(args, args.episodes)
    for env in envs.values():
        PDPolicy(env, gains=args.gains)  # rejects actions and layouts that it does not support
    require_writable("--output", args.output)
    torques = args.env.get("action") in ("motor", "wrench")
    first = first_seed("training", args.seed, args.episodes)
    vehicle = next(iter(envs.values())).unwrapped.flights.batch.vehicle
    return Search(envs, pd_gains(args.gains, vehicle), torques, first)


def main(args: TuneArgs) -> None:
    """Tune."""
    began = time.perf_counter()
    with options.usage_errors():
        search = configure(args)
    tuned = search.run(args.candidates, args.seed)
    gains = {f"initial gains ({args.gains})": search.start, "tuned gains": tuned}
    seed = first_seed("test", args.seed, args.held_out_episodes)
    text, numbers = compare_gains(make_envs(args, args.held_out_episodes), gains, seed)
    print(
        f"\nPD on the {args.observation}, sensors {args.sensors}; "
        f"{args.held_out_episodes:,} held-out episodes of each task.\n\n{text}\n"
        "Change: mean over pairs of episodes that did not crash, with its 95 % interval\n"
        "(Student's t)."
    )
    print("\n" + "\n".join(f"{name:14} {value:.3g}" for name, value in flat(tuned).items()))
    record = {
        "gains": tuned,
        "start": search.start,
        "candidates": len(search.rows),
        "held_out_episodes": numbers,
        "arguments": args,
        "versions": versions("numpy", "scipy", "numba"),
    }
    gains_file = write_json(args.output / "gains.json", record)
    write_csv(args.output / "search.csv", columns_of(search.rows))
    seconds = time.perf_counter() - began
    print(f"\nWrote 2 files to {args.output} after {seconds:.0f} s; fly them with")
    same = options.flying_options({"sensors": args.sensors, **args.env})
    print(f"quad-gym evaluate {options.full_id(args.env_ids[0])} --policy pd pd:{gains_file}{same}")

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

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import gymnasium
from tyro.conf import arg

from baselines.pd import PDPolicy
from baselines.seeds import first_seed
from quad_gym import pd_gains
from quad_gym.analysis.reports import columns_of, require_writable, versions, write_csv, write_json
from quad_gym.commands import options
from quad_gym.experiments.tuning import Search, compare_gains, flat

SEPARATE = ("observation", "sensors", "threads")  #: keywords of environments with separate options


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
    observation: Literal["estimate", "truth", "noisy"] = "estimate"
    """observation of the controller"""
    sensors: options.SuiteName = "standard"
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
    given: dict[str, Any] = {name: getattr(args, name) for name in SEPARATE}
    return {
        env_id: gymnasium.make_vec(env_id, num_envs=episodes, **given, **args.env)
        for env_id in map(options.full_id, args.env_ids)
    }


def configure(args: TuneArgs) -> Search:
    """Check all options before the search."""
    for env_id in args.env_ids:
        options.known_id("--env-ids", env_id, options.TRACKING)
    options.require_at_least(args, candidates=1, episodes=1, held_out_episodes=2, seed=0, threads=1)
    options.leave(args.env, *SEPARATE)
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

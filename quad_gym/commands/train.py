"""Train a controller on a filter's estimate, on the true state, or on any other observation.

    quad-gym train QuadGym/Circle-v0
    quad-gym train QuadGym/Hover-v0 --algorithm sac --seed 3 --env observation=truth
    quad-gym train circle --engine compiled
    quad-gym train circle --resume

Hyperparameters for the task and the algorithm come from baselines/recipes.py. During training, the
policy is evaluated on the task by its true position error and saved: last.zip and best.zip (.npz
with --engine compiled), which quad-gym evaluate can fly. The folder also contains evaluations.csv,
training.json, with everything needed to repeat the run, and files for TensorBoard. An interrupted
run continues exactly from its last checkpoint with --resume.
"""

import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from quad_gym import IDS
from quad_gym.commands import options
from quad_gym.envs.config import env_option


@dataclass(frozen=True)
class TrainArgs:
    """Options of the training."""

    env_id: options.EnvId = "QuadGym/Circle-v0"
    algorithm: Literal["ppo", "recurrent_ppo", "sac", "td3", "tqc"] = "ppo"
    """reinforcement learning algorithm"""
    engine: options.Engine = "sb3"
    sensors: options.OwnSuite = None
    estimator: options.EstimatorName = None
    env: options.Keywords = field(default_factory=dict)
    """keywords of the environment, such as observation=truth action=motor camera=false"""
    steps: int | None = None
    """number of environment steps; defaults to the recipe's"""
    n_envs: int | None = None
    """number of parallel flights; defaults to the recipe's"""
    set: options.Parameters = field(default_factory=dict)
    seed: int = 0
    """seed of the networks, and of the flights in training and its evaluations; other seeds use
    different flights, and so does quad-gym evaluate"""

    output: Path | None = None
    """folder of the run; defaults to results/train/TASK/ALGORITHM_seed_SEED; ALGORITHM begins
    with compiled_ for the compiled engine"""
    resume: bool = False
    """resume the run in this folder, or start a new one"""
    evaluations: int = 20
    """number of evaluations and checkpoints during the run"""
    episodes: int = 100
    """number of episodes in each evaluation"""
    threads: options.Threads = None
    tensorboard: bool = True
    """write files for TensorBoard, if it is installed"""
    progress: bool = True
    """show a progress bar"""
    export: Path | None = None
    """also write the best policy to this .npz file, which requires only NumPy"""


def configure(args: TrainArgs) -> tuple[Any, Path]:
    """Check all options before training."""
    from baselines.recipes import Plan
    from baselines.training import require_model, run_in
    from quad_gym.analysis.reports import require_writable

    args = options.with_full_id(args)
    environment = options.environment_of(args)
    options.require_at_least(args, steps=1, n_envs=1, evaluations=1, episodes=1, threads=1, seed=0)
    same = ("env_id", "seed", "threads", "engine", "evaluations", "episodes")
    values = {name: getattr(args, name) for name in same}
    plan = Plan(environment=environment, recipe=options.recipe_of(args), **values)
    if args.export is not None and args.export.suffix != ".npz":
        raise ValueError(f"--export must end in .npz, got {args.export}")
    if args.export is not None and args.algorithm == "recurrent_ppo":
        raise ValueError("--export is not possible for a policy with memory (recurrent_ppo)")
    task = IDS[args.env_id]
    name = f"compiled_{args.algorithm}" if args.engine == "compiled" else args.algorithm
    folder = args.output or Path("results/train") / task / f"{name}_seed_{args.seed}"
    run_in(folder, plan, resume=args.resume)
    plan.make_judge().close()
    require_model(plan)
    require_writable("--output", folder)
    if args.export is not None:
        require_writable("--export", args.export.parent)
    return plan, folder


def main(args: TrainArgs) -> None:
    """Train."""
    from_start = time.perf_counter()
    with options.usage_errors():
        plan, folder = configure(args)
    from baselines.keeping import RunError, has_checkpoint
    from baselines.training import export, train

    if args.resume and not has_checkpoint(folder):
        print(f"There is no run to resume in {folder}: starting a new one.")
    print(
        f"Training {plan.recipe.algorithm} on {plan.env_id} for {plan.recipe.steps:,} steps of "
        f"{plan.recipe.n_envs} flights, seed {plan.seed}; into {folder}."
    )
    with options.usage_errors((RunError,)), options.filter_hints():
        done = train(
            plan, folder, resume=args.resume, tensorboard=args.tensorboard, quiet=not args.progress
        )
    total = time.perf_counter() - from_start
    print(
        f"{done.steps:,} steps in {done.seconds:.0f} s of training, "
        f"{done.steps / max(done.seconds, 1e-9):,.0f} per second ({total:.0f} s in total).\n"
        f"Best evaluation, after {done.best['steps']:,.0f} steps: true position error "
        f"{done.best['mean_error']:.4f} m, {done.best['crash_rate']:.1%} crashed."
    )
    if not done.finished:
        print("Stopped. Run the same command with --resume to continue.", file=sys.stderr)
        raise SystemExit(130)
    if args.export is not None:
        export(done, args.export)
        print(f"Wrote {args.export}.")
    policy = f"--policy {done.best_policy}{options.flying_options(plan.environment)}"
    print(f"Fly it: quad-gym evaluate {plan.env_id} {policy}")
    if plan.recipe.algorithm != "recurrent_ppo":
        env = env_option(plan.environment)
        print(f"Export it: quad-gym export policy {done.best_policy} --to c{env}")

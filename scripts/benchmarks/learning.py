"""Time until the compiled PPO is better than tuned PD control, over training seeds.

Each training equals `quad-gym train circle --engine compiled`. The time excludes compilation and
evaluations.
"""

import sys
import tempfile
from pathlib import Path

from baselines.pd import PDPolicy
from baselines.recipes import Plan, first_seed, recipe
from baselines.training import train
from quad_gym.commands import benchmark
from quad_gym.evaluation import roll_out
from quad_gym.experiments import read_evaluations
from scripts.benchmarks.scope import Scope

ENV_ID = "QuadGym/Circle-v0"


def time_learning(scope: Scope) -> list[benchmark.Row]:
    """Train with each seed; with `scope.quick`, one short training."""
    quick, rows = scope.quick, list[benchmark.Row]()
    chosen = recipe(ENV_ID)
    chosen = chosen.replace(steps=(2 * 8_192 if quick else scope.steps) or chosen.steps)
    for seed in range(1 if quick else scope.seeds):
        plan = Plan(
            env_id=ENV_ID,
            recipe=chosen,
            seed=seed,
            threads=scope.threads,
            engine="compiled",
            evaluations=2 if quick else 40,
            episodes=8 if quick else 100,
        )
        with tempfile.TemporaryDirectory() as name:
            done = train(plan, Path(name), tensorboard=False, quiet=True)
            found = summary(read_evaluations(Path(name)), pd_error(plan))
        rows.append(
            {
                "seed": seed,
                "threads": scope.threads,
                **found,
                "steps": done.steps,
                "seconds": done.seconds,
            }
        )
        print(f"  seed {seed}: {done.seconds:.1f} s", file=sys.stderr, flush=True)
    return rows


def pd_error(plan: Plan) -> float:
    """Mean error of tuned PD control in the episodes of the training's evaluations [m]."""
    judge = plan.make_judge()
    first = first_seed("validation", plan.seed, plan.episodes)
    episodes = roll_out(PDPolicy(judge, gains="tuned"), judge, seed=first)
    judge.close()
    return episodes.summary()["mean_error"]


def summary(evaluations: list[dict[str, float]], pd: float) -> benchmark.Row:
    """First evaluation better than PD without a crash, and the last evaluation."""
    better = [r for r in evaluations if r["mean_error"] < pd and r["crash_rate"] == 0.0]
    last = evaluations[-1]
    return {
        "pd_error": pd,
        "steps_to_pd": better[0]["steps"] if better else None,
        "seconds_to_pd": better[0]["training_seconds"] if better else None,
        "error": last["mean_error"],
        "crash_rate": last["crash_rate"],
    }


def _in_words(rows: list[benchmark.Row]) -> str:
    """Number of trainings that became better than PD, and the latest of them."""
    times = [row["seconds_to_pd"] for row in rows if row["seconds_to_pd"] is not None]
    latest = f", the last after {max(times):.1f} s" if times else ""
    return f"\n{len(times)} of {len(rows)} below tuned PD{latest} of training."


SECTION = benchmark.Section(
    time_learning,
    {
        "": {"seed": benchmark.column("seed", "d")},
        "below tuned PD after": {
            "steps": benchmark.column("steps_to_pd", ",.0f"),
            "s": benchmark.column("seconds_to_pd", ".1f"),
            "PD [mm]": benchmark.column("pd_error", ".1f", 1e3),
        },
        "at the end": {
            "steps": benchmark.column("steps", ","),
            "s": benchmark.column("seconds", ".1f"),
            "error [mm]": benchmark.column("error", ".1f", 1e3),
            "crashed": benchmark.column("crash_rate", ".1%"),
        },
    },
    _in_words,
)

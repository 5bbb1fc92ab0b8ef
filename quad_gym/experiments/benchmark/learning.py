"""Time until the compiled PPO is better than tuned PD control, over training seeds.

Each training equals `quad-gym train circle --engine compiled`. The time excludes compilation and
evaluations.
"""

import csv
import sys
import tempfile
from pathlib import Path
from typing import Any

from quad_gym.analysis.reports import text_table
from quad_gym.experiments.benchmark import timing

ENV_ID = "QuadGym/Circle-v0"


def time_learning(seeds: int, steps: int | None, threads: int, quick: bool) -> list[timing.Row]:
    """Train with each seed.

    Args:
        seeds: Number of training seeds, from 0 on.
        steps: Environment steps of a training; None: as in the recipe.
        threads: Threads of each training.
        quick: True for one short training.
    """
    from baselines.plans import Plan
    from baselines.recipes import recipe
    from baselines.training import train

    chosen = recipe(ENV_ID)
    chosen = chosen.replace(steps=(2 * 8_192 if quick else steps) or chosen.steps)
    rows: list[timing.Row] = []
    for seed in range(1 if quick else seeds):
        plan = Plan(
            env_id=ENV_ID,
            recipe=chosen,
            seed=seed,
            threads=threads,
            engine="compiled",
            evaluations=2 if quick else 40,
            episodes=8 if quick else 100,
        )
        with tempfile.TemporaryDirectory() as name:
            done = train(plan, Path(name), tensorboard=False, quiet=True)
            text = (Path(name) / "evaluations.csv").read_text(encoding="utf-8")
        evaluations = [{k: float(v) for k, v in r.items()} for r in csv.DictReader(text.split())]
        row = {"seed": seed, "threads": threads, **summary(evaluations, pd_error(plan))}
        rows.append(row | {"steps": done.steps, "seconds": done.seconds})
        print(f"  seed {seed}: {done.seconds:.1f} s", file=sys.stderr, flush=True)
    return rows


def pd_error(plan: Any) -> float:
    """Mean error of tuned PD control in the episodes of the training's evaluations [m]."""
    from baselines.pd import PDPolicy
    from baselines.seeds import first_seed
    from quad_gym.evaluation import roll_out

    judge = plan.make_judge()
    first = first_seed("validation", plan.seed, plan.episodes)
    error: float = roll_out(PDPolicy(judge, gains="tuned"), judge, seed=first).summary()[
        "mean_error"
    ]
    judge.close()
    return error


def summary(evaluations: list[dict[str, float]], pd: float) -> timing.Row:
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


def learning_table(rows: list[timing.Row]) -> str:
    """Format the section: a line per seed, and the latest of all."""

    def format_or_dash(value: float | None, form: str) -> str:
        return "-" if value is None else format(value, form)

    cells = [
        (
            f"{row['seed']}",
            format_or_dash(row["steps_to_pd"], ",.0f"),
            format_or_dash(row["seconds_to_pd"], ".1f"),
            f"{1e3 * row['pd_error']:.1f}",
            *(f"{row['steps']:,}", f"{row['seconds']:.1f}", f"{1e3 * row['error']:.1f}"),
            f"{row['crash_rate']:.1%}",
        )
        for row in rows
    ]
    groups = {
        "": ["seed"],
        "below tuned PD after": ["steps", "s", "PD [mm]"],
        "at the end": ["steps", "s", "error [mm]", "crashed"],
    }
    table = text_table(groups, cells)
    times = [row["seconds_to_pd"] for row in rows if row["seconds_to_pd"] is not None]
    latest = f", the last after {max(times):.1f} s" if times else ""
    return f"{table}\n{len(times)} of {len(rows)} below tuned PD{latest} of training."

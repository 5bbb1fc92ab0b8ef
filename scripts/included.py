"""Train the included policies again, with the plans and seeds of their model cards.

    python -m scripts.included                        # all of them
    python -m scripts.included circle look_around     # some
    python -m scripts.included look_around --seeds 2 --pretrained results/trial  # a trial

Of several seeds, the policy with the best validation is kept, as `baselines/pretrained/NAME.npz`.
Each training is a folder in results/included: an interrupted command continues where it stopped.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from baselines.policies import PRETRAINED
from baselines.recipes import Plan, recipe
from baselines.training import TrainingResult, export, train
from quad_gym.commands import options
from quad_gym.params import checks as check
from scripts.studies.arms import ARMS, OUTAGE_DASH, STALE_RACE, TRUTH, Arm, chosen_arms


def _plan(task: str, arm: Arm | None = None, **more: Any) -> Plan:
    """Plan of a task's recipe, or of an arm of its study."""
    env_id = f"QuadGym/{task}-v0"
    if arm is None:
        return Plan(env_id=env_id, recipe=recipe(env_id), engine="compiled", **more)
    base = recipe(env_id, arm.algorithm)
    return Plan(
        env_id=env_id,
        environment=arm.environment,
        learning=arm.learning,
        recipe=base.replace(parameters={**base.parameters, **arm.parameters}),
        engine=arm.engine,
        **more,
    )


_CAREFUL, *_ = chosen_arms(ARMS, ["std_certainty"])
_STD, *_ = chosen_arms(STALE_RACE, ["std"])
_IMITATION, *_ = chosen_arms(OUTAGE_DASH, ["imitation"])


PLANS: Mapping[str, tuple[Plan, int]] = {
    "circle": (_plan("Circle"), 1),
    "circle_truth": (_plan("Circle", environment=TRUTH), 1),
    "hover": (_plan("Hover"), 1),
    "lemniscate": (_plan("Lemniscate"), 1),
    "random_trajectory": (_plan("RandomTrajectory"), 1),
    "waypoints": (_plan("Waypoints"), 1),
    "look_around": (_plan("LookAround", _CAREFUL, evaluations=9), 3),
    "look_around_truth": (_plan("LookAround", environment=TRUTH, evaluations=9), 1),
    "stale_race": (_plan("StaleRace", _STD, evaluations=8), 20),
    "outage_dash": (_plan("OutageDash", _IMITATION, evaluations=2), 10),
}
"""Plan of each policy, and the number of seeds of which the best validation is kept."""


@dataclass(frozen=True)
class IncludedArgs:
    """Options of the trainings."""

    names: Positional[tuple[str, ...]] = tuple(PLANS)
    """names of the policies"""
    seeds: int | None = None
    """largest number of seeds, for a trial"""
    output: Path = Path("results/included")
    """folder of the trainings"""
    pretrained: Path = PRETRAINED
    """folder of the policies"""


def best_of(name: str, folder: Path, most: int | None = None) -> TrainingResult:
    """Train a policy with its seeds, and return the training with the best validation."""
    plan, seeds = PLANS[name]
    trained = []
    for seed in range(seeds if most is None else min(seeds, most)):
        print(f"{name}, seed {seed}", flush=True)
        result = train(plan.replace(seed=seed), folder / name / f"seed_{seed}", resume=True)
        if not result.finished:
            raise SystemExit("stopped; the same command continues")
        trained.append(result)
    return max(trained, key=lambda result: result.best["score"])


def main(args: IncludedArgs) -> None:
    """Train the policies, and write their files."""
    for name in args.names:
        check.choice("names", name, tuple(PLANS))
    if args.seeds is not None:
        check.whole("--seeds", args.seeds)
    for name in args.names:
        best = best_of(name, args.output, args.seeds)
        export(best, file := args.pretrained / f"{name}.npz")
        print(f"{file}: {best.folder.name}, score {best.best['score']:.3f}")


if __name__ == "__main__":
    with options.quiet_end():
        main(options.parse(IncludedArgs, prog="python -m scripts.included", description=__doc__))

"""Training of policies according to a plan, with all results in one folder.

The folder contains

- `last.zip` and `best.zip`: the policies of the last and of the best evaluation, in the format of
  Stable-Baselines3;
- or, from the compiled engine, `last.npz` and `best.npz`, in the format of `MlpPolicy`;
- `training.json`: plan, versions, seeds, wall time; `evaluations.csv`: errors during training;
- files for TensorBoard.
"""

import importlib.util
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from baselines.keeping import RunError, RunKeeper, best_file
from baselines.mlp import MlpPolicy, mlp_of
from baselines.plans import Plan, description
from baselines.policies import interface_of
from quad_gym.analysis.reports import versions, write_json
from quad_gym.batch.threads import resolve_threads
from quad_gym.params import checks as check


@dataclass(frozen=True)
class TrainingResult:
    """Results of a training."""

    folder: Path
    steps: int
    """Number of environment steps completed"""
    seconds: float
    """Wall time of the training without evaluations [s]"""
    finished: bool
    """True if all steps were completed"""
    best: dict[str, float]
    """Results of the best evaluation, by name"""
    best_policy: Path
    """File of the policy with the best evaluation"""


def train(
    plan: Plan, folder: Path, *, tensorboard: bool = True, quiet: bool = False
) -> TrainingResult:
    """Train a policy. Ctrl-C or SIGTERM stops the run at the next step.

    Args:
        plan: Plan of the training.
        folder: Folder of the run, created if it is missing; the files of a run of this plan that
            was stopped are replaced.
        tensorboard: True to write files for TensorBoard, if it is installed.
        quiet: True to hide the progress bar.

    Returns:
        Results of the training.

    Raises:
        ValueError: If the plan is invalid, or the folder contains a finished run, or one of another
            plan.
        OSError: If the folder is not writable.
    """
    if finished_run(folder, plan) is not None:
        raise RunError(f"folder {folder} already contains a run: choose another one (--output)")
    tensorboard = tensorboard and importlib.util.find_spec("tensorboard") is not None
    folder.mkdir(parents=True, exist_ok=True)
    judge, described = plan.make_judge(), description(plan)
    begun = {"plan": described, "interface": interface_of(judge), "finished": False}
    _write_record(folder, begun)
    if plan.engine == "compiled":
        from baselines.compiled_ppo.run import run as run_compiled

        keeper: RunKeeper = run_compiled(plan, folder, judge, tensorboard=tensorboard, quiet=quiet)
    else:
        from baselines.sb3_run import run

        keeper = run(plan, folder, judge, tensorboard=tensorboard, quiet=quiet)
    names = ("finished", "steps", "best", "last")
    record = begun | {
        **{name: getattr(keeper, name) for name in names},
        "training_seconds": keeper.seconds,
        "steps_per_second": keeper.steps / max(keeper.seconds, 1e-9),
        "threads": resolve_threads(plan.threads),
        "ended": time.strftime("%Y-%m-%d %H:%M:%S"),
        "versions": versions("numpy", "numba", "torch", "stable_baselines3", "sb3_contrib"),
    }
    _write_record(folder, record)
    judge.close()
    values = {name: getattr(keeper, name) for name in ("steps", "seconds", "finished", "best")}
    return TrainingResult(folder, best_policy=best_file(plan, folder), **values)


def require_model(plan: Plan) -> None:
    """Make the untrained model once, to check a plan, and that its engine is installed."""
    if plan.engine == "compiled":
        check.package("numba", "the compiled engine", "compile")
        from baselines.compiled_ppo.run import make_compiled

        make_compiled(plan).env.close()
        return
    try:
        from baselines.models import make_model
    except ImportError as error:
        raise ImportError(f'training needs "quad-gym[train]" ({error})') from None
    make_model(plan, plan.make_flights())


def finished_run(folder: Path, plan: Plan) -> dict[str, Any] | None:
    """Record of the finished run in a folder; None: it has none, or one that was stopped.

    Raises a `RunError` if the folder contains the run of another plan.
    """
    if not (folder / "training.json").exists():
        return None
    found: dict[str, Any] = json.loads((folder / "training.json").read_text(encoding="utf-8"))
    described = description(plan)
    if found["plan"] != described:
        differing = [k for k in described if found["plan"].get(k) != described[k]]
        raise RunError(
            f"folder {folder} contains a run of another plan (different: {', '.join(differing)})"
        )
    return found if found["finished"] else None


def _write_record(folder: Path, record: Any) -> None:
    """Write `training.json` atomically."""
    write_json(folder / "training.json.part", record).replace(folder / "training.json")


def export(training: TrainingResult, file: Path) -> None:
    """Write the best policy of a training, with its record, to a file that requires only NumPy.

    Raises a ValueError if the policy is not a multilayer perceptron.
    """
    record = json.loads((training.folder / "training.json").read_text(encoding="utf-8"))
    if training.best_policy.suffix == ".npz":
        policy = MlpPolicy.load(training.best_policy)
        policy.record = record
    else:
        from baselines.models import algorithm_class

        kind = algorithm_class(record["plan"]["recipe"]["algorithm"])
        policy = mlp_of(kind.load(training.best_policy, device="cpu"), record)
    file.parent.mkdir(parents=True, exist_ok=True)
    policy.save(file)

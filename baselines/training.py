"""Training of policies according to a plan, with all results in one folder.

The folder contains

- `last.zip` and `best.zip`: the policies of the last and of the best evaluation, in the format of
  Stable-Baselines3; `last.zip` also contains the state for resuming: flights, random number
  generators and counters (and `replay_*.pickle` in addition, for algorithms with a replay buffer);
- or, from the compiled engine, `last.npz` and `best.npz`, in the format of `MlpPolicy`;
- `training.json`: plan, every keyword of the evaluations, versions, seeds, wall time;
- `evaluations.csv`: errors during training;
- `training.lock`, and `training.process`: the process that trains in the folder, or did last;
- files for TensorBoard.

A resumed run continues exactly from its last checkpoint.
"""

import importlib.util
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from baselines.keeping import RunError, RunKeeper, best_file, has_checkpoint, locked
from baselines.mlp import MlpPolicy, mlp_of
from baselines.policies import interface_of
from baselines.recipes import Plan, description
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
    plan: Plan, folder: Path, *, resume: bool = False, tensorboard: bool = True, quiet: bool = False
) -> TrainingResult:
    """Train a policy, or resume a training that was stopped.

    Ctrl-C or SIGTERM stops the run at the next step, from which it can be resumed. The folder is
    locked during the run (`baselines.keeping`).

    Args:
        plan: Plan of the training.
        folder: Folder of the run, created if it is missing.
        resume: True to continue from the folder's last checkpoint, if it has one.
        tensorboard: True to write files for TensorBoard, if it is installed.
        quiet: True to hide the progress bar.

    Returns:
        Results of the training.

    Raises:
        ValueError: If the plan is invalid, the folder contains a run and `resume` is not set, it
            contains the run of another plan, or another process trains in it.
        OSError: If the folder is not writable.
    """
    tensorboard = tensorboard and importlib.util.find_spec("tensorboard") is not None
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder):
        return _train(plan, folder, resume, {"tensorboard": tensorboard, "quiet": quiet})


def require_model(plan: Plan) -> None:
    """Make the untrained model once, to check a plan, and that its engine is installed."""
    if plan.engine == "compiled":
        check.package("numba", "the compiled engine", "compile")
        from baselines.compiled_ppo.run import make_compiled

        make_compiled(plan).env.close()
        return
    try:
        from baselines.models import make_flights, make_model
    except ImportError as error:
        raise ImportError(f'training needs "quad-gym[train]" ({error})') from None
    make_model(plan, make_flights(plan))


def run_in(folder: Path, plan: Plan, *, resume: bool) -> dict[str, Any] | None:
    """Record of the run in a folder that is resumed; None: a new run begins.

    Raises a `RunError` if the folder contains a run and `resume` is not set, or contains the run of
    another plan.
    """
    if not has_checkpoint(folder):
        return None
    if not resume:
        raise RunError(
            f"folder {folder} already contains a run: resume it (--resume), or choose "
            "another folder (--output)"
        )
    before: dict[str, Any] = json.loads((folder / "training.json").read_text(encoding="utf-8"))
    described = description(plan)
    if before["plan"] != described:
        differing = [k for k in described if before["plan"].get(k) != described[k]]
        raise RunError(
            f"folder {folder} contains a run of another plan (different: {', '.join(differing)})"
        )
    return before


def _train(plan: Plan, folder: Path, resume: bool, options: Mapping[str, bool]) -> TrainingResult:
    described = description(plan)
    before = run_in(folder, plan, resume=resume)
    if before is not None and before["finished"]:
        return _result(plan, folder, before)
    judge = plan.make_judge()
    flown = {
        "plan": described,
        "interface": interface_of(judge),
        "configuration": judge.unwrapped.flights.config.described,  # type: ignore[attr-defined]
    }
    if before is None:
        _write_record(folder, {**flown, "finished": False})
    if plan.engine == "compiled":
        from baselines.compiled_ppo.run import run as run_compiled

        keeper: RunKeeper = run_compiled(plan, folder, judge, **options)
    else:
        from baselines.models import run

        keeper = run(plan, folder, judge, **options)
    record = {
        **flown,
        **{name: getattr(keeper, name) for name in ("finished", "steps", "best", "last")},
        "training_seconds": keeper.seconds,
        "steps_per_second": keeper.steps / max(keeper.seconds, 1e-9),
        "threads": resolve_threads(plan.threads),
        "ended": time.strftime("%Y-%m-%d %H:%M:%S"),
        "versions": versions("numpy", "numba", "torch", "stable_baselines3", "sb3_contrib"),
    }
    _write_record(folder, record)
    judge.close()
    return _result(plan, folder, record)


def _result(plan: Plan, folder: Path, record: Mapping[str, Any]) -> TrainingResult:
    values = {name: record[name] for name in ("steps", "finished", "best")}
    best = best_file(plan, folder)
    return TrainingResult(folder, seconds=record["training_seconds"], best_policy=best, **values)


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

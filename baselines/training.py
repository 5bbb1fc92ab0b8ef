"""Training: from a plan to a folder with everything about the run.

The folder holds

- `last.zip` and `best.zip`: the policy at the last evaluation and at the best one, as
  Stable-Baselines3 loads them; `last.zip` also holds what resuming needs: the flights, the random
  number generators, the counters (and `replay_*.pickle` beside it, for algorithms with a replay
  buffer);
- or, from the compiled engine, `last.npz` and `best.npz` of the same kind, as `MlpPolicy` loads
  them;
- `training.json`: the plan, versions, seeds, wall time; `evaluations.csv`: errors while training;
- `training.lock`: which process trains in it, or did last;
- TensorBoard's files.

A resumed run continues exactly from its last evaluation.
"""

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from baselines.keeping import RunError, RunKeeper, best_file, has_checkpoint
from baselines.locks import locked
from baselines.mlp import MlpPolicy, mlp_of
from baselines.plans import Plan, description
from baselines.policies import interface_of
from quad_gym.analysis.reports import versions, write_json
from quad_gym.batch.threads import resolve_threads


@dataclass(frozen=True)
class Training:
    """What came of a run."""

    folder: Path
    steps: int
    """environment steps done"""
    seconds: float
    """wall time of training, evaluations left out"""
    finished: bool
    """whether all steps were done"""
    best: dict[str, float]
    """of the best evaluation"""
    best_policy: Path
    """the policy at the best evaluation"""


def train(
    plan: Plan, folder: Path, *, resume: bool = False, tensorboard: bool = True, quiet: bool = False
) -> Training:
    """Train a policy, or go on with a training that was stopped.

    Ctrl-C, or a request to terminate, ends the run at the next step; it can be resumed then. While
    it runs, its folder is locked (`baselines.locks`).

    Args:
        plan: What to train.
        folder: Where the run is kept; made if missing.
        resume: Go on from the folder's last checkpoint; without one, begin.
        tensorboard: Whether to write TensorBoard's files.
        quiet: Whether to leave out the progress bar.

    Returns:
        What came of it.

    Raises:
        ValueError: If the plan is invalid, the folder holds a run and `resume` is not set, or
            holds the run of another plan, or another process trains in it.
        OSError: If nothing can be written to the folder.
        ImportError: If TensorBoard's files are wanted and it is not installed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder):
        return _train(plan, folder, resume=resume, tensorboard=tensorboard, quiet=quiet)


def run_in(folder: Path, plan: Plan, *, resume: bool) -> dict[str, Any] | None:
    """The record of the run that the folder holds, which goes on; None: one begins.

    Args:
        folder: Where the run is, or will be.
        plan: What to train.
        resume: Whether to go on from the folder's last checkpoint.

    Raises:
        RunError: If it holds a run and `resume` is not set, or holds the run of another plan.
    """
    if not has_checkpoint(folder):
        return None
    if not resume:
        raise RunError(
            f"folder {folder} holds a run already: resume it (--resume), or choose "
            "another (--output)"
        )
    before: dict[str, Any] = json.loads((folder / "training.json").read_text(encoding="utf-8"))
    described = description(plan)
    if before["plan"] != described:
        differing = [k for k in described if before["plan"].get(k) != described[k]]
        raise RunError(
            f"folder {folder} holds the run of another plan (different: {', '.join(differing)})"
        )
    return before


def _train(plan: Plan, folder: Path, *, resume: bool, tensorboard: bool, quiet: bool) -> Training:
    described = description(plan)
    before = run_in(folder, plan, resume=resume)
    if before is not None and before["finished"]:
        return Training(
            folder,
            before["steps"],
            before["training_seconds"],
            True,
            before["best"],
            best_file(plan, folder),
        )
    judge = plan.make_judge()
    if before is None:
        begun = {"plan": described, "interface": interface_of(judge), "finished": False}
        _write_record(folder, begun)
    if plan.engine == "compiled":
        from baselines.compiled_ppo.run import run as run_compiled

        keeper: RunKeeper = run_compiled(plan, folder, judge, tensorboard=tensorboard, quiet=quiet)
    else:
        from baselines.checkpoints import run

        keeper = run(plan, folder, judge, tensorboard=tensorboard, quiet=quiet)
    record = {
        "plan": described,
        "interface": interface_of(judge),
        "finished": keeper.finished,
        "steps": keeper.steps,
        "training_seconds": keeper.seconds,
        "steps_per_second": keeper.steps / max(keeper.seconds, 1e-9),
        "best": keeper.best,
        "last": keeper.last,
        "threads": resolve_threads(plan.threads),
        "ended": time.strftime("%Y-%m-%d %H:%M:%S"),
        "versions": versions("numpy", "numba", "torch", "stable_baselines3", "sb3_contrib"),
    }
    _write_record(folder, record)
    judge.close()
    return Training(
        folder, keeper.steps, keeper.seconds, keeper.finished, keeper.best, best_file(plan, folder)
    )


def _write_record(folder: Path, record: Any) -> None:
    """Write `training.json`; at any moment there is the old or the new one, whole."""
    write_json(folder / "training.json.part", record).replace(folder / "training.json")


def export(training: Training, file: Path) -> None:
    """Write the best policy of a training, with its record, to a file that needs NumPy alone.

    Raises:
        ValueError: If the policy is no plain network.
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

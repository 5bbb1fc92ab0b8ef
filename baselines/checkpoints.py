"""Keeping a training: evaluations, checkpoints that resume exactly, and a calm end on Ctrl-C."""

import csv
import io
import os
import pickle
import signal
import threading
import time
import zipfile
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from baselines.plans import Plan
from baselines.seeds import first_seed
from quad_gym.evaluation import Episodes, roll_out

LAST, BEST, EVALUATIONS = "last.zip", "best.zip", "evaluations.csv"
_STATE = "training_state.pickle"  # within last.zip, where Stable-Baselines3 passes over it
_COLUMNS = (
    "steps",
    "training_seconds",
    "mean_error",
    "late_error",
    "crash_rate",
    "return",
    "gates_passed",
    "training_return",
)


class RunError(ValueError):
    """A folder does not hold the run that it should."""


def has_checkpoint(folder: Path) -> bool:
    """Whether a run can be resumed from the folder."""
    return (folder / LAST).exists() and (folder / "training.json").exists()


def score(summary: dict[str, float], duration: float) -> float:
    """What makes an evaluation the best: few crashes and small errors, or many gates and soon."""
    if summary["gates_total"] > 0.0:
        return summary["gates_passed"] - summary["crash_rate"] - summary["seconds"] / duration
    return -summary["mean_error"] - 10.0 * summary["crash_rate"]


class Keeper(BaseCallback):
    """Evaluates the policy now and then, and keeps what a run leaves behind.

    All is done between a rollout and the next, where nothing is half done. A checkpoint is written
    under another name and then moved to its place, so a kill at any moment leaves the one before.

    Args:
        plan: What is trained.
        folder: Where the run is kept.
        judge: Flights to evaluate on.
        quiet: Whether to leave out the progress bar.
    """

    def __init__(
        self,
        plan: Plan,
        folder: Path,
        judge: gymnasium.vector.VectorEnv[Any, Any, Any],
        *,
        quiet: bool = False,
    ) -> None:
        super().__init__()
        self._plan, self._folder, self._judge, self._quiet = plan, folder, judge, quiet
        self._interval = plan.recipe.steps / plan.evaluations
        self._first_seed = first_seed("validation", plan.seed, plan.episodes)
        self.steps, self.seconds, self.finished = 0, 0.0, False
        self.rows: list[dict[str, float]] = []
        self.best: dict[str, float] = {}
        self.last: dict[str, float] = {}
        self._since: float | None = None
        self._stop = False
        self._handlers: dict[int, Any] = {}
        self._bar: Any = None

    # ---- Stable-Baselines3 calls these ----------------------------------------------------------

    def _on_training_start(self) -> None:
        self.steps = self.num_timesteps
        self._since = time.perf_counter()

    def _on_rollout_start(self) -> None:
        """Here nothing is half done: the last rollout is learned, the next not begun."""
        done = self.model.num_timesteps
        if self._bar is not None:
            self._bar.update(done - self._bar.n)
        due = done // self._interval > self.steps // self._interval
        self.steps = done
        if due or self._stop or not self.rows:
            self._keep(self.model)

    def _on_step(self) -> bool:
        return not self._stop

    # ---- the beginning and the end --------------------------------------------------------------

    def __enter__(self) -> "Keeper":
        """Take over Ctrl-C and the request to terminate, and show the bar."""
        if threading.current_thread() is threading.main_thread():  # else they are not ours to take
            for number in (signal.SIGINT, signal.SIGTERM):
                self._handlers[number] = signal.signal(number, self._interrupt)
        if not self._quiet:
            from tqdm import tqdm

            self._bar = tqdm(total=self._plan.recipe.steps, unit=" steps", unit_scale=True)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Give the signals back."""
        while self._handlers:
            signal.signal(*self._handlers.popitem())
        if self._bar is not None:
            self._bar.close()

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        """The first signal ends the run with the rollout's present step; a second one, at once."""
        if self._stop:
            raise KeyboardInterrupt
        self._stop = True

    def finish(self, model: BaseAlgorithm) -> None:
        """Keep the policy that the last step has made, if the run came to its end."""
        if self._bar is not None:
            self._bar.update(model.num_timesteps - self._bar.n)
        self.finished = model.num_timesteps >= self._plan.recipe.steps
        if self.finished and self.steps < model.num_timesteps:
            self.steps = model.num_timesteps
            self._keep(model)

    # ---- keeping --------------------------------------------------------------------------------

    def _keep(self, model: BaseAlgorithm) -> None:
        """Evaluate, and write a checkpoint."""
        now = time.perf_counter()
        self.seconds += now - (now if self._since is None else self._since)
        episodes = roll_out(model, self._judge, seed=self._first_seed)
        row = self._row(model, episodes)
        for name, value in row.items():
            model.logger.record(f"evaluation/{name}", value)
        self.rows.append(row)
        batch = self._judge.unwrapped.flights.batch  # type: ignore[attr-defined]
        summary = {
            **row,
            "gates_total": float(batch.task.gate_count * (batch.task.kind == "waypoints")),
            "seconds": float(episodes.lengths.mean() / batch.clocks.control_rate),
        }
        self.last = row | {"score": score(summary, batch.task.duration or 1.0)}
        is_best = not self.best or self.last["score"] > self.best["score"]
        self.best = self.last if is_best else self.best
        save_model(self._folder, model, self)
        if is_best:
            _replace(self._folder / BEST, _model_bytes(model))
        self._write_rows()
        if self._bar is not None:
            self._bar.set_postfix_str(f"error {row['mean_error']:.3f} m")
        self._since = time.perf_counter()

    def _row(self, model: BaseAlgorithm, episodes: Episodes) -> dict[str, float]:
        summary = episodes.summary()
        records = model.ep_info_buffer or []
        training = float(np.mean([r["r"] for r in records])) if records else float("nan")
        known = {
            **summary,
            "steps": float(self.steps),
            "training_seconds": self.seconds,
            "training_return": training,
        }
        return {name: known[name] for name in _COLUMNS}

    def _write_rows(self) -> None:
        text = io.StringIO()
        writer = csv.DictWriter(text, _COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.rows)
        _replace(self._folder / EVALUATIONS, text.getvalue().encode())


def _replace(file: Path, content: bytes) -> None:
    """Write a file so that at any moment there is the old or the new one, whole."""
    part = file.with_name(file.name + ".part")
    with part.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())
    part.replace(file)


def _model_bytes(model: BaseAlgorithm) -> bytes:
    buffer = io.BytesIO()
    model.save(buffer)
    return buffer.getvalue()


def save_model(folder: Path, model: BaseAlgorithm, keeper: Keeper) -> None:
    """Write `last.zip`: the model, and the state of everything that random numbers come from."""
    env = model.get_env()
    assert env is not None
    state = {
        "flights": env.unwrapped.flights.batch.snapshot(),  # type: ignore[attr-defined]
        "torch": torch.get_rng_state(),
        "numpy": np.random.get_state(),  # noqa: NPY002 - Stable-Baselines3 shuffles with it
        "actions": model.action_space.np_random.bit_generator.state,
        "keeper": {name: getattr(keeper, name) for name in ("rows", "best", "last", "seconds")},
        "replay": None,
    }
    if isinstance(model, OffPolicyAlgorithm):
        replay = folder / f"replay_{model.num_timesteps}.pickle"
        part = replay.with_name(replay.name + ".part")
        model.save_replay_buffer(part)
        part.replace(replay)
        state["replay"] = replay.name
    buffer = io.BytesIO(_model_bytes(model))
    with zipfile.ZipFile(buffer, "a") as archive:
        archive.writestr(_STATE, pickle.dumps(state))
    _replace(folder / LAST, buffer.getvalue())
    for old in folder.glob("replay_*.pickle"):
        if old.name != state["replay"]:
            old.unlink()


def load_model(folder: Path, model: BaseAlgorithm, env: VecEnv, keeper: Keeper) -> BaseAlgorithm:
    """The model of `last.zip`, with flights and random numbers as they were then.

    Args:
        folder: Where the run is kept.
        model: An untrained model of the same plan.
        env: Its flights.
        keeper: Gets back what it knew.

    Raises:
        ValueError: If the file is damaged.
    """
    try:
        with zipfile.ZipFile(folder / LAST) as archive:
            state = pickle.loads(archive.read(_STATE))
        found = type(model).load(
            folder / LAST,
            env=env,
            device="cpu",
            force_reset=False,
            custom_objects={"tensorboard_log": model.tensorboard_log},
        )
    except (zipfile.BadZipFile, KeyError, pickle.UnpicklingError) as error:
        raise RunError(f"the checkpoint in {folder} is damaged: {error}") from None
    if state["replay"]:
        found.load_replay_buffer(folder / state["replay"])  # type: ignore[attr-defined]
    env.reset()
    env.unwrapped.flights.batch.restore(state["flights"])  # type: ignore[attr-defined]
    torch.set_rng_state(state["torch"])
    np.random.set_state(state["numpy"])  # noqa: NPY002
    found.action_space.np_random.bit_generator.state = state["actions"]
    for name, value in state["keeper"].items():
        setattr(keeper, name, value)
    keeper.steps = found.num_timesteps
    return found

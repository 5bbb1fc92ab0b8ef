"""Training of a plan with the compiled engine: PPO, or imitation."""

import io
import pickle
import time
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium

from baselines.compiled_ppo.imitation import Imitation, columns_of
from baselines.compiled_ppo.ppo import CompiledPPO
from baselines.compiled_ppo.training import NetworkTraining
from baselines.keeping import (
    STATE,
    RunKeeper,
    best_file,
    last_file,
    reading_checkpoint,
    replace_file,
)
from baselines.policies import interface_of
from baselines.recipes import IMITATION, Plan, description, first_seed


class Events:
    """Writer of scalars over steps for TensorBoard, which must be installed, into a folder."""

    def __init__(self, folder: Path) -> None:
        from tensorboard.compat.proto import event_pb2, summary_pb2
        from tensorboard.summary.writer.event_file_writer import EventFileWriter

        self._event, self._summary = event_pb2.Event, summary_pb2.Summary
        self._writer: Any = EventFileWriter(str(folder))

    def add(self, step: int, scalars: Mapping[str, float]) -> None:
        """Write scalars at a step, by tag."""
        values = [
            self._summary.Value(tag=tag, simple_value=value) for tag, value in scalars.items()
        ]
        summary = self._summary(value=values)
        self._writer.add_event(self._event(wall_time=time.time(), step=step, summary=summary))
        self._writer.flush()

    def close(self) -> None:
        """Close the file."""
        self._writer.close()


class CompiledKeeper(RunKeeper):
    """`RunKeeper` for the compiled engine."""

    events: Events | None = None
    """Writer for TensorBoard; None: no files"""

    def _training_return(self, model: NetworkTraining) -> float:
        return model.training_return

    def _save(self, model: NetworkTraining, *, best: bool) -> None:
        content = io.BytesIO()
        record = {"plan": description(self._plan), "interface": interface_of(self._judge)}
        if self.events is not None:
            row = {f"evaluation/{name}": value for name, value in self.rows[-1].items()}
            losses = {f"train/{name}": value for name, value in model.losses.items()}
            self.events.add(model.num_timesteps, row | losses)
        model.policy(record).save(content)
        if best:
            replace_file(best_file(self._plan, self._folder), content.getvalue())
        with zipfile.ZipFile(content, "a") as archive:
            archive.writestr(STATE, pickle.dumps((self.state(), model.state())))
        replace_file(last_file(self._plan, self._folder), content.getvalue())


def make_compiled(plan: Plan) -> NetworkTraining:
    """Make the untrained model of a plan, with its environment."""
    seed = first_seed("training", plan.seed, plan.recipe.n_envs)
    flights = plan.make_vector_flights()
    if plan.recipe.algorithm == IMITATION:
        judge = plan.make_judge()
        columns = columns_of(interface_of(judge)["observation"], flights)
        judge.close()
        return Imitation(flights, plan.recipe, columns=columns, seed=plan.seed, env_seed=seed)
    if plan.recipe.parameters.get("critic_only"):
        _require_leaving(plan, flights)
    return CompiledPPO(flights, plan.recipe, seed=plan.seed, env_seed=seed, threads=plan.threads)


def _require_leaving(plan: Plan, flights: Any) -> None:
    """Check that `critic_only` leaves the actor exactly the observation of the policy in tests."""
    judge: Any = plan.make_judge()
    learned, judged = (env.unwrapped.flights.table for env in (flights, judge))
    judge.close()
    more = learned[-1].slice.stop - judged[-1].slice.stop
    given = plan.recipe.parameters["critic_only"]
    if given != more or learned[: len(judged)] != judged:
        raise ValueError(
            "critic_only must be the number of values that the observation has only in training, "
            f"at its end: {max(more, 0)} of {learned[-1].slice.stop}, got {given}"
        )


def run(
    plan: Plan,
    folder: Path,
    judge: gymnasium.vector.VectorEnv[Any, Any, Any],
    *,
    tensorboard: bool,
    quiet: bool,
) -> CompiledKeeper:
    """Train, or resume from the folder's checkpoint; see `baselines.training.train`."""
    model, keeper = make_compiled(plan), CompiledKeeper(plan, folder, judge, quiet=quiet)
    if (file := last_file(plan, folder)).exists():
        with reading_checkpoint(folder):
            with zipfile.ZipFile(file) as archive:
                kept, state = pickle.loads(archive.read(STATE))
            model.restore(state)
            keeper.restore(kept, model.num_timesteps)

    if tensorboard:
        keeper.events = Events(folder / "tensorboard" / "run")

    def watch(model: NetworkTraining) -> bool:
        keeper.watch(model, model.num_timesteps)
        return not keeper.stopping

    with keeper.running():
        model.prepare()
        keeper.begin(model.num_timesteps)
        model.learn(plan.recipe.steps, watch, quiet=True)  # the keeper has a progress bar
        keeper.finish(model, model.num_timesteps)
    if keeper.events is not None:
        keeper.events.close()
    model.env.close()
    return keeper

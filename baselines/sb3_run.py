"""Training of a plan with Stable-Baselines3."""

import io
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from baselines.keeping import RunKeeper, best_file, last_file, replace_file
from baselines.models import make_model
from baselines.plans import Plan


class Keeper(RunKeeper, BaseCallback):
    """`RunKeeper` for Stable-Baselines3, as a callback."""

    def _on_training_start(self) -> None:
        self.begin()

    def _on_rollout_start(self) -> None:
        """Evaluate and save between two rollouts, after the update by the last one."""
        self.watch(self.model, self.model.num_timesteps)

    def _on_step(self) -> bool:
        return not self.stopping

    def _training_return(self, model: BaseAlgorithm) -> float:
        records = model.ep_info_buffer or []
        return float(np.mean([r["r"] for r in records])) if records else float("nan")

    def _save(self, model: Any, *, best: bool) -> None:
        for name, value in self.rows[-1].items():
            model.logger.record(f"evaluation/{name}", value)
        content = io.BytesIO()
        model.save(content)
        replace_file(last_file(self._plan, self._folder), content.getvalue())
        if best:
            replace_file(best_file(self._plan, self._folder), content.getvalue())


def run(
    plan: Plan,
    folder: Path,
    judge: gymnasium.vector.VectorEnv[Any, Any, Any],
    *,
    tensorboard: bool,
    quiet: bool,
) -> Keeper:
    """Train with Stable-Baselines3; see `training.train`."""
    torch.set_num_threads(1)  # networks of this size do not benefit from more
    env = plan.make_flights()
    model = make_model(plan, env, folder / "tensorboard" if tensorboard else None)
    keeper = Keeper(plan, folder, judge, quiet=quiet)
    with keeper.running():
        model.learn(plan.recipe.steps, callback=keeper, tb_log_name="run")
        keeper.finish(model, model.num_timesteps)
    env.close()
    return keeper

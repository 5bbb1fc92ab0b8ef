"""Fit the errors of the estimate to flights, for arms that are trained on the truth plus errors.

    python -m scripts.studies.fitting  # 300 flights of each task; a minute

Flights of a fixed rule that do not crash give the size of independent noise, and the residual model
of a race (`scripts.studies.residuals`). Both are committed in `scripts/studies/fitted`, and depend
on the flights: fit them again after a change of these.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from baselines.policies import keywords_of_policy, load_policy
from baselines.recipes import first_seed
from scripts.studies.residuals import FITTED, Floats, fit, record

ERRORS = FITTED / "errors.json"  #: root mean squares of errors, by task

FITTED_ON: Mapping[str, tuple[str, str]] = {
    "look_around": ("QuadGym/LookAround-v0", "pd:features_when_uncertain"),
    "stale_race": ("QuadGym/StaleRace-v0", "pd"),
}
"""Id and rule by task."""

_PARTS = {"position": 0, "velocity": 3, "attitude": 6, "body_rates": 9}


def errors_of(task: str) -> dict[str, float]:
    """Root mean squares per axis of a task: the fields of `quad_gym.NoisyObservationParams`."""
    found: dict[str, float] = json.loads(ERRORS.read_text(encoding="utf-8"))[task]
    return found


def sizes(errors: Floats) -> dict[str, float]:
    """Root mean squares per axis of errors (t, n, 12), with three significant digits."""
    return {
        name: float(f"{np.sqrt(np.nanmean(errors[:, :, k : k + 3] ** 2)):.3g}")
        for name, k in _PARTS.items()
    }


def fly(task: str, episodes: int) -> tuple[Floats, Floats]:
    """Record the flights of a task with seeds for training; see `residuals.record`."""
    env_id, rule = FITTED_ON[task]
    keywords: dict[str, Any] = keywords_of_policy(rule, env_id)
    env = gymnasium.make_vec(env_id, num_envs=episodes, **keywords)
    return record(load_policy(rule, env), env, first_seed("training", 0, episodes))


def main(episodes: int = 300, folder: Path = FITTED) -> None:
    """Write the errors of all tasks, and the residual model of the race."""
    found = {}
    for task in FITTED_ON:
        errors, velocities = fly(task, episodes)
        found[task] = sizes(errors)
        if task == "stale_race":
            fit(errors, velocities).save(folder / f"{task}.json")
    text = json.dumps(found, indent=1)
    (folder / ERRORS.name).write_text(text + "\n", encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()

"""Figure and film of a study: two policies in the same test episode.

The two arms are `truth`, or the included policy trained on the truth, and the other learned arm
with the largest return; of a trained arm, the training with the best validation is shown, so that
test episodes do not affect the choice. The episode is the first one of the first `TRACED` that
shows a difference, see `CHOICES`, or else the very first: where the rewarded heading is near the
features, policies see these anyway.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from quad_gym.experiments import flight_of_episode
from quad_gym.rendering.canvas import load_pygame
from quad_gym.rendering.video import Side, checked_video_path, save_side_by_side
from scripts.studies.study import Study, StudyResults

RATE = 10.0  #: pictures per second of a film

_RULE = "Of trained arms, the training with the best validation. The episode is the first one of "
CHOICES: Mapping[str, str] = {
    "glance": _RULE + "the test in which the rewarded heading is away from the features.",
    "pace": _RULE + "the test that only the policy trained on the truth ends with a crash.",
}
"""Rules of the choice in words, by kind of figure."""

AWAY = math.radians(100.0)
"""Mean angle between rewarded heading and features above which an episode is shown [rad]."""


class Pair(NamedTuple):
    """Two trainings and a test episode."""

    trainings: dict[str, int]  #: index of the seed by name of the arm, first the truth's
    episode: int  #: index of the test episode


def learned_arms(study: Study) -> tuple[str, list[str]] | None:
    """Names of the arm trained on the truth, and of other learned ones; None if one is missing."""
    learned = [arm for arm in study.arms if arm.learned]
    truth = next((arm.name for arm in learned if arm.label == "truth"), None)
    others = [arm.name for arm in learned if arm.label != "truth"]
    return None if truth is None or not others else (truth, others)


def pair_of(results: StudyResults) -> Pair | None:
    """Policies and episode to show; None without two arms to show."""
    found = learned_arms(results.study)
    if found is None:
        return None
    shown = (found[0], results.best(found[1]))
    trainings = {name: results.best_validated(name) for name in shown}
    truth, other = (results.flown[name][k] for name, k in trainings.items())
    if results.study.about.figure == "glance":
        off = other.recorded["off_wall"] - other.recorded["off_reward"]
        wrapped = np.abs(np.angle(np.exp(1j * off)))
        return Pair(trainings, int(np.argmax(np.nanmean(wrapped, axis=0) > AWAY)))
    count = truth.recorded["speed"].shape[1]
    alone = truth.episodes.crashed[:count] & ~other.episodes.crashed[:count]
    return Pair(trainings, int(np.argmax(alone)))


def label_of(results: StudyResults, name: str) -> str:
    """Label of a policy above a figure or a film."""
    return f"trained on {results.arm(name).label}"


def require_film(study: Study, kind: str) -> None:
    """Check, before training, that a film of a kind ("webp", "gif" or "mp4") can be made."""
    if learned_arms(study) is None:
        given = ", ".join(arm.name for arm in study.arms)
        raise ValueError(f"--video needs the arm truth and another learned one, got {given}")
    load_pygame()
    checked_video_path(study.folder / f"film.{kind}")


def write_film(results: StudyResults, kind: str) -> Path:
    """Fly the two policies once more, and write the film; returns its path."""
    pair = pair_of(results)
    assert pair is not None
    return save_side_by_side(
        [side_of(results, name, k, pair.episode) for name, k in pair.trainings.items()],
        results.study.folder / f"film.{kind}",
        fps=RATE,
        speed=results.study.about.film_speed,
        progress=lambda times: tqdm(times, desc="rendering", unit=" frames"),
    )


def side_of(results: StudyResults, name: str, k: int, episode: int) -> Side:
    """Fly one test episode of the training with the k-th seed of an arm again, for a film."""
    study, episodes = results.study, results.flown[name][k].episodes
    trial = study.trials()[name]
    policy, steps = trial.load(study.policies(trial)[k]), int(episodes.lengths[episode])
    ending = str(episodes.ending[episode])
    return Side(
        flight=flight_of_episode(policy, trial.env, study.first_episode, episode, steps, {}),
        label=label_of(results, name),
        ending="finish" if ending == "task" else ending,
        crashed=bool(episodes.crashed[episode]),
        course=study.about.course,
    )

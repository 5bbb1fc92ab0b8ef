"""What figures and films of a study show: two policies, and an episode that both fly.

One rule: the arms of the conclusions, which are `truth` and the other trained arm of the largest
return; of each the training with the best validation, so that the test had no say in it; and the
first test episode in which there is something to see:

- where a figure shows where policies look, the first one in which the rewarded heading is on
  average more than 100 degrees from the features: elsewhere a policy that looks where it is paid
  sees them anyway;
- where it shows how fast they fly, the first one that the policy trained on the truth ends with a
  crash.

If there is none among the first `TRACED` episodes it is the very first.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from quad_gym.experiments.study_flights import Flown
from quad_gym.experiments.study_results import Results

_TRAINING = "Of each arm it is the training with the best validation. The episode is the first one "
CHOICES: Mapping[str, str] = {
    "glance": _TRAINING + "of the test in which the rewarded heading is away from the features.",
    "pace": _TRAINING + "of the test that the policy trained on the truth ends with a crash.",
}
"""The rule for people, by the kind of figure."""

AWAY = math.radians(100.0)
"""Of the rewarded heading from the features, on average, that shows a difference [rad]."""


class Pair(NamedTuple):
    """Two trainings and an episode."""

    trainings: dict[str, int]
    """training seed by the name of the arm, `truth` first"""
    episode: int
    """of the test, counted from 0"""


def pair_of(results: Results) -> Pair | None:
    """The two policies and the episode to show; None without `truth` and another trained arm."""
    others = [name for name in results.trained() if name != "truth"]
    if "truth" not in results.trained() or not others:
        return None
    arms = ("truth", results.best(others))
    trainings = {name: results.best_validated(name) for name in arms}
    truth, other = (results.flown[training] for training in trainings.items())
    looks = results.study.about.figure == "glance"
    return Pair(trainings, _away(other) if looks else _crash(truth))


def label_of(results: Results, name: str) -> str:
    """Who flies, above a figure or a film."""
    return f"trained on {results.arm(name).label}"


def _away(flown: Flown) -> int:
    off_wall, off_reward = (flown.traces[name] for name in ("off_wall", "off_reward"))
    off = np.abs(np.angle(np.exp(1j * (off_wall - off_reward))))
    return int(np.argmax(np.nanmean(off, axis=0) > AWAY))


def _crash(flown: Flown) -> int:
    return int(np.argmax(flown.crashed[: flown.traces["speed"].shape[1]]))

"""A film of a study: two policies side by side in the same episode, both flown on the estimate.

Which policies and which episode, `study_pair` says.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym import FlightRecorder
from quad_gym.evaluation import roll_out
from quad_gym.experiments.arms import Arm
from quad_gym.experiments.study_pair import label_of, pair_of
from quad_gym.experiments.study_results import Results, Study
from quad_gym.rendering.canvas import load_pygame
from quad_gym.rendering.side_by_side import Side, save_side_by_side
from quad_gym.rendering.video import checked_video_path

RATE = 10.0
"""Pictures per second of a film."""


def require_film(study: Study, kind: str) -> None:
    """See that a film can be made, before anything is trained.

    Args:
        study: The study.
        kind: Of the film.

    Raises:
        ValueError: If the study has no two policies to compare.
        ImportError: If a library that draws or writes it is not installed.
    """
    trained = [arm.name for arm in study.arms if arm.trained]
    if "truth" not in trained or len(trained) < 2:
        given = ", ".join(arm.name for arm in study.arms)
        raise ValueError(f"--video needs the arm truth and another trained one, got {given}")
    load_pygame()
    checked_video_path(film_file(study, kind))


def film_file(study: Study, kind: str) -> Path:
    """Where a study's film is."""
    return study.folder / f"film.{kind}"


def write_film(results: Results, kind: str, flights_of: Callable[[Arm, int], Any]) -> Path:
    """Fly the two policies once more, and write the film.

    Args:
        results: Of the study; it compares two policies, see `require_film`.
        kind: "webp", "gif" or "mp4".
        flights_of: Makes the environment of the test of an arm, with so many flights.

    Returns:
        The file.
    """
    from tqdm import tqdm

    study, pair = results.study, pair_of(results)
    assert pair is not None
    sides = [
        side_of(results, name, seed, pair.episode, flights_of)
        for name, seed in pair.trainings.items()
    ]
    return save_side_by_side(
        sides,
        film_file(study, kind),
        fps=RATE,
        speed=study.about.film_speed,
        progress=lambda times: tqdm(times, desc="filming", unit=" pictures"),
    )


def side_of(
    results: Results,
    name: str,
    seed: int,
    episode: int,
    flights_of: Callable[[Arm, int], Any],
) -> Side:
    """One episode of one training, flown among all episodes of the test as it was in the test.

    In a smaller batch the policy's matrix products would round differently, and a flight that is
    lost can end elsewhere for it.
    """
    from baselines.policies import load_policy

    study, arm = results.study, results.arm(name)
    env = flights_of(arm, study.episodes)
    policy = load_policy(study.policy_of(arm, seed), env)
    recorder = FlightRecorder(env.unwrapped.flights.batch, episode)
    flying = True

    def keep(step: int, batch: Any, which: NDArray[np.bool_]) -> None:
        nonlocal flying
        if flying:  # the instant at which it ends among them
            recorder.keep()
        flying = bool(which[episode])

    episodes = roll_out(policy, env, seed=study.first_episode, watch=keep)
    env.close()
    ending = str(episodes.ending[episode])
    return Side(
        flight=recorder.flight,
        label=label_of(results, name),
        ending="finish" if ending == "task" else ending,
        crashed=bool(episodes.crashed[episode]),
        course=study.about.course,
    )

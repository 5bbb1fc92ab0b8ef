"""Speed of a task written in NumPy, compared with the compiled task."""

import math
from functools import partial
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from quad_gym import rewards
from quad_gym.commands import benchmark
from quad_gym.commands.benchmark import random_actions
from quad_gym.tasks.task import Task
from scripts.benchmarks.scope import Scope

if TYPE_CHECKING:
    from quad_gym.tasks.view import View

COUNTS = (8, 1024)  #: numbers of flights in the batches
TIPPED = math.cos(math.radians(100.0))


class OwnCircle(Task):
    """Reward, endings and observation of the circle in NumPy."""

    replaces_observation = True

    def reward(self, view: "View") -> NDArray[np.float64]:
        """(n,) the built-in reward per second."""
        return rewards.TRACKING(view)

    def terminated(self, view: "View") -> NDArray[np.bool_]:
        """(n,) too far from the reference, tipped over, or on the ground."""
        away, grounded = view.position_error > 3.0, view.position[:, 2] < -0.5
        return away | grounded | (view.truth.up[:, 2] < TIPPED)

    def truncated(self, view: "View") -> NDArray[np.bool_]:
        """(n,) time limit reached, or filter failed."""
        return np.logical_or(view.step >= 500, view.estimate.status)

    def observe(self, view: "View") -> dict[str, NDArray[np.float64]]:
        """Errors, directions, rates, reference and action, in the body frame."""
        seen = view.observed
        return {
            "position_error": seen.position_error,
            "velocity_error": seen.velocity_error,
            "up": seen.up,
            "heading": seen.heading,
            "body_rates": seen.body_rates,
            "reference_acceleration": seen.reference_acceleration,
            "preview": seen.preview.reshape(-1, 6),
            "last_action": view.action,
        }


def time_own_task(scope: Scope) -> list[benchmark.Row]:
    """Time steps of both tasks in alternation, at 50 Hz on the estimate."""
    rows, effort = list[benchmark.Row](), scope.effort
    options: dict[str, Any] = {"control_rate": 50.0, "threads": scope.threads}
    kinds = (options, {**options, "task": OwnCircle()})
    for count in COUNTS:
        envs = [gymnasium.make_vec("QuadGym/Circle-v0", num_envs=count, **kind) for kind in kinds]
        steps = [partial(_step, env, random_actions(count)) for env in envs]
        for env in envs:
            env.reset(seed=0)
        first = benchmark.by_turns(
            [partial(benchmark.lasting, step, 1) for step in steps], 3
        )  # warms up
        calls = max(1, round(effort.seconds / 4.0 / first[0].best))
        jobs = [partial(benchmark.lasting, step, calls) for step in steps]
        found = benchmark.by_turns(jobs, 4 * effort.repeats)
        for env in envs:
            env.close()
        for name, timed in zip(("shipped", "own, in NumPy"), found, strict=True):
            share = found[0].best / timed.best
            label = f"circle {name}, {count} flights"
            rows.append(benchmark.report(label, timed.per(count), envs=count, share=share))
    return rows


def _step(env: Any, actions: Any) -> None:
    env.step(next(actions))


SECTION = benchmark.Section(
    time_own_task,
    {
        "The circle, built-in and as a user-defined task, 50 Hz, estimate": {
            "task": benchmark.NAME,
            "steps/s": benchmark.per_second,
            "spread": benchmark.SPREAD,
            "of shipped": benchmark.column("share", ".2f"),
        }
    },
)

"""A task of a user's own in the benchmark: the circle written anew in NumPy, beside what ships."""

import math
from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from quad_gym.analysis.reports import text_table
from quad_gym.commands.benchmark.interfaces import random_actions
from quad_gym.commands.benchmark.timing import Effort, Row, by_turns, lasting, percent, report
from quad_gym.params.reward import RewardParams
from quad_gym.tasks.task import Task

if TYPE_CHECKING:
    from quad_gym.tasks.view import View

COUNTS = (8, 1024)
"""Flights in the batches."""

# arrays of no axes: NumPy would make one of a Python number in every step, which takes a while
_W = RewardParams()
NEAR_DECAY, FINE_DECAY, FINE = map(np.array, (-_W.near_decay, -_W.fine_decay, _W.fine))
HEADING, ACTION_RATE, BODY_RATES = map(np.array, (_W.heading, _W.action_rate, _W.body_rates))
FAR, LOW, MOST_STEPS = np.array(3.0), np.array(-0.5), np.array(500)
TIPPED = np.array(math.cos(math.radians(100.0)))


class OwnCircle(Task):
    """The circle's reward, endings and observation in NumPy, written for few flights.

    It makes as few calls as it can, of the functions that begin soonest: constants are arrays, and
    `np.vecdot` takes the place of `np.einsum`, which is faster with a thousand flights only.
    """

    replaces_observation = True

    def reward(self, view: "View") -> NDArray[np.float64]:
        """(n,) closeness and heading less changes of the action and body rates, a second."""
        error, change, rates = view.position_error, view.action - view.last_action, view.body_rates
        closeness = np.exp(NEAR_DECAY * error) + FINE * np.exp(FINE_DECAY * error)
        facing = np.vecdot(view.truth.forward, view.reference_heading)
        costs = ACTION_RATE * np.vecdot(change, change) + BODY_RATES * np.vecdot(rates, rates)
        return closeness + HEADING * facing - costs

    def terminated(self, view: "View") -> NDArray[np.bool_]:
        """(n,) too far from the reference, tipped over, or on the ground."""
        away, grounded = view.position_error > FAR, view.position[:, 2] < LOW
        return away | grounded | (view.truth.up[:, 2] < TIPPED)

    def truncated(self, view: "View") -> NDArray[np.bool_]:
        """(n,) out of time, or with a filter that has failed."""
        return np.logical_or(view.step >= MOST_STEPS, view.estimate.status)

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


def time_own_task(effort: Effort, threads: int) -> list[Row]:
    """Steps of both, by turns, at 50 Hz on the estimate.

    Args:
        effort: How long to measure.
        threads: Threads to use.
    """
    rows: list[Row] = []
    for count in COUNTS:
        options: dict[str, Any] = {
            "control_rate": 50.0,
            "threads": threads,
        }
        envs, steps = [], []
        for own_task in (None, OwnCircle()):
            more: dict[str, Any] = {} if own_task is None else {"task": own_task}
            env = gymnasium.make_vec("QuadGym/Circle-v0", num_envs=count, **options, **more)
            env.reset(seed=0)
            envs.append(env)
            steps.append(partial(_step, env, random_actions(count)))
        once = by_turns([partial(lasting, step, 1) for step in steps], 3)  # and to warm up
        calls = max(1, round(effort.seconds / 4.0 / once[0].best))
        found = by_turns([partial(lasting, step, calls) for step in steps], 4 * effort.repeats)
        for env in envs:
            env.close()
        for name, timing in zip(("shipped", "own, in NumPy"), found, strict=True):
            share = found[0].best / timing.best
            label = f"circle {name}, {count} flights"
            rows.append(report(label, timing.per(count), envs=count, share=share))
    return rows


def _step(env: Any, actions: Iterator[Any]) -> None:
    env.step(next(actions))


def own_task_table(rows: list[Row]) -> str:
    """The figures of tasks of a user's own."""
    cells = [
        (
            r["name"],
            f"{1.0 / r['seconds']:,.0f}",
            percent(r["spread"]),
            f"{r['share']:.2f}",
        )
        for r in rows
    ]
    heading = "The circle, shipped and as a task of one's own, 50 Hz, estimate"
    return text_table({heading: ["task", "steps/s", "spread", "of shipped"]}, cells)

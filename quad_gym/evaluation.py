"""Evaluation of a policy: one episode in each flight, with results for each episode."""

from collections.abc import Callable, Iterator
from itertools import islice
from typing import Any, NamedTuple, Protocol

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from quad_gym.analysis.metrics import NO_CRASHES
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.envs import keywords_of
from quad_gym.envs.vector import QuadVectorEnv
from quad_gym.params import checks as check
from quad_gym.records import Ending


class Policy(Protocol):
    """Any object with a method `predict` as in Stable-Baselines3."""

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Any, Any]:
        """Return actions for a batch of observations, and the state of a recurrent policy."""
        ...


class Episodes(NamedTuple):
    """Results of n episodes; each field is an array (n,).

    From a crash to the time limit, the tracking error counts as the bound `out_of_bounds` of the
    task, at which episodes end. A crash therefore never makes a mean error smaller.
    """

    returns: NDArray[np.float64]  #: sums of rewards
    lengths: NDArray[np.int64]  #: steps
    mean_error: NDArray[np.float64]  #: true position error, mean over the episode [m]
    late_error: NDArray[np.float64]
    """True position error, mean over the second half of the time limit [m]; NaN for episodes that
    ended before the time limit without a crash"""
    estimation_error: NDArray[np.float64]
    """Distance between observed and true position, mean up to the end of the episode [m]"""
    crashed: NDArray[np.bool_]  #: True for episodes that ended in a crash
    gates_passed: NDArray[np.int64]  #: number of gates passed on a course of gates
    ending: NDArray[Any]  #: name of the ending, as text

    def summary(self) -> dict[str, float]:
        """Means over the episodes, and the share of episodes that crashed, by name."""
        completed = self.late_error[~np.isnan(self.late_error)]
        return {
            "episodes": float(len(self.returns)),
            "return": float(self.returns.mean()),
            "mean_error": float(self.mean_error.mean()),
            "late_error": float(completed.mean()) if completed.size else float("nan"),
            "estimation_error": float(self.estimation_error.mean()),
            "crash_rate": float(self.crashed.mean()),
            "gates_passed": float(self.gates_passed.mean()),
        }


Watch = Callable[[int, FlightBatch, NDArray[np.bool_]], None]
"""Function called at the start (step 0) and after every step with the number of the step, the batch
of flights, and a mask (n,) of the episodes in progress."""


def roll_out(
    policy: Policy,
    env: gymnasium.vector.VectorEnv[Any, Any, Any],
    *,
    seed: int = 0,
    watch: Watch | None = None,
) -> Episodes:
    """Run one episode in each flight of a vector environment; episode i is seeded with seed + i.

    Args:
        policy: Policy, which acts deterministically on batches of observations.
        env: A `QuadVectorEnv`.
        seed: Seed of the first episode.
        watch: Function called at the start and after every step, such as `recording.Tracer.add`.

    Returns:
        Results of each episode. Errors refer to the true position.

    Raises:
        ValueError: If `env` is not a `QuadVectorEnv`, or its episodes have no time limit, or do not
            begin by themselves.
    """
    quads = env.unwrapped
    if not isinstance(quads, QuadVectorEnv) or hasattr(quads, "device"):
        raise ValueError(
            "env must be a QuadVectorEnv, as gymnasium.make_vec makes it, got "
            f"{type(quads).__name__}"
        )
    limit, bound = quads.flights.batch.max_steps, quads.flights.batch.task.out_of_bounds
    if limit == 0:
        raise ValueError("env must have a time limit: a duration or max_episode_steps above 0")
    count = env.num_envs
    if quads.autoreset_mode == AutoresetMode.DISABLED and count > 1:
        raise ValueError(
            'env must begin episodes by itself, with autoreset_mode="NextStep" or "SameStep", got '
            f'"{quads.autoreset_mode.value}"'
        )
    returns, errors, late, estimation = (np.zeros(count) for _ in range(4))
    lengths, gates = (np.zeros(count, np.int64) for _ in range(2))
    crashed, flying = np.zeros(count, bool), np.ones(count, bool)
    ending = np.full(count, "none", object)

    steps = steps_of(policy, env, seed)
    next(steps)
    if watch is not None:
        watch(0, quads.flights.batch, flying)
    for step, (reward, terminated, truncated, info) in enumerate(islice(steps, limit), 1):
        info = _info_of_step(info)
        returns[flying] += reward[flying]
        errors[flying] += info["position_error"][flying]
        estimation[flying] += info["estimation_error"][flying]
        lengths += flying
        if step > limit // 2:
            late[flying] += info["position_error"][flying]
        over = flying & (terminated | truncated)
        if over.any():
            ending[over] = [str(Ending(number)) for number in info["ending"][over]]
            crashed |= over & terminated & ~np.isin(info["ending"], NO_CRASHES)
            gates[over] = info["gates_passed"][over]
            flying &= ~over
        if watch is not None:
            watch(step, quads.flights.batch, flying | (over & (lengths == limit)))
        if not flying.any():
            break
    lost = (lengths < limit) & ~np.isin(ending, [str(reason) for reason in NO_CRASHES])
    half = limit // 2
    errors += bound * np.where(lost, limit - lengths, 0)
    late += bound * np.where(lost, limit - np.maximum(lengths, half), 0)
    mean_error = errors / np.where(lost, limit, lengths)
    late_error = np.where(lost | (lengths == limit), late / (limit - half), np.nan)
    estimation /= lengths
    return Episodes(returns, lengths, mean_error, late_error, estimation, crashed, gates, ending)


def steps_of(
    policy: Policy, env: gymnasium.vector.VectorEnv[Any, Any, Any], seed: int
) -> Iterator[tuple[Any, ...]]:
    """Reset an environment, and step it for as long as asked; the policy acts deterministically.

    Yields:
        Nothing, (), after the reset; rewards, terminated, truncated and `info` after each step.
    """
    observation, _ = env.reset(seed=seed)
    yield ()
    state, starts = None, np.ones(env.num_envs, bool)
    while True:
        action, state = policy.predict(
            observation, state=state, episode_start=starts, deterministic=True
        )
        observation, *results = env.step(action)
        starts = np.zeros(env.num_envs, bool)
        yield tuple(results)


def _info_of_step(info: dict[str, Any]) -> dict[str, Any]:
    """Replace `info` by `final_info` for flights whose next episode has begun in the step."""
    if "final_info" not in info:
        return info
    over, final = info["_final_info"], info["final_info"]
    return info | {
        name: np.where(over, final[name], info[name]) for name in final if not name.startswith("_")
    }


def evaluate(
    policy: Policy,
    env_id: str,
    *,
    episodes: int = 100,
    seed: int = 0,
    watch: Watch | None = None,
    **keywords: Any,
) -> Episodes:
    """Evaluate a policy over a number of episodes of an environment.

    Args:
        policy: Policy, which acts deterministically on batches of observations.
        env_id: Id from `quad_gym.IDS`, or one registered with `quad_gym.register_task`.
        episodes: Number of episodes.
        seed: Seed of the first episode; episode i has seed + i.
        watch: As in `roll_out`.
        keywords: Keywords of the environment.

    Returns:
        Results of each episode.

    Raises:
        ValueError: If an argument is invalid.
    """
    keywords_of(env_id)
    count = check.whole("episodes", episodes)
    env = gymnasium.make_vec(env_id, num_envs=count, **keywords)
    return roll_out(policy, env, seed=seed, watch=watch)

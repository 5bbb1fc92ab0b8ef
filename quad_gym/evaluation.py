"""Rolling out a policy, with results episode by episode."""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import gymnasium
import numpy as np
from numpy.typing import NDArray

from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.envs import keywords_of
from quad_gym.envs.vector import QuadVectorEnv
from quad_gym.params import checks as check
from quad_gym.records import Ending

NO_CRASHES = (Ending.LAST_GATE, Ending.TASK)
"""Endings of terminated episodes that are no crashes; what a task's own ending is, it knows."""


class Policy(Protocol):
    """Anything with the `predict` of Stable-Baselines3."""

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Any, Any]:
        """Actions for a batch of observations, and the state of a recurrent policy."""
        ...


class Episodes(NamedTuple):
    """One number per episode, each an array (n,)."""

    returns: NDArray[np.float64]
    """sum of rewards"""
    lengths: NDArray[np.int64]
    """steps"""
    mean_error: NDArray[np.float64]
    """true position error, mean over the episode [m]"""
    late_error: NDArray[np.float64]
    """true position error, mean over the time limit's second half [m]; NaN if it ended before"""
    estimation_error: NDArray[np.float64]
    """distance of the seen from the true position, mean over the episode [m]"""
    crashed: NDArray[np.bool_]
    """whether it was terminated by a crash"""
    gates_passed: NDArray[np.int64]
    """on a course of gates"""
    ending: NDArray[Any]
    """the ending as text"""

    def summary(self) -> dict[str, float]:
        """Means over the episodes, and the share that crashed."""
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
"""Called at the start (step 0) and after every step, with the flights and which still count."""


def roll_out(
    policy: Policy,
    env: gymnasium.vector.VectorEnv[Any, Any, Any],
    *,
    seed: int = 0,
    watch: Watch | None = None,
) -> Episodes:
    """Fly one episode in every flight of a vector environment; episode i is seeded with seed + i.

    Args:
        policy: Acts on batches of observations, deterministically.
        env: A `QuadVectorEnv`.
        seed: Of the first episode.
        watch: Called at the start and after every step, such as `recording.Tracer.add`.

    Returns:
        One number per episode. Errors are against the true position.

    Raises:
        ValueError: If `env` is no `QuadVectorEnv`, or its episodes have no time limit.
    """
    quads = env.unwrapped
    if not isinstance(quads, QuadVectorEnv):
        raise ValueError(f"env must be a QuadVectorEnv, got {type(env).__name__}")
    limit = quads.flights.batch.max_steps
    if limit == 0:
        raise ValueError("env must have a time limit: a duration or max_episode_steps above 0")
    count = env.num_envs
    returns, errors, late, estimation = (np.zeros(count) for _ in range(4))
    lengths, gates, late_steps = (np.zeros(count, np.int64) for _ in range(3))
    crashed, flying = np.zeros(count, bool), np.ones(count, bool)
    ending = np.full(count, "none", object)

    observation, _ = env.reset(seed=seed)
    state, starts = None, np.ones(count, bool)
    if watch is not None:
        watch(0, quads.flights.batch, flying)
    for step in range(1, limit + 1):
        action, state = policy.predict(
            observation, state=state, episode_start=starts, deterministic=True
        )
        observation, reward, terminated, truncated, info = env.step(action)
        info = _info_of_step(info)
        starts = np.zeros(count, bool)
        returns[flying] += reward[flying]
        errors[flying] += info["position_error"][flying]
        estimation[flying] += info["estimation_error"][flying]
        lengths += flying
        if step > limit // 2:
            late[flying] += info["position_error"][flying]
            late_steps += flying
        over = flying & (terminated | truncated)
        ending[over] = [str(reason) for reason in info["ending"][over]]
        crashed |= over & terminated & ~np.isin(info["ending"], NO_CRASHES)
        gates[over] = info["gates_passed"][over]
        flying &= ~over
        if watch is not None:
            watch(step, quads.flights.batch, flying | (over & (lengths == limit)))
        if not flying.any():
            break
    complete = (lengths == limit) & ~crashed
    late_error = np.where(complete, late / np.maximum(late_steps, 1), np.nan)
    return Episodes(
        returns,
        lengths,
        errors / lengths,
        late_error,
        estimation / lengths,
        crashed,
        gates,
        ending,
    )


def _info_of_step(info: dict[str, Any]) -> dict[str, Any]:
    """What was judged of the step, also where a new episode has begun within it."""
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
    """Fly a policy for some episodes of an environment.

    Args:
        policy: Acts on batches of observations.
        env_id: One of `quad_gym.IDS`, or of `quad_gym.register_task`.
        episodes: How many.
        seed: Of the first episode; episode i has seed + i.
        watch: Called at the start and after every step, such as `recording.Tracer.add`.
        keywords: Those of the environment.

    Returns:
        One number per episode.

    Raises:
        ValueError: If an argument is invalid.
    """
    keywords_of(env_id)
    count = check.whole("episodes", episodes)
    env = gymnasium.make_vec(env_id, num_envs=count, **keywords)
    return roll_out(policy, env, seed=seed, watch=watch)

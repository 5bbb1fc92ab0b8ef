"""The environments: one flight, many flights, and many flights for Stable-Baselines3."""

from typing import TYPE_CHECKING, Any

from gymnasium.envs.registration import register, registry

from quad_gym.params import checks as check
from quad_gym.params.task import TASKS

if TYPE_CHECKING:
    from quad_gym.envs.sb3 import QuadVecEnv

IDS = {f"QuadGym/{task.title().replace('_', '')}-v0": task for task in TASKS}
"""The registered environments and their tasks."""


def register_all() -> None:
    """Make the ids known to Gymnasium, once."""
    for env_id, task in IDS.items():
        if env_id not in registry:
            register(
                env_id,
                entry_point="quad_gym.envs.single:QuadEnv",
                vector_entry_point="quad_gym.envs.vector:QuadVectorEnv",
                kwargs={"task": task},
            )


def make_sb3_vec_env(
    env_id: str, n_envs: int = 1, seed: int | None = None, **keywords: Any
) -> "QuadVecEnv":
    """N flights of an id as a Stable-Baselines3 vector environment.

    Args:
        env_id: One of `IDS`, with or without the prefix "quad_gym:".
        n_envs: Number of flights.
        seed: Seeds flight i with seed + i at the first reset.
        keywords: Those of `QuadEnv`, and `threads`.

    Returns:
        The environment, ready for any Stable-Baselines3 algorithm.

    Raises:
        ValueError: If the id or a keyword is unknown, or a value is invalid.
        ImportError: If Stable-Baselines3 is not installed.
    """
    name = env_id.removeprefix("quad_gym:") if isinstance(env_id, str) else env_id
    if not isinstance(name, str) or name not in IDS:
        raise ValueError(f"env_id must be one of {', '.join(IDS)}, got {env_id!r}")
    check.seed("seed", seed)
    try:
        from quad_gym.envs.sb3 import QuadVecEnv
    except ImportError as error:
        raise ImportError(
            'make_sb3_vec_env needs Stable-Baselines3: pip install "quad-gym[train]"'
        ) from error
    env = QuadVecEnv(n_envs, IDS[name], **keywords)
    if seed is not None:
        env.seed(seed)
    return env

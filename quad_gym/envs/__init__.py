"""The environments: one flight, many flights, and many flights for Stable-Baselines3 or torch."""

from typing import TYPE_CHECKING, Any, Unpack

from gymnasium.envs.registration import register, registry

from quad_gym.envs.config import BENCHMARKS, EnvKeywords, VectorKeywords, require_known, shows
from quad_gym.params import checks as check
from quad_gym.params.task import TASKS

if TYPE_CHECKING:
    import torch

    from quad_gym.envs.sb3 import QuadSB3VecEnv
    from quad_gym.envs.torch_env import QuadTorchVecEnv
    from quad_gym.tasks import Task

IDS = {f"QuadGym/{task.title().replace('_', '')}-v0": task for task in (*TASKS, *BENCHMARKS)}
"""The registered environments: ids, and the tasks to which they belong."""

_ENTRY_POINTS = {
    "entry_point": "quad_gym.envs.single:QuadEnv",
    "vector_entry_point": "quad_gym.envs.vector:QuadVectorEnv",
}


def register_all() -> None:
    """Register all ids with Gymnasium, once."""
    for env_id, task in IDS.items():
        if env_id not in registry:
            register(env_id, **_ENTRY_POINTS, kwargs={"base": task})  # type: ignore[arg-type]


@shows(EnvKeywords)
def register_task(
    env_id: str,
    task: "Task | type[Task] | str",
    base: str = "QuadGym/Circle-v0",
    **keywords: Unpack[EnvKeywords],
) -> None:
    """Register an environment with your own task, for all three interfaces.

    Args:
        env_id: A new id, such as "Mine/Chase-v0".
        task: The task, see `quad_gym.Task`.
        base: The id of the environment that the task changes.
        keywords: Keywords of `QuadEnv`, as defaults.

    Raises:
        TypeError: If a keyword is unknown; the exception is also a ValueError.
        ValueError: If the id is one of `IDS`, or `base` is not one of them.
    """
    require_known(keywords)
    check.choice("base", base, tuple(IDS))
    if not isinstance(env_id, str) or env_id in IDS:
        raise ValueError(f"env_id must be a new one, got {env_id!r}")
    if not isinstance(task, str):  # a module is imported when an environment is made
        from quad_gym.tasks.task import resolve_task

        resolve_task(task)
    kwargs = {"base": (IDS[base], task), **keywords}
    register(env_id, **_ENTRY_POINTS, kwargs=kwargs)  # type: ignore[arg-type]


def keywords_of(env_id: str) -> dict[str, Any]:
    """Return the keywords of an id, "base" among them: of one of `IDS`, or of `register_task`."""
    name = env_id.removeprefix("quad_gym:") if isinstance(env_id, str) else env_id
    spec = registry.get(name) if isinstance(name, str) else None
    if spec is None or spec.entry_point != _ENTRY_POINTS["entry_point"]:
        raise ValueError(
            f"env_id must be one of {', '.join(IDS)}, or of register_task, got {env_id!r}"
            + _meant(env_id)
        )
    return dict(spec.kwargs)


def _meant(env_id: Any) -> str:
    """Return the end of a message that refuses an id, with the one that may be meant."""
    ours = _ENTRY_POINTS["entry_point"]
    registered = [name for name, spec in registry.items() if spec.entry_point == ours]
    id_of_task = {task: name for name, task in IDS.items()}
    close = check.closest(env_id, (*registered, *id_of_task))
    return f"; did you mean {id_of_task.get(close, close)}?" if close else ""


@shows(VectorKeywords)
def make_sb3_vec_env(
    env_id: str, n_envs: int = 1, seed: int | None = None, **keywords: Unpack[VectorKeywords]
) -> "QuadSB3VecEnv":
    """Make a Stable-Baselines3 vector environment of N flights.

    Args:
        env_id: One of `IDS`, with or without the prefix "quad_gym:", or an id of `register_task`.
        n_envs: Number of flights.
        seed: Seed of the first reset: flight i has seed + i.
        keywords: Keywords of `QuadEnv`, `threads` and `render_flights`.

    Returns:
        The environment, ready for any Stable-Baselines3 algorithm.

    Raises:
        TypeError: If a keyword is unknown; the exception is also a ValueError.
        ValueError: If the id is unknown, or a value is invalid.
        ImportError: If Stable-Baselines3 is not installed.
    """
    if "num_envs" in keywords:
        raise check.UnknownKeywordError("num_envs is n_envs here, as in Stable-Baselines3")
    given: dict[str, Any] = keywords_of(env_id) | dict(keywords)
    check.seed("seed", seed)
    try:
        from quad_gym.envs.sb3 import QuadSB3VecEnv
    except ImportError as error:
        raise ImportError(
            'make_sb3_vec_env needs Stable-Baselines3: pip install "quad-gym[train]"'
        ) from error
    env = QuadSB3VecEnv(n_envs, **given)
    if seed is not None:
        env.seed(seed)
    return env


@shows(VectorKeywords)
def make_torch_vec_env(
    env_id: str,
    num_envs: int = 1,
    device: "str | torch.device" = "cpu",
    *,
    autoreset_mode: str = "NextStep",
    **keywords: Unpack[VectorKeywords],
) -> "QuadTorchVecEnv":
    """Make a vector environment of N flights whose observations and rewards are torch tensors.

    Args:
        env_id: One of `IDS`, with or without the prefix "quad_gym:", or an id of `register_task`.
        num_envs: Number of flights.
        device: Device of the flights and tensors: "cpu", or "cuda" for an NVIDIA GPU.
        autoreset_mode: "NextStep", "SameStep" or "Disabled", as in Gymnasium.
        keywords: Keywords of `QuadEnv`, `threads` and `render_flights`.

    Returns:
        The environment; `reset` takes `seed` and `options`, as that of `gymnasium.make_vec`.

    Raises:
        TypeError: If a keyword is unknown; the exception is also a ValueError.
        ValueError: If the id is unknown, a value is invalid, or there is no such GPU.
        ImportError: If torch is not installed; on a GPU, also if cuda-core or Numba is not.
    """
    given: dict[str, Any] = keywords_of(env_id) | dict(keywords)
    try:
        from quad_gym.envs.torch_env import QuadTorchVecEnv, checked_device
    except ImportError as error:
        raise ImportError(
            'make_torch_vec_env needs torch: pip install "quad-gym[train]"'
        ) from error
    if checked_device(device).type == "cuda":
        from quad_gym.envs.torch_env import QuadDeviceVecEnv

        return QuadDeviceVecEnv(num_envs, device=device, autoreset_mode=autoreset_mode, **given)
    return QuadTorchVecEnv(num_envs, device=device, autoreset_mode=autoreset_mode, **given)

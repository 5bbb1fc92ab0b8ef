"""`SkrlWrapper`: flights as an environment of skrl."""

from typing import Any

import gymnasium
import torch
from skrl.envs.wrappers.torch import Wrapper

from quad_gym.envs.torch_env import QuadTorchVecEnv
from quad_gym.params import checks as check


class SkrlWrapper(Wrapper):
    """Flights for the trainers of skrl.

    Args:
        env: An environment of `quad_gym.make_torch_vec_env`, with the relative or absolute layout
            and without `privileged`.
        seed: Seed of the first reset: flight i has seed + i.

    Raises:
        ValueError: If the observation is a dictionary.
    """

    def __init__(self, env: QuadTorchVecEnv, seed: int | None = None) -> None:
        check.instance("env", env, QuadTorchVecEnv)
        if isinstance(env.single_observation_space, gymnasium.spaces.Dict):
            raise ValueError("env must have privileged=False: skrl observes one array")
        super().__init__(env)
        self._seed, self._started = seed, False

    @property
    def observation_space(self) -> gymnasium.Space[Any]:
        """Observation space of one flight."""
        return self._env.single_observation_space

    @property
    def action_space(self) -> gymnasium.Space[Any]:
        """Action space of one flight."""
        return self._env.single_action_space

    def reset(self) -> tuple[torch.Tensor, dict[str, Any]]:
        """Begin the first episodes; later ones begin by autoreset."""
        if not self._started:
            self._observations, self._infos = self._env.reset(seed=self._seed)
            self._started = True
        return self._observations, self._infos

    def step(
        self, actions: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Fly one control period; rewards, terminated and truncated are (n, 1)."""
        self._observations, rewards, terminated, truncated, self._infos = self._env.step(actions)
        columns = (values[:, None] for values in (rewards, terminated, truncated))
        return self._observations, *columns, self._infos  # type: ignore[return-value]

    def state(self) -> None:
        """Return None: critics have the observation of the policy."""

    def render(self, *args: Any, **kwargs: Any) -> Any:
        """Return the output of the environment's `render`; None without a `render_mode`."""
        return None if self._env.render_mode is None else self._env.render()

    def close(self) -> None:
        """Close the environment."""
        self._env.close()

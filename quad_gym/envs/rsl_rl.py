"""`RslRlVecEnv`: flights as a vector environment of rsl_rl."""

from typing import Any

import torch
from gymnasium.vector import AutoresetMode
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from quad_gym.envs.torch_env import QuadTorchVecEnv
from quad_gym.params import checks as check


class RslRlVecEnv(VecEnv):
    """Flights for the runners of rsl_rl.

    Observations are a `TensorDict` with two groups: "policy" has the observation of the policy,
    "critic" the same and, with `privileged=True`, the privileged quantities behind it.
    `extras["time_outs"]` marks episodes that were truncated.

    Args:
        env: An environment of `quad_gym.make_torch_vec_env` with `autoreset_mode="SameStep"`.
        seed: Seed of the first reset: flight i has seed + i.

    Raises:
        ValueError: If the environment has another autoreset mode or no time limit.
    """

    def __init__(self, env: QuadTorchVecEnv, seed: int | None = None) -> None:
        check.instance("env", env, QuadTorchVecEnv)
        if env.autoreset_mode != AutoresetMode.SAME_STEP:
            raise ValueError(
                'env must have autoreset_mode="SameStep", which rsl_rl assumes, got '
                f'"{env.autoreset_mode.value}"'
            )
        batch = env.flights.batch
        if not batch.max_steps:
            raise ValueError("env must have a time limit: give a duration or max_episode_steps")
        self.env, self.device, self.num_envs = env, env.device, env.num_envs
        self.num_actions = int(env.single_action_space.shape[0])  # type: ignore[index]
        self.max_episode_length = batch.max_steps
        self._lengths = torch.zeros(self.num_envs, dtype=torch.long, device=self.device)
        self.cfg = {"env_id": env.spec.id if env.spec else env.flights.name, "seed": seed}
        self._observations = env.reset(seed=seed)[0]

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Number of steps flown in each flight's episode, (n,) of whole numbers.

        Writing it, or its elements, changes when the flights reach their time limit, as the runner
        does with `init_at_random_ep_len=True`.
        """
        return self._lengths

    @episode_length_buf.setter
    def episode_length_buf(self, lengths: torch.Tensor) -> None:
        whole = isinstance(lengths, torch.Tensor) and not (
            lengths.is_floating_point() or lengths.is_complex() or lengths.dtype == torch.bool
        )
        if not whole or lengths.shape != (self.num_envs,):
            raise ValueError(
                f"episode_length_buf must be a tensor of {self.num_envs} whole numbers, got "
                f"{lengths!r}"
            )
        if bool(((lengths < 0) | (lengths >= self.max_episode_length)).any()):
            raise ValueError(
                f"episode_length_buf must be at least 0 and below {self.max_episode_length}, the "
                f"time limit, got {int(lengths.min())} to {int(lengths.max())}"
            )
        self._lengths = lengths.to(self.device, torch.long, copy=True)

    def get_observations(self) -> TensorDict:
        """Return the present observations in the groups "policy" and "critic"."""
        seen = self._observations
        if isinstance(seen, dict):
            policy, critic = seen["policy"], torch.cat([seen["policy"], seen["privileged"]], dim=1)
        else:
            policy = critic = seen
        return TensorDict({"policy": policy, "critic": critic}, batch_size=[self.num_envs])

    def step(
        self, actions: torch.Tensor
    ) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Fly one control period.

        Args:
            actions: (n, 4) in [-1, 1]; larger values are clipped.

        Returns:
            Observations, rewards (n,), ends of episodes (n,) bool, extras.
        """
        self.env.write_steps(self._lengths)
        self._observations, rewards, terminated, truncated, infos = self.env.step(actions)
        ended = terminated | truncated
        self._lengths += 1
        self._lengths[ended] = 0
        log = {f"/{name}": infos[name] for name in ("position_error", "estimation_error")}
        extras = {"time_outs": truncated & ~terminated, "log": log}
        return self.get_observations(), rewards, ended, extras

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

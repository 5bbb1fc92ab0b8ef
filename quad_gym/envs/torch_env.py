"""`QuadTorchVecEnv`: many flights as a vector environment of torch tensors."""

from typing import Any, Unpack

import numpy as np
import torch
from gymnasium.vector import AutoresetMode

from quad_gym.envs.config import Base
from quad_gym.envs.keywords import VectorKeywords, shows
from quad_gym.envs.vector import QuadVectorEnv
from quad_gym.params import checks as check


class QuadTorchVecEnv(QuadVectorEnv):
    """N flights for training loops in torch, whose results are tensors.

    Flights, seeds, autoreset and keywords are as in `QuadVectorEnv`, and the flights have the
    same bits. Observations share the memory that the compiled code wrote, without a copy; every
    step returns new tensors. Rewards are float32, (n,). `info` has tensors (n,) by the same names,
    without the masks `_name`, which are true for all flights after a step. With
    `autoreset_mode="SameStep"`, `info["final_obs"]` has the last observations of the episodes that
    ended, with rows for all flights, valid where the mask `info["_final_obs"]` is true.

    Args:
        num_envs: Number of flights.
        device: Device of the tensors, "cpu".
        keywords: Keywords of `QuadVectorEnv`.

    Raises:
        TypeError: If a keyword is unknown; the exception is also a ValueError.
        ValueError: If the device is another one, or the value of a keyword is invalid.
    """

    @shows(VectorKeywords)
    def __init__(
        self,
        num_envs: int = 1,
        *,
        device: str | torch.device = "cpu",
        base: "Base | None" = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        **keywords: Unpack[VectorKeywords],
    ) -> None:
        self.device = checked_device(device)
        if self.device.type != "cpu":
            raise ValueError(f'device must be "cpu", got {device!r}')
        given: dict[str, Any] = dict(keywords)
        super().__init__(num_envs, base=base, autoreset_mode=autoreset_mode, **given)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin episodes, as `QuadVectorEnv.reset` does.

        Args:
            seed: As in `QuadVectorEnv.reset`.
            options: As in `QuadVectorEnv.reset`; "reset_mask" may be a tensor.

        Returns:
            Observations of all flights, and `info` of those that were reset, with masks.
        """
        if isinstance(options, dict):
            options = {name: _array(value) for name, value in options.items()}
        seen, infos = super().reset(seed=seed, options=options)
        return _tensors(seen), _tensors(infos)

    def step(  # type: ignore[override]
        self, actions: torch.Tensor
    ) -> tuple[Any, torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Fly one control period.

        Args:
            actions: (n, 4) in [-1, 1]; larger values are clipped. Gradients do not pass.

        Returns:
            Observations, rewards, terminated, truncated, `info`: new tensors.

        Raises:
            ValueError: If the actions have another shape or are not finite; nothing has been flown
                then.
            gymnasium.error.ResetNeeded: As in `QuadVectorEnv.step`.
        """
        seen, rewards, terminated, truncated, infos, finals = self._flown(_array(actions))
        if finals is not None:
            last = self.flights.split(self.flights.batch.final_observations.copy())
            infos |= {"final_obs": last, "_final_obs": self._over.copy(), "final_info": finals}
        return (
            _tensors(seen),
            torch.from_numpy(rewards).float(),
            torch.from_numpy(terminated),
            torch.from_numpy(truncated),
            _tensors(infos),
        )

    def write_steps(self, steps: torch.Tensor) -> None:
        """Set the number of steps of each flight's episode, (n,), from which its time limit counts.

        Reference, sensors and faults keep their time.

        Raises:
            ValueError: If they are not n whole numbers of at least 0.
        """
        counts = check.array("steps", _array(steps), (self.num_envs,))
        if (counts < 0.0).any() or (counts % 1.0).any():
            raise ValueError(f"steps must be whole numbers of at least 0, got {steps!r}")
        self.flights.batch.write(np.arange(self.num_envs), step=counts)


def checked_device(device: str | torch.device) -> torch.device:
    """Return the device of the tensors: the processor, or an NVIDIA GPU."""
    try:
        found = torch.device(device)
    except (RuntimeError, TypeError) as error:
        raise ValueError(f'device must be "cpu" or "cuda", got {device!r}') from error
    if found.type not in ("cpu", "cuda"):
        raise ValueError(f'device must be "cpu" or "cuda", got {device!r}')
    return found


def _array(value: Any) -> Any:
    """Return a tensor as an array that shares its memory, and other values as they are."""
    if not isinstance(value, torch.Tensor):
        return value
    value = value.detach().cpu()
    return value.float().numpy() if value.dtype == torch.bfloat16 else value.numpy()


def _tensors(values: Any) -> Any:
    """Return arrays, also in dictionaries, as tensors that share their memory."""
    if isinstance(values, dict):
        return {name: _tensors(value) for name, value in values.items()}
    return torch.from_numpy(values)

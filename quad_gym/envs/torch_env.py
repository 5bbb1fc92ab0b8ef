"""`QuadTorchVecEnv`: flights as a vector environment of torch tensors, and the same on a GPU."""

from collections.abc import Callable
from typing import Any, Unpack

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from quad_gym.batch.starts import Words, keys_of, stream_keys
from quad_gym.configuration import MAX_FLIGHTS
from quad_gym.device import CudaLauncher, DevicePlan, Launcher, flights_on, plan_of, ptx_of
from quad_gym.envs.config import Base, VectorKeywords, shows
from quad_gym.envs.flights import named_options
from quad_gym.envs.vector import QuadVectorEnv, seeds_of
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


# --------------------------------------------------------------------------------------------------
# Flights on a GPU.
# --------------------------------------------------------------------------------------------------

_ON_PROCESSOR = ("threads", "render_mode", "render_flights")


class QuadDeviceVecEnv(QuadTorchVecEnv):
    """N flights on a GPU; flight i has the bits of a `QuadEnv` seeded with seed + i.

    A step is one launch of the kernel, without a copy to the host or a wait. The tensors of
    observations and `info` are views of the memory of the flights: the next step overwrites `info`,
    and the one after it the observations. The methods of a task in Python run on the host, which
    waits for the numbers that they read.
    `info` has "position_error" and "estimation_error", with `reward_terms=True` also these; with
    `autoreset_mode="SameStep"`, "final_obs" and its mask "_final_obs"; errors are then those at the
    end of the episode that ended. `batch.result` has the other results of a step, and
    `batch.record` the records of the flights.

    Args:
        num_envs: Number of flights.
        device: Device of the flights, such as "cuda" or "cuda:1".
        launcher: Makes the launcher of a plan's kernel; None: on the GPU.
        keywords: Keywords of `QuadEnv`.

    Raises:
        TypeError: If a keyword is unknown; the exception is also a ValueError.
        ValueError: If there is no GPU, the value of a keyword is invalid, or the configuration
            needs other Python than a task during a step: an estimator, or rendering.
        ImportError: If cuda-core or Numba is not installed.
    """

    _seeded = False

    @shows(VectorKeywords)
    def __init__(
        self,
        num_envs: int = 1,
        *,
        device: str | torch.device = "cuda",
        base: "Base | None" = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        launcher: Callable[[DevicePlan], Launcher] | None = None,
        **keywords: Unpack[VectorKeywords],
    ) -> None:
        given: dict[str, Any] = dict(keywords)
        for name in _ON_PROCESSOR:
            if given.pop(name, None) is not None:
                raise ValueError(f"{name} is of flights on the processor, and must not be given")
        check.whole("num_envs", num_envs, most=MAX_FLIGHTS)
        on_gpu = checked_device(device)
        if launcher is None and not torch.cuda.is_available():
            raise ValueError(
                f'device "{on_gpu}" needs an NVIDIA GPU and a torch with CUDA, and '
                "torch.cuda.is_available() is False"
            )
        super().__init__(1, base=base, autoreset_mode=autoreset_mode, threads=1, **given)
        plan = plan_of(self.flights.batch)
        make = launcher or (lambda plan: CudaLauncher(ptx_of(plan), on_gpu))
        self.device, self.num_envs = on_gpu, num_envs
        task = getattr(self.flights.batch, "made", None)
        self.batch = flights_on(on_gpu, plan, num_envs, make(plan), task)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        errors = ["position_error", "estimation_error"]
        self._infos: dict[str, Any] = {name: self.batch.result(name) for name in errors}
        self._terms = tuple(self.flights.batch.reward_terms())

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin episodes, as `QuadVectorEnv.reset` does.

        Args:
            seed: As in `QuadVectorEnv.reset`.
            options: "reset_mask" (n,) bool, a tensor or an array: the flights to reset.

        Returns:
            Observations of all flights, and `info`, which is empty.

        Raises:
            ValueError: If an option is unknown, or the seeds do not fit the flights.
        """
        options = named_options(options)
        mask = self._mask_on_gpu(options.pop("reset_mask", None))
        if options:
            raise ValueError(
                f"options on a GPU must be reset_mask alone, got {next(iter(options))}"
            )
        if not self._seeded:
            mask = None
        elif isinstance(seed, (list, tuple, np.ndarray)):
            seeds = seeds_of(list(seed), self.num_envs)
            everyone = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
            mask = everyone if mask is None else mask
            known = torch.tensor([one is not None for one in seeds], device=self.device)
            self.batch.reset(None, mask & ~known)
            mask = mask & known
        seen = self.batch.reset(self._keys(seed), mask)
        self._seeded = True
        return self._split(seen), {}

    def _mask_on_gpu(self, mask: Any) -> torch.Tensor | None:
        """Return the flights to reset; None: all. Reading a tensor would wait for the GPU."""
        if mask is None:
            return None
        if not isinstance(mask, torch.Tensor):
            return torch.from_numpy(self._checked_mask(mask)).to(self.device)
        if mask.dtype != torch.bool or mask.shape != (self.num_envs,):
            raise ValueError(
                f"options['reset_mask'] must have shape ({self.num_envs},) and booleans, got "
                f"{tuple(mask.shape)} and {mask.dtype}"
            )
        return mask

    def _keys(self, seed: int | list[int | None] | None) -> Words | None:
        """Return keys (n, 2) of the flights' streams; None: they continue."""
        if seed is None:
            if self._seeded:
                return None
            return np.random.default_rng().integers(0, 2**64, (self.num_envs, 2), np.uint64)
        if isinstance(seed, (list, tuple, np.ndarray)):
            return stream_keys(seeds_of(list(seed), self.num_envs))
        first = check.seed("seed", seed) or 0
        if first >= 1 << 63:
            return stream_keys(seeds_of(first, self.num_envs))
        return keys_of(np.arange(self.num_envs, dtype=np.uint64) + np.uint64(first))

    def write_steps(self, steps: torch.Tensor) -> None:
        """Set the number of steps of each flight's episode, as `QuadTorchVecEnv.write_steps`.

        Only the shape is checked: reading the numbers would wait for the GPU.
        """
        if tuple(steps.shape) != (self.num_envs,):
            raise ValueError(f"steps must have shape ({self.num_envs},), got {tuple(steps.shape)}")
        self.batch.write("step", steps.to(self.device, torch.float64))

    def step(
        self, actions: torch.Tensor
    ) -> tuple[Any, torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Fly one control period.

        Args:
            actions: (n, 4) on the device, in [-1, 1]; larger values are clipped, and NaN is not
                detected. Gradients do not pass.

        Returns:
            Observations, rewards, terminated, truncated, `info`.

        Raises:
            ValueError: If the actions have another shape.
            gymnasium.error.ResetNeeded: Before the first reset.
        """
        if tuple(actions.shape) != (self.num_envs, 4):
            raise ValueError(
                f"action must have shape {(self.num_envs, 4)}, got {tuple(actions.shape)}"
            )
        if not self._seeded:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        seen, result = self.batch.step(actions), self.batch.result
        terminated, truncated = result("terminated") > 0.0, result("truncated") > 0.0
        infos = dict(self._infos)
        if self.flights.reward_terms:
            infos["reward_terms"] = self.batch.reward_terms(self._terms)
        if self.autoreset_mode == AutoresetMode.SAME_STEP:
            infos["final_obs"] = self._split(self.batch.final_observations)
            infos["_final_obs"] = terminated | truncated
        return self._split(seen), result("reward").float(), terminated, truncated, infos

    def _split(self, seen: torch.Tensor) -> Any:
        """Return observations as the space has them: a tensor, or a dictionary of parts."""
        size = self.flights.policy_size
        return seen if size is None else {"policy": seen[:, :size], "privileged": seen[:, size:]}

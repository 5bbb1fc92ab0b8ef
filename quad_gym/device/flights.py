"""Flights whose records are a tensor: steps and resets are one launch each, without a wait.

It needs NumPy and torch, and no compiler: plan and kernel may be made elsewhere.
"""

from collections.abc import Iterable
from typing import Any, Protocol

import numpy as np
import torch

from quad_gym.device.plan import DevicePlan, Words
from quad_gym.kernels.stages import STAGE_TABLE
from quad_gym.records import WARP, Call, Command


class Launcher(Protocol):
    """Flies the blocks of a call."""

    warps: int  #: warps in flight at once, each with its own workspace

    def __call__(self, call: int, blocks: int, command: int) -> None:
        """Fly so many blocks; `call`: address of the words of the call on the device."""


class DeviceBatch:
    """N flights of one configuration on a device.

    Observations and results are views of the memory that the kernel writes. The next step
    overwrites results, and the one after it observations, which training loops store after a step.

    Args:
        plan: The configuration.
        count: Number of flights.
        launcher: Flies them.
        device: Device of the tensors.
    """

    def __init__(
        self, plan: DevicePlan, count: int, launcher: Launcher, device: str | torch.device = "cuda"
    ) -> None:
        self.plan, self.count, self.device = plan, count, torch.device(device)
        self._launch, size = launcher, plan.low.size
        blocks = -(-count // WARP)
        warps = min(launcher.warps, blocks)
        self._blocks = self._repeated(plan.flight, blocks)
        self._seen = [self._zeros(count, size, kind=torch.float32) for _ in range(2)]
        self.final_observations = torch.zeros_like(self._seen[0])
        """(n, k) float32, written where one episode ends and the next begins in a step"""
        self._actions = self._zeros(blocks * WARP, 4)
        self._resets = self._zeros(count, kind=torch.uint8)
        self._results = self._zeros(len(plan.results), blocks * WARP)
        self._shown = self._zeros(plan.shown, blocks * WARP)
        self._paths = [self._put(array) for array in (plan.paths, plan.pieces)]
        table = np.zeros(1, STAGE_TABLE)
        table["paths"], table["pieces"] = (tensor.data_ptr() for tensor in self._paths)
        self._memory = {
            Call.BLOCKS: self._blocks,
            Call.RESETS: self._resets,
            Call.WORLD: self._repeated(plan.world, 1),
            Call.OWN: self._repeated(plan.world, warps),
            Call.MODEL: self._repeated(plan.model, 1),
            Call.BELIEVED: self._repeated(plan.model, warps),
            Call.WORK: self._zeros(warps, plan.work, WARP),
            Call.STAGES: self._put(table.view(np.int64)),
            Call.ACTIONS: self._actions,
            Call.LOW: self._put(plan.low),
            Call.HIGH: self._put(plan.high),
            Call.FINAL_OBSERVATIONS: self.final_observations,
            Call.RESULTS: self._results,
            Call.SHOWN: self._shown,
        }
        words = np.zeros(len(Call), np.int64)
        for word, tensor in self._memory.items():
            words[word] = tensor.data_ptr()
        words[Call.BLOCKS] -= 8 * WARP * plan.skipped
        words[Call.PITCH] = 8 * WARP * len(plan.flight)
        words[Call.COUNT], words[Call.SIZE] = count, size
        words[Call.AUTORESET] = plan.autoreset
        words[Call.RESULT_PITCH] = words[Call.SHOWN_PITCH] = 8 * self._results.shape[1]
        self._calls = []
        for seen in self._seen:  # in turn
            words[Call.OBSERVATIONS] = seen.data_ptr()
            self._calls.append(self._put(words))

    def reset(self, keys: Words | None = None, mask: torch.Tensor | None = None) -> torch.Tensor:
        """Begin episodes.

        Args:
            keys: (n, 2) keys of the random streams, see `quad_gym.batch.seeding`; None: the
                streams continue.
            mask: (n,) bool, flights to reset; None: all.

        Returns:
            The observations.
        """
        self._resets.fill_(1) if mask is None else self._resets.copy_(mask)
        if keys is not None:
            chosen = self._resets.bool()
            given = self._put(keys.view(np.int64))
            self.write("key", torch.where(chosen[:, None], given, self.record("key")))
            for name in ("instant", "episode"):
                self.write(name, self.record(name).masked_fill_(chosen, 0))
        return self._fly(Command.RESET)

    def step(self, actions: torch.Tensor) -> torch.Tensor:
        """Fly one control period; return the observations, see `result` for the rest.

        Args:
            actions: (n, 4); they are clipped to [-1, 1], and not checked for NaN, which would wait.
        """
        self._keep_actions(actions)
        return self._fly(Command.STEP)

    def _keep_actions(self, actions: torch.Tensor) -> None:
        self._actions[: self.count].copy_(actions.detach()).clamp_(-1.0, 1.0)

    def _fly(self, command: Command) -> torch.Tensor:
        """Launch a command; return the observations, (n, k) float32."""
        self._seen.reverse()
        self._calls.reverse()
        self._launch(self._calls[0].data_ptr(), len(self._blocks), int(command))
        return self._seen[0]

    def result(self, name: str) -> torch.Tensor:
        """Return one of the results of the last step, (n,) float64."""
        return self._results[self.plan.results.index(name), : self.count]

    def reward_terms(self, builtin: Iterable[str]) -> dict[str, torch.Tensor]:
        """Return terms of the last step's reward by their names, (n,) each."""
        return {name: self.result(f"reward_{name}") for name in builtin}

    def record(self, name: str) -> torch.Tensor:
        """Return a copy of a field of all flights by its name in the kernels, (n, ...)."""
        field = self._field(name)
        return field.movedim(-1, 1).flatten(0, 1)[: self.count].clone()

    def write(self, name: str, values: torch.Tensor) -> None:
        """Write a field of all flights, (n, ...)."""
        field = self._field(name)
        flights = field.movedim(-1, 1)
        whole, rest = divmod(self.count, WARP)
        flights[:whole] = values[: whole * WARP].unflatten(0, (whole, WARP))
        if rest:
            flights[whole, :rest] = values[whole * WARP :]

    def _field(self, name: str) -> torch.Tensor:
        """Return a view of a field, (blocks, ..., WARP)."""
        field = self.plan.fields[name]
        part = self._blocks[:, field.first : field.first + int(np.prod(field.shape))]
        part = part.view(torch.float64) if field.kind == "f8" else part
        return part.unflatten(1, field.shape) if field.shape else part[:, 0]

    def _put(self, array: Any) -> torch.Tensor:
        return torch.from_numpy(np.array(array)).to(self.device)

    def _zeros(self, *shape: int, kind: torch.dtype = torch.float64) -> torch.Tensor:
        return torch.zeros(shape, dtype=kind, device=self.device)

    def _repeated(self, words: Words, times: int) -> torch.Tensor:
        """Return a record for all flights of so many blocks, (times, words, WARP)."""
        one = self._put(words.view(np.int64))
        return one[:, None].expand(times, -1, WARP).contiguous()

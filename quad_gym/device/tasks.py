"""Flights on a GPU with a task in Python, whose methods run in NumPy on the host.

Of the records, the host copies only the fields that the task reads.
"""

import weakref
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from quad_gym.device.flights import DeviceBatch, Launcher
from quad_gym.device.plan import DevicePlan, Words
from quad_gym.packing.configuration import FlightConfiguration
from quad_gym.records import FLIGHT_BLOCK, SHOWN, WARP, Command, Result, Room, aligned_zeros
from quad_gym.tasks.batch import TaskBatch

Made = tuple[FlightConfiguration, Mapping[str, Any]]
"""Arguments of a `TaskBatch`, see `TaskBatch.made`."""
_RESULTS = slice(len(Result))
"""Results that the task may change; the others are terms of the built-in reward."""


def flights_on(
    device: str | torch.device,
    plan: DevicePlan,
    count: int,
    launcher: Launcher,
    task: Made | None = None,
) -> DeviceBatch:
    """Make flights on a device; `task`: `made` of a batch with a task in Python."""
    if task is None:
        return DeviceBatch(plan, count, launcher, device)
    return DeviceTaskBatch(plan, count, launcher, device, task)


class DeviceTaskBatch(DeviceBatch):
    """Flights on a device with a task in Python.

    Between a step and the resets after it, the host calls the task's methods, and waits for the
    numbers that they read. Observations are new tensors.
    """

    def __init__(
        self,
        plan: DevicePlan,
        count: int,
        launcher: Launcher,
        device: str | torch.device,
        task: Made,
    ) -> None:
        super().__init__(plan, count, launcher, device)
        self._task = _TaskOnHost(weakref.proxy(self), *task)
        self.final_observations = self._put(self._task.final_observations)

    def reset(self, keys: Words | None = None, mask: torch.Tensor | None = None) -> torch.Tensor:
        """Begin episodes, as `DeviceBatch.reset` does."""
        chosen = None if mask is None else mask.cpu().numpy()
        return self._put(self._task.reset(keys=keys, mask=chosen))

    def step(self, actions: torch.Tensor) -> torch.Tensor:
        """Fly one control period, as `DeviceBatch.step` does.

        Raises:
            TaskError: If a method of the task fails, or returns an invalid value.
        """
        self._keep_actions(actions)
        seen = self._task.step()
        self._results[_RESULTS, : self.count] = self._put(self._task.results.T[_RESULTS])
        if self._task._same_step:
            over = np.flatnonzero(self._task.result("ending"))
            last = self._put(self._task.final_observations[over])
            self.final_observations[self._put(over)] = last
        return self._put(seen)

    def reward_terms(self, builtin: Iterable[str]) -> dict[str, torch.Tensor]:
        """Return the terms of the last step's reward, (n,) each; the task's own have precedence."""
        if "reward" not in self._task.methods:
            return super().reward_terms(builtin)
        return {name: self._put(term) for name, term in self._task.reward_terms().items()}


class _TaskOnHost(TaskBatch):
    """A `TaskBatch` whose records are on a device.

    Args:
        flights: The flights there.
        c: The configuration, with any number of flights.
        arguments: Other arguments of `TaskBatch`.
    """

    def __init__(
        self, flights: DeviceTaskBatch, c: FlightConfiguration, arguments: Mapping[str, Any]
    ) -> None:
        self._flights = flights
        super().__init__(replace(c, count=flights.count, threads=1), **arguments)

    def _allocate(self, room: Room, undrawn: NDArray[np.float64], configuration: int) -> None:
        self._room, self._undrawn, self._begun = room, undrawn, False
        self._blocks = aligned_zeros(0, room.dtype)

    def _keep_actions(self, actions: NDArray[Any] | None) -> None:
        """The device has them."""

    def _fly(self, command: int) -> NDArray[np.float32]:
        flights = self._flights
        if command == Command.RESET:
            flights._resets.copy_(torch.from_numpy(self._resets))
        seen = flights._fly(Command(command))
        if command == Command.STEP:
            results = flights._results[_RESULTS, : self.count]
            self._results[_RESULTS, : self.count] = _array(results)
        self._observations = _array(seen)
        return self._observations

    def _fetched(self, name: str, flights: NDArray[np.intp] | None) -> NDArray[Any]:
        values = self._flights.record(name)
        values = values if flights is None else values[self._flights._put(flights)]
        return _array(values).view(FLIGHT_BLOCK[name].base)

    def _drawn(self, columns: slice) -> NDArray[np.float64]:
        return _array(self._flights.record("drawn")[:, columns])

    def shown(self, name: str) -> NDArray[np.float64]:
        rows = SHOWN[name]
        self._shown[rows, : self.count] = _array(self._flights._shown[rows, : self.count])
        return super().shown(name)

    def write(self, flights: NDArray[np.intp], **values: ArrayLike) -> None:
        """Write fields of the records of some flights, (len(flights), ...) each."""
        there = self._flights
        block, lane = there._put(flights // WARP), there._put(flights % WARP)
        for name, value in values.items():
            words = np.asarray(value, FLIGHT_BLOCK[name].base)
            words = words.view(np.int64) if words.dtype.kind == "u" else words
            there._field(name)[block, ..., lane] = there._put(words)


def _array(tensor: torch.Tensor) -> NDArray[Any]:
    """Return a copy of a tensor, for which the host waits."""
    found = torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=tensor.is_cuda)
    array: NDArray[Any] = found.copy_(tensor).numpy()
    return array

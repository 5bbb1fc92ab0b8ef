"""Flights on a GPU: their memory as torch tensors, and the launches of their kernel."""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import subprocess
import sys
import weakref
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.configuration import FlightConfiguration
from quad_gym.kernels.library import DEVICE_KERNEL, FOLDER
from quad_gym.kernels.sources import sources_digest
from quad_gym.kernels.stages import STAGE_TABLE, Stage
from quad_gym.params import checks as check
from quad_gym.records import (
    ALIGNED,
    FLIGHT_BLOCK,
    PRECISION,
    RESULTS,
    SHOWN,
    SHOWN_SIZE,
    WARP,
    WIDTH,
    WORK_BLOCK,
    Call,
    Command,
    Result,
    Room,
    aligned_zeros,
    offset_of,
)
from quad_gym.records.sizes import REAL, RESIDENT
from quad_gym.tasks.batch import TaskBatch

with contextlib.suppress(ImportError):  # plans and PTX for wheels need no torch
    import torch

    _KINDS = {"f8": torch.float64, "f4": torch.float32, "u8": torch.int64}

# --------------------------------------------------------------------------------------------------
# `DevicePlan`: a configuration for a GPU, flown where only NumPy and torch are needed.
# --------------------------------------------------------------------------------------------------

Words = NDArray[np.uint64]
Parts = NDArray[np.uint32]


class FieldPlace(NamedTuple):
    """Place of a field in the record of a flight."""

    first: int  #: its first byte
    shape: tuple[int, ...]
    kind: str  #: "f8", "f4" in single precision, or "u8"

    @property
    def end(self) -> int:
        """The byte behind it."""
        return self.first + int(np.prod(self.shape)) * np.dtype(self.kind).itemsize


class DevicePlan(NamedTuple):
    """A configuration; a record has the numbers of one flight, in parts of four bytes."""

    settings: bytes
    stages: Mapping[Stage, str]
    flight: Parts  #: record of a flight that has never been reset
    skipped: int  #: bytes of the full record before the first stored one
    fields: Mapping[str, FieldPlace]
    world: Parts  #: record of the true parameters
    model: Parts  #: record of the parameters that filter and controller assume
    paths: NDArray[np.uint8]  #: a task's trajectories
    pieces: NDArray[np.uint8]  #: their segments
    low: NDArray[np.float64]  #: bounds of an observation, (k,)
    high: NDArray[np.float64]
    work: int  #: bytes of the workspace of a flight
    results: tuple[str, ...]  #: names of the results of a step
    autoreset: int  #: an `Autoreset`
    shown: int = 0  #: numbers of a flight for the views of a task in Python
    real: str = "f8"  #: kind of the numbers in records


# --------------------------------------------------------------------------------------------------
# `CudaLauncher`: launches of a kernel on an NVIDIA GPU, by cuda-core.
# --------------------------------------------------------------------------------------------------


class _Stream:
    """A stream of torch, as cuda-core accepts it."""

    def __init__(self, handle: int) -> None:
        self._handle = handle

    def __cuda_stream__(self) -> tuple[int, int]:
        return 0, self._handle


class CudaLauncher:
    """Launches the kernel of a module of PTX on torch's current stream, without a wait.

    Args:
        ptx: The module.
        device: GPU with the memory of the flights.

    Raises:
        ImportError: If cuda-core is not installed.
    """

    def __init__(self, ptx: bytes, device: torch.device) -> None:
        try:
            from cuda import core
        except ImportError as error:
            raise ImportError(
                'flights on a GPU need cuda-core: pip install "quad-gym[cuda]"'
            ) from error
        torch.cuda.init()  # with its primary context, in which kernel and tensors meet
        number = torch.cuda.current_device() if device.index is None else device.index
        self._device = core.Device(number)
        self._device.set_current()
        self._kernel = core.ObjectCode.from_ptx(ptx).get_kernel(DEVICE_KERNEL)
        self._core: Any = core
        self._torch_device = torch.device("cuda", number)
        processors = torch.cuda.get_device_properties(number).multi_processor_count
        self.warps = RESIDENT * processors

    def __call__(self, call: int, blocks: int, command: int) -> None:
        """Fly blocks: each warp its share."""
        handle = torch.cuda.current_stream(self._torch_device).cuda_stream
        stream = self._device.create_stream(_Stream(handle))
        config = self._core.LaunchConfig(grid=min(self.warps, blocks), block=WARP)
        self._core.launch(stream, config, self._kernel, *map(np.int64, (call, blocks, command)))


# --------------------------------------------------------------------------------------------------
# Flights whose records are a tensor: steps and resets are one launch each, without a wait.
#
# It needs NumPy and torch, and no compiler: plan and kernel may be made elsewhere.
# --------------------------------------------------------------------------------------------------


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
        self._blocks = self._repeated(plan.flight, plan.fields.values(), blocks)
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
            Call.WORLD: self._parameters(plan.world, 1),
            Call.OWN: self._parameters(plan.world, warps),
            Call.MODEL: self._parameters(plan.model, 1),
            Call.BELIEVED: self._parameters(plan.model, warps),
            Call.WORK: self._block_memory(warps, plan.work).zero_(),
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
        words[Call.BLOCKS] -= WARP * plan.skipped
        words[Call.PITCH] = self._blocks.shape[1]
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
            keys: (n, 2) keys of the random streams, see `quad_gym.batch.starts`; None: the
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
        """Return a copy of a field of all flights by its name in the kernels, (n, ...).

        Numbers of single precision are returned as float64.
        """
        found = self._field(name).movedim(-1, 1).flatten(0, 1)[: self.count]
        return found.double() if found.dtype == torch.float32 else found.clone()

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
        part = self._blocks[:, WARP * field.first : WARP * field.end].view(_KINDS[field.kind])
        return part.unflatten(1, (*field.shape, WARP))

    def _put(self, array: Any) -> torch.Tensor:
        return torch.from_numpy(np.array(array)).to(self.device)

    def _zeros(self, *shape: int, kind: torch.dtype | None = None) -> torch.Tensor:
        return torch.zeros(shape, dtype=kind or torch.float64, device=self.device)

    def _block_memory(self, count: int, size: int) -> torch.Tensor:
        """Return memory for blocks of flights with so many bytes each, (count, WARP size)."""
        whole = count * WARP * size
        memory = torch.empty(whole + ALIGNED, dtype=torch.uint8, device=self.device)
        first = -memory.data_ptr() % ALIGNED
        return memory[first : first + whole].view(count, WARP * size)

    def _repeated(self, record: Parts, fields: Iterable[FieldPlace], count: int) -> torch.Tensor:
        """Return so many blocks in which all flights have the same record, as bytes."""
        given = record.view(np.uint8)
        one = np.empty(WARP * given.size, np.uint8)
        for field in fields:
            values = given[field.first : field.end].view(field.kind)
            one[WARP * field.first : WARP * field.end] = np.repeat(values, WARP).view(np.uint8)
        return self._block_memory(count, given.size).copy_(self._put(one))

    def _parameters(self, record: Parts, count: int) -> torch.Tensor:
        """Return so many blocks with the same parameters, which are numbers without words."""
        kind = np.dtype(self.plan.real)
        whole = FieldPlace(0, (record.nbytes // kind.itemsize,), self.plan.real)
        return self._repeated(record, [whole], count)


# --------------------------------------------------------------------------------------------------
# Flights on a GPU with a task in Python, whose methods run in NumPy on the host.
#
# Of the records, the host copies only the fields that the task reads.
# --------------------------------------------------------------------------------------------------

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
        found, kind = _array(values), FLIGHT_BLOCK[name].base
        return found.view(kind) if kind.kind == "u" else found

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


# --------------------------------------------------------------------------------------------------
# The plan of a batch for a GPU, and the PTX of its kernel.
# --------------------------------------------------------------------------------------------------

LANES = {"QUAD_GYM_LANES": str(WARP), "NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
"""Environment of a process with the blocks of a GPU."""


def plan_of(batch: FlightBatch) -> DevicePlan:
    """Return the plan of a batch that has never been reset, for any number of flights.

    Raises:
        ValueError: If the batch needs Python during its steps, other than the methods of a task.
    """
    c = batch.configuration
    for python, what in (
        (c.estimator is not None, "an own estimator"),
        (c.begins_after_step, 'innovations with autoreset_mode="SameStep"'),
    ):
        if python:
            raise ValueError(f"flights on a GPU need compiled steps, and {what} runs in Python")
    room = batch._room
    fields = {}
    for name in room.dtype.names or ():
        kind = room.dtype[name]
        first = offset_of(room.dtype, name) // WIDTH
        fields[name] = FieldPlace(first, kind.shape[:-1], kind.base.str[1:])
    paths, pieces = (np.frombuffer(array.tobytes(), np.uint8) for array in batch._paths)
    return DevicePlan(
        settings=batch._settings.tobytes(),
        stages=batch._stages,
        flight=batch.copied_record(0),
        skipped=room.skipped // WIDTH,
        fields=fields,
        world=_first_lane(batch._world),
        model=_first_lane(batch._model),
        paths=paths,
        pieces=pieces,
        low=batch._low,
        high=batch._high,
        work=WORK_BLOCK.itemsize // WIDTH,
        results=RESULTS,
        autoreset=int(c.compiled_autoreset),
        shown=SHOWN_SIZE if batch._settings["shown"][0] else 0,
        real=REAL,
    )


def _first_lane(block: NDArray[Any]) -> Parts:
    return block.view(REAL).reshape(-1, WIDTH)[:, 0].copy().view(np.uint32)


def ptx_of(plan: DevicePlan) -> bytes:
    """Return the PTX of a plan's kernel: from a wheel, or cached by sources and settings.

    Raises:
        ImportError: If Numba is needed and not installed.
        RuntimeError: If the kernel cannot be emitted.
    """
    file = _packed(plan)
    return zlib.decompress(file.read_bytes()) if file.is_file() else _emitted(plan)


def pack(plans: Iterable[DevicePlan]) -> Iterator[Path]:
    """Write the PTX of plans for a wheel, in place of all that is there; yield the files.

    Raises:
        ImportError: If Numba is not installed.
        RuntimeError: If a kernel cannot be emitted.
    """
    for old in FOLDER.glob("*.ptx.z"):
        old.unlink()
    FOLDER.mkdir(exist_ok=True)
    for plan in plans:
        file = _packed(plan)
        file.write_bytes(zlib.compress(_emitted(plan), 9))
        yield file


def _packed(plan: DevicePlan) -> Path:
    """Return the file of a wheel with the PTX of a plan, which need not exist."""
    key = repr((plan.settings, sorted(plan.stages.items()), PRECISION))
    sources = sources_digest(Path(__file__).parent)
    return FOLDER / f"{sources[:12]}_{hashlib.sha256(key.encode()).hexdigest()[:12]}.ptx.z"


def _emitted(plan: DevicePlan) -> bytes:
    """Return the PTX of a plan, which another process emits, as blocks have another size there."""
    check.package("numba", "flying on a GPU", "compile")
    path = os.pathsep.join(part for part in sys.path if isinstance(part, str))
    done = subprocess.run(
        [sys.executable, "-c", "from quad_gym.kernels.compiling.building import write; write()"],
        input=pickle.dumps((plan.settings, dict(plan.stages))),
        stdout=subprocess.PIPE,
        env={**os.environ, **LANES, "PYTHONPATH": path},
        check=False,
    )
    if done.returncode:
        raise RuntimeError("the kernel could not be emitted for a GPU, see above")
    return done.stdout

"""The golden flights on AArch64: compiled for it, run by an emulator, compared byte by byte.

python -m tests.golden.aarch64 [CASE ...]    # needs aarch64-linux-gnu-gcc and qemu-aarch64-static

Python flies the cases here, with two lanes and the library of compiled kernels, in single precision
with four lanes and Numba, and records the memory before and after the calls. A C program
(`replay.c`), linked with the kernels for AArch64, makes the same calls on a copy of this memory;
then both must be equal. Only the bits of NaNs may differ, as they depend on the processor.
"""

import itertools
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from quad_gym.kernels.compiling import building
from quad_gym.records.sizes import REAL_BYTES, SINGLE

COMPILER, EMULATOR = "aarch64-linux-gnu-gcc", "qemu-aarch64-static"
LANES = 16 // REAL_BYTES  #: numbers in a register
KERNELS = "numba" if SINGLE else "library"  #: of the flights here
PROCESSOR = building.PROCESSORS["aarch64"][2]
NUMBERS, WORDS = (np.float32, np.uint32) if SINGLE else (np.float64, np.uint64)
PLACE = 1 << 36  #: address of the memory in the C program
LINE = 64  #: size of the pieces in which changed memory is sent [bytes]
SHOWN_EVERY = 30  #: calls between comparisons; the last call is compared, too
ROOT = Path(__file__).parents[2]


class Memory:
    """The memory of a batch, with the addresses of the C program."""

    def __init__(self, batch: Any) -> None:
        from quad_gym.batch.threads import board_of
        from quad_gym.kernels.stages import STAGE_TABLE
        from quad_gym.records import Call

        self.batch, self._arrays, size = batch, [], 0
        words = np.zeros(len(Call), np.int64)

        def put(array: Any) -> int:
            nonlocal size
            self._arrays.append((size, array))
            size += -(-max(array.nbytes, 1) // LINE) * LINE
            return PLACE + size - -(-max(array.nbytes, 1) // LINE) * LINE

        for word, value in batch.memory_of_call().items():
            if isinstance(value, int):
                words[word] = value
            else:  # of a list, one for each thread, the first
                words[word] = put(value[0] if isinstance(value, list) else value)
        if hasattr(batch, "_shown"):  # fields that a user's task reads
            words[Call.SHOWN], words[Call.SHOWN_PITCH] = put(batch._shown), batch._shown.strides[0]
        words[Call.BLOCKS] = put(batch._blocks) - batch._room.skipped
        words[Call.PITCH] = batch._room.dtype.itemsize
        table = np.zeros(1, STAGE_TABLE)
        table["paths"], table["pieces"] = map(put, batch._paths)
        self.compared = size
        words[Call.STAGES] = self.table = put(table)
        board = board_of(len(batch._blocks), 1, batch._group)
        self.board, self.board_size, self.call = put(board), board.size, put(words)
        self.size = size

    def addresses(self) -> np.ndarray:
        """Return a mask of the compared bytes: the addresses that kernels store between calls."""
        found = np.zeros(self.size, bool)
        for place, array in self._arrays:
            for name in {"source", "source_block"} & set(array.dtype.names or ()):
                kind, first = array.dtype.fields[name][:2]
                for record in range(place, place + array.nbytes, array.dtype.itemsize):
                    found[record + first : record + first + kind.itemsize] = True
        return found[: self.compared]

    def content(self) -> np.ndarray:
        """Return the current bytes."""
        content = np.zeros(self.size, np.uint8)
        for place, array in self._arrays:
            content[place : place + array.nbytes] = np.frombuffer(array.tobytes(), np.uint8)
        return content


class Recording:
    """The calls of one batch, as the C program reads them, and the memory that it must produce."""

    def __init__(self, symbols: dict[str, int]) -> None:
        self._symbols, self._memory = symbols, None
        self.calls: list[tuple[int, list[bytes]]] = []
        self._shown: list[np.ndarray] = []

    def record(self, batch: Any, command: int, fly: Any) -> Any:
        """Fly, and record the call."""
        if self._memory is None:
            self._memory = Memory(batch)
            self._first = self._known = self._memory.content()
            self._slots = [(int(slot), self._symbols[n]) for slot, n in batch._stages.items()]
        assert self._memory.batch is batch
        before = self._memory.content()
        changed = np.flatnonzero((before != self._known).reshape(-1, LINE).any(axis=1))
        patches = [
            _words(LINE * line, LINE) + before[LINE * line : LINE * (line + 1)].tobytes()
            for line in changed.tolist()
        ]
        observations = fly(batch, command)
        self._known = self._memory.content()
        if len(self.calls) % SHOWN_EVERY == 0:
            self._shown.append(self._known)
        self.calls.append((int(command), patches))
        return observations

    def given(self) -> bytes:
        """Return the input of the C program."""
        m = self._memory
        assert m is not None
        places = (PLACE, m.size, m.compared, m.call, m.board, m.table, m.board_size)
        head = _words(*places, len(self._slots), len(self.calls))
        content, last = [head, self._first.tobytes()], len(self.calls) - 1
        content += itertools.starmap(_words, self._slots)
        for k, (command, patches) in enumerate(self.calls):
            shows = k % SHOWN_EVERY == 0 or k == last
            content += [_words(command, len(patches), int(shows)), *patches]
        return b"".join(content)

    def differences(self, found: bytes) -> str:
        """Describe the differences of the memory that the C program has shown; empty if none."""
        assert self._memory is not None
        shown = self._shown + [self._known] * ((len(self.calls) - 1) % SHOWN_EVERY > 0)
        expected = np.concatenate([memory[: self._memory.compared] for memory in shown])
        if len(found) != len(expected):
            return f"{len(found)} bytes, not {len(expected)}"
        addresses = np.tile(self._memory.addresses(), len(shown))
        a, b = (
            np.where(addresses, 0, given).astype(np.uint8).view(NUMBERS)
            for given in (expected, np.frombuffer(found, np.uint8))
        )
        other = (a.view(WORDS) != b.view(WORDS)) & ~(np.isnan(a) & np.isnan(b))
        return f"{other.sum()} of {len(a)} words differ" if other.any() else ""


def _words(*numbers: int) -> bytes:
    return np.array(numbers, np.uint64).tobytes()


def _program(folder: Path) -> tuple[Path, dict[str, int]]:
    """Return the C program with all kernels for AArch64, and the order of its stages."""
    from quad_gym.kernels.library import core_symbol
    from quad_gym.kernels.stages import SOURCES

    names = building.part_names()
    objects = building.objects_of(names, PROCESSOR)
    for k, content in enumerate(objects):
        (folder / f"{k}.o").write_bytes(content)
    stages = list(dict.fromkeys(source.name for source in SOURCES))
    symbols = [core_symbol(name) for name in stages]
    table = [f"extern char {symbol}[];" for symbol in symbols]
    table.append(f"void *const stages[] = {{{', '.join(symbols)}}};\n")
    (folder / "stages.c").write_text("\n".join(table))
    (folder / "entries.c").write_text(building.calls("none"))
    sources = [folder / "stages.c", folder / "entries.c", Path(__file__).with_name("replay.c")]
    files = [*sources, *(folder / f"{k}.o" for k in range(len(objects)))]
    # without -lm: kernels call no function of the math library
    command = [COMPILER, "-O2", "-static", "-w", "-o", folder / "replay", *files]
    subprocess.run(command, check=True)
    return folder / "replay", {name: k for k, name in enumerate(stages)}


def _compare(chosen: list[str]) -> None:
    """Fly and replay cases; raise SystemExit if any differ."""
    from quad_gym.batch.flight_batch import FlightBatch
    from tests.golden.flights import DIGESTS, cases, fly

    golden, original, wrong = json.loads(DIGESTS.read_text()), FlightBatch._fly, []
    with tempfile.TemporaryDirectory() as folder:
        program, symbols = _program(Path(folder))
        flown = {name: case for name, case in cases().items() if name in chosen or not chosen}
        for name, case in flown.items():
            recordings: dict[int, Recording] = {}  # by batch; most cases have one

            def record(batch: Any, command: int, found: Any = recordings) -> Any:
                recording = found.setdefault(id(batch), Recording(symbols))
                return recording.record(batch, command, original)

            FlightBatch._fly = record  # type: ignore[method-assign]
            here, problem, calls = fly(case, threads=1), "", 0
            for recording in recordings.values():
                done = subprocess.run(
                    [EMULATOR, program], input=recording.given(), capture_output=True, check=False
                )
                problem += done.stderr.decode() or recording.differences(done.stdout)
                calls += len(recording.calls)
            if here != golden[name]:
                problem += "; not golden here"
            print(f"{name}: {calls} calls, {problem or 'the same'}", flush=True)
            if problem:
                wrong.append(name)
    if wrong:
        raise SystemExit(f"these flights differ on AArch64: {', '.join(wrong)}")
    print(f"{len(flown)} golden flights are the same on AArch64, byte by byte")


def main() -> None:
    """Check the tools, make the kernels for Python, and compare in a separate process."""
    missing = [tool for tool in (COMPILER, EMULATOR, "cc") if shutil.which(tool) is None]
    if missing:
        print(
            f"skipped: golden flights on AArch64 need {', '.join(missing)}: "
            "apt install gcc gcc-aarch64-linux-gnu qemu-user-static"
        )
        return
    if os.environ.get("QUAD_GYM_KERNELS") != KERNELS:
        if KERNELS == "library":
            building.build([LANES])
        choice = {"QUAD_GYM_KERNELS": KERNELS, "QUAD_GYM_LANES": str(LANES)}
        generic = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
        command = [sys.executable, "-m", "tests.golden.aarch64", *sys.argv[1:]]
        done = subprocess.run(command, cwd=ROOT, env=os.environ | generic | choice, check=False)
        raise SystemExit(done.returncode)
    _compare(sys.argv[1:])


if __name__ == "__main__":
    main()

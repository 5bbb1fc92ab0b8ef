"""Run an exported filter on an emulated Cortex-M4, and count the instructions of its calls.

    pip install unicorn ziglang
    python docs/examples/cortex_m4.py crazyflie rtk

Zig compiles the example of the exported filter for Linux on ARM, with the library's code for
Cortex-M4 in it, and Unicorn emulates processor and system calls. Cycles are those of the Cortex-M4
Technical Reference Manual without wait states.
"""

import io
import os
import struct
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from baselines.exporting import export_filter
from baselines.exporting.filter_library import LIBRARY
from quad_gym import sensor_suite
from quad_gym.analysis.reports import text_table

CLOCK = 168e6  #: of the processor of a Crazyflie [Hz]
HEIGHT = 1.5  #: of the vehicle at rest that is measured [m]
_COMPILER = ("-m", "ziglang", "cc", "-target", "thumb-linux-musleabihf", "-mcpu=cortex_a7")
_HEAP, _STACK, _PAGE = 0x40000000, 0x7F000000, 4096
_EXIT, _READ, _WRITE, _OPEN, _BRK, _IOCTL, _SEEK, _READV, _WRITEV, _MMAP, _TLS = (
    *((1, 248), (3,), (4,), (5, 322), (45,), (54,), (140,), (145,), (146,), (192,)),
    (0xF0005,),
)
"""Numbers of the system calls of Linux on ARM that the example needs; others do nothing."""


def compiled(folder: Path) -> Path:
    """Compile the example of a filter that was exported for cortex-m4; return the program."""
    program = folder / "example"
    files = (folder / "main.c", folder / LIBRARY, "-o", program)
    cache = {name: str(folder / "zig") for name in ("ZIG_GLOBAL_CACHE_DIR", "ZIG_LOCAL_CACHE_DIR")}
    command = (sys.executable, *_COMPILER, "-std=c99", "-O2", "-static", *files)
    subprocess.run(command, check=True, env=cache | dict(os.environ))
    return program


class Machine:
    """A Linux process on an emulated processor: a static program and its arguments."""

    def __init__(self, program: Path, *arguments: Any) -> None:
        import unicorn
        from unicorn import arm_const as arm

        self.symbols: dict[str, tuple[int, int]] = {}  #: addresses and sizes by name
        self._files: list[Any] = []
        self._heap, self._printed, self._code = _HEAP, bytearray(), -1
        self._unicorn, self._arm = unicorn, arm
        self.uc = unicorn.Uc(unicorn.UC_ARCH_ARM, unicorn.UC_MODE_THUMB)
        self.uc.ctl_set_cpu_model(arm.UC_CPU_ARM_CORTEX_A7)
        access = self.uc.reg_read(arm.UC_ARM_REG_C1_C0_2)
        self.uc.reg_write(arm.UC_ARM_REG_C1_C0_2, access | 0xF << 20)
        self.uc.reg_write(arm.UC_ARM_REG_FPEXC, 1 << 30)  # floating-point unit on
        for first, size in ((_HEAP, 1 << 24), (_STACK - (1 << 20), 1 << 20)):
            self.uc.mem_map(first, size)
        self._load(program.read_bytes())
        self._begin([str(word).encode() + b"\0" for word in (program, *arguments)])
        self.uc.hook_add(unicorn.UC_HOOK_INTR, self._call)

    def run(self) -> str:
        """Run the program; return what it has printed."""
        self.uc.emu_start(self._entry, 0)
        printed = self._printed.decode()
        if self._code:
            raise RuntimeError(f"the program ended with {self._code}: {printed[-500:]}")
        return printed

    def _load(self, raw: bytes) -> None:
        """Load the segments and symbols of an ELF file."""
        self._entry, heads, sections = struct.unpack_from("<3I", raw, 24)
        size, count, section_size, section_count = struct.unpack_from("<4H", raw, 42)
        pages = set[int]()
        self._heads = (0, size, count)
        for k in range(count):
            kind, offset, place, _, filled, whole = struct.unpack_from("<6I", raw, heads + k * size)
            if kind != 1:
                continue
            for page in range(place // _PAGE, -(-(place + whole) // _PAGE)):
                if page not in pages:
                    self.uc.mem_map(page * _PAGE, _PAGE)
                pages.add(page)
            self.uc.mem_write(place, raw[offset : offset + filled])
            if offset <= heads < offset + filled:
                self._heads = (place + heads - offset, size, count)
        found = [
            struct.unpack_from("<7I", raw, sections + k * section_size)
            for k in range(section_count)
        ]
        for _, kind, _, _, first, length, link in found:
            for at in range(first, first + length, 16) if kind == 2 else ():
                name, place, extent = struct.unpack_from("<3I", raw, at)
                name += found[link][4]
                word = raw[name : raw.index(b"\0", name)].decode()
                self.symbols[word] = place & -2, extent

    def _begin(self, words: list[bytes]) -> None:
        """Write the arguments, and the values that Linux gives a program."""
        at, places = _STACK - _PAGE, []
        for word in words:
            self.uc.mem_write(at, word)
            places.append(at)
            at += len(word)
        first, size, count = self._heads
        values = (3, first, 4, size, 5, count, 6, _PAGE, 16, 1 << 15, 25, _STACK - 64, 0, 0)
        vector = (len(words), *places, 0, 0, *values)
        self.uc.mem_write(_STACK - 2 * _PAGE, struct.pack(f"<{len(vector)}I", *vector))
        self.uc.reg_write(self._arm.UC_ARM_REG_SP, _STACK - 2 * _PAGE)

    def _call(self, uc: Any, interrupt: int, _: Any) -> None:
        """Do what Linux does for a system call."""
        arm = self._arm
        a, b, c, d, e = (uc.reg_read(arm.UC_ARM_REG_R0 + k) for k in range(5))
        number, result = uc.reg_read(arm.UC_ARM_REG_R7), 0
        if interrupt != 2 or number in _EXIT:
            self._code = a if interrupt == 2 else -1
            uc.emu_stop()
            return
        if number in _TLS:
            uc.reg_write(arm.UC_ARM_REG_C13_C0_3, a)
        elif number in (*_READ, *_READV, *_WRITE, *_WRITEV):
            pieces = [(b, c)]
            if number in (*_READV, *_WRITEV):
                numbers = struct.unpack(f"<{2 * c}I", uc.mem_read(b, 8 * c))
                pieces = list(zip(numbers[::2], numbers[1::2], strict=True))
            for place, length in pieces:
                if number in (*_READ, *_READV):
                    content = self._files[a - 3].read(length)
                    uc.mem_write(place, content)
                    result += len(content)
                else:
                    self._printed += uc.mem_read(place, length)
                    result += length
        elif number in _OPEN:
            place = a if number == _OPEN[0] else b
            name = bytes(uc.mem_read(place, 512)).partition(b"\0")[0]
            self._files.append(io.BytesIO(Path(name.decode()).read_bytes()))
            result = 2 + len(self._files)
        elif number in _SEEK:
            offset = struct.unpack("<q", struct.pack("<2I", c, b))[0]
            uc.mem_write(d, struct.pack("<q", self._files[a - 3].seek(offset, e)))
        elif number in _MMAP:
            result, self._heap = self._heap, self._heap + -(-b // _PAGE) * _PAGE
        elif number in _IOCTL:
            result = -25  # no terminal
        uc.reg_write(arm.UC_ARM_REG_R0, result & 0xFFFFFFFF)

    # ---- counts -------------------------------------------------------------------------------

    def count(self, *names: str) -> dict[str, list[tuple[int, int, int]]]:
        """Run the program; return instructions, cycles and stack of each call of functions."""
        arm, uc = self._arm, self.uc
        entries = {self.symbols[name][0]: name for name in names}
        found: dict[str, list[tuple[int, int, int]]] = {name: [] for name in names}
        costs: dict[int, int] = {}
        name, back, top, low, following, instructions, cycles = "", 0, 0, 0, 0, 0, 0

        def note(uc: Any, at: int, size: int, _: Any) -> None:
            nonlocal name, back, top, low, following, instructions, cycles
            sp = uc.reg_read(arm.UC_ARM_REG_SP)
            if not name:
                if at not in entries:
                    return
                name, back = entries[at], uc.reg_read(arm.UC_ARM_REG_LR) & -2
                top, low, following, instructions, cycles = sp, sp, at, 0, 0
            elif at == back:
                found[name].append((instructions, cycles, top - low))
                name = ""
                return
            if at not in costs:
                costs[at] = cycles_of(bytes(uc.mem_read(at, size)))
            instructions += 1
            # after a branch, the pipeline fills again
            cycles += costs[at] + (0 if at == following else 2)
            low, following = min(low, sp), at + size

        uc.hook_add(self._unicorn.UC_HOOK_CODE, note)
        self.run()
        return found


def cycles_of(code: bytes) -> int:
    """Return the cycles of an instruction of a Cortex-M4, of a branch without the jump."""
    first, second = struct.unpack("<HH", code.ljust(4, b"\0"))
    if len(code) == 2:
        if first >> 12 in (5, 6, 7, 8, 9) or first >> 11 == 9:  # a load or a store
            return 2
        if first >> 12 == 12:  # of several registers
            return 1 + (first & 0xFF).bit_count()
        return 1 + (first & 0x1FF).bit_count() if first & 0xF600 == 0xB400 else 1
    if first & 0xEF00 == 0xEE00 and second & 0x0E10 == 0x0A00:  # floating-point
        opcode = first & 0xFFB0
        if opcode == 0xEE80 or (opcode == 0xEEB0 and first & 0xF == 1 and second & 0xC0 == 0xC0):
            return 14  # division, square root
        return 3 if opcode in (0xEE00, 0xEE10, 0xEE90, 0xEEA0) else 1  # multiply-adds
    if first & 0xFFE0 == 0xEC40:  # moves of two registers
        return 2
    if first & 0xEE00 == 0xEC00 and second & 0x0E00 == 0x0A00:  # loads and stores of these
        return 2 if first & 0x0F20 == 0x0D00 else 1 + (second & 0xFF)
    if first & 0xFE40 == 0xE800:  # of several registers
        return 1 + second.bit_count()
    if first & 0xFE40 == 0xE840:  # of two registers
        return 3
    if first & 0xFE00 == 0xF800:
        return 2
    if first & 0xFFD0 == 0xFB90:  # division of integers
        return 7
    return 1


def rows(suite: Any) -> list[str]:
    """Return calls for the example: a start at rest, predictions, and each sensor at a time."""
    dt, time = suite.imu.dt, 0.0
    found = [f"rest,0,0,{HEIGHT},0,0"]
    values = {"barometer": [HEIGHT], "range_finder": [HEIGHT], "gnss_baseline": [1.0, 0.0, 0.0]}
    for sensor in ("", *suite.sensors):
        for _ in range(8):
            found.append(f"imu,0,0,0,0,0,9.80665,{dt!r}")
            time += dt
        if not sensor:
            continue
        numbers = [time]
        for reading in suite.sensors[sensor].readings(sensor):
            count = max(suite.blocks_of(reading.name), 1)
            numbers += values.get(reading.name, [0.0] * (count * reading.length))
            numbers += [float("nan")] * (reading.sigmas if reading.reported else 0)
        found.append(",".join([sensor, *map(repr, numbers)]))
    return found


def counted(name: str, folder: Path) -> list[list[str]]:
    """Return rows of a table for a suite's filter."""
    suite = sensor_suite(name)
    export_filter(suite, name, "cortex-m4", folder)
    calls = rows(suite)
    (folder / "samples.csv").write_text("\n".join(calls))
    machine = Machine(compiled(folder), folder / "samples.csv")
    found = machine.count("qg_predict", "qg_update")
    table = [("predict", found["qg_predict"][7])]
    table += zip(suite.sensors, found["qg_update"], strict=True)
    stack = max(stack for calls in found.values() for _, _, stack in calls)
    result = [
        [f"{name}: {call.replace('_', ' ')}", f"{count:,}", f"{cycles:,}", _time(cycles)]
        for call, (count, cycles, _) in table
    ]
    sizes = {"memory": machine.symbols["filter"][1], "stack": stack}
    return [*result, *([f"{name}: {k} [bytes]", f"{v:,}", "", ""] for k, v in sizes.items())]


def _time(cycles: int) -> str:
    return f"{1e6 * cycles / CLOCK:,.0f}"


def main() -> None:
    """Print a table: instructions and cycles of each call, and its time."""
    table = []
    for name in sys.argv[1:] or ("crazyflie", "rtk"):
        with tempfile.TemporaryDirectory() as folder:
            table += counted(name, Path(folder))
    heads = {"": ["call"], "instructions": ["or bytes"], "cycles": [""], "at 168 MHz": ["[us]"]}
    print("UKF in single precision on a Cortex-M4\n")
    print(text_table(heads, table))


if __name__ == "__main__":
    main()

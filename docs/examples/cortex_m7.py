"""Count the instructions of an exported filter's calls on an emulated Cortex-M7.

    python docs/examples/cortex_m7.py rtk consumer

QEMU emulates the board MPS2 AN500 with one instruction per nanosecond, and the program reads the
processor's timer before and after each call. Needs gcc-arm-none-eabi with newlib, and
qemu-system-arm.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

from baselines.exporting import export_filter
from baselines.exporting.filter_library import LIBRARY
from quad_gym import sensor_suite
from quad_gym.analysis.reports import text_table

SOURCE = Path(__file__).with_suffix(".c")
FLAGS = (
    "-std=gnu99",
    "-O2",
    "-mcpu=cortex-m7",
    "-mfloat-abi=hard",
    "-mfpu=fpv5-d16",
    "-nostartfiles",
    "--specs=nosys.specs",
    "-Wl,-e,start",
    "-Wl,--section-start=.vectors=0",
    "-Wl,-Ttext=0x400",
    "-Wl,-Tdata=0x20000000",
)
BOARD = (
    "-M",
    "mps2-an500",
    "-icount",
    "shift=0",
    "-semihosting",
    "-nographic",
    "-monitor",
    "none",
    "-serial",
    "none",
)
CYCLES, CLOCK = 2.0, 480e6  # cycles per instruction (assumed), and Hz


def counted(name, folder):
    """Instructions, memory and stack of a suite's filter, by name."""
    export_filter(sensor_suite(name), name, "cortex-m7", folder)
    program = folder / "program.elf"
    files = (SOURCE, folder / LIBRARY, "-lm", "-o", program)
    compiler = ("arm-none-eabi-gcc", *FLAGS, "-I", folder)
    subprocess.run([*compiler, *files], check=True, stderr=subprocess.DEVNULL)
    size = subprocess.run(["arm-none-eabi-size", program], check=True, capture_output=True)
    text, data, *_ = size.stdout.splitlines()[1].split()
    run = ("timeout", "100", "qemu-system-arm", *BOARD, "-kernel", program)
    printed = subprocess.run(run, check=True, capture_output=True, text=True)
    lines = (printed.stdout + printed.stderr).splitlines()
    found = {word: int(number) for word, number in (line.split() for line in lines)}
    return {"flash": int(text) + int(data), **found}


def main():
    """Print a table: instructions of each call, and its time at 480 MHz."""
    rows = []
    for name in sys.argv[1:] or ("rtk", "consumer"):
        with tempfile.TemporaryDirectory() as folder:
            found = counted(name, Path(folder))
        memory = {key: found.pop(key) for key in ("flash", "memory", "stack")}
        for call, number in found.items():
            time = f"{1e6 * CYCLES * number / CLOCK:,.0f}"
            rows.append([f"{name}: {call.replace('_', ' ')}", f"{number:,}", time])
        rows += [[f"{name}: {key} [bytes]", f"{number:,}", ""] for key, number in memory.items()]
    heads = {"": ["call"], "instructions": ["or bytes"], "at 480 MHz": ["[us]"]}
    print(f"UKF on a Cortex-M7, {CYCLES:g} cycles per instruction assumed\n")
    print(text_table(heads, rows))


if __name__ == "__main__":
    main()

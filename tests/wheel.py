"""Test a built wheel, from `pip install` to an exported filter whose estimates equal a replay.

    python -m tests.wheel dist/quad_gym-*.whl          # the last step of make wheel
    python -m tests.wheel WHEEL --folder FOLDER        # keep environment and files there

Installs the wheel with the extras `compile` and `plot` (for `replay`) in a new virtual environment.
There, commands export the filter of a suite and compile it. Its example prints the estimates of the
samples of a log, which must equal the output of `quad-gym replay`. The same test runs for AArch64
in an emulator if compiler and emulator are installed.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

import numpy as np

from tests.logged_flights import Recorded, flown

SUITE, SECONDS = "rtk", 3.0
GCC, EMULATOR = "aarch64-linux-gnu-gcc", "qemu-aarch64-static"


def installed(wheel, folder):
    """Folder of the commands of an environment with the wheel, made if it is missing."""
    commands = folder / "environment" / "bin"
    if not (commands / "quad-gym").exists():
        venv.create(folder / "environment", with_pip=True)
        requirement = f"{wheel.resolve()}[compile,plot]"
        subprocess.run([commands / "pip", "install", "--quiet", requirement], check=True)
    return commands


def numbers(text):
    """Header and values of a table."""
    names, *rows = text.split()
    return names, np.array([row.split(",") for row in rows], float)


def main(argv=None):
    """Test a wheel; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("wheel", type=Path)
    parser.add_argument("--folder", type=Path)
    args = parser.parse_args(argv)
    folder = args.folder or Path(tempfile.mkdtemp(prefix="quad_gym_wheel_"))
    commands = installed(args.wheel, folder)
    log = folder / "flight.csv"
    Recorded(flown(seconds=SECONDS)).write_csv(log)

    elsewhere = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

    def run(*words):  # not in the clone, whose package would be imported
        print("$", *words, flush=True)
        options = {"cwd": folder, "env": elsewhere, "stdout": subprocess.PIPE, "text": True}
        return subprocess.run(words, check=True, **options).stdout

    quad_gym = commands / "quad-gym"
    options = ("--output", "replay", "--samples", "samples.csv", "--overwrite")
    run(quad_gym, "replay", log, "--sensors", SUITE, *options)
    wanted = numbers((folder / "replay" / "estimates.csv").read_text(encoding="utf-8"))
    emulated = shutil.which(GCC) and shutil.which(EMULATOR)
    for target, options, before in (
        ("x86-64", (), ()),
        ("aarch64", (f"-DCMAKE_C_COMPILER={GCC}", "-DCMAKE_EXE_LINKER_FLAGS=-static"), (EMULATOR,)),
    ):
        if before and not emulated:
            print(f"no {GCC} or no {EMULATOR}: {target} is not tested")
            continue
        run(quad_gym, "export", "filter", "--sensors", SUITE, "--target", target)
        source = f"results/export/filter_{SUITE}_{target}"
        run("cmake", "-S", source, "-B", target, *options)
        run("cmake", "--build", target)
        names, found = numbers(run(*before, f"./{target}/example", "samples.csv"))
        if names != wanted[0] or not np.array_equal(found, wanted[1]):
            print(f"{target}: estimates differ from those of a replay", file=sys.stderr)
            return 1
        print(f"{target}: {len(found)} estimates equal those of a replay")
    if args.folder is None:
        shutil.rmtree(folder)
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Filters of random suites, exported for AArch64: an emulator prints the replay's estimates."""

import re
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from baselines.exporting import export_filter
from baselines.exporting.filter_library import LIBRARY
from quad_gym.estimation import replay
from tests.exported import as_printed, estimates, hard_log
from tests.logged_flights import Recorded, flown
from tests.soak import drawing

ABOUT = "estimates of an exported filter on AArch64, in an emulator, with a replay"
TOOLS = {
    "aarch64-linux-gnu-gcc": "gcc-aarch64-linux-gnu",
    "qemu-aarch64-static": "qemu-user-static",
}
"""Packages of the programs that run an exported filter."""


def missing():
    """Packages of programs that this machine lacks."""
    return [package for tool, package in TOOLS.items() if shutil.which(tool) is None]


def run(rng):
    """Export a filter, and compare its estimates on a plain and on a hard log."""
    suite = drawing.suite(rng)
    folder = Path(tempfile.mkdtemp(prefix="quad_gym_soak_"))
    try:
        export_filter(suite, "soak", "aarch64", folder)
        compiler, emulator = TOOLS
        files = [folder / "main.c", folder / LIBRARY]
        program = folder / "example"
        subprocess.run([compiler, "-O2", "-static", *files, "-lm", "-o", program], check=True)
        for log, start in (plain_log(suite, int(rng.integers(1 << 31))), hard_log(suite)):
            samples = folder / "samples.csv"
            kind = suite.estimator.kind  # a library has the suite's filter
            wanted = replay(log, sensors=suite, estimator=kind, start=start, samples=samples)
            names, rows = estimates(emulator, program, samples)
            assert names == list(wanted.columns())
            np.testing.assert_array_equal(rows, as_printed(wanted))
        return False
    finally:
        shutil.rmtree(folder)


def plain_log(suite, seed):
    """A log with latency, jitter and losses, and its start."""
    table = Recorded(flown(suite, 3.0, seed=seed), suite, seed=seed, max_ticks=3).table()
    measured = {_kind(name) for name, values in table.items() if np.isfinite(values).any()}
    # a marker that was never in view keeps its column
    table = {name: values for name, values in table.items() if _kind(name) in measured}
    at_rest = {"position": (0.0, 0.0, 1.5), "heading": np.radians(20.0)}
    return table, at_rest if suite.gnss is None else {}


def _kind(column):
    """Name of a column without the number of its marker or anchor."""
    return re.sub(r"\d+", "", column)

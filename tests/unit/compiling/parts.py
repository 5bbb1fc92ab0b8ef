"""A small module of entries that records its compilations, and processes that compile it."""

import os
import subprocess
import sys
import time
from pathlib import Path

SOURCE = '''
import os, signal, time
import numpy as np
from numba import float64, none, types
from numba.extending import intrinsic
from quad_gym.kernels.compiling import entry, kernel

SIGNATURE = none(types.Array(float64, 1, "C"))


def noting(name):
    """A function, equal to 1, that leaves a line in a file when it is compiled."""

    def note():
        with open(os.environ["NOTES"], "a") as file:
            file.write(f"{name} {os.getpid()}\\n")
        in_worker = os.environ.get("PARENT", "") != str(os.getpid())
        mood = os.environ.get("MOOD", "")
        if mood == "die" and in_worker:
            os.kill(os.getpid(), signal.SIGKILL)
        if mood == "dawdle" and in_worker:
            time.sleep(3600.0)
        if mood == "raise":
            raise RuntimeError("this part cannot be compiled")

    @intrinsic
    def noted(typing_context):
        def lower(context, builder, sig, args):
            note()
            return context.get_constant(types.float64, 1.0)

        return types.float64(), lower

    return noted


note_a, note_b, note_c = noting("a"), noting("b"), noting("c")


@kernel
def twice(x):
    return x + x


def a(x):
    x[0] = 1.0 + twice(x[1]) * note_a()


def b(x):
    x[0] = 2.0 + twice(x[1]) * note_b()


def c(x):
    x[0] = 3.0 + twice(x[1]) * note_c()


sources = {"a": a, "b": b, "c": c}
a, b, c = entry(a, SIGNATURE), entry(b, SIGNATURE), entry(c, SIGNATURE)
NAMES = [f"{__name__}:{name}" for name in "abc"]


def results():
    """What the three entries give for (0, 5): 11, 12 and 13."""
    found = []
    for function in (a, b, c):
        x = np.array([0.0, 5.0])
        function(x)
        found.append(float(x[0]))
    return found
'''
PREPARE = """
import os
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)  # which jobs in the background ignore
os.environ["PARENT"] = str(os.getpid())
import parts_of_test as parts
from quad_gym.kernels.compiling.workers import prepare
prepare(parts.NAMES, processes={processes})
print(parts.results())
"""
RIGHT = "[11.0, 12.0, 13.0]"


class Parts:
    """The module in a separate folder, with a record of its compilations."""

    def __init__(self, folder):
        self.folder = Path(folder)
        self.notes, self.cache = self.folder / "notes", self.folder / "__pycache__"
        (self.folder / "parts_of_test.py").write_text(SOURCE)

    def start(self, code=PREPARE, processes=2, **environment):
        """Start a process that compiles and calls the parts, in a separate session."""
        root = Path(__file__).parents[3]
        variables = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
        variables |= {
            "PYTHONPATH": os.pathsep.join([str(self.folder), str(root)]),
            "NOTES": str(self.notes),
            "HOME": str(self.folder),
            **environment,
        }
        return subprocess.Popen(
            [sys.executable, "-c", code.format(processes=processes)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=variables,
            start_new_session=True,
        )

    def run(self, code=PREPARE, processes=2, **environment):
        """Run a process; return its output and its standard error if it succeeds."""
        process = self.start(code, processes, **environment)
        output, said = process.communicate(timeout=600)
        assert process.returncode == 0, said
        return output.strip(), said

    def compiled(self):
        """Sorted names of the compiled parts, one for each compilation."""
        return sorted(line.split()[0] for line in self._lines())

    def compilers(self):
        """Identifiers of the processes that compiled."""
        return {int(line.split()[1]) for line in self._lines()}

    def _lines(self):
        return self.notes.read_text().splitlines() if self.notes.exists() else []

    def files(self, kind):
        """Files of a kind in the cache."""
        return sorted(self.cache.glob(f"parts_of_test.*.{kind}"))


def alive(process):
    """Return true if a process runs; a zombie does not."""
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state not in "ZX"


def wait_until(true, seconds=600.0):
    """Wait until a condition is true; fail if that takes too long."""
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.02)

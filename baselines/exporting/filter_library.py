"""A suite's filter as a static library for another processor, with its header and an example.

The library has the kernels of `quad_gym.estimation` for one vehicle, with one flight in a block.
Records have another layout then, so a separate process writes the files.
"""

import os
import pickle
import re
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

from baselines.exporting.controller import Controller, c_source, descriptions
from quad_gym.packing import slow_errors_of
from quad_gym.params import checks as check
from quad_gym.params.sensor_table import READINGS
from quad_gym.params.suites import SensorSuite, blocks_together
from quad_gym.records import PRECISION

# --------------------------------------------------------------------------------------------------
# A policy for an exported filter: its observation from the estimate, as text of C sources.
# --------------------------------------------------------------------------------------------------

_SIGMAS = ("position", "velocity", "attitude", "accel_bias", "gyro_bias")
_FIELDS = {
    "position_error": "o = qgi_seen(o, e.R_BI, reference->position, e.position);",
    "velocity_error": "o = qgi_seen(o, e.R_BI, reference->velocity, e.velocity);",
    "up": "o = qgi_seen(o, e.R_BI, up, zero);",
    "heading": "o = qgi_seen(o, e.R_BI, reference->heading, zero);",
    "body_rates": "for (int i = 0; i < 3; i++)\n"
    "        *o++ = (float)(f->window.gyro[i] - e.gyro_bias[i]);",
    "reference_acceleration": "o = qgi_seen(o, e.R_BI, reference->acceleration, zero);",
    "preview_1": "o = qgi_seen(o, e.R_BI, reference->preview[0], reference->position);",
    "preview_2": "o = qgi_seen(o, e.R_BI, reference->preview[1], reference->position);",
    "last_action": "for (int i = 0; i < 4; i++)\n        *o++ = f->last_action[i];",
    **{
        f"{name}_sigma": f"for (int i = {3 * k}; i < {3 * k + 3}; i++)\n"
        "        *o++ = (float)e.sigma[i];"
        for k, name in enumerate(_SIGMAS)
    },
}
"""C code that writes each part of an observation."""


def policy_values(controller: Controller) -> dict[str, Any]:
    """Return the values of a policy for the templates of an exported filter.

    Raises a ValueError if its observation has parts that do not follow from the estimate.
    """
    names = [field.name for field in controller.table]
    unknown = [name for name in names if name not in _FIELDS]
    frames = {field.name: field.frame for field in controller.table}
    if unknown or frames.get("preview_1", "B") != "B":
        raise ValueError(
            "policy must have observation='estimate' and layout='relative' to be exported with a "
            f"filter, got an observation of {', '.join(unknown or names)}"
        )
    network = re.sub(
        r"\b([Wb]\d+|low|high|mean|deviation|dot)\b", r"qgi_\1", c_source(controller, "qg_policy")
    )
    fields = "\n    ".join(_FIELDS[name] for name in names)
    return {**descriptions(controller), "POLICY": True, "FIELDS": fields, "NETWORK": network}


# --------------------------------------------------------------------------------------------------
# A suite's filter as a static library for another processor, with its header and an example.
# --------------------------------------------------------------------------------------------------

LIBRARY, HEADER = "libquad_gym_filter.a", "quad_gym_filter.h"


class Target(NamedTuple):
    """A processor for which filters are exported."""

    processor: dict[str, Any]
    """triple of four parts, processor and relocation, in LLVM's words; see `building.Processor`"""
    words: str  #: description
    build: str  #: commands that build the example
    single: bool = False  #: True: always in single precision; False: in that of the process


_CMAKE = "cmake -B build && cmake --build build"
_BARE = """\
arm-none-eabi-gcc -std=c99 -O2 -mcpu={0} -mfloat-abi=hard -mfpu={1} \\
    main.c libquad_gym_filter.a -lm  # with the start-up code and linker script of your board"""
_WASM = """\
# Debian: clang lld wasi-libc libclang-rt-dev-wasm32
clang --target=wasm32-wasi --sysroot=/usr -std=c99 -O2 -D_WASI_EMULATED_PROCESS_CLOCKS \\
    main.c libquad_gym_filter.a -lm -lwasi-emulated-process-clocks -o example.wasm"""
_THUMB = "thumbv7em-unknown-none-eabihf"
TARGETS = {
    "x86-64": Target(
        {"triple": "x86_64-unknown-linux-gnu", "cpu": "x86-64-v3"},
        "Linux on x86-64 with AVX2 and FMA (since 2013)",
        _CMAKE,
    ),
    "aarch64": Target(
        {"triple": "aarch64-unknown-linux-gnu", "cpu": "generic"},
        "Linux on AArch64",
        _CMAKE.replace("build &&", "build -DCMAKE_C_COMPILER=aarch64-linux-gnu-gcc &&", 1),
    ),
    "cortex-m7": Target(
        {"triple": _THUMB, "cpu": "cortex-m7", "reloc": "static"},
        "Cortex-M7 with double-precision FPU, hard-float ABI",
        _BARE.format("cortex-m7", "fpv5-d16"),
    ),
    "cortex-m4": Target(
        {"triple": _THUMB, "cpu": "cortex-m4", "reloc": "static", "fma": "qg_core_fma"},
        "Cortex-M4 or Cortex-M7 with single-precision FPU, hard-float ABI",
        _BARE.format("cortex-m4", "fpv4-sp-d16"),
        single=True,
    ),
    "wasm32": Target(
        {"triple": "wasm32-unknown-unknown", "cpu": "generic", "reloc": "static"},
        "WebAssembly",
        _WASM,
    ),
}
"""Processors by the names that users write."""


def export_filter(
    suite: SensorSuite,
    label: str,
    target: str,
    folder: Path,
    policy: Controller | None = None,
    *,
    imu_rate: float = 0.0,
) -> list[Path]:
    """Write a filter's library, header, example, and files that build and explain them.

    Args:
        suite: Sensor suite with its filter.
        label: Name of the suite.
        target: One of TARGETS.
        folder: Folder to write to; created if it does not exist.
        policy: Policy that acts on the estimate; None: the filter alone.
        imu_rate: Highest rate of the IMU, if it exceeds the suite's [Hz]: memory for late
            measurements.

    Raises:
        ValueError: If the target is unknown, the filter of the suite cannot run, or the policy
            observes more than the estimate.
        ImportError: If Numba is not installed.
        RuntimeError: If the kernels cannot be emitted for the target.
    """
    check.choice("target", target, tuple(TARGETS))
    suite.require_filter()
    check.package("numba", "exporting a filter", "compile")
    values = {} if policy is None else policy_values(policy)
    env = {"QUAD_GYM_LANES": "1", "NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
    env["QUAD_GYM_PRECISION"] = "single" if TARGETS[target].single else PRECISION
    if env["QUAD_GYM_PRECISION"] == "single":
        env["QUAD_GYM_ROOM"] = " ".join(map(str, room_for(suite)))
    path = os.pathsep.join(part for part in sys.path if isinstance(part, str))
    done = subprocess.run(
        [sys.executable, "-c", "from baselines.exporting.filter_process import write; write()"],
        input=pickle.dumps((suite, label, target, values, imu_rate)),
        stdout=subprocess.PIPE,
        env={**os.environ, **env, "PYTHONPATH": path},
        check=False,
    )
    if done.returncode:
        raise RuntimeError(f"the filter could not be compiled for {target}, see above")
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for name, content in pickle.loads(done.stdout).items():
        files.append(folder / name)
        files[-1].write_bytes(content)
    return files


def room_for(suite: SensorSuite) -> tuple[int, ...]:
    """Return the sizes of the records of a suite's filter, see `records.ROOM`."""
    blocks = []
    for name, reading in READINGS.items():
        count = suite.blocks_of(name)  # those that may be several support each other in the gate
        blocks.append(max(2 if count and reading.most_blocks > 1 else 1, count))
    together = blocks_together(suite)
    states = max(len(slow_errors_of(suite)) - 2, together - 15, 1)  # without biases of the IMU
    return (*blocks, together, 3 * -(-states // 3))


def archive(objects: dict[str, bytes]) -> bytes:
    """Return a static library of object files, each with one symbol, in the format of GNU ar."""
    index_size = 4 + 4 * len(objects) + sum(len(name) + 1 for name in objects)
    place, offsets, members = 8 + 60 + index_size + index_size % 2, [], b""
    for k, content in enumerate(objects.values()):
        offsets.append(place + len(members))
        members += _member(f"{k}.o/", content)
    index = struct.pack(f">{1 + len(offsets)}I", len(offsets), *offsets)
    index += b"".join(name.encode() + b"\0" for name in objects)
    return b"!<arch>\n" + _member("/", index) + members


def _member(name: str, content: bytes) -> bytes:
    head = f"{name:<16}{0:<12}{0:<6}{0:<6}{'100644':<8}{len(content):<10}`\n"
    return head.encode() + content + b"\n" * (len(content) % 2)

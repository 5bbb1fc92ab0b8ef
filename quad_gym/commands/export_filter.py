"""Export a suite's filter as a C library.

    quad-gym export filter --sensors rtk --output filter
    quad-gym export filter --sensors mine.toml --target cortex-m7 --output filter
    quad-gym export filter --policy pretrained --env-id QuadGym/Circle-v0 --output pilot

Writes a folder with a static library, a C99 header, an example that filters a log, and a CMake
file. The estimates are bitwise those of `quad-gym replay`. docs/deployment.md explains the use.

    quad-gym export filter --sensors mine.toml --log flight.csv --output filter

Options that read a log, such as --columns and --from, have the meaning that they have in replay.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from quad_gym.commands.options import (
    SENSORS,
    Normalized,
    SuiteName,
    full_id,
    refuse_overwriting,
    usage_errors,
)
from quad_gym.commands.replay import ReadingArgs


@dataclass(frozen=True)
class ExportFilterArgs(ReadingArgs):
    """Options of the export; those that read a log need --log."""

    sensors: SuiteName = SENSORS
    target: Literal["x86-64", "aarch64", "cortex-m7", "cortex-m4", "wasm32"] = "x86-64"
    """processor: x86-64 (with AVX2) or aarch64 with Linux, cortex-m7, cortex-m4 (in single
    precision, also for a Cortex-M7 without double precision), or WebAssembly"""
    policy: str | None = None
    """also export a policy that acts on the estimate: pretrained, or a file of quad-gym train"""
    normalization: Normalized = None
    log: Path | None = None
    """log of a flight at the place where the filter will run: the origin of its positions, magnetic
    field and rate of the IMU; defaults to the suite's"""
    env_id: str | None = None
    """environment of the policy; defaults to that of its training record"""
    output: Path | None = None
    """folder to write; defaults to one in results/export"""
    overwrite: bool = False
    """replace an existing library"""


def main(args: ExportFilterArgs) -> None:
    """Export a filter."""
    from baselines.exporting import controller_of
    from baselines.exporting.filter_library import LIBRARY, export_filter
    from quad_gym.analysis.reports import require_writable
    from quad_gym.estimation import read_log
    from quad_gym.logs.replaying.replay import origin_of
    from quad_gym.params.suites import sensor_suite, suite_label

    with usage_errors((ValueError, OSError, ImportError, RuntimeError)):
        suite, label = sensor_suite(args.sensors), suite_label(args.sensors)
        folder = args.output or Path("results/export") / f"filter_{label}_{args.target}"
        refuse_overwriting(folder / LIBRARY, args.overwrite)
        require_writable("--output", folder)
        if args.log is None and (words := args.words()):
            raise ValueError(f"{words[0]} must come with --log")
        if args.env_id is not None and args.policy is None:
            raise ValueError("--env-id must come with --policy")
        if args.normalization is not None and args.policy is None:
            raise ValueError("--normalization must come with --policy")
        env_id = None if args.env_id is None else full_id(args.env_id)
        policy = (
            None
            if args.policy is None
            else controller_of(args.policy, env_id, normalization=args.normalization)
        )
        rate = 0.0
        if args.log is not None:
            log = read_log(args.log, **args.reading())
            suite = origin_of(log.corrected(suite), suite)
            rate = 1.0 / float(np.median(np.diff(log.imu.time)))
        files = export_filter(suite, label, args.target, folder, policy, imu_rate=rate)
    print(
        f"Wrote {len(files)} files to {folder}: the {suite.estimator.kind.upper()} of the suite "
        f'"{args.sensors}" for {args.target}. README.md there explains how to build and call it.'
    )

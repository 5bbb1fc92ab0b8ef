"""Export a trained policy to an autopilot.

    quad-gym export policy pretrained QuadGym/Circle-v0 --to c
    quad-gym export policy results/train/circle/ppo_seed_0/best.zip --to onnx

The policy is written as one self-contained C99 file, or as an ONNX model, which is compared with
the policy in onnxruntime. Both clip observations to their bounds and document observation and
action: names, units, frames, rate. docs/deployment.md explains how to use them.
"""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from quad_gym.commands.options import (
    Keywords,
    Normalized,
    full_id,
    leave,
    refuse_overwriting,
    usage_errors,
)

_SUFFIXES = {"c": ".c", "onnx": ".onnx"}

_C_KEYWORDS = re.compile(
    "auto|break|case|char|const|continue|default|do|double|else|enum|extern|float|for|goto|if|"
    "inline|int|long|register|restrict|return|short|signed|sizeof|static|struct|switch|typedef|"
    "union|unsigned|void|volatile|while"
)
"""Keywords of C99 that begin with a letter, which are not valid names of functions."""


@dataclass(frozen=True)
class ExportPolicyArgs:
    """Options of the export."""

    policy: tyro.conf.Positional[
        Annotated[
            str,
            tyro.conf.arg(
                metavar="POLICY",
                help="policy: pretrained (the included policy for the task), or a file of quad-gym "
                "train (.zip or .npz)",
            ),
        ]
    ]
    env_id: tyro.conf.Positional[
        Annotated[
            str | None,
            tyro.conf.arg(
                metavar="[ENV_ID]",
                help="environment of the policy; defaults to that of its training record",
            ),
        ]
    ] = None
    to: Literal["c", "onnx"] = "c"
    """format of the file"""
    env: Keywords = field(default_factory=dict)
    """keywords of the environment; defaults to those of the training record"""
    normalization: Normalized = None
    output: Path | None = None
    """file to write; defaults to one in results/export; its name is also the function's name"""
    overwrite: bool = False
    """replace an existing file"""


def _file(args: ExportPolicyArgs) -> Path:
    """File to write, in a writable folder."""
    from quad_gym import IDS
    from quad_gym.analysis.reports import require_writable

    suffix, path = _SUFFIXES[args.to], Path(args.policy).with_suffix("")
    name = "_".join(part for part in path.parts[-3:] if part not in ("/", "..", "."))
    if args.policy == "pretrained":
        name = IDS.get(full_id(args.env_id or ""), "policy")
    file = args.output or Path("results/export") / (name + suffix)
    if file.suffix != suffix:
        raise ValueError(f"--output must end in {suffix}, got {file}")
    refuse_overwriting(file, args.overwrite)
    require_writable("--output", file.parent)
    return file


def function_name(file: Path) -> str:
    """Name of the C function in a file: its name without extension, as an identifier."""
    name = re.sub(r"\W", "_", file.stem, flags=re.ASCII)
    return name if name[:1].isalpha() and not _C_KEYWORDS.fullmatch(name) else f"policy_{name}"


def export(args: ExportPolicyArgs, file: Path) -> str:
    """Write a policy; return a message for the user."""
    from baselines.exporting import c_source, controller_of, save_onnx

    env_id = None if args.env_id is None else full_id(args.env_id)
    leave(args.env)
    controller = controller_of(args.policy, env_id, args.env or None, args.normalization)
    if args.to == "onnx":
        error = save_onnx(controller, file)
        return f"Its actions in onnxruntime differ from the policy's by at most {error:.1g}."
    name = function_name(file)
    file.write_text(c_source(controller, name), encoding="utf-8")
    return (
        f"Call {name}(observation, action) {controller.control_rate:g} times per second; "
        "the comment at the top of the file explains both arguments."
    )


def main(args: ExportPolicyArgs) -> None:
    """Export a policy."""
    with usage_errors():
        file = _file(args)
        message = export(args, file)
    print(f"Wrote {file}. {message}")

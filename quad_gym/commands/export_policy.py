"""Take a trained policy to an autopilot.

    quad-gym export policy pretrained QuadGym/Circle-v0 --to c
    quad-gym export policy results/train/circle/ppo_seed_0/best.zip --to onnx

A policy becomes one file of C99 that needs nothing else, or an ONNX model, which is compared with
the policy in onnxruntime. Both clip observations to their bounds, and describe observation and
action: names, units, frames, rate. docs/deployment.md explains how to feed them.
"""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from quad_gym.commands.options import Keywords, full_id, usage_errors, writable_file

_SUFFIXES = {"c": ".c", "onnx": ".onnx"}

_C_KEYWORDS = re.compile(
    "auto|break|case|char|const|continue|default|do|double|else|enum|extern|float|for|goto|if|"
    "inline|int|long|register|restrict|return|short|signed|sizeof|static|struct|switch|typedef|"
    "union|unsigned|void|volatile|while"
)
"""The keywords of C99 that begin with a letter; no function can have them as its name."""


@dataclass(frozen=True)
class Args:
    """Options of the export."""

    policy: tyro.conf.Positional[
        Annotated[
            str,
            tyro.conf.arg(
                metavar="POLICY",
                help="pretrained (the pretrained policy of the task), or a file of quad-gym train "
                "(.zip or .npz)",
            ),
        ]
    ]
    env_id: tyro.conf.Positional[
        Annotated[
            str | None,
            tyro.conf.arg(
                metavar="[ENV_ID]",
                help="the environment of the policy; if not given, as in its training record",
            ),
        ]
    ] = None
    to: Literal["c", "onnx"] = "c"
    """kind of file"""
    env: Keywords = field(default_factory=dict)
    """keywords of the environment; if not given, as in the training record"""
    output: Path | None = None
    """file to write; if not given, in results/export; it names the function, too"""
    overwrite: bool = False
    """replace the file if there is one"""


def configure(args: Args) -> Path:
    """Check the options that do not need the policy, and make the folder.

    Returns:
        The file to write.

    Raises:
        ValueError: If options do not belong together, or the file is there already.
        OSError: If nothing can be written to the folder.
    """
    return writable_file(args.output, _name(args), _SUFFIXES[args.to], args.overwrite)


def _name(args: Args) -> str:
    """The stem of the file if none is given."""
    from quad_gym import IDS

    if args.policy == "pretrained":
        return IDS.get(full_id(args.env_id or ""), "policy")
    path = Path(args.policy).with_suffix("")
    return "_".join(part for part in path.parts[-3:] if part not in ("/", "..", "."))


def function_name(file: Path) -> str:
    """The name of the C function in a file: its stem, as an identifier."""
    name = re.sub(r"\W", "_", file.stem, flags=re.ASCII)
    return name if name[:1].isalpha() and not _C_KEYWORDS.fullmatch(name) else f"policy_{name}"


def export(args: Args, file: Path) -> str:
    """Write a policy; returns a message for the user."""
    from baselines.exporting import c_source, controller_of, save_onnx

    env_id = None if args.env_id is None else full_id(args.env_id)
    controller = controller_of(args.policy, env_id, args.env or None)
    if args.to == "onnx":
        error = save_onnx(controller, file)
        return f"Its actions in onnxruntime differ from the policy's by at most {error:.1g}."
    name = function_name(file)
    file.write_text(c_source(controller, name), encoding="utf-8")
    return (
        f"Call {name}(observation, action) {controller.control_rate:g} times a second; "
        "the comment at its beginning explains both."
    )


def main(args: Args) -> None:
    """Export a policy."""
    with usage_errors():
        file = configure(args)
        message = export(args, file)
    print(f"Wrote {file}. {message}")

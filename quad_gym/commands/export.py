"""Take a trained policy, or the parameters of a filter, to an autopilot.

    quad-gym export pretrained QuadGym/Circle-v0 --to c
    quad-gym export results/train/circle/ppo_seed_0/best.zip --to onnx
    quad-gym export filter --sensors rtk

A policy becomes one file of C99 that needs nothing else, or an ONNX model, which is compared with
the policy in onnxruntime. Both clip observations to their bounds, and say what observation and
action are: names, units, frames, rate. A filter becomes JSON or a header of C, with the numbers
that its equations take. docs/deployment.md says how to feed them.
"""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from quad_gym.commands.options import Keywords, SuiteName, full_id, refuse_overwriting, usage_errors

_SUFFIXES = {"c": ".c", "onnx": ".onnx", "json": ".json", "header": ".h"}

_C_KEYWORDS = re.compile(
    "auto|break|case|char|const|continue|default|do|double|else|enum|extern|float|for|goto|if|"
    "inline|int|long|register|restrict|return|short|signed|sizeof|static|struct|switch|typedef|"
    "union|unsigned|void|volatile|while"
)
"""Those of C99 that begin with a letter; no function can have them as its name."""


@dataclass(frozen=True)
class Args:
    """Options of the export."""

    policy: tyro.conf.Positional[
        Annotated[
            str,
            tyro.conf.arg(
                metavar="POLICY",
                help="pretrained (the one that ships for the task), a file of quad-gym train "
                "(.zip or .npz), or filter, for the numbers of a filter",
            ),
        ]
    ]
    env_id: tyro.conf.Positional[
        Annotated[
            str | None,
            tyro.conf.arg(
                metavar="[ENV_ID]",
                help="what the policy flies; if not given, as its training record says",
            ),
        ]
    ] = None
    to: Literal["c", "onnx", "json", "header"] | None = None
    """c or onnx of a policy, header or json of a filter; if not given, c or header"""
    env: Keywords = field(default_factory=dict)
    """keywords of the environment; if not given, as the training record says"""
    sensors: SuiteName = "standard"
    """whose filter; of a policy, sensors are among --env"""
    output: Path | None = None
    """file to write; if not given, in results/export; it names the function, too"""
    overwrite: bool = False
    """replace the file if there is one"""


def configure(args: Args) -> tuple[str, Path]:
    """Check what does not need the policy, and make the folder.

    Returns:
        What to write, and where.

    Raises:
        ValueError: If options do not belong together, or the file is there already.
        OSError: If nothing can be written to the folder.
    """
    from quad_gym.analysis.reports import require_writable

    of_filter = args.policy == "filter"
    kinds = ("header", "json") if of_filter else ("c", "onnx")
    kind = args.to or kinds[0]
    if kind not in kinds:
        what = "a filter" if of_filter else "a policy"
        raise ValueError(f"--to must be {' or '.join(kinds)} for {what}, got {kind}")
    if of_filter and (args.env_id is not None or args.env):
        raise ValueError("a filter takes no ENV_ID and no --env: --sensors alone chooses it")
    if not of_filter and args.sensors != "standard":
        raise ValueError(
            f"--sensors is for filters; for a policy, give --env sensors={args.sensors}"
        )
    file = args.output or Path("results/export") / (_name(args) + _SUFFIXES[kind])
    if file.suffix != _SUFFIXES[kind]:
        raise ValueError(f"--output must end in {_SUFFIXES[kind]}, got {file}")
    refuse_overwriting(file, args.overwrite)
    require_writable("--output", file.parent)
    return kind, file


def _name(args: Args) -> str:
    """The stem of the file if none is given."""
    from quad_gym import IDS
    from quad_gym.params.suites import suite_label

    if args.policy == "filter":
        return f"filter_{suite_label(args.sensors)}"
    if args.policy == "pretrained":
        return IDS.get(full_id(args.env_id or ""), "policy")
    path = Path(args.policy).with_suffix("")
    return "_".join(part for part in path.parts[-3:] if part not in ("/", "..", "."))


def function_name(file: Path) -> str:
    """The name of the C function in a file: its stem, as an identifier."""
    name = re.sub(r"\W", "_", file.stem, flags=re.ASCII)
    return name if name[:1].isalpha() and not _C_KEYWORDS.fullmatch(name) else f"policy_{name}"


def export_policy(args: Args, kind: str, file: Path) -> str:
    """Write a policy; returns what to tell."""
    from baselines.exporting import c_source, controller_of, save_onnx

    env_id = None if args.env_id is None else full_id(args.env_id)
    controller = controller_of(args.policy, env_id, args.env or None)
    if kind == "onnx":
        error = save_onnx(controller, file)
        return f"Its actions in onnxruntime differ from the policy's by at most {error:.1g}."
    name = function_name(file)
    file.write_text(c_source(controller, name), encoding="utf-8")
    return (
        f"Call {name}(observation, action) {controller.control_rate:g} times a second; "
        "the comment at its beginning explains both."
    )


def export_filter(args: Args, kind: str, file: Path) -> str:
    """Write the numbers of a filter; returns what to tell."""
    from baselines.exporting.filter_numbers import filter_header, filter_json
    from quad_gym.params.suites import sensor_suite, suite_label

    suite, name = sensor_suite(args.sensors), suite_label(args.sensors)
    text = filter_json(suite) if kind == "json" else filter_header(suite, name)
    file.write_text(text, encoding="utf-8")
    return f'The numbers of the {suite.estimator.kind.upper()} of the suite "{args.sensors}".'


def main(args: Args) -> None:
    """Export."""
    with usage_errors():
        kind, file = configure(args)
        write = export_filter if args.policy == "filter" else export_policy
        told = write(args, kind, file)
    print(f"Wrote {file}. {told}")

"""Export the parameters of a filter to an autopilot.

    quad-gym export filter --sensors rtk
    quad-gym export filter --sensors rtk --to json

The parameters are written as a C header or JSON, in the form used in the equations of the filter.
docs/deployment.md explains them.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from quad_gym.commands.options import SuiteName, usage_errors, writable_file

_SUFFIXES = {"json": ".json", "header": ".h"}


@dataclass(frozen=True)
class ExportFilterArgs:
    """Options of the export."""

    sensors: SuiteName = "standard"
    to: Literal["header", "json"] = "header"
    """format of the file"""
    output: Path | None = None
    """file to write; if not given, in results/export"""
    overwrite: bool = False
    """replace an existing file"""


def export(args: ExportFilterArgs, file: Path) -> str:
    """Write the parameters of a filter; return a message for the user."""
    from baselines.exporting.filter_numbers import filter_header, filter_json
    from quad_gym.params.suites import sensor_suite, suite_label

    suite, name = sensor_suite(args.sensors), suite_label(args.sensors)
    text = filter_json(suite) if args.to == "json" else filter_header(suite, name)
    file.write_text(text, encoding="utf-8")
    return f'Parameters of the {suite.estimator.kind.upper()} of the suite "{args.sensors}".'


def main(args: ExportFilterArgs) -> None:
    """Export a filter."""
    from quad_gym.params.suites import suite_label

    with usage_errors():
        name = f"filter_{suite_label(args.sensors)}"
        file = writable_file(args.output, name, _SUFFIXES[args.to], args.overwrite)
        message = export(args, file)
    print(f"Wrote {file}. {message}")

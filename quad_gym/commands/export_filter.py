"""Take the parameters of a filter to an autopilot.

    quad-gym export filter --sensors rtk
    quad-gym export filter --sensors rtk --to json

A filter becomes JSON or a header of C, with the numbers that its equations take. docs/deployment.md
explains them.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from quad_gym.commands.options import SuiteName, usage_errors, writable_file

_SUFFIXES = {"json": ".json", "header": ".h"}


@dataclass(frozen=True)
class Args:
    """Options of the export."""

    sensors: SuiteName = "standard"
    to: Literal["header", "json"] = "header"
    """kind of file"""
    output: Path | None = None
    """file to write; if not given, in results/export"""
    overwrite: bool = False
    """replace the file if there is one"""


def configure(args: Args) -> Path:
    """Check the options, and make the folder.

    Returns:
        The file to write.

    Raises:
        ValueError: If options do not belong together, or the file is there already.
        OSError: If nothing can be written to the folder.
    """
    from quad_gym.params.suites import suite_label

    name = f"filter_{suite_label(args.sensors)}"
    return writable_file(args.output, name, _SUFFIXES[args.to], args.overwrite)


def export(args: Args, file: Path) -> str:
    """Write the numbers of a filter; returns a message for the user."""
    from baselines.exporting.filter_numbers import filter_header, filter_json
    from quad_gym.params.suites import sensor_suite, suite_label

    suite, name = sensor_suite(args.sensors), suite_label(args.sensors)
    text = filter_json(suite) if args.to == "json" else filter_header(suite, name)
    file.write_text(text, encoding="utf-8")
    return f'The numbers of the {suite.estimator.kind.upper()} of the suite "{args.sensors}".'


def main(args: Args) -> None:
    """Export a filter."""
    with usage_errors():
        file = configure(args)
        message = export(args, file)
    print(f"Wrote {file}. {message}")

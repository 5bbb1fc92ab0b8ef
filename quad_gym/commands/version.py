"""Print the version."""

from dataclasses import dataclass

import quad_gym


@dataclass(frozen=True)
class VersionArgs:
    """`version` has no options."""


def main(args: VersionArgs) -> None:
    """Print the version."""
    print(quad_gym.__version__)

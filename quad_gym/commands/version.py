"""Print the version, and the precision of flights."""

from dataclasses import dataclass

import quad_gym
from quad_gym.records.sizes import PRECISION


@dataclass(frozen=True)
class VersionArgs:
    """`version` has no options."""


def main(args: VersionArgs) -> None:
    """Print the version, and the precision of the flights of this process."""
    print(quad_gym.__version__ + ("" if PRECISION == "double" else f" ({PRECISION} precision)"))

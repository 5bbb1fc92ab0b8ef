"""Print a script for the completion of commands and options in a shell.

For bash, put the first line into ~/.bashrc; for zsh, write the output of the second one to a file
_quad-gym in a folder of fpath:

  source <(quad-gym completion bash)
  quad-gym completion zsh
"""

from dataclasses import dataclass
from typing import Literal

import tyro


@dataclass(frozen=True)
class CompletionArgs:
    """Option of the script."""

    shell: tyro.conf.Positional[Literal["bash", "zsh"]]
    """name of the shell"""


def main(args: CompletionArgs) -> int:
    """Print the script."""
    from quad_gym.commands import main as program

    return program.main(["--tyro-print-completion", args.shell])

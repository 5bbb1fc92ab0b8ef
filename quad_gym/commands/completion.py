"""Print a script that completes commands and options with the Tab key.

Put the first line into ~/.bashrc; for zsh, write what the second prints to a file _quad-gym in a
folder of fpath:

  source <(quad-gym completion bash)
  quad-gym completion zsh
"""

from dataclasses import dataclass
from typing import Literal

import tyro

from quad_gym.commands.help_texts import registry


@dataclass(frozen=True)
class Args:
    """For which shell."""

    shell: tyro.conf.Positional[Literal["bash", "zsh"]]
    """the shell"""


def main(args: Args) -> None:
    """Print it: one script for all commands, as shells know it by the name of the program."""
    from quad_gym.commands.main import COMMANDS, PROGRAM, module_of

    kinds = {name: module_of(name).Args for name in COMMANDS}
    words = ["--tyro-print-completion", args.shell]
    tyro.extras.subcommand_cli_from_dict(kinds, prog=PROGRAM, args=words, registry=registry())

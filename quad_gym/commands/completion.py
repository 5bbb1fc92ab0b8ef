"""Print a script for the completion of commands and options in a shell.

For bash, put the first line into ~/.bashrc; for zsh, write the output of the second one to a file
_quad-gym in a folder of fpath:

  source <(quad-gym completion bash)
  quad-gym completion zsh
"""

from dataclasses import dataclass
from typing import Literal

import tyro

from quad_gym.commands.help_texts import registry


@dataclass(frozen=True)
class Args:
    """Option of the script."""

    shell: tyro.conf.Positional[Literal["bash", "zsh"]]
    """name of the shell"""


def main(args: Args) -> None:
    """Print one script for all commands, because shells identify it by the program's name."""
    from quad_gym.commands.main import COMMANDS, PROGRAM, module_of

    kinds = {name: module_of(name).Args for name in COMMANDS}
    words = ["--tyro-print-completion", args.shell]
    tyro.extras.subcommand_cli_from_dict(kinds, prog=PROGRAM, args=words, registry=registry())

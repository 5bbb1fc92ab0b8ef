"""The same as `quad-gym sweep`: see `quad_gym/commands`."""

import sys

from quad_gym.commands.main import run

if __name__ == "__main__":
    sys.exit(run("sweep"))

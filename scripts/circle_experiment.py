"""Run `quad-gym circle`, with `--seeds` for `--episodes`; see `quad_gym/commands`."""

import sys

from quad_gym.commands.main import main

if __name__ == "__main__":
    sys.exit(main(["circle", *sys.argv[1:]]))

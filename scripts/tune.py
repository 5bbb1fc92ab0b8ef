"""Run `quad-gym tune`; see `quad_gym/commands`."""

import sys

from quad_gym.commands.main import main

if __name__ == "__main__":
    sys.exit(main(["tune", *sys.argv[1:]]))

"""Run `quad-gym ablation`; see `quad_gym/commands`."""

import sys

from quad_gym.commands.main import main

if __name__ == "__main__":
    sys.exit(main(["ablation", *sys.argv[1:]]))

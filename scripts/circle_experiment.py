"""The same as `quad-gym circle`, with `--seeds` for `--episodes`: see `quad_gym/commands`."""

import sys

from quad_gym.commands.main import run

if __name__ == "__main__":
    sys.exit(run("circle", [word.replace("--seeds", "--episodes") for word in sys.argv[1:]]))

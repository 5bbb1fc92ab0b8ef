"""`python -m quad_gym` is `quad-gym`."""

import sys

from quad_gym.commands.main import main

if __name__ == "__main__":
    sys.exit(main())

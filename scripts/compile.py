"""Compile the kernels ahead of their first use: `python -m quad_gym compile`."""

import sys

from quad_gym.__main__ import main

if __name__ == "__main__":
    sys.exit(main(["compile", *sys.argv[1:]]))

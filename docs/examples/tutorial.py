"""Run the program of docs/tutorial.md, block by block, as a reader does.

    python docs/examples/tutorial.py --output results/tutorial

The figure and the film are written into the folder. It takes about three minutes on two cores.
"""

import os
import re
from dataclasses import dataclass
from pathlib import Path

import tyro

PAGE = Path(__file__).parents[1] / "tutorial.md"


@dataclass
class Args:
    """Options."""

    output: Path = Path("results/tutorial")
    """folder of the figure and the film"""


def main(args):
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text("utf-8"), re.MULTILINE | re.DOTALL)
    args.output.mkdir(parents=True, exist_ok=True)
    os.chdir(args.output)
    namespace = {"__name__": "__tutorial__"}
    for block in blocks:
        exec(compile(block, PAGE.name, "exec"), namespace)


if __name__ == "__main__":
    main(tyro.cli(Args))

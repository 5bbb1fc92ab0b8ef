"""Import of the scripts in docs/examples, which is not a package."""

import importlib.util
import sys
from pathlib import Path

FOLDER = Path(__file__).parents[1] / "docs" / "examples"


def example(name, folder=FOLDER):
    """Import a script of a folder as a module, without running its command."""
    spec = importlib.util.spec_from_file_location(name, folder / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look it up there
    spec.loader.exec_module(module)
    return module

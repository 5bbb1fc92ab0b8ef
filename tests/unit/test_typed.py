"""Users' type checkers see what the packages promise."""

import ast
from pathlib import Path

import baselines
import quad_gym


def test_packages_and_names_imported_on_first_use_have_types():
    """A type checker does not run `__getattr__`: it reads the imports that are for it alone."""
    for package in (quad_gym, baselines):
        assert (Path(package.__file__).parent / "py.typed").exists()
    tree = ast.parse(Path(quad_gym.__file__).read_text(encoding="utf-8"))
    (block,) = [node for node in tree.body if isinstance(node, ast.If)]
    assert ast.unparse(block.test) == "TYPE_CHECKING"
    told = {name.name: statement.module for statement in block.body for name in statement.names}
    assert told == quad_gym._LAZY
    assert set(told) <= set(quad_gym.__all__)  # exported, so that type checkers admit them

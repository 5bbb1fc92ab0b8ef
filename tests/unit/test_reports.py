"""Tables, JSON and CSV."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from quad_gym.analysis.reports import as_json, text_table, write_csv, write_json


@dataclasses.dataclass
class Point:
    x: float
    where: Path


def test_json_of_everything(tmp_path):
    value = {1: Point(np.nan, Path("a/b")), "array": np.arange(2), "flag": np.bool_(True)}
    file = write_json(tmp_path / "a.json", value)
    want = {"1": {"x": None, "where": "a/b"}, "array": [0, 1], "flag": True}
    assert json.loads(file.read_text()) == want
    assert as_json((1.5, np.float64("inf"))) == [1.5, None]


def test_csv_leaves_unknown_cells_empty(tmp_path):
    columns = {"a": np.array([1.0, np.nan]), "b": ["x", None]}
    assert write_csv(tmp_path / "a.csv", columns).read_text() == "a,b\n1.0,x\n,\n"
    with pytest.raises(ValueError, match="shorter"):
        write_csv(tmp_path / "a.csv", {"a": [1, 2], "b": [1]})


def test_table():
    table = text_table(
        {"": ["name"], "a long heading": ["x", "y"], "z": ["value"]},
        [["one", "1", "2", "3.25"], ["three", "10", "20", "-"]],
    )
    assert table.splitlines() == [
        "      | a long heading |   z",
        "name  |  x           y | value",
        "------+----------------+------",
        "one   |  1           2 |  3.25",
        "three | 10          20 |     -",
    ]

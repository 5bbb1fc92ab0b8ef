"""The script of tables about the filter: its cases, and what it writes."""

import json

import pytest

from tests import console_commands


def run(output, *options):
    common = ("--episodes", "48", "--duration", "1.1", "--output", str(output))
    done = console_commands.run("ablation", *options, *common)
    assert done.returncode == 0, done.stderr
    return done.stdout, json.loads((output / f"{options[0]}.json").read_text())


def test_wrong_models_stand_beside_the_matched_one(tmp_path):
    printed, found = run(tmp_path, "models")
    rows = found["rows"]
    assert next(iter(rows)) == "nominal"
    assert {"mass 20 % more", "mass 20 % less", "steady wind of 8 m/s"} < set(rows)
    assert all(name in printed for name in rows)
    assert rows["GNSS noise doubled"]["nees_state"] > 1.2 * rows["nominal"]["nees_state"]
    masses = [case["true_vehicle"]["mass"] for case in found["cases"] if "mass" in case["name"]]
    assert masses == pytest.approx([0.8 * 0.78, 1.2 * 0.78])
    assert found["seeds"] == [0, 47]


def test_forms_of_the_filter_stand_beside_each_other(tmp_path):
    printed, found = run(tmp_path, "filters", "--sensors", "indoor")
    rows = found["rows"]
    assert list(rows)[:2] == ["UKF", "EKF"]
    assert all(name in printed for name in rows)
    assert rows["UKF"]["relative_cost"] == 1.0
    whole = rows["UKF, no recursive image update"]["nees_state"]
    assert whole > 1.05 * rows["UKF"]["nees_state"]

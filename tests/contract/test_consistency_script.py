"""The command `consistency`: files and verdicts."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from quad_gym.analysis.consistency import MeanSquare
from quad_gym.analysis.consistency_flights import Findings
from quad_gym.experiments.consistency import single
from tests import console_commands


def run(output, *options):
    common = "--sensors lab --form corrected --no-camera --episodes 64 --duration 1 --output"
    return console_commands.run("consistency", *common.split(), output, *options)


def test_command_writes_figures_numbers_and_configuration(tmp_path):
    done = run(tmp_path, "--estimator", "ekf")
    assert done.returncode == 0, done.stderr
    assert "NEES" in done.stdout
    assert "Filters with a numerical failure: 0." in done.stdout
    for name in ("nees.png", "nees.svg", "errors.png", "nis.svg", "whiteness.png"):
        assert (tmp_path / name).stat().st_size > 5000
    found = json.loads((tmp_path / "consistency.json").read_text())
    assert found["seeds"] == [0, 63]
    assert found["configuration"]["episodes"] == 64
    assert found["sensors"]["estimator"]["kind"] == "ekf"
    assert found["sensors"]["imu"]["samples"] == "average"
    assert set(found["nis"]) == {"position", "baseline"} == set(found["whiteness"])
    assert len(found["nees"]["state"]["mean"]) == len(found["rms_errors"]) == 21


def test_wrong_noise_is_called_overconfident_or_too_cautious(tmp_path, monkeypatch):
    monkeypatch.setattr(single, "save_figure", lambda figure, stem: [])
    assert run(tmp_path, "--noise-factor", "1.5").returncode == 0
    found = json.loads((tmp_path / "consistency.json").read_text())
    assert not found["consistent"]
    assert "overconfident" in found["verdicts"]["nees_state"]
    assert run(tmp_path, "--noise-factor", "0.7").returncode == 0
    found = json.loads((tmp_path / "consistency.json").read_text())
    assert "too cautious" in found["verdicts"]["nees_state"]


def test_small_innovations_of_a_constant_error_are_expected(tmp_path):
    line = ["--episodes", "100", "--duration", "2", "--output", str(tmp_path)]
    assert console_commands.run("consistency", "--sensors", "rtk", *line).returncode == 0
    found = json.loads((tmp_path / "consistency.json").read_text())
    verdicts = found["verdicts"]
    assert found["overall"]["nis_baseline"] < 0.5
    expected = {name for name, sentence in verdicts.items() if "Expected" in sentence}
    assert expected == {"nis_baseline", "innovations_baseline"} & verdicts.keys()


@pytest.mark.parametrize(("mean", "consistent"), [(0.1, True), (2.0, True), (2.1, False)])
def test_nis_of_constant_error_is_consistent_unless_too_large(mean, consistent):
    one = np.ones(4)
    nees = {"state": MeanSquare("state", 15, one, 15.0 * one, 14.0 * one, 16.0 * one)}
    nis = {"baseline": MeanSquare("baseline", 2, one, mean * one, 1.9 * one, 2.1 * one)}
    some: Any = None
    findings = Findings(nees, nis, {}, one, one, some, one > 2.0, 0, frozenset({"baseline"}))
    assert findings.consistent == consistent
    assert not replace(findings, nis={}, failed=1).consistent

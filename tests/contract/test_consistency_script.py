"""The command `consistency`: files and verdicts."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import quad_gym
from quad_gym.analysis.consistency import Findings, MeanSquare
from tests import console_commands


def run(output, *options, figures=False):
    common = "--sensors lab --form corrected --no-camera --episodes 64 --duration 1 --output"
    return console_commands.run("consistency", *common.split(), output, *options, figures=figures)


def test_command_writes_figures_numbers_and_configuration(tmp_path):
    done = run(tmp_path, "--estimator", "ekf", figures=True)
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


def test_wrong_noise_is_called_overconfident_or_too_cautious(tmp_path):
    assert run(tmp_path, "--noise-factor", "1.5").returncode == 0
    found = json.loads((tmp_path / "consistency.json").read_text())
    assert not found["consistent"]
    assert "overconfident" in found["verdicts"]["nees_state"]
    assert run(tmp_path, "--noise-factor", "0.7").returncode == 0
    found = json.loads((tmp_path / "consistency.json").read_text())
    assert "too cautious" in found["verdicts"]["nees_state"]


def test_small_innovations_of_a_constant_error_are_expected(tmp_path):
    line = ["--episodes", "64", "--duration", "1", "--output", str(tmp_path)]
    assert console_commands.run("consistency", "--sensors", "rtk", *line).returncode == 0
    found = json.loads((tmp_path / "consistency.json").read_text())
    verdicts = found["verdicts"]
    assert found["overall"]["nis_baseline"] < 0.5
    expected = {name for name, sentence in verdicts.items() if "Expected" in sentence}
    assert expected == {"nis_baseline", "innovations_baseline"} & verdicts.keys()


class Held(quad_gym.Estimator):
    """The last fix, and the initial attitude."""

    state = {"r": np.zeros(3), "R": np.eye(3)}  # noqa: RUF012

    def reset(self, view, mask):
        self.state.r, self.state.R = view.position, view.R_BI

    def update(self, measurements):
        s, fix = self.state, measurements.gnss_position
        s.r = np.where(fix.new[:, np.newaxis], fix.value, s.r)
        return {"position": s.r, "velocity": 0.0 * s.r, "R_BI": s.R}


def test_estimator_without_covariance_has_errors_but_no_verdict(tmp_path):
    options = f"--estimator {__name__}:Held --sensors rtk --episodes 16 --duration 0.5"
    done = console_commands.run("consistency", *options.split(), "--output", tmp_path, figures=True)
    assert done.returncode == 0, done.stderr
    assert "has no covariance, so its consistency cannot be tested" in done.stdout
    assert "nan" not in done.stdout
    assert "overconfident" not in done.stdout
    found = json.loads((tmp_path / "consistency.json").read_text())
    assert found["consistent"] is None
    assert found["nees"] == found["verdicts"] == {}
    error = 1e3 * np.linalg.norm(found["rms_errors"][-1][:3])
    assert f"position {error:.1f} mm" in done.stdout


@pytest.mark.parametrize(("mean", "consistent"), [(0.1, True), (2.0, True), (2.1, False)])
def test_nis_of_constant_error_is_consistent_unless_too_large(mean, consistent):
    one = np.ones(4)
    nees = {"state": MeanSquare("state", 15, one, 15.0 * one, 14.0 * one, 16.0 * one)}
    nis = {"baseline": MeanSquare("baseline", 2, one, mean * one, 1.9 * one, 2.1 * one)}
    some: Any = None
    findings = Findings(nees, nis, {}, one, one, one, some, one > 2.0, 0, frozenset({"baseline"}))
    assert findings.consistent == consistent
    assert not replace(findings, nis={}, failed=1).consistent

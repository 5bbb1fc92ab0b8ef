"""Flights are bitwise equal to the golden ones, in any batch and process: `tests.golden`."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from quad_gym.records.sizes import WIDTHS
from tests.golden.flights import DIGESTS, cases, fly

GOLDEN, CASES = json.loads(DIGESTS.read_text()), cases()


def test_every_case_has_a_digest_and_every_digest_a_case():
    assert GOLDEN.keys() == CASES.keys()


def test_every_fault_changes_a_flight():
    digests = [GOLDEN[name] for name in CASES if name.startswith("fault ")]  # and "fault none"
    assert len(set(digests)) == len(digests)


@pytest.mark.parametrize("name", CASES)
def test_flights_equal_golden_flights(name):
    assert fly(CASES[name]) == GOLDEN[name], "changed on purpose? see tests/golden/__init__.py"


def assert_the_same_with(**environment):
    """Check all golden flights in a process with other environment variables."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.golden.flights"],
        cwd=Path(__file__).parents[2],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.slow  # each compiles all kernels
@pytest.mark.parametrize("lanes", WIDTHS)
def test_golden_flights_do_not_depend_on_number_of_lanes(lanes):
    assert_the_same_with(QUAD_GYM_LANES=str(lanes))


@pytest.mark.slow
def test_digests_do_not_depend_on_the_processor():
    """Rounding in NumPy's linear algebra depends on the processor; flights must not."""
    assert_the_same_with(OPENBLAS_CORETYPE="Prescott")

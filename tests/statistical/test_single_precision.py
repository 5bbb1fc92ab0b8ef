"""Filters in single precision are as consistent as in double precision, with any number of lanes.

A process computes in one precision, and each compiles its own kernels.
"""

import json

import numpy as np
import pytest

from tests.builders import run_python

pytestmark = pytest.mark.slow


def flown(suite, kind, flights, seconds, **environment):
    """Results of `tests.precision_flights` in a process with these variables."""
    words = ("-m", "tests.precision_flights", suite, kind, flights, seconds)
    done = run_python(*words, **environment)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("kind", ["ukf", "ekf"])
@pytest.mark.parametrize("suite", ["standard"])
def test_filters_in_single_precision_have_the_errors_of_double(suite, kind):
    double, single = (
        flown(suite, kind, 64, 60, QUAD_GYM_PRECISION=precision)
        for precision in ("double", "single")
    )
    assert single["precision"] == "single"
    assert single["failures"] == single["failed_predictions"] == 0
    assert single["nees"] == pytest.approx(double["nees"], rel=5e-3)
    assert single["nis"] == pytest.approx(double["nis"], rel=5e-3)
    apart = np.abs(np.subtract(single["r_hat"], double["r_hat"])).max()
    assert 0.0 < apart < 5e-4


@pytest.mark.parametrize("suite", ["standard"])
def test_flights_in_single_precision_do_not_depend_on_number_of_lanes(suite):
    digests = {
        flown(suite, "ukf", 20, 2, QUAD_GYM_PRECISION="single", QUAD_GYM_LANES=str(lanes))["digest"]
        for lanes in (2, 4, 8, 16)
    }
    assert len(digests) == 1

"""Filters in single precision are as consistent as in double precision, with any number of lanes.

A process computes in one precision, and each compiles its own kernels.
"""

import json
import shutil

import numpy as np
import pytest

from quad_gym.records.sizes import SINGLE_WIDTHS
from tests.builders import run_python
from tests.precision_flights import cases

pytestmark = pytest.mark.slow


def flown(*arguments, module="tests.precision_flights", **environment):
    """Return the output of a module in a process with these variables."""
    done = run_python("-m", module, *arguments, **environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def both():
    """Results of all cases over 64 flights of 60 s, in double and single precision."""
    return [
        json.loads(flown(64, 60, QUAD_GYM_PRECISION=precision))
        for precision in ("double", "single")
    ]


@pytest.mark.parametrize("case", cases())
def test_filters_in_single_precision_have_the_errors_of_double(both, case):
    assert [found["precision"] for found in both] == ["double", "single"]
    double, single = (found[case] for found in both)
    for count in ("failures", "failed_predictions", "resets"):
        assert single[count] == double[count], count
    assert single["failures"] == single["failed_predictions"] == 0
    assert sum(double["resets"]) > 0 or "resets" not in case
    assert single["nees"] == pytest.approx(double["nees"], rel=5e-3)
    assert single["nis"] == pytest.approx(double["nis"], rel=5e-3)
    assert single["from_rotations"] < 5e-6
    assert double["from_rotations"] < 1e-12
    assert not np.array_equal(single["r_hat"], double["r_hat"])


REPLAY = """
import json
import sys
from pathlib import Path

import numpy as np
from quad_gym.estimation import replay
from tests.logged_flights import RTK, Recorded, flown

log = Path(sys.argv[1])
if not log.exists():
    Recorded(flown(seconds=20.0)).write_csv(log)
found = replay(log, sensors=RTK)
print(json.dumps({
    "position": found.position.tolist(),
    "velocity": found.velocity.tolist(),
    "sigma": found.sigma.tolist(),
    "verdict": found.verdict.partition(":")[0],
}))
"""


def printed_in_both(program, folder):
    """Output of a program that reads a log, in double and in single precision."""
    told = []
    for precision in ("double", "single"):  # the first one writes the log
        words = ("-c", program, str(folder / "log.csv"))
        done = run_python(*words, QUAD_GYM_PRECISION=precision)
        assert done.returncode == 0, done.stderr
        told.append(done.stdout)
    return told


def test_replay_in_single_precision_agree_with_double(tmp_path):
    double, single = map(json.loads, printed_in_both(REPLAY, tmp_path))
    np.testing.assert_allclose(single["position"], double["position"], atol=1e-3)
    np.testing.assert_allclose(single["velocity"], double["velocity"], atol=1e-3)
    np.testing.assert_allclose(single["sigma"], double["sigma"], rtol=1e-2)
    assert single["verdict"] == double["verdict"]


CALIBRATION = """
import sys
from pathlib import Path

import numpy as np
from quad_gym.estimation import calibrate, fit_vehicle
from quad_gym.params.suites import CONSUMER
from tests.logged_flights import Recorded, flown

log, suite = Path(sys.argv[1]), CONSUMER.with_rates(imu=100.0).replace(barometer=None)
if not log.exists():
    flight = flown(suite, 14.0)
    Recorded(flight, suite, lost=0.0, jitter=0.0).write_csv(log)
    np.savez(log.with_suffix(".npz"), time=flight["time"], voltages=flight.about["voltages"])
sentences = []
found = calibrate(log, sensors=suite, share=0.6, delays=False, progress=sentences.append)
replay = found.after.replay
numbers = [
    sentences,
    found.numbers,
    found.suite,
    found.verdict,
    found.after.sensors,
    replay.position.tolist(),
    replay.sigma.tolist(),
    fit_vehicle(log, sensors=suite, motors=dict(np.load(log.with_suffix(".npz")))),
]
print(numbers)
"""


def test_calibration_in_single_precision_has_the_bits_of_double(tmp_path):
    """The fit of a vehicle, too, and the sentences on progress."""
    double, single = printed_in_both(CALIBRATION, tmp_path)
    assert double == single
    assert "Computing intervals" in double


@pytest.mark.skipif(not shutil.which("cc"), reason="no C compiler (cc)")
@pytest.mark.parametrize("suite", ["crazyflie", "rtk", "consumer", "uwb"])
def test_exported_filters_in_single_precision_equal_replays_in_it(suite):
    """With resets, outliers, outages, late measurements and starts in motion, bitwise.

    Also on a Cortex-M4, where the tools to emulate one are installed.
    """
    words = f"replay and {suite} and not (aarch64 or cortex-m7 or wasm32)"
    words = ("-q", "-k", words, "tests/unit/test_filter_library.py")
    told = flown(*words, module="pytest", QUAD_GYM_PRECISION="single")
    assert " passed" in told


INTERFACES = """
tests/contract/test_own_estimators.py tests/contract/test_pd_policy.py
tests/contract/test_same_flights.py tests/contract/test_tasks.py tests/contract/test_torch_env.py
tests/unit/test_flight_record.py tests/unit/test_replay_own.py
"""
TO_LAST_DIGITS = """
documented_formula documented_spread distances_between no_hovering_start default_to_the_gyro
of_its_flight_only controller_observes ukf_in_numpy consistency_command
"""


def test_interfaces_work_in_single_precision():
    """Own estimators and tasks, policies, torch views, recordings, and replays with own estimators.

    Without tests that compare with formulas to more digits than single precision has.
    """
    chosen = f"not ({' or '.join(TO_LAST_DIGITS.split())})"
    words = ("-q", "-m", "not slow", "-k", chosen, *INTERFACES.split())
    assert " passed" in flown(*words, module="pytest", QUAD_GYM_PRECISION="single")


@pytest.mark.parametrize("lanes", SINGLE_WIDTHS[1:])
def test_golden_flights_in_single_precision_do_not_depend_on_number_of_lanes(lanes):
    environment = {"QUAD_GYM_PRECISION": "single", "QUAD_GYM_LANES": str(lanes)}
    flown(module="tests.golden.flights", **environment)

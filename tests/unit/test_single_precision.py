"""Single precision of a process: its records, memory of exported filters, and analyses of logs."""

import re

import pytest

from baselines.exporting.filter_library import room_for
from quad_gym import sensor_suite
from quad_gym.params.suites import ALL_SUITES
from quad_gym.records import FLIGHT_BLOCK, WIDTH, places_of_lanes
from tests.builders import run_python

RECORDS = """
import warnings

import numpy as np
from quad_gym import UnscentedKalmanFilter, sensor_suite
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.commands.main import main
from quad_gym.records import FLIGHT, FLIGHT_BLOCK, WIDTH

assert FLIGHT["r"].base == np.float64 and FLIGHT_BLOCK["r"].base == np.float32
flights = np.arange(WIDTH + 3)
batch = FlightBatch(len(flights))
batch.write(flights, r=flights[:, np.newaxis] + np.arange(3.0) / 3.0)
batch.write(flights, key=flights[:, np.newaxis].astype(np.uint64) + np.uint64(2**60))
chosen = [WIDTH + 1, 0, 2]
copied = batch.with_records([batch.copied_record(k) for k in chosen])
for name in ("r", "key", "P", "needs_reset"):
    np.testing.assert_array_equal(copied.record(name), batch.record(name)[chosen])
assert batch.record("r").dtype == batch.covariance().dtype == np.float64
ukf = UnscentedKalmanFilter(sensor_suite("rtk"))
ukf._engine.write("r_hat", np.tile([1.0, 2.0, 1.0 / 3.0], (WIDTH, 1)))
copied = ukf._engine.copy()
ukf._engine.write("r_hat", np.zeros((WIDTH, 3)))
ukf._engine.restore(copied)
np.testing.assert_allclose(ukf._engine.read("r_hat"), [[1.0, 2.0, 1.0 / 3.0]] * WIDTH, rtol=1e-7)

with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    for reach in (999.0, 1001.0, 1002.0):
        batch.write(flights, r=np.full((len(flights), 3), reach))
        batch._calls_until_check = 0
        batch._warn_beyond_single()
assert [str(w.message).split(":")[0] for w in caught] == [
    "a flight is 1001 m from the origin, beyond 1000 m"
]
main(["version"])
"""

SINES = """
import numpy as np
from quad_gym.kernels.compiling import entry
from quad_gym.kernels.numbers.blocks import lanes_of
from quad_gym.kernels.numbers.elementary import sin_cos
from quad_gym.records import REAL, WIDTH, aligned_zeros

@entry
def evaluate(blocks):
    for i in range(len(blocks)):
        f = lanes_of(blocks[i])
        f.sin, f.cos = sin_cos(f.x)

names = ("x", "sin", "cos")
blocks = aligned_zeros(2500, np.dtype([(name, REAL, (WIDTH,)) for name in names], align=True))
x = blocks["x"]
x[:] = np.random.default_rng(1).uniform(-1.0, 1.0, x.shape)
x[:1000] *= 10.0
x[1000:2000] *= 3e4
x[2000:] = np.round(1e4 * x[2000:]) * np.pi / 2.0
evaluate(blocks)
truth = x.astype(float)
print(*(np.abs(f(truth) - blocks[f.__name__]).max() for f in (np.sin, np.cos)))
"""


def test_sine_and_cosine_in_single_precision_have_their_documented_error(tmp_path):
    script = tmp_path / "sines.py"
    script.write_text(SINES)
    done = run_python(script, QUAD_GYM_PRECISION="single")
    assert done.returncode == 0, done.stderr
    assert max(map(float, done.stdout.split())) < 1e-7


def test_each_number_in_a_block_belongs_to_one_lane():
    places = places_of_lanes(FLIGHT_BLOCK)
    assert places.shape[1] == WIDTH
    assert sorted(places.ravel()) == list(range(places.size))


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({"QUAD_GYM_PRECISION": "half"}, "must be double or single, got 'half'"),
        (
            {"QUAD_GYM_PRECISION": "single", "QUAD_GYM_LANES": "64"},
            "must be 2, 4, 8 or 16 in single precision, got '64'",
        ),
    ],
)
def test_unknown_precision_or_lanes_are_refused(variables, message):
    done = run_python("-c", "import quad_gym.records", **variables)
    assert message in done.stderr


def test_flights_in_single_precision_equal_golden_flights():
    """Others, and other numbers of lanes: `make test-single`."""
    words = ("-m", "tests.golden.flights", "late", "observation truth, consumer")
    done = run_python(*words, QUAD_GYM_PRECISION="single")
    assert done.returncode == 0, done.stderr


def test_single_precision_has_its_own_records_and_warns_of_distance():
    done = run_python("-c", RECORDS, QUAD_GYM_PRECISION="single")
    assert "(single precision)" in done.stdout, done.stderr


ANALYSES = """
import os
import time
import warnings

from quad_gym.logs.double import in_double
from quad_gym.records import PRECISION


class OwnError(Exception):
    def __init__(self, first, second):
        super().__init__(f"{first} and {second}")


@in_double
def analysis(end="", progress=None):
    print("printed there")
    progress(os.getpid())
    if end == "own":
        raise OwnError("one", "two")
    if end == "killed":
        os._exit(3)
    if end == "endless":
        time.sleep(1000.0)
    warnings.warn("too short", RuntimeWarning)
    return PRECISION, end
"""

SCRIPT = """
import os
import signal
import threading
import warnings

from analyses import analysis

signal.signal(signal.SIGINT, signal.default_int_handler)  # which jobs in the background ignore


class Own:
    pass


def refused(kind, text, end, progress=print):
    try:
        analysis(end, progress=progress)
    except kind as error:
        assert text in str(error), error
        return error
    raise AssertionError(end)


def interrupt(process):
    seen.append(process)
    threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()


seen = []
print("in", os.getpid())
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    assert analysis(progress=seen.append) == ("double", "")
assert [str(w.message) for w in caught] == ["too short"]
assert "in analysis" in refused(RuntimeError, "OwnError: one and two", "own").__notes__[0]
refused(RuntimeError, "ended with exit code 3", "killed")
refused(ValueError, "arguments cannot be sent there", Own())
refused(ValueError, "arguments cannot be sent there", lambda: None)
refused(KeyboardInterrupt, "", "endless", interrupt)
assert len(seen) == 2
for process in seen:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        continue
    raise AssertionError("a process is left")
"""


def test_analyses_in_double_precision_pass_progress_warnings_errors_and_interrupts(tmp_path):
    """To a script whose main module has no guard."""
    (tmp_path / "analyses.py").write_text(ANALYSES)
    (tmp_path / "script.py").write_text(SCRIPT)
    done = run_python("script.py", where=tmp_path, QUAD_GYM_PRECISION="single")
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("in ") == 1
    assert done.stderr.count("printed there") == 4


SMOOTHED = """
import numpy as np
from quad_gym import sensor_suite
from quad_gym.estimation import smooth

rng, n = np.random.default_rng(3), 60
table = {
    "time": 0.02 * np.arange(n),
    "gyro": 1e-4 * rng.normal(size=(n, 3)),
    "accel": [0.0, 0.0, 9.8] + 0.02 * rng.normal(size=(n, 3)),
    "gnss_enu": np.where(np.arange(n)[:, np.newaxis] % 10, np.nan, 0.02 * rng.normal(size=(n, 3))),
}
found = smooth(table, sensors="rtk", start={"heading": 0.3})
for name in ("position", "quaternion", "sigma", "covariance"):
    print(getattr(found, name).tobytes().hex())
"""


def test_smoothing_in_single_precision_has_the_bits_of_double():
    done = [
        run_python("-c", SMOOTHED, QUAD_GYM_PRECISION=precision, QUAD_GYM_LANES=lanes)
        for precision, lanes in (("double", None), ("single", "16"))
    ]
    assert done[1].stdout == done[0].stdout, done[1].stderr
    assert len(done[0].stdout) > 10_000, done[0].stderr


MEMORY = """
import sys

from baselines.exporting.filter_process import Sources
from quad_gym import sensor_suite
from quad_gym.records import FLIGHT_BLOCK

sources = Sources(sensor_suite(sys.argv[1]), sys.argv[1], "cortex-m4", {})
room = sources.room
for name in room.dtype.names:
    assert room.dtype.fields[name][1] + room.skipped == FLIGHT_BLOCK.fields[name][1]
print(sources.texts(0)["README.md"].decode())
"""


@pytest.mark.parametrize(
    ("name", "most"),
    [
        ("crazyflie", 50_000),
        ("indoor", 100_000),  # sixteen features
        *(
            pytest.param(name, 100_000, marks=pytest.mark.slow)
            for name in ALL_SUITES
            if name not in ("crazyflie", "indoor")
        ),
    ],
)
def test_exported_filter_in_single_precision_fits_the_memory_of_a_microcontroller(name, most):
    room = " ".join(map(str, room_for(sensor_suite(name))))
    variables = {"QUAD_GYM_LANES": "1", "QUAD_GYM_ROOM": room, "QUAD_GYM_PRECISION": "single"}
    done = run_python("-c", MEMORY, name, **variables)
    assert done.returncode == 0, done.stderr
    told = re.search(r"`qg_filter`.*about ([\d,]+) \|", done.stdout)
    assert 20_000 < int(told[1].replace(",", "")) < most

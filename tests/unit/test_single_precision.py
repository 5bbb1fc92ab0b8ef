"""Single precision of a process: its records, and refused calls that need double precision."""

import pytest

from quad_gym.records import FLIGHT_BLOCK, WIDTH, places_of_lanes
from tests.builders import run_python

RECORDS = """
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
main(["version"])
UnscentedKalmanFilter(sensor_suite("standard"))
"""


def test_each_number_in_a_block_belongs_to_one_lane():
    places = places_of_lanes(FLIGHT_BLOCK)
    assert places.shape[1] == WIDTH
    assert sorted(places.ravel()) == list(range(places.size))


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({"QUAD_GYM_PRECISION": "half"}, "must be double or single, got 'half'"),
        (
            {"QUAD_GYM_PRECISION": "single", "QUAD_GYM_LANES": "32"},
            "must be 2, 4, 8 or 16 in single precision, got '32'",
        ),
    ],
)
def test_unknown_precision_or_lanes_are_refused(variables, message):
    done = run_python("-c", "import quad_gym.records", **variables)
    assert message in done.stderr


def test_single_precision_has_its_own_records_and_refuses_single_filters():
    done = run_python("-c", RECORDS, QUAD_GYM_PRECISION="single")
    assert "(single precision)" in done.stdout, done.stderr
    assert "needs double precision, got QUAD_GYM_PRECISION=single" in done.stderr

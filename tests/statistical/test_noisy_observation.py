"""The noise of `observation="noisy"` is as large as the errors of the suite's filter."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quad_gym import FlightBatch, TaskParams, sensor_suite
from quad_gym.records import Source

FLIGHTS, RATE, BEGIN, END = 256, 50.0, 20.0, 26.0


def measured_errors(suite):
    """Return RMS errors per axis of the state that control on the estimate uses, on the circle."""
    task = TaskParams(kind="circle", start="hover", duration=0.0, out_of_bounds=100.0)
    batch = FlightBatch(
        FLIGHTS, sensors=suite, task=task, source=Source.ESTIMATE, control_rate=RATE, gains="tuned"
    )
    batch.reset(seeds=range(91_000, 91_000 + FLIGHTS))
    squares = []
    for step in range(round(END * RATE)):
        batch.step()
        if step < BEGIN * RATE or step % 5:
            continue
        w, x, y, z = batch.record("q").T
        to_inertial = Rotation.from_quat(np.stack([x, y, z, w], axis=1))
        seen = Rotation.from_matrix(batch.record("R_seen"))  # inertial to body
        errors = [batch.record(f"{name}_seen") - batch.record(name) for name in "rvw"]
        errors.insert(2, (seen * to_inertial).as_rotvec())
        squares.append([(error**2).mean() for error in errors])
    assert not batch.record("filter_status").any()
    return np.sqrt(np.mean(squares, axis=0))


@pytest.mark.slow
@pytest.mark.parametrize("suite", ["rtk", "consumer", "indoor"])
def test_observation_noise_of_suite_equals_rms_error_of_its_filter(suite):
    noisy = sensor_suite(suite).noisy
    stated = [noisy.position, noisy.velocity, noisy.attitude, noisy.body_rates]
    np.testing.assert_allclose(stated, measured_errors(suite), rtol=0.25)

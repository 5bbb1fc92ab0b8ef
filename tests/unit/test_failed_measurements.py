"""A failed measurement leaves the estimate bitwise unchanged and is counted."""

import numpy as np
import pytest

import quad_gym
from quad_gym.envs.vector import QuadVectorEnv
from quad_gym.records import (
    BASELINE_BLOCK,
    FEATURE_BLOCKS,
    POSITION_BLOCK,
    VELOCITY_BLOCK,
    WIDTH,
    Ending,
    FilterForm,
    FilterStatus,
    GateDecision,
)
from tests.circle_flight import record_circle
from tests.lane_filter import EIGHT, STATE, LaneFilter

LAB = quad_gym.sensor_suite("lab")
LAB = LAB.replace(gnss=LAB.gnss.replace(velocity_sigma=0.05))
FIELD = LAB.replace(
    estimator=LAB.estimator.replace(
        bearing_noise_at="pinhole",
        integration="midpoint",
        attitude_reset=True,
        false_alarm_probability=1e-4,
    )
)
RECORDING = record_circle(LAB.replace(estimator=FIELD.estimator), 60, 3)
TICK = int(np.flatnonzero(np.isfinite(RECORDING.pixels).all(axis=(1, 2)))[0])
BAD = 2
"""The flight whose measurement fails."""
KEPT = (*STATE, "nis", "nis_dimension")
VALUES = {name: f"gnss_{name}" for name in ("position", "baseline", "velocity")}
VALUES |= {"features": "pixels"}
BLOCKS = {
    "position": [POSITION_BLOCK],
    "baseline": [BASELINE_BLOCK],
    "velocity": [VELOCITY_BLOCK],
    "features": [FEATURE_BLOCKS, FEATURE_BLOCKS + 1],
}


def filters_with(blocks, sensors, form):
    """Return eight filters with measurements of some blocks."""
    filters = LaneFilter(sensors)
    filters.form |= int(form)
    for lane in range(EIGHT):
        filters.measure(lane, RECORDING, TICK)
    filters.initialize()
    for lane in range(EIGHT):
        names = ("position", "baseline")
        chosen = {name: name in blocks for name in names} | {"camera": "features" in blocks}
        filters.measure(lane, RECORDING, TICK, **chosen)
        filters.put(lane, gnss_velocity=np.zeros(3))
        filters.set_valid(lane, VELOCITY_BLOCK, "velocity" in blocks)
    return filters


@pytest.mark.parametrize("form", [0, FilterForm.EKF], ids=["ukf", "ekf"])
@pytest.mark.parametrize("sensors", [LAB, FIELD], ids=["report", "field"])
@pytest.mark.parametrize(
    "blocks",
    [("position",), ("baseline",), ("velocity",), ("features",), tuple(VALUES)],
    ids=["position", "baseline", "velocity", "features", "all"],
)
@pytest.mark.parametrize("how", ["nan", "infinity", "singular", "covariance"])
def test_a_failed_update_changes_nothing(how, blocks, sensors, form):
    """One flight fails, with one block or all blocks; the others update as without the failure."""
    if how == "infinity" and sensors is FIELD:
        pytest.skip("a gate rejects what is infinitely far")
    filters, free = (filters_with(blocks, sensors, form) for _ in range(2))
    last = blocks[-1]
    if how in ("nan", "infinity"):
        filters.put(BAD, **{VALUES[last]: np.nan if how == "nan" else np.inf})
    elif how == "singular":  # neither the estimate nor the measurements have any noise
        for name in ("position_sigma_I", "baseline_noise", "velocity_sigma", "pixel_sigma"):
            filters.put_params(BAD, **{name: 0.0})
        filters.put_params(BAD, direction_floor=0.0)
        filters.put(BAD, P=0.0)
    else:
        covariance = filters.get("P")[BAD]
        covariance[8, 1] = np.nan
        filters.put(BAD, P=covariance)
    before = {name: filters.get(name) for name in KEPT}
    filters.update()
    free.update()
    for name in KEPT:
        np.testing.assert_array_equal(filters.get(name)[BAD], before[name][BAD], err_msg=name)
        others = np.delete(filters.get(name), BAD, axis=0)
        np.testing.assert_array_equal(others, np.delete(free.get(name), BAD, axis=0))
    status, failures = filters.get("filter_status"), filters.get("update_failures")
    assert status[BAD] == FilterStatus.UPDATE_FAILED
    assert failures[BAD] == 1.0
    assert not np.delete(status, BAD).any()
    assert not np.delete(failures, BAD).any()
    assert not filters.get("prediction_failures").any()
    if sensors is FIELD:
        taken = [block for name in blocks for block in BLOCKS[name]]
        assert (filters.get("gate")[BAD, taken] == GateDecision.FAILED).all()
        assert (
            np.delete(filters.get("gate")[:, taken], BAD, axis=0) == GateDecision.ACCEPTED
        ).all()
    # with a valid measurement the filter continues as if nothing had failed
    if how in ("nan", "infinity"):
        filters.put(BAD, **{VALUES[last]: filters.get(VALUES[last])[0]})
        for name in STATE:
            filters.put(0, **{name: filters.get(name)[BAD]})
        filters.update()
        for name in STATE:
            np.testing.assert_array_equal(filters.get(name)[BAD], filters.get(name)[0])
        assert filters.get("update_failures")[BAD] == 1.0


@pytest.mark.parametrize("form", [0, FilterForm.EKF], ids=["ukf", "ekf"])
@pytest.mark.parametrize("sensors", [LAB, FIELD], ids=["report", "field"])
@pytest.mark.parametrize("field", ["gyro", "accel", "P"])
def test_a_failed_prediction_changes_nothing(field, sensors, form):
    filters, free = (filters_with(("position",), sensors, form) for _ in range(2))
    filters.put(BAD, **{field: np.nan})
    if field == "P":
        filters.put(BAD, P=1e200 * np.tri(15))  # squares overflow
    before = {name: filters.get(name) for name in STATE}
    for lanes in (filters, free):
        lanes.predict()
    for name in STATE:
        np.testing.assert_array_equal(filters.get(name)[BAD], before[name][BAD], err_msg=name)
        others = np.delete(filters.get(name), BAD, axis=0)
        np.testing.assert_array_equal(others, np.delete(free.get(name), BAD, axis=0))
    assert filters.get("filter_status")[BAD] == FilterStatus.PREDICTION_FAILED
    assert filters.get("prediction_failures")[BAD] == 1.0
    assert not np.delete(filters.get("prediction_failures"), BAD).any()
    filters.predict()
    assert filters.get("prediction_failures")[BAD] == 2.0


def test_environment_reports_failed_filter_and_resets_the_flight():
    env = QuadVectorEnv(9, "hover", autoreset_mode="SameStep")
    env.reset(seed=1)
    batch = env.flights.batch
    flights = batch.snapshot()
    flights["P"][3 // WIDTH, 4, 4, 3 % WIDTH] = np.nan
    batch.restore(flights)
    *_, truncated, info = env.step(np.zeros((9, 4)))
    np.testing.assert_array_equal(np.flatnonzero(truncated), [3])
    final = info["final_info"]
    assert final["ending"][3] == Ending.FILTER_FAILED
    assert final["filter_status"][3] == 3
    assert not info["filter_status"].any()
    assert not batch.record("update_failures").any()
    assert not batch.record("prediction_failures").any()

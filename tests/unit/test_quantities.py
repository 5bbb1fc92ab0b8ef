"""Quantities have equal public names and equal values in all interfaces."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import quad_gym
from quad_gym import FlightBatch, TaskParams, sensor_suite
from quad_gym.batch.quantities import QUANTITIES
from quad_gym.flights import COLUMNS
from quad_gym.params.sensor_table import AID_PARAMS
from quad_gym.records import Source
from quad_gym.tasks.view import VIEW_FIELDS
from tests import builders

ONLY_IN_FLIGHTS = {
    "covariance",
    "nees",
    "gnss_decision",
    "feature_decision",
    *(f"{name}_decision" for name in AID_PARAMS),
}
AIDED = sensor_suite("rtk").replace(
    barometer=quad_gym.BarometerParams(), magnetometer=quad_gym.MagnetometerParams()
)


def flown(task="circle", **keywords):
    """The batch of five flights after some steps, with a view."""
    return builders.flown(task, **{"steps": 30, "task": quad_gym.Task(), **keywords}).flights.batch


def test_flights_and_views_use_the_names_of_the_table():
    assert {column.name for column in COLUMNS} - set(QUANTITIES) == ONLY_IN_FLIGHTS
    views = {field.name for field in VIEW_FIELDS}
    for name in QUANTITIES:
        group, _, rest = name.partition("_")
        for prefix, shown in (("estimated", "estimate"), ("observed", "observed")):
            if group == prefix and rest not in ("gnss_drift", "quaternion"):
                assert f"{shown}.{rest}" in views, name
    assert {"truth.position", "truth.quaternion", "truth.accel_bias", "reference_velocity"} <= views


def test_every_quantity_has_the_shape_of_the_table():
    room = {"gates": 5, "obstacles": 1, "features": len(AIDED.camera.features_I)}
    wall = quad_gym.Wall(center_I=(9.0, 0.0, 1.0))
    batch = flown("waypoints", sensors=AIDED, world=quad_gym.WorldParams(obstacles=(wall,)))
    for name, quantity in QUANTITIES.items():
        if name in AID_PARAMS:
            room["blocks"] = AID_PARAMS[name].most_blocks
        shape = tuple(room.get(n, n) for n in quantity.shape)
        values = batch.read(name)
        assert values.shape == (5, *shape), name
        assert values.dtype == {float: np.float64, int: np.int64, bool: np.bool_}[quantity.kind]
        some = batch.read(name, np.array([3, 1]))
        np.testing.assert_array_equal(some, values[[3, 1]], err_msg=name)
        values[:] = 0  # a copy
        np.testing.assert_array_equal(batch.read(name, np.array([3, 1])), some, err_msg=name)


def test_attitudes_agree_with_scipy():
    batch = flown(sensors="rtk", observation="noisy", include_std=True)
    for prefix in ("", "estimated_", "observed_"):
        q, R_BI = batch.read(f"{prefix}quaternion"), batch.read(f"{prefix}R_BI")
        expected = Rotation.from_quat(q, scalar_first=True).as_matrix().transpose(0, 2, 1)
        np.testing.assert_allclose(R_BI, expected, atol=1e-12)


@pytest.mark.parametrize(
    "task",
    [
        "hover",
        "circle",
        "lemniscate",
        "random_trajectory",
        "waypoints",
        "trajectory",
        "look_around",
        "outage_dash",
    ],
)
def test_reference_quantities_equal_the_view_of_tasks(task):
    batch = flown(task, steps=40)
    view = batch.view
    for name in ("position", "velocity", "acceleration", "heading"):
        np.testing.assert_allclose(
            batch.read(f"reference_{name}"), getattr(view, f"reference_{name}"), atol=1e-11
        )


def test_unknown_quantities_are_refused_and_drawn_ones_are_read():
    batch = builders.batch(4, randomization={"mass": quad_gym.Uniform(0.7, 0.8)})
    np.testing.assert_array_equal(batch.read("mass"), batch.drawn()["mass"])
    np.testing.assert_array_equal(batch.read("mass", np.array([2])), batch.drawn()["mass"][2:3])
    with pytest.raises(ValueError, match=r"must be a quantity.* did you mean position"):
        batch.read("positon")
    for wrong in ("r", "v_hat", None, 3):
        with pytest.raises(ValueError, match="name must be a quantity of flights"):
            batch.read(wrong)
    with pytest.raises(ValueError, match=r"field of a flight's record.* did you mean b_a_hat"):
        batch.record("b_a_hut")


@pytest.mark.parametrize(
    "flights", [[3], [-1], np.array([0, 8]), np.array([True, False, True]), [0.5], [[0]], 0, ["a"]]
)
@pytest.mark.parametrize("name", ["position", "R_BI", "mass", "features"])
def test_flights_that_do_not_exist_are_refused(flights, name):
    """A block holds up to eight flights: NumPy would read from lanes without one."""
    batch = builders.batch(3, randomization={"mass": quad_gym.Uniform(0.7, 0.8)})
    assert len(batch.read(name, [2, 0])) == 2
    assert len(batch.read(name, [])) == 0
    with pytest.raises(ValueError, match=r"flights must be indices \(n,\) from 0 to 2, got"):
        batch.read(name, flights)
    with pytest.raises(ValueError, match=r"flights must be indices \(n,\) from 0 to 2, got"):
        batch.record("r", flights)


def test_estimates_without_a_filter_are_refused():
    batch = FlightBatch(2, source=Source.TRUTH, task=TaskParams(start="hover"))
    batch.reset(seeds=[0, 1])
    for name, quantity in QUANTITIES.items():
        if quantity.filtered:
            with pytest.raises(ValueError, match=f"{name} needs a filter"):
                batch.read(name)
        else:
            batch.read(name)
    assert not batch.read("filter_diverged").any()

"""Starts of vehicles on ground that carries them, and refused parameters of the ground."""

import numpy as np
import pytest

from quad_gym import GroundParams, TaskParams, Trajectory, Uniform, WorldParams, vehicle_params
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.records import COLUMNS, Control, Source

LEGS, HUBS = 0.1, vehicle_params("lab").rotor_positions_B


def batch(count=4, height=-0.1, task=None, ground=None, **options):
    world = WorldParams(ground=GroundParams(**(ground or {})), ground_height=height)
    task = TaskParams(**({"start": "ground", "duration": 0.0} | (task or {})))
    options = {"sensors": "lab", "source": Source.TRUTH, "control": Control.MOTOR} | options
    return FlightBatch(count, task=task, world=world, **options)


def stand(flights, steps=20):
    """Let flights stand with stopped rotors and return their endings."""
    endings = np.zeros(flights.count)
    for _ in range(steps):
        flights.step(np.full((flights.count, 4), -1.0))
        endings = np.maximum(endings, flights.result("ending"))
    return endings


@pytest.mark.parametrize(
    ("height", "reference"), [(-300.0, 1.0), (-0.7, 1.0), (-0.4, 1.0), (5.0, 6.0), (900.0, 901.0)]
)
@pytest.mark.parametrize("kind", ["hover", "circle", "waypoints"])
def test_episode_does_not_end_at_start_for_any_ground_height(kind, height, reference):
    task = {"kind": kind, "height": reference, "out_of_bounds": 400.0}
    flights = batch(height=height, task=task)
    flights.reset(seeds=range(4))
    assert (stand(flights) == 0.0).all()
    np.testing.assert_allclose(flights.record("r")[:, 2], height + LEGS, rtol=0.0, atol=1e-9)
    assert (flights.record("footing") == 4.0).all()


@pytest.mark.parametrize("start", ["ground", "mixed", "hover", "moving"])
def test_ground_out_of_bounds_of_the_reference_is_refused(start):
    task = {"start": start, "height": 1.0, "out_of_bounds": 3.0}
    for height in (-2.0, 3.8):
        flights = batch(64, height=height, task=task)
        flights.reset(seeds=range(64))
        assert (stand(flights, steps=1) == 0.0).all()
    with pytest.raises(ValueError, match=r"WorldParams\.ground_height .* out_of_bounds=3 .* got 4"):
        batch(height=4.0, task=task)
    if start in ("hover", "moving"):
        batch(height=-2.2, task=task)
    else:
        with pytest.raises(ValueError, match=r"WorldParams\.ground_height .* got -2.2"):
            batch(height=-2.2, task=task)


def test_ground_height_is_checked_against_start_of_reference():
    path = Trajectory.through([(0, 0, 10), (2, 0, 11), (4, 0, 14)])
    given = {"kind": "trajectory", "trajectory": path}
    for height, refused in ((7.0, False), (12.0, False), (0.0, True), (14.0, True)):
        if refused:
            with pytest.raises(ValueError, match=r"WorldParams\.ground_height"):
                batch(height=height, task=given)
        else:
            batch(height=height, task=given)
    for kind in ("waypoints", "random_trajectory"):
        with pytest.raises(ValueError, match=r"WorldParams\.ground_height"):
            batch(height=50.0, task={"kind": kind})


SMALL = Uniform(-1e-3, 1e-3)
DRAWS = [{}, *({name: SMALL} for name in ("start_velocity_I", "start_body_rates", "start_yaw"))]
DRAWS += [{"start_position_I": (None, None, Uniform(-0.5, -0.1))}]  # lifted onto the ground
DRAWS += [{"center_of_mass_B": (SMALL, SMALL, None)}]


@pytest.mark.parametrize("pad", [True, False])
@pytest.mark.parametrize("draws", DRAWS, ids=str)
def test_start_on_the_ground_with_any_draws_is_at_ground_height(pad, draws):
    task = {"pad": pad, "out_of_bounds": 10.0}
    flights = batch(16, height=-2.0, task=task, randomization=draws)
    flights.reset(seeds=range(16))
    np.testing.assert_allclose(flights.record("r")[:, 2], -2.0 + LEGS, rtol=0.0, atol=1e-12)
    flights.reset(seeds=range(16), velocity=[0.1, 0.0, 0.0])
    np.testing.assert_allclose(flights.record("r")[:, 2], -2.0 + LEGS, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("pad", [True, False])
@pytest.mark.parametrize("start", ["ground", "mixed"])
def test_a_drawn_height_is_on_top_of_the_ground(pad, start):
    draws = {"start_position_I": (None, None, Uniform(0.5, 1.5))}
    task = {"pad": pad, "start": start, "out_of_bounds": 10.0}
    flights, level = (
        batch(64, height=-2.0, task=task, randomization=given) for given in (draws, {})
    )
    flights.reset(seeds=range(64))
    level.reset(seeds=range(64))
    drawn = flights.record("drawn")[:, COLUMNS["start_position_I"]][:, 2]
    np.testing.assert_allclose(
        flights.record("r")[:, 2], level.record("r")[:, 2] + drawn, rtol=0.0, atol=1e-12
    )
    assert (level.record("r")[:, 2] == -2.0 + LEGS).sum() > 20
    assert (flights.record("footing") == 0.0).all()
    flights.reset(seeds=range(64), position=[0.0, 0.0, -1.0])
    assert (flights.record("r")[:, 2] == -1.0).all()


def test_only_reset_flights_are_put_onto_the_ground():
    flights = batch(16, height=-2.0, task={"out_of_bounds": 10.0})
    flights.reset(seeds=range(16), position=[0.0, 0.0, 1.0])
    chosen = np.arange(16) % 2 == 0
    flights.reset(mask=chosen)
    np.testing.assert_allclose(
        flights.record("r")[:, 2], np.where(chosen, -2.0 + LEGS, 1.0), rtol=0.0, atol=1e-12
    )


@pytest.mark.parametrize("whose", ["vehicle", "true_vehicle"])
def test_feet_that_are_not_below_the_rotor_hubs_are_refused(whose):
    """Only the true vehicle stands on the feet; the nominal hubs have no effect."""
    lab = vehicle_params("lab")
    for z, refused in ((0.1, False), (-0.099, False), (-0.1, True), (-0.2, True)):
        hubs = tuple((x, y, z if k == 2 else 0.2) for k, (x, y, _) in enumerate(HUBS))
        given = {whose: lab.replace(rotor_positions_B=hubs)}
        if refused:
            with pytest.raises(ValueError, match=rf"GroundParams\.feet_B .* at {z:g} m, got -0.1"):
                batch(**given)
        else:
            batch(**given)
    hubs = tuple((x, y, -0.3) for x, y, _ in HUBS)
    batch(vehicle=lab.replace(rotor_positions_B=hubs), true_vehicle=lab)

"""Ground contact under thrust: vehicles come to rest or slide, and do not sink in."""

import math

import numpy as np
import pytest

from tests.builders import put
from tests.unit.test_ground import CALM, FLOOR, TOUGH, at_random, batch, points

STILL_GAP = 2e-4


def rotors(shares):
    """Return rotor speeds (n, 4) that carry shares of the weight, and actions that hold them."""
    forces = np.asarray(shares) * CALM.mass * CALM.gravity / 4.0
    speeds = np.sqrt(forces / CALM.thrust_coefficient)
    actions = speeds / CALM.motor_speed_per_volt / CALM.hover_voltage - 1.0
    return np.tile(speeds[:, None], 4), np.tile(actions[:, None], 4)


def level(flights, shares, height, velocity):
    """Put flights above the ground, level, without rotation; return actions for their thrust."""
    n = flights.count
    speeds, actions = rotors(shares)
    r = np.column_stack([np.zeros((n, 2)), height])
    q = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    put(flights, r=r, v=velocity, q=q, w=np.zeros((n, 3)), rotor_speeds=speeds)
    return actions


def feet(flights):
    return points(flights)[:, :4, 2] - FLOOR


def test_landings_under_thrust_come_to_rest():
    rng, shares = np.random.default_rng(0), np.repeat([0.2, 0.5, 0.7, 0.8, 0.9], 32)
    flights = batch(len(shares))
    flights.reset(seeds=range(len(shares)))
    down = np.column_stack([np.zeros((len(shares), 2)), -rng.uniform(0.02, 0.3, len(shares))])
    actions = level(flights, shares, rng.uniform(1e-4, 6e-3, len(shares)), down)
    for _ in range(100):
        flights.step(actions)
    assert (flights.record("v") == 0.0).all()
    assert (flights.record("w") == 0.0).all()
    assert np.abs(feet(flights)).max() < STILL_GAP


@pytest.mark.parametrize("friction", [0.0, 0.1])
def test_sliding_under_thrust_keeps_its_height(friction):
    """The ground carries (1 - share) m g, so the deceleration is friction (1 - share) g."""
    shares = np.array([0.0, 0.5, 0.9])
    flights = batch(3, ground={"friction": friction})
    flights.reset(seeds=range(3))
    actions = level(flights, shares, np.zeros(3), np.tile([1.0, 0.0, 0.0], (3, 1)))
    for _ in range(100):
        flights.step(actions)
    assert np.abs(feet(flights)).max() < 1e-4
    slower = friction * (1.0 - shares) * CALM.gravity * 0.5
    np.testing.assert_allclose(flights.record("v")[:, 0], 1.0 - slower, atol=5e-3)


def test_vehicle_tumbling_under_thrust_does_not_sink_in():
    flights = batch(96, ground=TOUGH)
    flights.reset(seeds=range(96))
    at_random(flights, np.random.default_rng(0))
    speeds, actions = rotors(np.linspace(0.1, 0.9, 96))
    put(flights, rotor_speeds=speeds)
    deepest = np.zeros(96)
    for _ in range(2 * 200):
        flights.step(actions)
        deepest = np.minimum(deepest, (points(flights)[..., 2] - FLOOR).min(axis=1))
    assert math.isfinite(flights.record("v").sum())
    assert deepest.min() > -0.02


@pytest.mark.parametrize("tilt", [0.0, 0.01])
def test_feet_below_the_plane_come_to_rest(tilt):
    """The ground does not push feet out, which would gain energy; vehicles stay in place."""
    rng = np.random.default_rng(0)
    flights = batch(64)
    flights.reset(seeds=range(64))
    actions = level(flights, np.full(64, 0.3), -rng.uniform(0.0, 0.02, 64), np.zeros((64, 3)))
    angle, half = rng.uniform(-math.pi, math.pi, 64), 0.5 * tilt
    aside = math.sin(half) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    put(flights, q=np.column_stack([np.full(64, math.cos(half)), aside, np.zeros(64)]))
    for _ in range(4 * 200):  # a vehicle on one foot below the plane settles slowly
        flights.step(actions)
    assert (flights.record("v") == 0.0).all()
    assert (flights.record("w") == 0.0).all()
    assert feet(flights).max() < STILL_GAP
    before = flights.record("r")
    for _ in range(100):
        flights.step(actions)
    assert (flights.record("r") == before).all()

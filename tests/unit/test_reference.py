"""References: closed forms, exact derivatives, headings, and bounds of random trajectories."""

import numpy as np
import pytest

import quad_gym
from quad_gym.configuration import FlightConfiguration
from quad_gym.kernels.compiling import entry
from quad_gym.kernels.numbers.blocks import lanes_of
from quad_gym.kernels.numbers.linalg import store
from quad_gym.kernels.numbers.random import stream_of
from quad_gym.kernels.task.episode import draw_reference
from quad_gym.kernels.task.reference import evaluate_reference, position_on_reference
from quad_gym.packing import settings_record
from quad_gym.records import (
    FLIGHT,
    FLIGHT_BLOCK,
    MAX_HARMONICS,
    WIDTH,
    Source,
    aligned_zeros,
    field_of_flights,
)


@entry
def draw_in_lanes(blocks, settings):
    for i in range(len(blocks)):
        flight = lanes_of(blocks[i])
        draw_reference(flight, settings[0], stream_of(flight), flight.tick >= 0.0)


@entry
def evaluate_on_floats(flights, times, out):
    for i in range(len(flights)):
        for k in range(len(times)):
            r, v, a, x = evaluate_reference(flights[i], times[k])
            store(out[i, k, 0], r)
            store(out[i, k, 1], v)
            store(out[i, k, 2], a)
            store(out[i, k, 3], x)
            store(out[i, k, 4], position_on_reference(flights[i], times[k]))


def evaluated(flights, times):
    """Position, velocity, acceleration and heading, each (n_flights, n_times, 3)."""
    times = np.atleast_1d(np.asarray(times, float))
    out = np.empty((len(flights), len(times), 5, 3))
    evaluate_on_floats(flights, times, out)
    np.testing.assert_allclose(out[:, :, 4], out[:, :, 0], rtol=0.0, atol=1e-13)
    return tuple(out[:, :, k] for k in range(4))


def drawn(count, seed=1, **task):
    """Flights, as scalar records, whose references were drawn for a task."""
    task_params = quad_gym.TaskParams(**task)
    configuration = FlightConfiguration(count, task=task_params, sensors="lab", source=Source.TRUTH)
    settings = settings_record(configuration)
    blocks = aligned_zeros(-(-count // WIDTH), FLIGHT_BLOCK)
    rng = np.random.default_rng(seed)
    blocks["key"] = rng.integers(0, 2**64, blocks["key"].shape, np.uint64)
    draw_in_lanes(blocks, settings)
    flights = np.zeros(count, FLIGHT)
    for name in FLIGHT.names:
        flights[name] = field_of_flights(blocks, name, count)
    return flights


def random_series(seed):
    """A flight whose reference is a full Fourier series."""
    rng = np.random.default_rng(seed)
    flight = np.zeros(1, FLIGHT)
    flight["ref_omega"], flight["ref_center"] = rng.uniform(0.1, 1.0), rng.normal(size=3)
    flight["ref_cos"] = rng.normal(size=(MAX_HARMONICS, 3))
    flight["ref_sin"] = rng.normal(size=(MAX_HARMONICS, 3))
    return flight


TIMES = np.linspace(0.0, 30.0, 301)


def test_a_series_is_the_sum_of_its_terms():
    flight = random_series(1)
    position = evaluated(flight, TIMES)[0][0]
    phase = np.outer(TIMES, flight["ref_omega"][0] * np.arange(1, MAX_HARMONICS + 1))
    expected = np.cos(phase) @ flight["ref_cos"][0] + np.sin(phase) @ flight["ref_sin"][0]
    np.testing.assert_allclose(position, flight["ref_center"][0] + expected, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_velocity_and_acceleration_are_the_derivatives(seed):
    flight, h = random_series(seed), 1e-3
    steps = np.array([-2, -1, 1, 2])
    weights = np.array([1.0, -8.0, 8.0, -1.0]) / (12.0 * h)  # fourth-order differences
    _, velocity, acceleration, _ = evaluated(flight, TIMES)
    around = (TIMES[:, np.newaxis] + h * steps).ravel()
    positions, velocities = (x[0].reshape(-1, 4, 3) for x in evaluated(flight, around)[:2])
    slope, bend = (np.einsum("k,tki->ti", weights, x) for x in (positions, velocities))
    np.testing.assert_allclose(velocity[0], slope, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(acceleration[0], bend, rtol=0.0, atol=1e-8)


@pytest.mark.parametrize(
    ("speed", "acceleration", "radius", "period"),
    [(2.5, 3.0, 4.0, 10.0), (0.5, 100.0, 50.0, 20.0), (50.0, 0.3, 50.0, 5.0), (50, 50, 1.0, 10.0)],
)
def test_random_trajectories_respect_their_bounds(speed, acceleration, radius, period):
    limits = {"max_speed": speed, "max_acceleration": acceleration, "radius": radius}
    flights = drawn(200, kind="random_trajectory", **limits, period=period, height=2.0)
    times = np.linspace(0.0, period, 400)
    r, v, a, _ = evaluated(flights, times)
    slack = 1.0 + 1e-12
    away = np.linalg.norm(r - [0.0, 0.0, 2.0], axis=-1).max(axis=1)
    fast, hard = (np.linalg.norm(x, axis=-1).max(axis=1) for x in (v, a))
    assert fast.max() <= speed * slack
    assert hard.max() <= acceleration * slack
    assert away.max() <= radius * slack
    # each trajectory reaches a fifth of at least one bound
    assert np.max([fast / speed, hard / acceleration, away / radius], axis=0).min() > 0.2
    np.testing.assert_allclose(r[:, 0], r[:, -1], rtol=0.0, atol=1e-9)
    gaps = np.linalg.norm(r[:64, np.newaxis, 1] - r[:64, 1], axis=-1)[np.triu_indices(64, 1)]
    assert gaps.min() > 1e-4


@pytest.mark.parametrize("gate_count", [1, 3, 8])
def test_drawn_gates_stay_within_bounds_and_apart(gate_count):
    flights = drawn(200, kind="waypoints", gate_count=gate_count, radius=3.0, height=2.0)
    gates = flights["gates"]
    distance = np.linalg.norm(gates[..., :2], axis=-1)
    assert distance.min() >= 0.4 * 3.0 - 1e-12
    assert distance.max() <= 3.0 + 1e-12
    assert gates[..., 2].min() >= 1.4 - 1e-12
    assert gates[..., 2].max() <= 2.6 + 1e-12
    azimuth = np.unwrap(np.arctan2(gates[..., 1], gates[..., 0]), axis=1)[:, :gate_count]
    turn = np.abs(np.angle(np.exp(1j * np.diff(azimuth, axis=1))))
    assert (turn >= np.pi / 3 - 1e-9).all()
    np.testing.assert_array_equal(
        gates[:, gate_count:], np.repeat(gates[:, gate_count - 1 : gate_count], 8 - gate_count, 1)
    )
    np.testing.assert_array_equal(flights["ref_center"], gates[:, 0])


@pytest.mark.parametrize(
    ("rule", "point", "expected"),
    [
        (0.0, (5.0, 2.0, 9.0), (0.6, 0.8, 0.0)),
        (1.0, (0.0, -3.0, 5.0), (0.0, -1.0, 0.0)),
        (1.0, (0.0, 0.0, 5.0), (1.0, 0.0, 0.0)),
        (0.0, (2.0, -2.0, 0.0), (1.0, 0.0, 0.0)),
        (2.0, (9.0, 9.0, 9.0), (0.0, 1.0, 0.0)),
    ],
    ids=["toward", "along", "straight up", "overhead", "velocity"],
)
def test_the_heading_is_a_horizontal_direction_or_east(rule, point, expected):
    flight = np.zeros(1, FLIGHT)
    flight["ref_center"], flight["ref_omega"] = (2.0, -2.0, 1.0), 1.0
    flight["ref_heading_rule"], flight["ref_heading_point"] = rule, point
    if rule == 2.0:
        flight["ref_sin"][0, 0] = (0.0, 1.0, 3.0)
    heading = evaluated(flight, 0.0)[3][0, 0]
    np.testing.assert_allclose(heading, expected, rtol=0.0, atol=1e-15)

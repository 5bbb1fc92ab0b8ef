"""Dryden gusts against MIL-F-8785C: scales, discretization, variance, correlation, spectrum."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

import quad_gym
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.kernels.vehicle.air import (
    first_order,
    gust_scales,
    second_order,
    sinh_less_argument,
)
from quad_gym.records import Control, Source
from tests.unit.alarms import assert_normal
from tests.unit.compiled import Compiled

FOOT = 0.3048
WIND, HEIGHT = 8.0, 6.0


def military_scales(height, wind_speed):
    """Return sigma_u, sigma_w [m/s], L_u, L_w [m] by the formulas of the specification, in feet."""
    h = np.clip(height / FOOT, 10.0, 1000.0)
    sigma_w = 0.1 * wind_speed
    sigma_u = sigma_w / (0.177 + 0.000823 * h) ** 0.4
    return sigma_u, sigma_w, FOOT * h / (0.177 + 0.000823 * h) ** 1.2, FOOT * h


def scales(f, _):
    f.sigma_u, f.sigma_w, f.L_u, f.L_w = gust_scales(f.height, f.wind_speed)


def filters(f, _):
    f.u = first_order(f.x, f.h, f.n)
    f.v, f.w = second_order(f.x, f.y, f.h, f.n, f.m)
    f.excess = sinh_less_argument(f.h)


scales_of = Compiled(scales, height=(), wind_speed=(), sigma_u=(), sigma_w=(), L_u=(), L_w=())
filter_of = Compiled(filters, x=(), y=(), h=(), n=(), m=(), u=(), v=(), w=(), excess=())


@given(st.floats(-10.0, 1000.0), st.floats(0.0, 40.0))
def test_gust_scales_match_the_specification(height, wind_speed):
    got = scales_of.on_floats(height=[height], wind_speed=[wind_speed])
    expected = military_scales(height, wind_speed)
    for name, value in zip(("sigma_u", "sigma_w", "L_u", "L_w"), expected, strict=True):
        np.testing.assert_allclose(got[name][0], value, rtol=1e-13, err_msg=name)


def test_hyperbolic_sine_minus_its_argument_is_exact_to_a_few_units_in_the_last_place():
    """Against the series in fractions; below one there is no cancellation."""
    h = np.array([1e-6, 1e-3, 0.1, 0.5, 0.9, 0.999, 0.9999])
    expected = [
        float(sum(Fraction(x) ** k / math.factorial(k) for k in range(3, 40, 2))) for x in h
    ]
    for run in (filter_of.on_floats, filter_of.on_lanes):
        np.testing.assert_allclose(run(h=h)["excess"], expected, rtol=1e-15)


@pytest.mark.parametrize("h", [1e-9, 1e-6, 1e-3, 0.03, 0.9, 1.1, 4.0])
def test_the_discretization_is_exact(h):
    """Transition and noise covariance equal Van Loan's matrix exponential (1978)."""
    A, B = np.array([[-1.0, 0.0], [1.0, -1.0]]), np.array([[1.0], [0.0]])
    van_loan = expm(h * np.block([[-A, B @ B.T], [np.zeros((2, 2)), A.T]]))
    transition = van_loan[2:, 2:].T
    noise = transition @ van_loan[:2, 2:]
    # columns: response to each state, and to each normal sample
    inputs = {"x": [1, 0, 0, 0], "y": [0, 1, 0, 0], "n": [0, 0, 1, 0], "m": [0, 0, 0, 1]}
    got = filter_of.on_lanes(**inputs, h=[h] * 4)
    responses = np.stack([got["v"], got["w"]])
    np.testing.assert_allclose(responses[:, :2], transition, rtol=1e-13, atol=1e-14)
    factor = responses[:, 2:]
    # Van Loan's entries lose digits where h^3 vanishes next to 1: compare scaled entries
    sizes = np.sqrt(np.diag([h, h**3 / 3])) if h < 1e-2 else np.eye(2)
    whiten = np.linalg.inv(sizes)
    found, tolerance = whiten @ (factor @ factor.T) @ whiten, {"rtol": 1e-8, "atol": 1e-8}
    if h < 1e-3:  # the leading terms of the integrals of e^(-2t), t e^(-2t), t^2 e^(-2t)
        noise, tolerance = np.array([[h, h**2 / 2], [h**2 / 2, h**3 / 3]]), {"rtol": 3 * h + 1e-6}
    np.testing.assert_allclose(found, whiten @ noise @ whiten, **tolerance)
    np.testing.assert_allclose(got["u"][0], np.exp(-h), rtol=1e-15)
    np.testing.assert_allclose(got["u"][2] ** 2, -np.expm1(-2 * h), rtol=1e-6)


def hovering_in_gusts(count, *, height=HEIGHT, wind=(0.0, WIND, 0.0), dt=0.005):
    """Return vehicles at rest: level, without drag, with a thrust equal to the weight."""
    vehicle = quad_gym.vehicle_params("lab").replace(disc_area=0.0)
    sensors = quad_gym.sensor_suite("lab").replace(camera=None).with_rates(imu=1.0 / dt)
    task = quad_gym.TaskParams(kind="hover", start="hover", duration=0.0)
    world = quad_gym.WorldParams(wind_I=wind, gust_wind_speed=WIND, ground_height=0.0)
    made = {"vehicle": vehicle, "sensors": sensors, "task": task, "world": world}
    batch = FlightBatch(count, source=Source.TRUTH, control=Control.MOTOR, **made)
    batch.reset(seeds=range(count), position=(0.0, 0.0, height), velocity=(0.0, 0.0, 0.0), yaw=0.0)
    batch._blocks["q"] = np.array([1.0, 0.0, 0.0, 0.0])[:, np.newaxis]
    return batch


def gusts(batch):
    """Return gusts (n, 3) along the wind (north), across (west) and up, divided by intensities."""
    sigma_u, sigma_w, _, _ = military_scales(HEIGHT, WIND)
    east, north, up = (batch.record("wind") - batch.world.wind_I).T
    return np.stack([north / sigma_u, -east / sigma_u, up / sigma_w], axis=1)


@pytest.fixture(scope="module")
def history():
    """Gusts of 4,000 flights at some times [s]: {time: (n, 3)}."""
    found = {}
    for dt, ticks in ((0.005, (0, 1, 40, 400)), (0.05, (400,))):
        batch = hovering_in_gusts(4000, dt=dt)
        for tick in range(401):
            if tick in ticks:
                found[tick * dt] = gusts(batch)
            batch.step()
        np.testing.assert_allclose(batch.record("r"), [[0.0, 0.0, HEIGHT]] * 4000, atol=1e-6)
    return found


@pytest.mark.parametrize("time", [0.0, 0.005, 20.0])
def test_gusts_are_normal_with_the_specified_intensities(history, time):
    assert_normal(history[time], np.zeros(3), np.eye(3))


@pytest.mark.parametrize("time", [0.005, 0.2, 2.0])
def test_autocorrelation_of_gusts_matches_dryden_spectra(history, time):
    _, _, L_u, L_w = military_scales(HEIGHT, WIND)
    x, z = np.array([L_u, L_u, L_w]), WIND * time
    first_order_decay = np.exp(-z / x)
    expected = first_order_decay * np.array([1.0, 1.0 - 0.5 * z / L_u, 1.0 - 0.5 * z / L_w])
    start, now = history[0.0], history[time]
    # given the first gust, the innovation of the second is normal with a known variance
    innovation = (now - expected * start) / np.sqrt(1.0 - expected**2)
    assert_normal(np.hstack([start, innovation]), np.zeros(6), np.eye(6))


def test_gust_axes_turn_with_the_wind_direction():
    still, turned = hovering_in_gusts(8), hovering_in_gusts(8, wind=(-WIND, 0.0, 0.0))
    np.testing.assert_allclose(
        (turned.record("wind") - turned.world.wind_I)[:, 0], -(still.record("wind")[:, 1] - WIND)
    )
    np.testing.assert_allclose(turned.record("wind")[:, 1], still.record("wind")[:, 0])

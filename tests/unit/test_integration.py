"""The Runge-Kutta integration of a flight: its order, conservation laws, closed forms and SciPy."""

from typing import NamedTuple

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import quad_gym
from quad_gym.kernels.entries import integrate_flight
from quad_gym.kernels.vehicle.air import integrate_in_air
from quad_gym.kernels.vehicle.dynamics import integrate
from quad_gym.packing import params_record
from quad_gym.records import FLIGHT
from quad_gym.rotations import dcm_to_quaternion, quaternion_to_dcm
from quad_gym.vehicle import state_derivative
from tests.unit.compiled import Compiled

LAB = quad_gym.vehicle_params("lab")
SKEWED_INERTIA = ((0.02, 0.003, -0.001), (0.003, 0.03, 0.002), (-0.001, 0.002, 0.04))


def flown(vehicle, duration, substeps, *, R_BI=None, **start):
    """The record of one flight after `duration`, from rest except for the values in `start`."""
    flight, params = np.zeros(1, FLIGHT), params_record(vehicle, quad_gym.SensorSuite())
    flight["q"] = dcm_to_quaternion(np.eye(3) if R_BI is None else R_BI)
    for name, value in start.items():
        flight[name] = value
    params["dt"] = duration
    integrate_flight(flight, params, substeps)
    return flight[0]


def random_start(seed):
    rng = np.random.default_rng(seed)
    return {
        "R_BI": Rotation.random(rng=rng).as_matrix(),
        "r": rng.normal(size=3),
        "v": rng.normal(0.0, 3.0, 3),
        "w": rng.normal(0.0, 2.0, 3),
        "rotor_speeds": rng.uniform(900.0, 1000.0, 4),
        "voltages": rng.uniform(4.8, 5.2, 4),
        "disturbance": rng.normal(0.0, 2.0, 3),
    }


def scipy_flight(vehicle, duration, start):
    """The state after a flight by DOP853 on the matrix form of the equations."""
    shapes = {"position": (3,), "velocity": (3,), "R_BI": (3, 3)}
    shapes |= {"body_rates": (3,), "rotor_speeds": (4,)}
    cuts = np.cumsum([int(np.prod(shape)) for shape in shapes.values()])[:-1]

    def unpack(y):
        parts = np.split(y, cuts)
        return {n: v.reshape(s) for (n, s), v in zip(shapes.items(), parts, strict=True)}

    def rate(t, y):
        force = start["disturbance"]
        rates = state_derivative(unpack(y), start["voltages"], force, vehicle)
        return np.concatenate([rates[name].ravel() for name in shapes])

    first = [start[n].ravel() for n in ("r", "v", "R_BI", "w", "rotor_speeds")]
    solution = solve_ivp(
        rate, (0.0, duration), np.concatenate(first), method="DOP853", rtol=1e-12, atol=1e-11
    )
    return unpack(solution.y[:, -1])


@pytest.mark.parametrize(
    "seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))]
)
@pytest.mark.parametrize("skewed", [False, True])
def test_random_flights_agree_with_scipy(seed, skewed):
    vehicle = LAB.replace(inertia=SKEWED_INERTIA, disc_area=0.2) if skewed else LAB
    start = random_start(seed)
    mine = flown(vehicle, 0.3, 3_000, **start)
    expected = scipy_flight(vehicle, 0.3, start)
    np.testing.assert_allclose(mine["r"], expected["position"], rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(mine["v"], expected["velocity"], rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(quaternion_to_dcm(mine["q"]), expected["R_BI"], atol=1e-10)
    np.testing.assert_allclose(mine["w"], expected["body_rates"], rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(mine["rotor_speeds"], expected["rotor_speeds"], rtol=1e-9)


@pytest.mark.parametrize("name", ["r", "v", "q", "w", "rotor_speeds"])
def test_the_error_falls_with_the_fourth_power_of_the_step(name):
    # a climb so fast that z_I . v keeps its sign: at the kink of the drag the order is lower
    start = random_start(5) | {"R_BI": np.eye(3), "v": (3.0, 2.0, 30.0), "w": (2.0, -3.0, 4.0)}
    vehicle = LAB.replace(disc_area=0.3)
    exact = flown(vehicle, 0.2, 20_000, **start)[name]
    substeps = np.array([16, 32, 64, 128])
    errors = [np.linalg.norm(flown(vehicle, 0.2, n, **start)[name] - exact) for n in substeps]
    slope = -np.polyfit(np.log(substeps), np.log(errors), 1)[0]
    assert slope == pytest.approx(4.0, abs=0.2)


@pytest.mark.parametrize("inertia", [LAB.inertia, SKEWED_INERTIA])
def test_free_body_keeps_its_energy_and_angular_momentum(inertia):
    J = np.array(inertia)
    # close to the axis of middle inertia, about which it tumbles
    w = np.linalg.eigh(J)[1] @ np.array([0.05, 6.0, 0.02])
    R_BI = Rotation.from_euler("zxy", [0.3, 1.0, -0.4]).as_matrix()
    vehicle = LAB.replace(inertia=inertia)
    end = flown(vehicle, 8.0, 16_000, R_BI=R_BI, w=w)
    turned = quaternion_to_dcm(end["q"])
    assert np.abs(end["w"] - w).max() > 1.0 or np.abs(turned - R_BI).max() > 0.5
    assert end["w"] @ J @ end["w"] == pytest.approx(w @ J @ w, rel=1e-9)
    np.testing.assert_allclose(
        turned.T @ J @ end["w"], R_BI.T @ J @ w, rtol=0.0, atol=1e-9 * np.linalg.norm(J @ w)
    )
    assert np.linalg.norm(end["q"]) == pytest.approx(1.0, abs=1e-15)


STATE = {"r": (3,), "v": (3,), "q": (4,), "w": (3,), "rotor_speeds": (4,)}
PARAMS = dict.fromkeys(("dt", "gravity", "mass", "half_drag", "thrust_coefficient"), ())
PARAMS |= dict.fromkeys(("motor_time_constant", "motor_speed_per_volt"), ())
PARAMS |= {"inertia": (3, 3), "inertia_inverse": (3, 3), "effectiveness": (4, 4)}
INPUTS = {"voltages": (4,), "disturbance": (3,)}
lanes_and_floats = Compiled(lambda f, n: integrate(f, f, n), **STATE, **PARAMS, **INPUTS)


def eight_flights():
    """Fields of eight flights with different states, inputs and vehicles."""
    vehicles = [LAB.replace(mass=0.5 + 0.1 * i, disc_area=0.1 * i) for i in range(8)]
    records = [params_record(v, quad_gym.SensorSuite())[0] for v in vehicles]
    fields = {name: np.array([record[name] for record in records]) for name in PARAMS}
    starts = [random_start(seed) for seed in range(8)]
    for start in starts:
        start["q"] = dcm_to_quaternion(start.pop("R_BI"))
    return fields | {name: np.array([start[name] for start in starts]) for name in starts[0]}


def test_lanes_and_floats_integrate_eight_flights_equally():
    flights = eight_flights()
    plain = lanes_and_floats.on_floats(20, **flights)
    lanes = lanes_and_floats.on_lanes(20, **flights)
    for name in STATE:
        np.testing.assert_allclose(plain[name], lanes[name], rtol=1e-12, atol=1e-12, err_msg=name)


class Air(NamedTuple):
    """Settings of air with linear drag alone."""

    substeps: int
    linear_drag: bool = True
    ground_effect: bool = False


AIR = dict.fromkeys(("wind", "linear_drag_B", "rotor_drag_B"), (3,))
AIR |= {"ground_height": (), "rotor_radius": (), "rotor_positions_B": (4, 3)}
in_air = Compiled(
    lambda f, n: integrate_in_air(f, f, Air(n, True, False)), **STATE, **PARAMS, **INPUTS, **AIR
)


@pytest.mark.parametrize("instance", ["on_floats", "on_lanes"])
def test_velocity_approaches_the_wind_exponentially(instance):
    fields = eight_flights()
    fields["w"], fields["rotor_speeds"], fields["voltages"] = (np.zeros((8, n)) for n in (3, 4, 4))
    fields["half_drag"] = np.zeros(8)
    fields["wind"] = np.random.default_rng(31).normal(0.0, 5.0, (8, 3))
    fields["linear_drag_B"], fields["dt"] = np.full((8, 3), 0.7), np.full(8, 1.5)
    got = getattr(in_air, instance)(200, **fields)
    rate, mass = 0.7 / fields["mass"][:, np.newaxis], fields["mass"][:, np.newaxis]
    weight = fields["disturbance"] / mass - [0.0, 0.0, 1.0] * fields["gravity"][:, np.newaxis]
    last = fields["wind"] + weight / rate
    decay = np.exp(-1.5 * rate)
    v = last + (fields["v"] - last) * decay
    np.testing.assert_allclose(got["v"], v, rtol=0.0, atol=1e-8)
    r = fields["r"] + last * 1.5 + (fields["v"] - last) * (1.0 - decay) / rate
    np.testing.assert_allclose(got["r"], r, rtol=0.0, atol=1e-8)

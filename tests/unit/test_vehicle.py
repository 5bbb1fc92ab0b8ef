"""The equations of motion agree with a NumPy version and with physical laws."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import quad_gym
from quad_gym.vehicle import state_derivative
from tests.body_states import random_state
from tests.reference_aids import cross_matrix

LAB = quad_gym.vehicle_params("lab")
SKEWED = quad_gym.VehicleParams(
    mass=1.3,
    inertia=((0.02, 0.003, -0.001), (0.003, 0.03, 0.002), (-0.001, 0.002, 0.04)),
    rotor_positions_B=((0.2, -0.1, 0.02), (0.3, 0.2, 0.0), (-0.2, 0.3, 0.1), (-0.1, -0.2, 0.0)),
    rotor_spins=(-1.0, 1.0, -1.0, 1.0),
    motor_time_constant=0.02,
    motor_speed_per_volt=150.0,
    disc_area=0.1,
    gravity=1.62,
)
NO_FORCE = np.zeros(3)


def at_rest(**changes):
    still = dict.fromkeys(("position", "velocity", "body_rates"), np.zeros(3))
    return {**still, "R_BI": np.eye(3), "rotor_speeds": np.zeros(4), **changes}


def newton_and_euler(state, voltages, d_I, p):
    """Return the derivative by the laboratory's published equations, term by term."""
    v, R_BI, w, W = (state[k] for k in ("velocity", "R_BI", "body_rates", "rotor_speeds"))
    J, e3 = np.array(p.inertia), np.array([0.0, 0.0, 1.0])
    z_I = R_BI.T @ e3
    force = -p.mass * p.gravity * e3 + d_I
    force = force - 0.5 * p.drag_coefficient * p.disc_area * p.air_density * abs(z_I @ v) * v
    torque = np.zeros(3)
    for place, spin, speed in zip(p.rotor_positions_B, p.rotor_spins, W, strict=True):
        thrust = p.thrust_coefficient * speed**2
        force = force + thrust * z_I
        torque = torque + np.cross(place, thrust * e3) - spin * p.torque_coefficient * speed**2 * e3
    return {
        "position": v,
        "velocity": force / p.mass,
        "R_BI": -cross_matrix(w) @ R_BI,
        "body_rates": np.linalg.solve(J, torque - np.cross(w, J @ w)),
        "rotor_speeds": (p.motor_speed_per_volt * voltages - W) / p.motor_time_constant,
    }


@pytest.mark.parametrize("params", [LAB, SKEWED], ids=["lab", "skewed"])
def test_state_derivative_equals_published_equations(params):
    rng = np.random.default_rng(1)
    for seed in range(50):
        state, voltages, d_I = random_state(seed), rng.uniform(0, 12, 4), rng.normal(size=3)
        got = state_derivative(state, voltages, d_I, params)
        expected = newton_and_euler(state, voltages, d_I, params)
        assert set(got) == set(expected)
        for name, value in expected.items():
            scale = 1.0 + np.abs(value).max()
            np.testing.assert_allclose(got[name], value, rtol=0.0, atol=1e-13 * scale, err_msg=name)


def test_lab_coefficients_equal_laboratory_values_in_rpm():
    per_rpm = 60.0 / (2.0 * np.pi)
    assert LAB.thrust_coefficient == pytest.approx(6.11e-8 * per_rpm**2, rel=1e-7)
    assert LAB.torque_coefficient == pytest.approx(1.5e-9 * per_rpm**2, rel=1e-7)
    assert LAB.max_rotor_force == pytest.approx(LAB.thrust_coefficient * 2400.0**2, rel=1e-15)


@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.0])
@pytest.mark.parametrize("params", [LAB, SKEWED.replace(rotor_positions_B=LAB.rotor_positions_B)])
def test_at_hover_voltage_nothing_moves(params, yaw):
    voltages = np.full(4, params.hover_voltage)
    state = at_rest(
        R_BI=Rotation.from_euler("z", yaw).as_matrix().T,
        rotor_speeds=params.motor_speed_per_volt * voltages,
    )
    for name, rate in state_derivative(state, voltages, NO_FORCE, params).items():
        np.testing.assert_allclose(rate, 0.0, rtol=0.0, atol=1e-12, err_msg=name)


@pytest.mark.parametrize(
    ("rotor", "signs"),
    [
        (0, (-1, -1, -1)),  # front right: lifts its side and the nose, turns against its spin of +1
        (1, (+1, -1, +1)),  # front left
        (2, (+1, +1, -1)),  # rear left
        (3, (-1, +1, +1)),  # rear right
    ],
)
def test_torque_of_each_rotor_has_expected_signs_and_sizes(rotor, signs):
    speeds = np.zeros(4)
    speeds[rotor] = 1000.0
    rates = state_derivative(at_rest(rotor_speeds=speeds), np.zeros(4), NO_FORCE, LAB)
    torque = np.array(LAB.inertia) @ rates["body_rates"]
    np.testing.assert_array_equal(np.sign(torque), signs)
    arm = 0.21 * LAB.thrust_coefficient * 1e6
    sizes = [arm, arm, LAB.torque_coefficient * 1e6]
    np.testing.assert_allclose(np.abs(torque), sizes, rtol=1e-14)


def test_bad_voltages_and_disturbances_are_refused():
    wrong = [[1.0, 2.0, bad, 3.0] for bad in (-1e-9, 12.0 + 1e-9, np.nan, np.inf)]
    for voltages in (*wrong, [1.0, 2.0, 3.0], 5.0, np.zeros((1, 4)), "full"):
        with pytest.raises(ValueError, match=r"^voltages must"):
            state_derivative(at_rest(), voltages, NO_FORCE, LAB)
    for force in ([1.0, 2.0], np.full(3, np.nan), None):
        with pytest.raises(ValueError, match=r"^disturbance_I must"):
            state_derivative(at_rest(), np.zeros(4), force, LAB)
    with pytest.raises(ValueError, match=r"^params must be a VehicleParams, got 'lab'"):
        state_derivative(at_rest(), np.zeros(4), NO_FORCE, "lab")


@pytest.mark.parametrize("name", sorted(at_rest()))
def test_a_bad_state_is_refused_by_name(name):
    missing = at_rest()
    del missing[name]
    for state in (missing, at_rest(speed=1.0)):
        with pytest.raises(ValueError, match=r"^state must have the keys"):
            state_derivative(state, np.zeros(4), NO_FORCE, LAB)
    for bad in (np.zeros(5), np.full_like(at_rest()[name], np.nan), "here"):
        with pytest.raises(ValueError, match=rf"^state\['{name}'\] must"):
            state_derivative(at_rest(**{name: bad}), np.zeros(4), NO_FORCE, LAB)


def test_the_given_state_is_not_changed():
    state = random_state(1)
    before = {name: value.copy() for name, value in state.items()}
    got = state_derivative(state, np.zeros(4), NO_FORCE, LAB)
    got["position"][:] = 0.0
    for name, value in before.items():
        np.testing.assert_array_equal(state[name], value)

"""Allocation, the report's PD controller and the inner loops, against their equations in NumPy."""

import functools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import quad_gym
from quad_gym.kernels.compiling import entry
from quad_gym.kernels.numbers.blocks import lanes_of
from quad_gym.kernels.numbers.linalg import load3, load4, store
from quad_gym.kernels.vehicle.control import act, allocate
from quad_gym.packing import params_block, params_record
from quad_gym.records import FLIGHT, FLIGHT_BLOCK, WIDTH, Control, aligned_zeros

LAB, GAINS = quad_gym.vehicle_params("lab"), quad_gym.pd_gains("lab")
TILTED = LAB.replace(
    inertia=((0.002, 3e-4, 0.0), (3e-4, 0.004, 1e-4), (0.0, 1e-4, 0.005)),
    rotor_spins=(-1.0, 1.0, -1.0, 1.0),
)
FMAX = LAB.max_rotor_force

seeds = st.integers(0, 2**32 - 1)


@entry
def allocate_all(demands, params, voltages):
    for i in range(len(demands)):
        demand = demands[i]
        torque = (demand[1], demand[2], demand[3])
        store(voltages[i], allocate(demand[0], torque, params[0]))


@entry
def act_on_floats(flights, params, mode, ref):
    reference = (load3(ref[0]), load3(ref[1]), load3(ref[2]), load3(ref[3]))
    act(flights[0], load4(flights[0].action), params[0], mode, reference)


@entry
def act_on_lanes(blocks, params, mode, ref):
    flight = lanes_of(blocks[0])
    one = 1.0 + 0.0 * flight.tick
    r_ref, v_ref = one * load3(ref[0]), one * load3(ref[1])
    reference = (r_ref, v_ref, one * load3(ref[2]), one * load3(ref[3]))
    act(flight, load4(flight.action), lanes_of(params[0]), mode, reference)


@functools.cache
def numbers_of(vehicle):
    return params_record(vehicle, quad_gym.SensorSuite(), GAINS, quad_gym.ActionParams())


def forces_of(voltages, vehicle=LAB):
    return vehicle.thrust_coefficient * (vehicle.motor_speed_per_volt * voltages) ** 2


def allocated(thrust, torque, vehicle=LAB):
    """Return the rotor forces that the kernel commands."""
    voltages = np.empty((1, 4))
    demand = np.array([[thrust, *torque]])
    allocate_all(demand, numbers_of(vehicle), voltages)
    assert voltages.min() >= 0.0
    return forces_of(voltages[0], vehicle)


def searched(thrust, torque, vehicle=LAB):
    """Return rotor forces by the laboratory's rule, and the largest alpha by bisection."""
    places, spins = np.array(vehicle.rotor_positions_B), np.array(vehicle.rotor_spins)
    ratio = vehicle.torque_coefficient / vehicle.thrust_coefficient
    matrix = np.array([np.ones(4), places[:, 1], -places[:, 0], -ratio * spins])
    limit = vehicle.max_rotor_force

    def forces(alpha):
        demand = np.append(min(thrust, 0.9 * 4.0 * limit), alpha * np.asarray(torque))
        return np.linalg.solve(matrix, demand)

    low, high = 0.0, 1.0
    if forces(1.0).max() <= limit:
        low = 1.0
    else:
        for _ in range(60):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if forces(middle).max() <= limit else (low, middle)
    return np.maximum(forces(low), 0.0), low


thrusts = st.floats(-5.0, 60.0)
torques = st.tuples(st.floats(-8.0, 8.0), st.floats(-8.0, 8.0), st.floats(-1.0, 1.0))


@given(thrusts, torques)
def test_torque_is_scaled_by_the_largest_factor_rotors_allow(thrust, torque):
    expected, _ = searched(thrust, torque)
    np.testing.assert_allclose(allocated(thrust, torque), expected, rtol=1e-12, atol=1e-11 * FMAX)
    assert allocated(thrust, torque).max() <= FMAX * (1.0 + 1e-12)


@pytest.mark.parametrize("thrust", [5.0, 20.0, 1e3])
def test_rotors_on_unequal_arms_stay_within_their_limit(thrust):
    front, rear = 0.1, -0.3
    places = ((front, -0.2, 0.0), (front, 0.2, 0.0), (rear, 0.2, 0.0), (rear, -0.2, 0.0))
    vehicle = LAB.replace(rotor_positions_B=places)
    forces = allocated(thrust, (0.1, 0.2, 0.0), vehicle)
    assert forces.max() <= vehicle.max_rotor_force * (1.0 + 1e-12)


def seen_state(seed):
    """Return a random observed state, reference and action."""
    rng = np.random.default_rng(seed)
    return {
        "r": rng.normal(size=3),
        "v": rng.normal(size=3),
        "R_BI": (Rotation.from_rotvec(0.6 * rng.normal(size=3))).as_matrix(),
        "w": rng.normal(size=3),
        "action": rng.uniform(-1.0, 1.0, 4),
        "ref": rng.normal(size=(4, 3)) * [[1.0], [1.0], [2.0], [1.0]],
    }


def commanded(mode, state, vehicle=LAB):
    """Return the motor voltages that the kernel sets."""
    flight = np.zeros(1, FLIGHT)
    flight["r_seen"], flight["v_seen"] = state["r"], state["v"]
    flight["R_seen"], flight["w_seen"] = state["R_BI"], state["w"]
    flight["action"] = state["action"]
    act_on_floats(flight, numbers_of(vehicle), int(mode), state["ref"])
    return flight["voltages"][0]


def unit(vector):
    return vector / np.linalg.norm(vector)


def voltages_for(thrust, torque, vehicle):
    forces, _ = searched(thrust, torque, vehicle)
    return np.sqrt(forces / vehicle.thrust_coefficient) / vehicle.motor_speed_per_volt


def pd_controller(state, vehicle):
    """Return thrust and torque of the laboratory's controller as published."""
    r_ref, v_ref, a_ref, x_ref = state["ref"]
    R_BI, w, m = state["R_BI"], state["w"], vehicle.mass
    e3, J = np.array([0.0, 0.0, 1.0]), np.array(vehicle.inertia)
    F_I = 5.0 * (r_ref - state["r"]) + 3.1 * (v_ref - state["v"])
    F_I = F_I + m * vehicle.gravity * e3 + m * a_ref
    z_ref = unit(F_I)
    b = unit(np.cross(z_ref, x_ref))
    R_E = np.stack([np.cross(b, z_ref), b, z_ref]) @ R_BI.T
    e = np.array([R_E[1, 2] - R_E[2, 1], R_E[2, 0] - R_E[0, 2], R_E[0, 1] - R_E[1, 0]])
    torque = np.diag([1.0, 0.95, 0.21]) @ e - np.diag([0.25, 0.25, 0.12]) @ w
    return F_I @ (R_BI.T @ e3), torque + np.cross(w, J @ w)


def rate_loop(w_wanted, w, vehicle):
    J = np.array(vehicle.inertia)
    return J @ (14.0 * (w_wanted - w)) + np.cross(w, J @ w)


def tilt_loop(z_I, state, yaw_rate, vehicle):
    """Return the torque for the rates k_a (e3 x R z*) plus the desired yaw rate."""
    rates = 7.0 * np.cross([0.0, 0.0, 1.0], state["R_BI"] @ z_I) + [0.0, 0.0, yaw_rate]
    return rate_loop(rates, state["w"], vehicle)


def heading_frame(state):
    """Return the columns ahead, left and up in I."""
    x = unit(state["R_BI"][0] * [1.0, 1.0, 0.0])
    return np.stack([x, np.cross([0.0, 0.0, 1.0], x), [0.0, 0.0, 1.0]], axis=1)


def demanded(mode, state, vehicle):
    """Return the thrust and torque that an action demands."""
    a = state["action"]
    weight = vehicle.mass * vehicle.gravity
    if mode == Control.PD:
        return pd_controller(state, vehicle)
    if mode == Control.WRENCH:
        ratio = vehicle.torque_coefficient / vehicle.thrust_coefficient
        return weight * (1 + a[0]), weight * np.array([0.21, 0.21, ratio]) * a[1:]
    if mode == Control.CTBR:
        rates = np.array([6.0, 6.0, 3.0]) * a[1:]
        return weight * (1 + a[0]), rate_loop(rates, state["w"], vehicle)
    if mode == Control.ATTITUDE:
        tilt = Rotation.from_euler("XY", np.radians(45.0) * a[1:3]).apply([0.0, 0.0, 1.0])
        z_I = heading_frame(state) @ tilt
        return weight * (1 + a[0]), tilt_loop(z_I, state, 3.0 * a[3], vehicle)
    level = heading_frame(state)
    pull = vehicle.mass * 4.0 * (5.0 * a[:3] - level.T @ state["v"])
    low = np.array([-weight, -weight, -0.5 * weight])
    F_I = level @ (pull.clip(low, weight) + np.array([0.0, 0.0, weight]))
    return F_I @ state["R_BI"][2], tilt_loop(unit(F_I), state, 3.0 * a[3], vehicle)


MODES = [Control.PD, Control.WRENCH, Control.CTBR, Control.ATTITUDE, Control.VELOCITY]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("vehicle", [LAB, TILTED], ids=["lab", "tilted"])
def test_voltages_match_the_control_equations(mode, vehicle):
    for seed in range(60):
        state = seen_state(seed)
        expected = voltages_for(*demanded(mode, state, vehicle), vehicle)
        got = commanded(mode, state, vehicle)
        # near a force of zero a voltage is ill-conditioned: compare the forces
        limit = 1e-11 * vehicle.max_rotor_force
        np.testing.assert_allclose(
            forces_of(got, vehicle), forces_of(expected, vehicle), rtol=0.0, atol=limit
        )


@given(st.tuples(*[st.floats(-1.0, 1.0)] * 4))
def test_motor_action_scales_the_hover_voltage(action):
    got = commanded(Control.MOTOR, seen_state(1) | {"action": action})
    expected = np.minimum(LAB.hover_voltage * (1.0 + np.array(action)), LAB.max_voltage)
    np.testing.assert_allclose(got, expected, rtol=1e-14)
    assert got.min() >= 0.0


@given(seeds, st.sampled_from([Control.MOTOR, *MODES]), st.floats(0.0, 100.0))
def test_no_voltage_ever_leaves_its_range(seed, mode, size):
    state = seen_state(seed)
    for name in ("r", "v", "w", "ref"):
        state[name] = size * state[name]
    got = commanded(mode, state)
    assert np.isfinite(got).all()
    assert got.min() >= 0.0
    assert got.max() <= LAB.max_voltage * (1.0 + 1e-12)


@pytest.mark.parametrize("ref_force", ["none", "along the heading", "vertical heading"])
def test_voltages_are_finite_without_a_desired_direction(ref_force):
    state = seen_state(3) | {"R_BI": np.eye(3), "w": np.zeros(3), "v": np.zeros(3)}
    x_ref, a_ref = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, -9.8])
    if ref_force == "along the heading":
        a_ref = np.array([5.0, 0.0, -9.8])
    if ref_force == "vertical heading":
        x_ref, a_ref = np.array([0.0, 0.0, 1.0]), np.zeros(3)
    state["ref"] = np.array([state["r"], np.zeros(3), a_ref, x_ref])
    assert np.isfinite(commanded(Control.PD, state)).all()


@pytest.mark.parametrize("mode", [Control.MOTOR, *MODES])
def test_controller_on_lanes_equals_controller_on_floats(mode):
    states = [seen_state(seed) for seed in range(WIDTH)]
    ref = states[0]["ref"]
    block = aligned_zeros(1, FLIGHT_BLOCK)
    for lane, state in enumerate(states):
        state["ref"] = ref
        block["r_seen"][0, :, lane], block["v_seen"][0, :, lane] = state["r"], state["v"]
        block["R_seen"][0, ..., lane], block["w_seen"][0, :, lane] = state["R_BI"], state["w"]
        block["action"][0, :, lane] = state["action"]
    act_on_lanes(block, params_block(numbers_of(LAB)), int(mode), ref)
    for lane, state in enumerate(states):
        got, expected = block["voltages"][0, :, lane], commanded(mode, state)
        np.testing.assert_allclose(forces_of(got), forces_of(expected), rtol=0.0, atol=1e-11 * FMAX)

"""Demands of trajectories on a vehicle, against separate inverse dynamics."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import quad_gym
from quad_gym import Trajectory
from quad_gym.params.trajectories import motion_of, sampling_times
from tests.unit.test_trajectory import FIVE

VEHICLE = quad_gym.vehicle_params("lab")
UP = np.array([0.0, 0.0, VEHICLE.gravity])


def attitudes(path, t):
    """Return body axes in I as rows (n, 3, 3), from thrust direction and heading."""
    z = path(t, 2) + UP
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    yaw = path.yaw(t)
    y = np.cross(z, np.stack([np.cos(yaw), np.sin(yaw), 0.0 * yaw], axis=1))
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    return np.stack([np.cross(y, z), y, z], axis=1)


def rates_between(path, t, h):
    """Return mean body rates over [t - h, t + h], from the rotation between the attitudes."""
    turn = attitudes(path, t + h) @ attitudes(path, t - h).transpose(0, 2, 1)
    return -Rotation.from_matrix(turn).as_rotvec() / (2.0 * h)


@pytest.mark.parametrize(
    "options", [{}, {"yaw": "along"}, {"look_at": (0.5, 9.0)}, {"yaw": [0.0, 1.0, -1.0, 2.0, 0.5]}]
)
@pytest.mark.parametrize("closed", [False, True])
def test_required_thrust_and_torque_produce_the_motion(options, closed):
    """The equations of motion with thrust and torques give the accelerations of the motion."""
    path = Trajectory.through(FIVE, max_speed=4.0, max_acceleration=6.0, closed=closed, **options)
    t, h = np.linspace(0.4, path.duration - 0.4, 60), 1e-4
    motion = motion_of(path, VEHICLE, t)
    np.testing.assert_allclose(motion.R_BI, attitudes(path, t), rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(motion.body_rates, rates_between(path, t, h), rtol=0, atol=1e-5)
    # J dw/dt + w x J w by differences of the rates
    J = np.array(VEHICLE.inertia)
    after, before = (motion_of(path, VEHICLE, t + s * h).body_rates for s in (1.0, -1.0))
    change = (after - before) / (2.0 * h)
    torque = change @ J.T + np.cross(motion.body_rates, motion.body_rates @ J.T)
    np.testing.assert_allclose(motion.torque, torque, rtol=0.0, atol=1e-6)
    # the rotors' forces, rotor by rotor: l x F e3 - s kN/kF F e3
    arms, spins = np.array(VEHICLE.rotor_positions_B), np.array(VEHICLE.rotor_spins)
    drag = VEHICLE.torque_coefficient / VEHICLE.thrust_coefficient
    for force, wanted, thrust in zip(motion.rotor_forces, torque, motion.thrust, strict=True):
        up = np.outer(force, [0.0, 0.0, 1.0])
        made = np.cross(arms, up).sum(axis=0) - [0.0, 0.0, drag * (spins * force).sum()]
        np.testing.assert_allclose(made, wanted, rtol=0.0, atol=1e-6)
        assert force.sum() == pytest.approx(thrust, rel=1e-12)
    demand = path.check(VEHICLE)
    fine = np.linspace(0.0, path.duration, 40_001)
    speed, acceleration = (np.linalg.norm(path(fine, k), axis=1).max() for k in (1, 2))
    force = np.linalg.norm(path(fine, 2) + UP, axis=1) * VEHICLE.mass
    assert demand.speed == pytest.approx(speed, rel=1e-3)
    assert demand.acceleration == pytest.approx(acceleration, rel=1e-3)
    assert demand.thrust == pytest.approx((force.min(), force.max()), rel=1e-3)
    rates = np.abs(motion_of(path, VEHICLE, fine).body_rates).max(axis=0)
    assert demand.body_rates == pytest.approx(rates, rel=1e-3)
    assert demand.tilt == pytest.approx(np.arccos(attitudes(path, fine)[:, 2, 2]).max(), rel=1e-3)


def test_infeasible_trajectory_error_names_value_time_and_segment():
    path = Trajectory.through(FIVE, max_speed=9.0, max_acceleration=7.0)
    times, segments = sampling_times(path), len(path.times) - 1
    motion, weak = motion_of(path, VEHICLE, times), 1.03 * VEHICLE.hover_voltage
    forces, rates = motion.rotor_forces, np.abs(motion.body_rates)
    rotor = forces.max(axis=0).argmax()
    for values, what, options in (
        (motion.thrust, "thrust of {:.4g} N", {"max_thrust": 8.5}),
        (motion.tilt, "a tilt of .* degrees", {"max_tilt": math.radians(20.0)}),
        (rates[:, 0], "body rate about x of {:.4g} rad/s", {"max_body_rates": (0.1, 6.0, 6.0)}),
        (forces[:, rotor], f"force of rotor {rotor} of {{:.4g}} N", {"max_thrust": 1e3}),
    ):
        k = int(values.argmax())
        segment = np.searchsorted(path.times, times[k], side="right")
        where = f"at {times[k]:.3f} s .segment {segment} of {segments}."
        vehicle = VEHICLE.replace(max_voltage=weak) if options == {"max_thrust": 1e3} else VEHICLE
        with pytest.raises(ValueError, match=f"{what.format(values[k])} {where}"):
            path.check(vehicle, **options)
    with pytest.raises(ValueError, match=r"a speed of .* m/s"):
        path.check(VEHICLE, max_speed=1.0)
    path.check(VEHICLE)
    with pytest.raises(ValueError, match="vehicle must be a VehicleParams"):
        path.check("lab")


def test_trajectory_that_needs_negative_thrust_raises_value_error():
    """A fall faster than gravity needs rotors that pull, unless the vehicle is upside down."""
    path = Trajectory.of(lambda t: (0.0, 0.0, 9.0 - 5.5 * t * t), 1.0)
    path.check(VEHICLE, max_tilt=math.pi)  # upside down, thrust downward
    with pytest.raises(ValueError, match="a tilt of 180 degrees"):
        path.check(VEHICLE, max_tilt=math.radians(100.0))
    free_fall = Trajectory.of(lambda t: (0.0, 0.0, 9.0 - 0.5 * VEHICLE.gravity * t * t), 1.0)
    with pytest.raises(ValueError, match="is infeasible for this vehicle"):
        free_fall.check(VEHICLE)


def test_jumps_are_refused():
    terms = np.zeros((8, 2, 4))
    terms[6, :, 0] = 1.0
    terms[7, 1, 0] = 1.0
    path = Trajectory(times=[0.0, 1.0, 2.0], coefficients=terms)
    path.check(VEHICLE)
    for row, what in ((7, "position"), (6, "velocity"), (5, "acceleration")):
        other = terms.copy()
        other[row, 1, 1] = 0.25
        path = Trajectory(times=[0.0, 1.0, 2.0], coefficients=other)
        with pytest.raises(ValueError, match=f"jump: its {what} does by 0.*at 1.000 s"):
            path.check(VEHICLE)
    closed = Trajectory(times=[0.0, 1.0, 2.0], coefficients=terms, closed=True)
    with pytest.raises(ValueError, match=r"jump: its position does by 2 m at 2.000 s"):
        closed.check(VEHICLE)


def test_heading_jump_by_180_degrees_raises_value_error():
    """On a straight line there and back, the heading along it jumps where the velocity reverses."""
    points = [(0, 0, 1), (3, 0, 1)]
    Trajectory.through(points, closed=True).check(VEHICLE)
    back = Trajectory.through(points, closed=True, yaw="along")
    with pytest.raises(ValueError, match="its heading does by 180 degrees at"):
        back.check(VEHICLE)
    over = Trajectory.through([(-2, 0, 1), (2, 0, 1)], look_at=(0.0, 0.0))
    with pytest.raises(ValueError, match="its heading does by 180 degrees at"):
        over.check(VEHICLE)

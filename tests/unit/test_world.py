"""Wind, drag, ground effect and battery against closed forms and a plain reference."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import quad_gym
from baselines import PDPolicy
from quad_gym import BatteryParams, Uniform, WorldParams
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.records import Control, Source
from quad_gym.rotations import quaternion_to_dcm
from quad_gym.vehicle import state_derivative
from tests.body_states import random_state, state_of
from tests.builders import flown_batch, vec_env
from tests.unit.test_vehicle import LAB, NO_FORCE, SKEWED, newton_and_euler

FULL = WorldParams(
    wind_I=(3.0, -2.0, 1.0),
    linear_drag_B=(0.4, 0.3, 0.1),
    rotor_drag_B=(1e-5, 2e-5, 3e-5),
    ground_effect=True,
    ground_height=-0.3,
)
HOVER_SPEED = LAB.motor_speed_per_volt * LAB.hover_voltage
HOVERING = {"voltage": LAB.hover_voltage, "speed": HOVER_SPEED}


def in_world(state, voltages, d_I, p, world):
    """Add the world's forces to the published model of calm air, term by term."""
    v_air = state["velocity"] - world.wind_I
    R_BI, W = state["R_BI"], state["rotor_speeds"]
    k = np.array(world.linear_drag_B) + np.array(world.rotor_drag_B) * W.sum()
    force, torque = d_I - R_BI.T @ (k * (R_BI @ v_air)), np.zeros(3)
    if world.ground_effect:
        tilt = max(0.0, R_BI[2, 2])
        for place, speed in zip(p.rotor_positions_B, W, strict=True):
            z = (state["position"] + R_BI.T @ place)[2] - world.ground_height
            z = max(z, world.rotor_radius / 2)
            gain = 1.0 / (1.0 - (world.rotor_radius / (4.0 * z)) ** 2) - 1.0
            thrust = tilt * gain * p.thrust_coefficient * speed**2 * np.array([0.0, 0.0, 1.0])
            force, torque = force + R_BI.T @ thrust, torque + np.cross(place, thrust)
    rates = newton_and_euler({**state, "velocity": v_air}, voltages, force, p)
    rates["position"] = state["velocity"]
    rates["body_rates"] = rates["body_rates"] + np.linalg.solve(np.array(p.inertia), torque)
    return rates


@pytest.mark.parametrize("params", [LAB, SKEWED], ids=["lab", "skewed"])
def test_state_derivative_equals_model_of_wind_drag_and_ground_effect(params):
    rng = np.random.default_rng(1)
    for seed in range(100):
        state, voltages, d_I = random_state(seed), rng.uniform(0, 12, 4), rng.normal(size=3)
        state["position"][2] = rng.uniform(-0.5, 1.0)
        got = state_derivative(state, voltages, d_I, params, FULL)
        expected = in_world(state, voltages, d_I, params, FULL)
        for name, value in expected.items():
            scale = 1.0 + np.abs(value).max()
            np.testing.assert_allclose(got[name], value, rtol=0.0, atol=1e-12 * scale, err_msg=name)


def motors_only(world, *, vehicle=LAB, voltage=0.0, speed=0.0, velocity=(0, 0, 0), yaw=0.0, **more):
    """Return a batch of one level vehicle, whose episode never ends, and an action of a voltage."""
    far = {"duration": 0.0, "out_of_bounds": 1e9, "min_height": -1e9}
    task = quad_gym.TaskParams(kind="hover", start="ground", pad=False, **far)
    options = {"vehicle": vehicle, "task": task, "world": world, **more}
    batch = FlightBatch(1, source=Source.TRUTH, control=Control.MOTOR, **options)
    batch.reset(seeds=[1], position=(0.0, 0.0, 10.0), velocity=velocity, yaw=yaw)
    batch._blocks["rotor_speeds"] = speed
    action = voltage / batch.vehicle.hover_voltage - 1.0
    return batch, np.full((1, 4), action)


def flown(batch, action, seconds):
    for _ in range(round(seconds * 200)):
        batch.step(action)
    return batch


@pytest.mark.parametrize("yaw", [0.0, 0.7])
@pytest.mark.parametrize("by_rotor_speed", [False, True])
def test_hovering_vehicle_approaches_wind_velocity_exponentially(yaw, by_rotor_speed):
    """Along each body axis, v = wind (1 - exp(-D t / m))."""
    D = np.array([0.5, 0.3, 0.2])
    drag = {"linear_drag_B": D}
    if by_rotor_speed:
        drag = {"linear_drag_B": 0.5 * D, "rotor_drag_B": 0.5 * D / (4 * HOVER_SPEED)}
    wind = np.array([4.0, -3.0, 0.5])
    world, vehicle = WorldParams(wind_I=wind, **drag), LAB.replace(disc_area=0.0)
    batch, action = motors_only(world, vehicle=vehicle, yaw=yaw, **HOVERING)
    flown(batch, action, 2.0)
    R_BI = quaternion_to_dcm(batch.record("q"))[0]
    expected = R_BI.T @ ((R_BI @ wind) * -np.expm1(-D * 2.0 / LAB.mass))
    np.testing.assert_allclose(batch.record("v")[0], expected, rtol=1e-9)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_a_flight_in_a_wind_is_the_calm_flight_carried_along(seed):
    rng = np.random.default_rng(seed)
    wind, velocity = rng.normal(0.0, 5.0, 3), rng.normal(0.0, 3.0, 3)
    drag = {"linear_drag_B": (0.5, 0.3, 0.1), "rotor_drag_B": (1e-5, 1e-5, 0.0)}
    keywords = {"vehicle": LAB.replace(disc_area=0.5), "voltage": 3.2, "speed": 500.0, "yaw": 0.3}
    calm, blown = (
        flown(*motors_only(WorldParams(wind_I=air, **drag), velocity=velocity + air, **keywords), 1)
        for air in (np.zeros(3), wind)
    )
    np.testing.assert_allclose(blown.record("v"), calm.record("v") + wind, atol=1e-10)
    np.testing.assert_allclose(blown.record("r"), calm.record("r") + wind, atol=1e-10)
    np.testing.assert_allclose(blown.record("q"), calm.record("q"), atol=1e-10)


def test_accelerometer_measures_aerodynamic_forces():
    """Without noise, the reading is R (a + g e3) with the acceleration of the present instant."""
    quiet = dict.fromkeys(
        ("accel_noise_density", "gyro_noise_density", "accel_bias_sigma", "gyro_bias_sigma"),
        Uniform(1e-14, 1e-14),
    )
    sensors, lever = quad_gym.sensor_suite("lab"), np.array([0.1, -0.2, 0.05])
    sensors = sensors.replace(imu=sensors.imu.replace(lever_arm_B=lever))
    task = quad_gym.TaskParams(kind="hover", start="hover", height=0.3)
    world = FULL.replace(gust_wind_speed=8.0)
    batch = flown_batch(range(8), 150, sensors=sensors, task=task, world=world, randomization=quiet)
    for i in range(8):
        state = state_of(batch.record, i)
        R_BI, w = state["R_BI"], state["body_rates"]
        now = world.replace(wind_I=batch.record("wind")[i], gust_wind_speed=0.0)
        rates = state_derivative(state, np.zeros(4), NO_FORCE, LAB, now)
        a = R_BI @ (rates["velocity"] + [0.0, 0.0, LAB.gravity])
        a = a + np.cross(rates["body_rates"], lever) + np.cross(w, np.cross(w, lever))
        np.testing.assert_allclose(batch.record("accel")[i], a, atol=1e-10)
        np.testing.assert_allclose(batch.record("gyro")[i], w, atol=1e-12)


def battery_law(charge, speeds, battery, vehicle=LAB):
    """Return U and P <= P_max; U is the larger root of U = U0 - R P / U, at most P_max / I."""
    torque = vehicle.torque_coefficient * speeds**2 / battery.motor_efficiency
    power, current = torque @ speeds, vehicle.motor_speed_per_volt * torque.sum()
    empty = battery.empty_voltage
    U0 = vehicle.max_voltage * (empty + (1 - empty) * charge)
    most = U0**2 / (4.0 * battery.resistance)
    power = min(power, most)
    loaded = max(np.roots([1.0, -U0, battery.resistance * power]).real)
    return (min(loaded, most / current) if current else loaded), power


@pytest.mark.parametrize(
    ("mass", "resistance", "speed", "limited"),
    [
        (0.78, 0.01, 0.0, False),
        (3.3, 0.005, 0.0, False),  # hovers at 6.03 V, so full action requests 12 V
        (0.78, 0.1, 0.0, True),
        (0.78, 0.24, 0.0, True),
        (0.78, 0.2, 2.0 * HOVER_SPEED, True),
    ],
    ids=["enough power", "loaded", "too little", "least", "rotors too fast"],
)
def test_battery_limits_voltage_and_power(mass, resistance, speed, limited):
    battery, vehicle = BatteryParams(energy=5000.0, resistance=resistance), LAB.replace(mass=mass)
    batch, _ = motors_only(WorldParams(battery=battery), vehicle=vehicle, speed=speed)
    taken, most = 0.0, 12.0**2 / (4.0 * resistance)
    for _ in range(200):
        charge, speeds = batch.record("charge")[0], batch.record("rotor_speeds")[0]
        assert charge == pytest.approx(1.0 - taken / battery.energy, rel=1e-12)
        voltage, power = battery_law(charge, speeds, battery)
        batch.step(np.ones((1, 4)))
        expected = min(2.0 * vehicle.hover_voltage, voltage)
        np.testing.assert_allclose(batch.record("voltages")[0], expected, rtol=1e-12)
        taken += 0.005 * power
    assert (power > 0.9 * most * (0.83 + 0.17 * charge) ** 2) == limited


def test_battery_resistance_too_high_to_hover_is_refused():
    power = 4.0 * LAB.torque_coefficient * HOVER_SPEED**3 / 0.75
    limit = 12.0**2 / (4.0 * power)
    for resistance in (1.001 * limit, 5.0, 1e6):
        world = WorldParams(battery=BatteryParams(resistance=resistance))
        with pytest.raises(ValueError, match=r"BatteryParams.resistance must be at most 0.24"):
            FlightBatch(1, world=world)
        world, drawn = WorldParams(battery=BatteryParams()), Uniform(0.01, resistance)
        with pytest.raises(ValueError, match=r"must be at most 0.24\d ohm, drawn or not"):
            FlightBatch(1, world=world, randomization={"battery_resistance": drawn})
    world = WorldParams(battery=BatteryParams(energy=1e12, resistance=0.999 * limit))
    batch, action = motors_only(world, **HOVERING)
    flown(batch, action, 5.0)
    np.testing.assert_allclose(batch.record("rotor_speeds")[0], HOVER_SPEED, rtol=1e-9)


def test_an_empty_battery_cuts_off():
    batch, action = motors_only(WorldParams(battery=BatteryParams(energy=30.0)), **HOVERING)
    flown(batch, action, 2.0)
    assert batch.record("charge")[0] == 0.0
    np.testing.assert_array_equal(batch.record("voltages"), 0.0)


def test_max_voltage_of_true_vehicle_limits_motor_voltages():
    weak = LAB.replace(max_voltage=4.0)
    batch, _ = motors_only("calm", true_vehicle=weak)
    batch.step(np.ones((1, 4)))
    np.testing.assert_array_equal(batch.record("voltages"), 4.0)


def test_calm_world_leaves_flight_bitwise_unchanged():
    plain = flown_batch(range(9), 100).snapshot()
    for world in ("calm", WorldParams(), WorldParams(rotor_radius=0.3, ground_height=-5.0)):
        calm = flown_batch(range(9), 100, world=world, randomization={}).snapshot()
        calm["configuration"] = plain["configuration"]
        assert calm.tobytes() == plain.tobytes()


def test_wind_without_drag_changes_flight_only_by_rounding():
    vehicle = LAB.replace(disc_area=0.0)
    plain = flown_batch(range(9), 100, vehicle=vehicle)
    world = WorldParams(wind_I=(5.0, 0.0, 0.0), gust_wind_speed=5.0)
    blown = flown_batch(range(9), 100, vehicle=vehicle, world=world)
    for name in ("b_a", "b_g", "key", "instant"):  # random draws are equal
        np.testing.assert_array_equal(blown.record(name), plain.record(name))
    for name in ("r", "v", "q", "w", "r_hat", "accel", "pixels"):
        np.testing.assert_allclose(blown.record(name), plain.record(name), rtol=1e-6, atol=1e-7)
    assert np.ptp(blown.record("wind")[:, 0]) > 0.1


def test_world_presets_fly_and_unknown_worlds_raise_value_error():
    for name in ("calm", "breeze", "fresh_breeze"):
        batch = flown_batch(range(9), 100, world=name)
        assert batch.world == quad_gym.world_params(name)
        assert np.isfinite(batch.record("r")).all()
    with pytest.raises(ValueError, match="world must be one of calm"):
        FlightBatch(1, world="storm")
    with pytest.raises(ValueError, match="world must be a WorldParams"):
        FlightBatch(1, world=3.0)


def test_worlds_scale_with_the_vehicle():
    """Energy, propellers and reach of a Crazyflie are from its data sheet: within 15 %."""
    crazyflie = quad_gym.vehicle_params("crazyflie")
    lab, small = (quad_gym.world_params("breeze", vehicle) for vehicle in (LAB, crazyflie))
    assert lab.linear_drag_B == (0.78 * 0.544, 0.78 * 0.386, 0.0)
    assert (lab.battery, lab.rotor_radius, lab.vehicle_radius) == (BatteryParams(), 0.127, 0.42)
    np.testing.assert_allclose(
        np.divide(small.linear_drag_B, crazyflie.mass), np.divide(lab.linear_drag_B, LAB.mass)
    )
    assert small.battery.energy == pytest.approx(3600 * 0.25 * 3.7, rel=0.15)
    assert small.rotor_radius == pytest.approx(0.023, rel=0.15)
    assert small.vehicle_radius == pytest.approx(0.069, rel=0.15)
    for world, vehicle in ((lab, LAB), (small, crazyflie)):
        force = vehicle.mass * vehicle.gravity / 4.0
        power = 4.0 * vehicle.torque_coefficient * (force / vehicle.thrust_coefficient) ** 1.5
        sag = world.battery.resistance * power / world.battery.motor_efficiency
        assert sag / vehicle.max_voltage**2 == pytest.approx(0.0305, abs=1e-4)
    assert quad_gym.world_params("slalom", crazyflie).vehicle_radius == small.vehicle_radius


@pytest.mark.parametrize("vehicle", ["lab", "crazyflie"])
def test_no_vehicle_crashes_in_a_breeze(vehicle):
    """PD control, whose preset gains are scaled to the vehicle, too."""
    env = vec_env("hover", 60, seed=0, vehicle=vehicle, world="breeze", observation="truth")
    assert env.flights.batch.world == quad_gym.world_params("breeze", env.flights.batch.vehicle)
    policy, observations = PDPolicy(env), env.reset(seed=0)[0]
    for _ in range(250):
        observations, _, terminated, _, _ = env.step(policy.predict(observations)[0])
        assert not terminated.any()


def test_preset_gains_give_every_vehicle_the_same_accelerations():
    crazyflie = quad_gym.vehicle_params("crazyflie")
    lab, small = (quad_gym.pd_gains("tuned", vehicle) for vehicle in (LAB, crazyflie))
    assert lab == quad_gym.pd_gains("tuned")
    for name, of_lab, of_small in (
        ("position", LAB.mass, crazyflie.mass),
        ("velocity", LAB.mass, crazyflie.mass),
        ("attitude", np.diag(LAB.inertia), np.diag(crazyflie.inertia)),
        ("body_rates", np.diag(LAB.inertia), np.diag(crazyflie.inertia)),
    ):
        np.testing.assert_allclose(getattr(lab, name) / of_lab, getattr(small, name) / of_small)

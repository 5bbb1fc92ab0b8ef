"""Vehicle parameters fitted to a simulated log, and saved to a file."""

import numpy as np
import pytest

import quad_gym
from quad_gym import VehicleParams, WorldParams, vehicle_params, world_params
from quad_gym.commands.calibrate import CalibrateArgs, fit_body
from quad_gym.estimation import fit_vehicle
from quad_gym.logs.calibrating.vehicle_fit import _mean_squares
from tests.logged_flights import RTK, Recorded, flown

LAB = VehicleParams()
TRUE = LAB.replace(
    thrust_coefficient=1.2 * LAB.thrust_coefficient, motor_time_constant=0.08, drag_coefficient=3.0
)
DRAG = (0.5, 0.3)  #: linear drag over the mass [1/s]


@pytest.fixture(scope="module")
def table():
    """Return a log with a row for each change of the motor voltages."""
    world = WorldParams(linear_drag_B=(*(TRUE.mass * d for d in DRAG), 0.0))
    flight = flown(RTK, 12.0, task="lemniscate", vehicle=TRUE, world=world)
    table = Recorded(flight, lost=0.0, jitter=0.0).table()
    times, voltages = flight["time"][:-1], flight.about["voltages"][1:]
    empty = np.full(len(times), np.nan)
    table = {name: np.append(column, empty) for name, column in table.items()}
    for name in ("time", "received"):
        table[name][-len(times) :] = times
    order = np.argsort(table["received"], kind="stable")
    motors = np.full((len(order), 4), np.nan)
    motors[-len(times) :] = voltages
    table = {name: column[order] for name, column in table.items()}
    return table | {f"motor_{k}": motors[order, k] for k in range(4)}


@pytest.fixture(scope="module")
def found(table):
    return fit_vehicle(table, sensors=RTK)


@pytest.mark.parametrize(
    ("name", "true", "width"),
    [
        ("thrust_over_mass", TRUE.thrust_coefficient / TRUE.mass, 0.05),
        ("motor_time_constant", TRUE.motor_time_constant, 0.5),
        ("drag_over_mass", 0.5 * 3.0 * TRUE.disc_area * TRUE.air_density / TRUE.mass, 1.0),
        ("hover_voltage", TRUE.hover_voltage, 0.05),
    ],
)
def test_fitted_interval_is_narrow_and_contains_true_value(found, name, true, width):
    number = getattr(found, name)
    assert number.low < true < number.high
    assert number.high - number.low < width * true


def test_fitted_linear_drag_is_that_of_the_world(found):
    for true, number in zip(DRAG, found.linear_drag_over_mass, strict=True):
        assert number.value == pytest.approx(true, rel=0.03)
        assert number.high - number.low < 0.1 * true
    found_drag = [number.value * LAB.mass for number in found.linear_drag_over_mass]
    assert found.world == WorldParams(linear_drag_B=(*found_drag, 0.0))


def test_fitted_interval_of_battery_sag_contains_zero(found):
    assert found.sag.low < 0.0 < found.sag.high


def test_fitted_vehicle_flies_after_saving_and_reading(found, tmp_path):
    file = found.vehicle.save(tmp_path / "mine.toml")
    assert vehicle_params(file) == vehicle_params(str(file)) == found.vehicle
    env = quad_gym.QuadEnv("circle", vehicle=str(file))
    env.reset(seed=0)
    assert np.isfinite(env.step(env.action_space.sample())[0]).all()


def test_command_writes_the_vehicle_of_a_log_in_a_file(table, found, tmp_path):
    names = list(table)
    rows = np.column_stack([table[name] for name in names])
    lines = [",".join("" if np.isnan(x) else repr(float(x)) for x in row) for row in rows]
    (tmp_path / "flight.csv").write_text("\n".join([",".join(names), *lines]))
    mine = LAB.replace(mass=0.9, thrust_coefficient=LAB.thrust_coefficient * 0.9 / LAB.mass)
    args = CalibrateArgs(
        logs=(tmp_path / "flight.csv", tmp_path / "flight.csv"),
        vehicle=tmp_path / "body.toml",
        vehicle_from=str(mine.save(tmp_path / "mine.toml")),
    )
    assert "rotor lag 0.08" in fit_body(args, RTK, [{}, {}])
    world = world_params(tmp_path / "body-world.toml")
    ratios = np.divide(world.linear_drag_B[:2], found.world.linear_drag_B[:2])
    np.testing.assert_allclose(ratios, 0.9 / LAB.mass, rtol=1e-6)
    written = vehicle_params(tmp_path / "body.toml")
    assert (written.mass, written.inertia) == (0.9, LAB.inertia)
    found_ratio = found.vehicle.thrust_coefficient / found.vehicle.mass
    assert written.thrust_coefficient / 0.9 == pytest.approx(found_ratio, rel=1e-6)


LEVEL = RTK.replace(
    camera=None,
    imu=RTK.imu.replace(samples="average"),
    estimator=RTK.estimator.replace(integration="midpoint"),
)
FINE = 20  #: steps of the simulation per IMU sample


def rising_flight(rate, lag, seconds=8.0):
    """Log and commands of a level vehicle whose four motors get equal random commands at a rate."""
    rng = np.random.default_rng(1)
    each, tick = round(200.0 / rate), 0.005
    levels = LAB.hover_voltage * (1.0 + 0.12 * rng.choice([-1.0, 1.0], round(seconds * rate)))
    held, keep = np.repeat(levels, each * FINE), np.exp(-tick / FINE / lag)
    u = np.empty(len(held) + 1)
    u[0] = held[0]
    for k, level in enumerate(held):
        u[k + 1] = level + keep * (u[k] - level)
    force = LAB.gravity / LAB.hover_voltage**2 * 0.5 * (u[1:] ** 2 + u[:-1] ** 2)
    z = np.cumsum(np.cumsum(force - LAB.gravity)) * (tick / FINE) ** 2
    n = len(held) // FINE + 1
    accel, gnss, baseline = np.zeros((n, 3)), np.full((n, 3), np.nan), np.full((n, 3), np.nan)
    accel[:, 2] = np.append(LAB.gravity, force.reshape(-1, FINE).mean(axis=1))
    gnss[::20], baseline[::20] = 0.0, (1.0, 0.0, 0.0)
    gnss[20::20, 2] = z[20 * FINE - 1 :: 20 * FINE]
    gnss[::20] += rng.normal(0.0, 0.01, (len(gnss[::20]), 3))
    log = {
        "time": tick * np.arange(n),
        "gyro": rng.normal(0.0, 1e-3, (n, 3)),
        "accel": accel + rng.normal(0.0, 0.02, (n, 3)),
        "gnss_enu": gnss,
        "gnss_baseline_enu": baseline,
    }
    times = each * tick * np.arange(len(levels))
    return log, {"time": times, "voltages": np.tile(levels[:, np.newaxis], 4)}


@pytest.mark.parametrize(
    "rate", [10.0, 25.0, *(pytest.param(rate, marks=pytest.mark.slow) for rate in (50.0, 200.0))]
)
def test_rotor_lag_is_unbiased_with_commands_slower_than_the_imu(rate):
    """By the trapezoid rule, 0.047 s was found at 25 Hz, and 10 Hz had no solution."""
    log, motors = rising_flight(rate, 0.05)
    found = fit_vehicle(log, sensors=LEVEL, motors=motors, start={"heading": 0.0})
    assert found.motor_time_constant.value == pytest.approx(0.05, rel=0.005)
    assert found.hover_voltage.value == pytest.approx(LAB.hover_voltage, rel=1e-3)


@pytest.mark.parametrize("sag", [0.0, 0.01])
def test_mean_squares_are_integrals_of_the_rotors_response(sag):
    times = np.array([0.0, 0.03, 0.05, 0.15, 0.2])
    voltages = np.random.default_rng(2).uniform(2.0, 4.0, (5, 4))
    begins, ends = np.array([0.01, 0.02, 0.06, 0.19]), np.array([0.02, 0.14, 0.1, 0.26])
    found = _mean_squares(times, voltages, (begins, ends), 0.04, sag)
    speed = np.zeros(4) + voltages[0]
    fine = np.arange(0.0, 0.26, 1e-5)
    squares = []
    for t in fine:
        squares.append((speed**2).sum())
        k = np.searchsorted(times, t + 5e-6, side="right") - 1
        speed += (voltages[k] * (1.0 - sag * times[k]) - speed) * -np.expm1(-1e-5 / 0.04)
    for begin, end, mean in zip(begins, ends, found, strict=True):
        within = (fine >= begin - 5e-6) & (fine <= end + 5e-6)
        exact = np.trapezoid(np.array(squares)[within], fine[within])
        assert mean == pytest.approx(exact / np.ptp(fine[within]), rel=1e-4)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('base = "lab"\nmas = 1.0\n', "mas is not a field of VehicleParams"),
        ("mass = 1.0\n", "there must be a value inertia"),
        ('base = "la"\n', "base must be one of"),
    ],
)
def test_invalid_vehicle_file_is_refused(text, message, tmp_path):
    (tmp_path / "mine.toml").write_text(text)
    with pytest.raises(ValueError, match=message):
        vehicle_params(tmp_path / "mine.toml")


def test_motor_commands_must_have_a_row_for_each_time():
    with pytest.raises(ValueError, match="voltages"):
        fit_vehicle({}, motors={"time": [0.0, 1.0], "voltages": np.zeros((3, 4))}, sensors=RTK)


def test_log_without_motor_voltages_is_refused():
    table = {"time": [0.0, 0.1], "gyro": np.zeros((2, 3)), "accel": np.ones((2, 3))}
    with pytest.raises(ValueError, match="must have the columns motor_0 to motor_3"):
        fit_vehicle(table, sensors=RTK)

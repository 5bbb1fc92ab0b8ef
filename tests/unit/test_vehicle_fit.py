"""Vehicle parameters fitted to a simulated log, and saved to a file."""

import numpy as np
import pytest

import quad_gym
from quad_gym import VehicleParams, vehicle_params
from quad_gym.commands.calibrate import CalibrateArgs, fit_body
from quad_gym.estimation import fit_vehicle
from tests.logged_flights import RTK, Recorded, flown

LAB = VehicleParams()
TRUE = LAB.replace(
    thrust_coefficient=1.2 * LAB.thrust_coefficient, motor_time_constant=0.08, drag_coefficient=3.0
)


@pytest.fixture(scope="module")
def table():
    """Return a log with a row for each change of the motor voltages."""
    flight = flown(RTK, 12.0, task="lemniscate", vehicle=TRUE)
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
    args = CalibrateArgs(log=tmp_path / "flight.csv", vehicle=tmp_path / "body.toml")
    assert "rotor lag 0.08" in fit_body(args, RTK, {})
    assert vehicle_params(tmp_path / "body.toml") == found.vehicle


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

"""Draws against SciPy's distributions; flights with draws against flights with the parameters."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import special, stats

import quad_gym
from quad_gym import LogUniform, Normal, Randomization, Uniform, WorldParams
from quad_gym.kernels.task.draws import normal_quantile
from quad_gym.params.randomization import nominal_values
from quad_gym.records import COLUMNS, DRAWABLES, FEATURE_SLICE, Control, Source
from quad_gym.rotations import euler_to_dcm
from tests.builders import batch, flown_batch
from tests.unit.alarms import ALARM, alarm_score
from tests.unit.compiled import Compiled

LAB, SUITE = quad_gym.vehicle_params("lab"), quad_gym.sensor_suite("lab")
WORLD = WorldParams(
    wind_I=(2.0, 1.0, 0.5),
    gust_wind_speed=5.0,
    linear_drag_B=(0.4, 0.3, 0.1),
    rotor_drag_B=(1e-5, 1e-5, 1e-5),
    battery=quad_gym.BatteryParams(),
)


def quantile(f, _):
    f.x = normal_quantile(f.p)


quantiles = Compiled(quantile, p=(), x=())


@given(st.floats(1e-300, 1.0 - 2.0**-53))
def test_normal_quantile_agrees_with_scipy(p):
    got = quantiles.on_floats(p=[p])["x"][0]
    np.testing.assert_allclose(got, special.ndtri(p), rtol=2e-13, atol=1e-15)


DRAWS = {
    "mass": (Uniform(0.8, 1.2, relative=True), stats.uniform(0.8 * 0.78, 0.4 * 0.78)),
    "motor_time_constant": (LogUniform(0.5, 2.0, relative=True), stats.loguniform(0.025, 0.1)),
    "wind_north": (Normal(1.0, 2.0), stats.norm(1.0, 2.0)),
    "wind_east": (
        Normal(0.0, 1.0, low=-0.5, high=2.0, offset=True),
        stats.truncnorm(-0.5, 2.0, loc=2.0),
    ),
    "baseline_sigma": (Uniform(0.01, 0.1), stats.uniform(0.01, 0.09)),
    "primary_antenna_B": (
        Normal(0.0, 0.01, offset=True),
        [stats.norm(x, 0.01) for x in SUITE.gnss.primary_antenna_B],
    ),
    "start_yaw": (Uniform(-3.0, 3.0), stats.uniform(-3.0, 6.0)),
}


@pytest.fixture(scope="module")
def drawn():
    randomization = {name: given for name, (given, _) in DRAWS.items()}
    flights = batch(20_000, source=Source.TRUTH, world=WORLD, randomization=randomization)
    first = flights.drawn()
    flights.reset()
    return first, flights.drawn()


@pytest.mark.parametrize("name", DRAWS)
def test_draws_have_their_distribution(drawn, name):
    values = np.reshape(drawn[0][name], (20_000, -1))
    expected = DRAWS[name][1]
    expected = expected if isinstance(expected, list) else [expected]
    for component, distribution in zip(values.T, expected, strict=True):
        assert stats.kstest(component, distribution.cdf).pvalue > ALARM
        low, high = distribution.support()
        assert low <= component.min() < component.max() <= high


def test_all_draws_are_independent(drawn):
    """Draws of parameters, components, flights and episodes are not correlated."""
    columns = [np.reshape(part[name], (20_000, -1)).T for part in drawn for name in sorted(DRAWS)]
    ranks = stats.rankdata(np.concatenate(columns), axis=1)
    scores = np.corrcoef(ranks)[np.triu_indices(len(ranks), 1)] * math.sqrt(20_000)
    assert np.abs(scores).max() < alarm_score(scores.size)
    centered = ranks - ranks.mean(axis=1, keepdims=True)
    along = (centered[:, 1:] * centered[:, :-1]).mean(axis=1) / centered.var(axis=1)
    assert np.abs(along).max() < alarm_score(along.size) / math.sqrt(19_999)


@given(st.floats(-5.0, 3.0), st.floats(0.0, 3.0), st.floats(0.1, 4.0), st.integers(0, 3))
def test_bounds_hold_to_the_last_bit(low, width, sigma, kind):
    high = low + width
    given = Uniform(low, high)
    if kind == 1:
        given = LogUniform(math.exp(low - 5.0), math.exp(high - 5.0))
    elif kind == 2:
        given = Normal(low + 0.3 * width, sigma, low, high + 1e-3)
    elif kind == 3:
        given = Uniform(low, high, offset=True)
    drawing = {"randomization": {"start_yaw": given}, "threads": 1}
    values = batch(16, source=Source.TRUTH, **drawing).read("start_yaw")
    assert (given.support[0] <= values).all()
    assert (values <= given.support[1]).all()


def test_a_parameter_does_not_depend_on_which_others_are_drawn():
    mass, inertia = Uniform(0.5, 1.0), (None, LogUniform(0.5, 2.0, relative=True), None)
    few, many = (
        batch(12, source=Source.TRUTH, randomization=randomization)
        for randomization in ({"mass": mass}, {"mass": mass, "inertia": inertia})
    )
    np.testing.assert_array_equal(few.read("mass"), many.read("mass"))
    drawn = many.read("inertia")  # the other components stay
    assert [len(np.unique(column)) for column in drawn.T] == [1, 12, 1]


def parameters_with(name, value):
    """Vehicle, sensors and world, with the parameter set in the dataclass that has it."""
    scalar = float(value[0]) if value.size == 1 else tuple(value)
    imu, gnss, camera, battery = SUITE.imu, SUITE.gnss, SUITE.camera, WORLD.battery
    vehicle, sensors, world = LAB, SUITE, WORLD
    if name == "inertia":
        vehicle = LAB.replace(inertia=np.diag(value))
    elif name == "center_of_mass_B":
        vehicle = LAB.replace(rotor_positions_B=np.array(LAB.rotor_positions_B) - value)
        sensors = SUITE.replace(
            imu=imu.replace(lever_arm_B=np.array(imu.lever_arm_B) - value),
            gnss=gnss.replace(
                primary_antenna_B=np.array(gnss.primary_antenna_B) - value,
                secondary_antenna_B=np.array(gnss.secondary_antenna_B) - value,
            ),
            camera=camera.replace(position_B=np.array(camera.position_B) - value),
        )
    elif name in ("wind_east", "wind_north", "wind_up"):
        wind = list(WORLD.wind_I)
        wind[["wind_east", "wind_north", "wind_up"].index(name)] = scalar
        world = WORLD.replace(wind_I=wind)
    elif name == "wind_speed":
        angle = math.atan2(1.0, 2.0)
        world = WORLD.replace(wind_I=(scalar * math.cos(angle), scalar * math.sin(angle), 0.5))
    elif name == "wind_direction":
        speed = math.hypot(2.0, 1.0)
        world = WORLD.replace(wind_I=(speed * math.cos(scalar), speed * math.sin(scalar), 0.5))
    elif name.startswith("battery_"):
        changed = {name.removeprefix("battery_"): scalar}
        world = WORLD.replace(battery=battery.replace(**changed))
    elif name == "camera_position_B":
        sensors = SUITE.replace(camera=camera.replace(position_B=scalar))
    elif name in ("pixel_sigma", "focal_length"):
        sensors = SUITE.replace(camera=camera.replace(**{name: scalar}))
    elif hasattr(LAB, name):
        vehicle = LAB.replace(**{name: scalar})
    elif hasattr(WORLD, name):
        world = WORLD.replace(**{name: scalar})
    elif hasattr(imu, name):
        sensors = SUITE.replace(imu=imu.replace(**{name: scalar}))
    else:
        sensors = SUITE.replace(gnss=gnss.replace(**{name: scalar}))
    return vehicle, sensors, world


def some_distribution(name):
    nominal = nominal_values(LAB, SUITE, WORLD)[COLUMNS[name]]
    if name == "battery_charge":
        return Uniform(0.2, 0.9)
    if name in ("center_of_mass_B", "lever_arm_B"):
        return Uniform(-0.01, 0.01)
    return Uniform(0.9, 1.1, relative=True) if (nominal != 0.0).all() else Uniform(-0.02, 0.02)


def flown(ticks=60, seeds=(3,), **keywords):
    task = quad_gym.TaskParams(kind="circle", start="hover", duration=0.0)
    return flown_batch(seeds, ticks, **{"task": task, "sensors": SUITE, **keywords})


SEEN = ("r", "v", "q", "w", "rotor_speeds", "charge", "wind", "accel", "gyro", "b_a", "b_g",
        "gnss_position", "gnss_baseline", "pixels", "r_hat", "v_hat", "b_a_hat")  # fmt: skip


def assert_alike(left, right, flight=0):
    for name in SEEN:
        np.testing.assert_allclose(
            left.record(name)[flight], right.record(name)[0], rtol=1e-7, atol=1e-8, err_msg=name
        )


FEATURES = {"features_yaw", "features_shift_I", "feature_offsets_I"}
OTHERS = {"rotor_efficiency", "camera_rotation", "action_delay", *FEATURES}
TOLD = [d.name for d in DRAWABLES if d.name not in OTHERS and not d.name.startswith("start_")]


@pytest.mark.parametrize("name", TOLD)
def test_flight_with_drawn_parameter_equals_flight_with_given_parameter(name):
    drawing = flown(seeds=(2, 3), world=WORLD, randomization={name: some_distribution(name)})
    value = np.atleast_1d(drawing.read(name)[1])
    nominal = nominal_values(LAB, SUITE, WORLD)[COLUMNS[name]]
    assert (value != nominal).any()
    vehicle, sensors, world = parameters_with(name, value)
    told_so = flown(true_vehicle=vehicle, true_sensors=sensors, world=world)
    assert_alike(drawing, told_so, flight=1)
    if name in ("max_voltage", "battery_resistance"):
        return  # limits that this vehicle does not reach: see the next test
    unaware = flown(world=WORLD)
    changed = [n for n in SEEN if (drawing.record(n)[1] != unaware.record(n)[0]).any()]
    assert changed, "the draw changes nothing"


@pytest.mark.parametrize("name", ["max_voltage", "battery_resistance", "battery_charge"])
def test_a_heavy_vehicle_reaches_the_voltage_that_is_drawn(name):
    task = quad_gym.TaskParams(kind="hover", start="hover", duration=0.0, out_of_bounds=1e3)
    heavy = {"vehicle": LAB.replace(mass=2.5), "control": Control.MOTOR, "task": task}
    given = Uniform(0.01, 0.03) if name == "battery_resistance" else some_distribution(name)
    drawing = batch(2, 2, **heavy, world=WORLD, randomization={name: given})
    vehicle, _, world = parameters_with(name, np.atleast_1d(drawing.read(name)[1]))
    telling = batch(1, 3, **heavy, world=world, true_vehicle=vehicle.replace(mass=2.5))
    for _ in range(100):
        drawing.step(np.ones((2, 4)))
        telling.step(np.ones((1, 4)))
    first, second = drawing.record("voltages")
    np.testing.assert_allclose(second, telling.record("voltages")[0], rtol=1e-9)
    assert (first != second).all()


@pytest.mark.parametrize(
    "name", ["mass", "inertia", "thrust_coefficient", "torque_coefficient", "motor_speed_per_volt",
             "position_sigma_I", "accel_bias_tau", "primary_antenna_B", "center_of_mass_B"]
)  # fmt: skip
def test_known_draws_are_used_by_filter_and_controller(name):
    given = Randomization({name: some_distribution(name)}, known=True)
    gains = {"gains": quad_gym.pd_gains("lab")}  # preset gains by name depend on the vehicle
    drawing = flown(seeds=(2, 3), world=WORLD, randomization=given, **gains)
    vehicle, sensors, world = parameters_with(name, np.atleast_1d(drawing.read(name)[1]))
    telling = flown(vehicle=vehicle, sensors=sensors, world=world, **gains)
    assert_alike(drawing, telling, flight=1)


HOVER = quad_gym.TaskParams(kind="hover", start="hover", duration=0.0)
LONG = LAB.replace(rotor_positions_B=np.array(LAB.rotor_positions_B) * (1.3, 0.8, 1.0))


@pytest.mark.parametrize("control", [control for control in Control if control is not Control.PD])
def test_known_draws_scale_the_actions(control):
    """Actions are shares of the weight and of what the rotors can do, of the drawn vehicle."""
    actions = np.random.default_rng(7).uniform(-0.3, 0.3, (12, 1, 4))
    for name in ("mass", "thrust_coefficient", "torque_coefficient", "motor_speed_per_volt"):
        given = Randomization({name: some_distribution(name)}, known=True)
        keywords = {"control": control, "source": Source.TRUTH, "task": HOVER}
        drawing = batch(1, 3, **keywords, vehicle=LONG, randomization=given)
        vehicle = LONG.replace(**{name: float(drawing.read(name)[0])})
        telling, nominal = (batch(1, 3, **keywords, vehicle=one) for one in (vehicle, LONG))
        for action in actions:
            for flight in (drawing, telling, nominal):
                flight.step(action)
        for field, tolerance in (("voltages", 0.0), ("w", 1e-9)):
            found, expected = drawing.record(field), telling.record(field)
            np.testing.assert_allclose(found, expected, rtol=1e-8, atol=tolerance, err_msg=name)
        assert (drawing.record("w") != nominal.record("w")).any(), name


def test_mean_squares_of_draws_are_those_of_their_distributions():
    """By their integrals; a component that is not drawn keeps its value."""
    antenna = (Uniform(-0.03, 0.06), None, Normal(0.02, 0.05, low=0.0))
    drawn = {"primary_antenna_B": antenna, "battery_resistance": LogUniform(0.01, 0.05)}
    table = batch(1, 3, source=Source.TRUTH, sensors=SUITE, world=WORLD, randomization=drawn)
    draws = table.configuration.draws
    found = [*draws.mean_square("primary_antenna_B"), *draws.mean_square("battery_resistance")]
    logarithmic = (0.05**2 - 0.01**2) / (2.0 * math.log(5.0))
    kept = SUITE.gnss.primary_antenna_B[1] ** 2
    normal = stats.truncnorm(-0.4, math.inf, 0.02, 0.05).moment(2)
    expected = [(0.03**2 - 0.03 * 0.06 + 0.06**2) / 3.0, kept, normal, logarithmic]
    np.testing.assert_allclose(found, expected, rtol=1e-3)


def test_each_rotor_has_its_efficiency():
    """Body rates and velocity after a tick follow from the rotors' forces."""
    task = quad_gym.TaskParams(kind="hover", start="hover", duration=0.0)
    still = {"source": Source.TRUTH, "control": Control.MOTOR, "task": task}
    start_v = batch(1, 1, **still).record("v")[0]
    weak = batch(1, 1, **still, randomization={"rotor_efficiency": Uniform(0.8, 1.0)})
    efficiency, W = weak.read("rotor_efficiency")[0], weak.record("rotor_speeds")[0]
    weak.step(np.zeros((1, 4)))
    v, w, R = weak.record("v")[0], weak.record("w")[0], weak.record("R_seen")[0]
    forces = efficiency * LAB.thrust_coefficient * W**2
    torque = LAB.effectiveness[1:] @ forces
    np.testing.assert_allclose(w, 0.005 * np.linalg.solve(np.array(LAB.inertia), torque), rtol=2e-3)
    pull = (v - start_v) / 0.005 + [0.0, 0.0, LAB.gravity]
    np.testing.assert_allclose(R @ pull, [0.0, 0.0, forces.sum() / LAB.mass], atol=0.1)


def test_drawn_camera_rotation_turns_the_image():
    draws = {"camera_rotation": Uniform(-0.1, 0.1), "pixel_sigma": Uniform(1e-9, 1e-9)}
    flight, camera = flown(ticks=0, randomization=draws), SUITE.camera
    turn = euler_to_dcm(flight.read("camera_rotation")[0])
    R_BI = quad_gym.rotations.quaternion_to_dcm(flight.record("q"))[0]
    for i in np.flatnonzero(flight.record("block_valid")[0, FEATURE_SLICE]):
        in_B = R_BI @ (np.array(camera.features_I[i]) - flight.record("r")[0]) - camera.position_B
        in_C = turn @ euler_to_dcm(camera.attitude) @ in_B
        expected = camera.focal_length * in_C[:2] / in_C[2]
        np.testing.assert_allclose(flight.record("pixels")[0, i], expected, atol=1e-6)


def test_start_is_shifted_by_the_draws():
    given = {
        "start_position_I": Uniform(-1.0, 1.0),
        "start_velocity_I": Normal(0.0, 2.0),
        "start_body_rates": Uniform(-1.0, 1.0),
        "start_yaw": Uniform(-3.0, 3.0),
        "start_roll": Uniform(-0.25, 0.25),
        "start_pitch": Uniform(-0.25, 0.25),
    }
    plain, spread = flown(0, range(20)), flown(0, range(20), randomization=given)
    drawn = spread.drawn()
    for name, draw in (("r", "start_position_I"), ("v", "start_velocity_I")):
        expected = plain.record(name) + drawn[draw]
        np.testing.assert_allclose(spread.record(name), expected, atol=1e-12)
    np.testing.assert_array_equal(spread.record("w"), drawn["start_body_rates"])
    eulers = [
        quad_gym.rotations.dcm_to_euler(quad_gym.rotations.quaternion_to_dcm(b.record("q")))
        for b in (plain, spread)
    ]
    change = np.stack([drawn[f"start_{n}"] for n in ("roll", "pitch", "yaw")], axis=1)
    turned = (eulers[1] - eulers[0] - change + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(turned, 0.0, atol=1e-9)
    spread.reset(seeds=range(20), position=(0.5, 0.6, 0.7))  # a caller's position is kept
    np.testing.assert_array_equal(spread.record("r"), [[0.5, 0.6, 0.7]] * 20)

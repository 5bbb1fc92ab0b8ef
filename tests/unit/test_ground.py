"""Ground contact of a vehicle against closed forms and conservation laws."""

import math

import numpy as np
import pytest

import quad_gym
from quad_gym import FlightBatch, GroundParams, TaskParams, WorldParams, vehicle_params
from quad_gym.kernels.numbers.lanes import select
from quad_gym.kernels.numbers.linalg import load3
from quad_gym.kernels.vehicle.ground import _can_hold
from quad_gym.records import Control, Ending, Source
from quad_gym.rotations import quaternion_to_dcm
from tests.builders import put
from tests.field_flights import nees
from tests.unit.compiled import Compiled

GRAVITY, TICK, FLOOR = 9.8, 1.0 / 200.0, -0.1
CALM = vehicle_params("lab").replace(drag_coefficient=0.0)
TOUGH = {"max_touchdown_speed": 50.0, "max_touchdown_tilt": math.pi}


MADE = {"sensors": "lab", "source": Source.TRUTH, "control_rate": 200.0, "control": Control.MOTOR}


def batch(count=1, world=None, ground=None, task=None, **options):
    task = {"start": "hover", "duration": 0.0, "out_of_bounds": 1e3} | (task or {})
    task = TaskParams(max_tilt=math.pi, min_height=-1e3, **task)
    world = WorldParams(ground=GroundParams(**(ground or {})), **(world or {}))
    return FlightBatch(count, task=task, world=world, **MADE | {"vehicle": CALM} | options)


def stopped(flights):
    return np.full((flights.count, 4), -1.0)  # voltage 0


def resting_rotors(flights):
    put(flights, rotor_speeds=np.zeros((flights.count, 4)))


def at_random(flights, rng, height=(0.05, 0.3)):
    """Put tumbling vehicles at any attitude a little above the ground, with rotors at rest."""
    n = flights.count
    q = rng.normal(size=(n, 4))
    put(
        flights,
        q=q / np.linalg.norm(q, axis=1, keepdims=True),
        r=np.column_stack([np.zeros((n, 2)), FLOOR + 0.3 + rng.uniform(*height, n)]),
        v=rng.normal(0.0, 1.0, (n, 3)),
        w=rng.normal(0.0, 3.0, (n, 3)),
        rotor_speeds=np.zeros((n, 4)),
    )


def points(flights):
    """Return feet and hubs in I, (n, 8, 3)."""
    R_BI = quaternion_to_dcm(flights.record("q"))
    p_B = np.vstack([GroundParams().feet_B, CALM.rotor_positions_B])
    return flights.record("r")[:, None] + p_B @ R_BI


def energy(flights):
    v, w, J = flights.record("v"), flights.record("w"), np.array(CALM.inertia)
    turning = 0.5 * np.einsum("ni,ij,nj->n", w, J, w)
    return turning + CALM.mass * (0.5 * (v**2).sum(1) + GRAVITY * flights.record("r")[:, 2])


def standing(support, count, world=None, **options):
    """Return vehicles on the launch pad, or on ground that carries them."""
    if support == "ground":
        flights = batch(count, world, task={"start": "ground"}, **options)
    else:
        task = TaskParams(start="ground", duration=0.0, out_of_bounds=1e3)
        world = WorldParams(**(world or {}))
        flights = FlightBatch(count, task=task, world=world, **MADE | options)
    flights.reset(seeds=range(count))
    return flights


def stands(support, flights):
    """Return a mask (n,) of the vehicles that stand."""
    return flights.record("footing") == 4.0 if support == "ground" else flights.record("on_pad") > 0


@pytest.mark.parametrize("wind", [0.0, 3.0])
@pytest.mark.parametrize("support", ["pad", "ground"])
def test_vehicle_on_the_ground_does_not_move_for_a_minute(support, wind):
    world = {"wind_I": (wind, 0.0, 0.0), "linear_drag_B": (0.3, 0.3, 0.3)}
    flights = standing(support, 3, world, run_filter=True)
    before = {name: flights.record(name) for name in ("r", "q")}
    actions = np.full((3, 4), -0.4)  # the rotors carry a part of the weight
    for _ in range(60 * 200):
        flights.step(actions)
    for name, value in before.items():
        assert (flights.record(name) == value).all(), name
    assert (flights.record("v") == 0.0).all()
    assert stands(support, flights).all()
    assert (flights.record("needs_reset") == 0.0).all()


@pytest.mark.parametrize("sensors", ["lab", "standard"])
@pytest.mark.parametrize("support", ["pad", "ground"])
def test_accelerometer_on_the_ground_reads_gravity(support, sensors):
    flights = standing(support, 128, sensors=sensors, run_filter=True)
    f, w = np.zeros((2, 128, 3))
    for _ in range(100):
        flights.step(stopped(flights))
        f += (flights.record("accel") - flights.record("b_a")) / 100
        w += (flights.record("gyro") - flights.record("b_g")) / 100
    imu = quad_gym.sensor_suite(sensors).imu
    f -= [0.0, 0.0, GRAVITY]
    for mean, density in ((f, imu.accel_noise_density), (w, imu.gyro_noise_density)):
        deviations = mean / (density * math.sqrt(imu.rate) / 10.0)
        assert np.abs(deviations.mean(0)).max() < 5.0 / math.sqrt(128)


def test_a_level_fall_ends_at_rest_where_it_touches():
    flights = batch()
    flights.reset(seeds=[0], position=[0.0, 0.0, 0.05], velocity=[0.0, 0.0, 0.0], yaw=0.3)
    put(flights, q=flights.record("q") * [[1, 0, 0, 1]], w=np.zeros((1, 3)))
    put(flights, q=flights.record("q") / np.linalg.norm(flights.record("q")))
    resting_rotors(flights)
    ticks = 0
    while flights.record("footing")[0] == 0.0:
        flights.step(stopped(flights))
        ticks += 1
    fall = math.sqrt(2.0 * 0.05 / GRAVITY)
    assert abs(ticks * TICK - fall) <= TICK
    for _ in range(20):
        flights.step(stopped(flights))
    assert np.abs(flights.record("v")).max() == 0.0
    assert abs(flights.record("r")[0, 2]) < 1e-5
    assert flights.record("crashed")[0] == 0.0


@pytest.mark.parametrize(("friction", "depth"), [(0.6, 0.015), (5.0, 0.05)])
def test_ground_contact_gains_no_energy_and_limits_penetration(friction, depth):
    flights = batch(96, ground={"friction": friction, **TOUGH})
    flights.reset(seeds=range(96))
    at_random(flights, np.random.default_rng(0))
    had, deepest = energy(flights), 0.0
    for _ in range(3 * 200):
        flights.step(stopped(flights))
        has = energy(flights)
        assert (has <= had + 1e-9).all(), (has - had).max()
        had = has
        deepest = min(deepest, (points(flights)[..., 2] - FLOOR).min())
    assert deepest > -depth  # one tick of rotation at some 20 rad/s
    # all have come to rest: upright, upside down, or on an edge
    assert np.linalg.norm(flights.record("v"), axis=1).max() < 0.02


def test_without_friction_horizontal_momentum_stays():
    flights = batch(64, ground={"friction": 0.0, **TOUGH})
    flights.reset(seeds=range(64))
    at_random(flights, np.random.default_rng(1))
    before = flights.record("v")[:, :2]
    for _ in range(200):
        flights.step(stopped(flights))
    np.testing.assert_allclose(flights.record("v")[:, :2], before, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("friction", [0.2, 0.5])
def test_sliding_vehicle_stops_according_to_coulomb_friction(friction):
    """With a = friction g, the vehicle stops after v / a and slides v^2 / (2 a)."""
    flights = batch(ground={"friction": friction})
    flights.reset(seeds=[0])
    put(flights, q=[[1.0, 0.0, 0.0, 0.0]], r=[[0.0] * 3], v=[[1.0, 0.5, 0.0]], w=[[0.0] * 3])
    resting_rotors(flights)
    speed, slowing = math.hypot(1.0, 0.5), friction * GRAVITY
    ticks = 0
    while np.linalg.norm(flights.record("v")) > 0.0:
        flights.step(stopped(flights))
        ticks += 1
    assert abs(ticks * TICK - speed / slowing) < 4 * TICK
    slid, expected = flights.record("r")[0], np.array([1.0, 0.5]) * speed / (2.0 * slowing)
    np.testing.assert_allclose(slid[:2], expected, atol=speed * TICK)
    assert abs(slid[2]) < 1e-4


def test_wind_beyond_friction_limit_moves_the_vehicle():
    """The vehicle slides if linear drag k v exceeds friction, at v > friction m g / k."""
    for wind, moves in ((9.0, False), (15.0, True)):
        world = {"wind_I": (wind, 0.0, 0.0), "linear_drag_B": (0.2, 0.2, 0.0)}
        flights = batch(world=world, ground={"friction": 0.3}, task={"start": "ground"})
        flights.reset(seeds=[0])
        start = flights.record("r")
        for _ in range(200):
            flights.step(stopped(flights))
        assert (np.linalg.norm(flights.record("r") - start) > 0.01) == moves


@pytest.mark.parametrize("action", [0.05, 0.2, 1.0])
@pytest.mark.parametrize("support", ["pad", "ground"])
def test_vehicle_lifts_off_when_thrust_exceeds_weight(support, action):
    """The time at which W(t) = cm ea (1 - exp(-t / tau)) reaches hover speed has a closed form."""
    lab = vehicle_params("lab")
    flights = standing(support, 1, vehicle=lab)
    voltage = min(lab.hover_voltage * (1.0 + action), lab.max_voltage)
    expected = -lab.motor_time_constant * math.log(1.0 - lab.hover_voltage / voltage)
    ticks = 0
    while stands(support, flights)[0]:
        flights.step(np.full((1, 4), action))
        ticks += 1
    assert abs(ticks * TICK - expected) <= 2.0 * TICK
    assert abs(flights.record("r")[0, 2]) < 1e-3
    heights = []
    for _ in range(50):
        flights.step(np.full((1, 4), action))
        heights.append(flights.record("r")[0, 2])
    assert (np.diff(heights) > 0.0).all()


def test_thrust_on_one_side_tips_it_over():
    """It tips about the right feet, 0.15 m off center, if left thrust exceeds m g 0.15 / 0.36."""
    lab, tipped = vehicle_params("lab"), []
    for share in (0.9, 1.1):
        flights = batch(task={"start": "ground"}, vehicle=lab)
        flights.reset(seeds=[0])
        force = share * lab.mass * GRAVITY * 0.15 / (0.15 + 0.21) / 2.0
        volts = math.sqrt(force / lab.thrust_coefficient) / lab.motor_speed_per_volt
        action = np.full((1, 4), -1.0)
        action[0, [1, 2]] = volts / lab.hover_voltage - 1.0
        feet = []
        for _ in range(300):
            flights.step(action)
            feet.append(flights.record("footing")[0])
        tipped.append(bool(flights.record("needs_reset")[0]))
        turning = [number for number in feet if number != 4.0]
        assert turning[:10] == (10 * [2.0] if tipped[-1] else [])
    assert tipped == [False, True]


@pytest.mark.parametrize("samples", ["average", "instant"])
def test_integrated_specific_force_equals_velocity_change_in_landing(samples):
    """Specific force minus gravity, integrated over a landing, is the change of velocity."""
    suite = quad_gym.sensor_suite("lab")
    tiny = dict.fromkeys(("accel_noise_density", "gyro_noise_density"), 1e-12)
    tiny |= dict.fromkeys(("accel_bias_sigma", "gyro_bias_sigma"), 1e-12)
    imu = suite.imu.replace(samples=samples, lever_arm_B=(0.0, 0.0, 0.0), **tiny)
    estimator = suite.estimator.replace(integration="midpoint")
    sensors = suite.replace(imu=imu, estimator=estimator)
    flights = batch(16, sensors=sensors, run_filter=True)
    flights.reset(seeds=range(16), position=[0.0, 0.0, 0.03], velocity=[0.2, 0.0, -0.3])
    resting_rotors(flights)
    v, gained = flights.record("v"), np.zeros((16, 3))
    for _ in range(100):
        before = flights.record("q")
        flights.step(stopped(flights))
        after = flights.record("q")
        middle = before + after if samples == "average" else after
        R_BI = quaternion_to_dcm(middle / np.linalg.norm(middle, axis=1, keepdims=True))
        f_I = np.einsum("nji,nj->ni", R_BI, flights.record("accel"))
        gained += TICK * (f_I - [0.0, 0.0, GRAVITY])
    assert (flights.record("v") == 0.0).all()
    # in free flight an instantaneous sample is not the mean over its tick
    np.testing.assert_allclose(gained, -v, atol=1e-8 if samples == "average" else 0.02)


@pytest.mark.parametrize(
    ("start", "crashes"),
    [
        ({"v": (0.0, 0.0, -0.5)}, False),
        ({"v": (0.0, 0.0, -2.0)}, True),
        ({"q": (math.cos(0.1), math.sin(0.1), 0.0, 0.0)}, False),
        ({"q": (math.cos(0.3), math.sin(0.3), 0.0, 0.0)}, True),
        ({"q": (0.0, 1.0, 0.0, 0.0)}, True),
    ],
)
def test_hard_landing_ends_the_episode(start, crashes):
    flights = batch(2)
    flights.reset(seeds=[0, 1])
    state = {"q": (1.0, 0.0, 0.0, 0.0), "r": (0.0, 0.0, 0.06), "v": (0.0, 0.0, 0.0)} | start
    put(flights, w=np.zeros((2, 3)), rotor_speeds=np.zeros((2, 4)))
    put(flights, **{name: np.tile(value, (2, 1)) for name, value in state.items()})
    ended = np.zeros(2)
    for _ in range(60):
        flights.step(stopped(flights))
        ended = np.maximum(ended, flights.result("ending"))
        if crashes and ended.any():
            break
    assert (ended == (float(Ending.BELOW_MIN_HEIGHT) if crashes else 0.0)).all()


def test_start_below_the_ground_is_lifted_onto_it():
    flights = batch(3, world={"ground_height": -0.3}, task={"start": "ground"})
    flights.reset(seeds=[0, 1, 2])
    np.testing.assert_allclose(flights.record("r")[:, 2], -0.2, atol=1e-12)
    assert (flights.record("footing") == 4.0).all()
    flights.reset(seeds=[0, 1, 2], position=[0.0, 0.0, -0.7])
    np.testing.assert_allclose(flights.record("r")[:, 2], -0.2, atol=1e-12)
    flights.reset(seeds=[0, 1, 2], position=[0.0, 0.0, 1.0])
    assert (flights.record("r")[:, 2] == 1.0).all()
    assert (flights.record("footing") == 0.0).all()


@pytest.mark.parametrize("suite", ["standard", "indoor"])
def test_filter_is_consistent_while_vehicle_is_on_the_ground(suite):
    """The mean NEES over 256 flights is 15 +- 0.34, and the test allows five standard deviations.
    Filters of suites with several errors are slightly conservative."""
    flights = batch(256, sensors=suite, source=Source.ESTIMATE, task={"start": "ground"})
    flights.reset(seeds=range(256))
    for _ in range(5 * 200):
        flights.step(np.full((256, 4), -0.3))
    assert (flights.record("footing") == 4.0).all()
    assert 10.0 < nees(flights).mean() < 15.0 + 5.0 * 0.34


def hold(f, option):
    f.holds = select(_can_hold(f, load3(f.F), load3(f.T), f.friction), 1.0, 0.0)


holding = Compiled(hold, ground_arm=(4, 3), F=(3,), T=(3,), friction=(), holds=())


@pytest.mark.parametrize("instance", ["on_floats", "on_lanes"])
@pytest.mark.parametrize("friction", [0.4, 10.0])
def test_vehicle_rests_if_its_feet_can_push_as_needed(instance, friction):
    """The feet share a horizontal impulse; normal ones, by least squares, give the other torque."""
    rng = np.random.default_rng(21)
    feet = np.array([[1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]]) * [0.2, 0.1, 0.0]
    feet += [0.02, -0.01, -0.15]  # from the center of mass
    F, T = np.concatenate([rng.normal(size=(400, 2)), np.ones((400, 1))], axis=1), []
    F[:, :2] *= 0.3
    expected, sure = [], []
    for f in F:
        aside = np.append(f[:2], 0.0) / 4
        pushed = np.cross(feet, aside).sum(axis=0)
        torque = pushed + np.append(rng.normal(size=2) * [0.1, 0.2], 0.0) * 0.7
        torque[:2] += np.cross(feet, [0.0, 0.0, 0.25]).sum(axis=0)[:2]
        ups = np.cross(feet, [0.0, 0.0, 1.0])[:, :2]
        A, b = np.vstack([np.ones(4), ups.T]), np.append(f[2], (torque - pushed)[:2])
        least = np.linalg.lstsq(A, b, rcond=None)[0].min()
        margin = friction * f[2] - np.hypot(f[0], f[1])
        T.append(torque)
        expected.append(least >= 0.0 and margin >= 0.0)
        sure.append(min(abs(least), abs(margin)) > 1e-9)
    arms = np.broadcast_to(feet, (400, 4, 3))
    given = {"ground_arm": arms, "F": F, "T": T, "friction": np.full(400, friction)}
    got = getattr(holding, instance)(**given)["holds"]
    assert all(sure)
    assert 40 < sum(expected) < 360
    np.testing.assert_array_equal(got, expected)

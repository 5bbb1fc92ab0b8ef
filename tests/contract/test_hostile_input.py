"""Invalid values are refused by the name of their argument, or flown with finite numbers.

The arguments belong to interfaces, flights, filters, parameters, draws and faults. The values
are not numbers, not finite, too large, too small, or of another type or shape.
"""

import dataclasses
import inspect
import warnings

import gymnasium
import numpy as np
import pytest

import quad_gym
from quad_gym import BarometerParams, FlightBatch, TaskParams, WorldParams
from quad_gym import faults as fault_kinds
from quad_gym.faults import DirectedFault
from quad_gym.records import Control
from tests.builders import flat
from tests.filter_states import at_rest

RTK, INDOOR = quad_gym.sensor_suite("rtk"), quad_gym.sensor_suite("indoor")
NUMBERS = [np.nan, np.inf, -np.inf, -1.0, 0.0, 10**400]
NUMBERS += [1e308, -1e308, 1e15, 1e12, 1e9, 1e6, -1e6, 1e4, 1e-308, 1e-14, 1e-9, 1e-6, 1e-4]
OTHERS = ["three", b"3", True, (), [], {}, [[1.0]], [np.nan] * 3, np.zeros((2, 2)), object(), 3j]


HALVES = [0, pytest.param(1, marks=pytest.mark.slow)]
"""The first of each two values, and the others for the slow run."""


def vectors(size):
    return [(value,) * size for value in NUMBERS if isinstance(value, float)]


def assert_refused_or_flown(call, name, value):
    """Check that `call` raises an error that names the argument, or returns finite arrays."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # overflow, for example
        warnings.filterwarnings("ignore", rf".*{name} is .*: after a cold start", UserWarning)
        try:
            seen = call(value)
        except (ValueError, TypeError) as error:
            if name.lower() not in str(error).lower():
                pytest.fail(f"{name}={value!r} is refused without its name: {error!r}")
            return
    for array in seen:
        assert np.isfinite(array).all(), f"{name}={value!r}"


ONE_TASK = {
    "gate_count": "Waypoints",
    "gate_radius": "Waypoints",
    "max_speed": "RandomTrajectory",
    "max_acceleration": "RandomTrajectory",
    "trajectory": "Trajectory",
}


def names_of(kind):
    return [field.name for field in dataclasses.fields(kind)]


def environment_keywords():
    """Return the documented arguments of the environment, and the fields of a task."""
    text = inspect.getdoc(quad_gym.QuadEnv).partition("Args:")[2].partition("Raises:")[0]
    heads = [line for line in text.splitlines() if line.startswith("    ") and line[4] != " "]
    names = [n for head in heads for n in head.strip().split(":")[0].split(", ")]
    names += [name for name in names_of(TaskParams) if name != "kind"]
    return sorted(
        {name.strip(", ") for name in names if name.strip(", ").isidentifier()} - {"task"}
    )


INTERFACES = {
    "make": lambda name, **keywords: gymnasium.make(name, disable_env_checker=True, **keywords),
    "make_vec": lambda name, **keywords: gymnasium.make_vec(name, num_envs=2, **keywords),
    "make_sb3_vec_env": lambda name, **keywords: quad_gym.make_sb3_vec_env(name, 2, 1, **keywords),
}


def fly(interface, task, **keywords):
    """Observations and rewards of a few steps."""
    env = INTERFACES[interface](f"QuadGym/{task}-v0", **keywords)
    start = env.reset() if interface == "make_sb3_vec_env" else env.reset(seed=1)[0]
    seen, action = [np.asarray(flat(start))], np.full(4 if interface == "make" else (2, 4), 0.3)
    for _ in range(4):
        observation, reward, *others = env.step(action)
        seen += [np.asarray(flat(observation)), np.array(reward)]
        if interface == "make" and (others[0] or others[1]):
            break
    env.close()
    return seen


@pytest.mark.parametrize("half", HALVES)
@pytest.mark.parametrize("name", [*environment_keywords(), "threads"])
@pytest.mark.parametrize("interface", INTERFACES)
def test_any_value_of_environment_keyword_is_refused_by_name_or_flown(interface, name, half):
    if name == "render_mode" or (interface, name) == ("make", "max_episode_steps"):
        pytest.skip("Gymnasium itself handles this keyword")
    if name.startswith("render"):
        pytest.skip("it has no effect without render_mode")
    task = ONE_TASK.get(name, "Circle")
    some = 1 if interface == "make" else 4  # interfaces share their checks
    for value in [*NUMBERS, *OTHERS][half::2][::some]:
        assert_refused_or_flown(lambda v: fly(interface, task, **{name: v}), name, value)


@pytest.mark.parametrize("name", ["position", "velocity", "yaw", "seed", "options", "colour"])
def test_any_value_of_reset_argument_is_refused_by_name_or_flown(name):
    env = quad_gym.QuadEnv("hover")
    env.reset(seed=1)

    def reset(value):
        given = {name: value} if name in ("seed", "options") else {"options": {name: value}}
        return [env.reset(**given)[0], env.step(np.zeros(4))[0]]

    for value in [*NUMBERS, *OTHERS, *vectors(3), None]:
        if isinstance(value, dict) and name == "options":
            continue  # an empty dictionary is valid
        assert_refused_or_flown(reset, name, value)


FIELDS = ("r", "v", "q", "w", "rotor_speeds", "r_hat", "v_hat", "R_hat", "b_a_hat", "P", "reward")


def fly_batch(controls=(Control.PD, Control.VELOCITY), **keywords):
    seen = []
    for control in controls:
        batch = FlightBatch(4, **{"control": control, **keywords})
        batch.reset(seeds=range(4))
        for _ in range(20):
            batch.step(np.full((4, 4), 0.2))
        seen += [batch.record(name) for name in FIELDS]
    return seen


@pytest.mark.parametrize(
    "name", sorted(set(inspect.signature(FlightBatch).parameters) - {"bounds"})
)
def test_any_value_of_batch_argument_is_refused_by_name_or_flown(name):
    enumerations = ("source", "control", "layout", "autoreset")
    names = name if name not in enumerations else name.capitalize()
    for value in [*NUMBERS, *OTHERS]:
        if name == "count":
            if type(value) is float and value in (1e4, 1e6):
                continue  # a valid number of flights
            assert_refused_or_flown(lambda v: [FlightBatch(v).results], name, value)
        elif name in enumerations and isinstance(value, np.ndarray):
            continue  # Python raises its own message
        elif name not in ("run_filter", "include_std", "privileged") or isinstance(value, str):
            # these flags accept any value
            assert_refused_or_flown(lambda v: fly_batch(**{name: v}), names, value)


@pytest.mark.parametrize("name", ["seeds", "keys", "mask", "position", "velocity", "yaw"])
def test_any_value_of_batch_reset_argument_is_refused_by_name_or_flown(name):
    def reset(value):
        batch = FlightBatch(3)
        batch.reset(**{"seeds": range(3), **({name: value} if name != "keys" else {})})
        if name == "keys":
            batch.reset(keys=value)
        batch.step()
        return [batch.record("r"), batch.record("v")]

    for value in [*NUMBERS, *OTHERS, *vectors(3)]:
        assert_refused_or_flown(reset, name, value)


def suite_of(**parts):
    return {"sensors": RTK.replace(**parts)}


def imu_suite(imu):
    kept = imu.samples == "average"
    integration = RTK.estimator.replace(integration="midpoint" if kept else "euler")
    return suite_of(imu=imu, estimator=integration)


PARAMETERS = [
    (quad_gym.VehicleParams(), lambda p: {"vehicle": p}),
    (quad_gym.PDGains(), lambda p: {"gains": p}),
    (quad_gym.ActionParams(), lambda p: {"action_params": p}),
    (TaskParams(), lambda p: {"task": p}),
    (quad_gym.RewardParams(), lambda p: {"task": TaskParams(start="hover", reward_params=p)}),
    (WorldParams(), lambda p: {"world": p}),
    (quad_gym.BatteryParams(), lambda p: {"world": WorldParams(battery=p)}),
    (quad_gym.GroundParams(), lambda p: {"world": WorldParams(ground=p)}),
    (RTK.imu, imu_suite),
    (RTK.gnss, lambda p: suite_of(gnss=p)),
    (RTK.camera, lambda p: suite_of(camera=p)),
    (RTK.estimator, lambda p: suite_of(estimator=p)),
    (RTK.noisy, lambda p: suite_of(noisy=p)),
    (RTK.log_delays, lambda p: suite_of(log_delays=p)),
    (INDOOR.initial_pose, lambda p: {"sensors": INDOOR.replace(initial_pose=p)}),
    (RTK, lambda p: {"sensors": p}),
]
FIELDS_OF_PARAMETERS = [
    pytest.param(nominal, use, name, id=f"{type(nominal).__name__}-{name}")
    for nominal, use in PARAMETERS
    for name in names_of(nominal)
]


@pytest.mark.slow  # values far within the limits of tests/unit/test_limits.py, minutes of flights
@pytest.mark.parametrize("half", [0, 1])
@pytest.mark.parametrize(("nominal", "use", "name"), FIELDS_OF_PARAMETERS)
def test_any_value_of_parameter_field_is_refused_by_name_or_flown(nominal, use, name, half):
    controls = {
        quad_gym.VehicleParams: (Control.PD, Control.VELOCITY),
        TaskParams: (Control.PD, Control.VELOCITY),
        quad_gym.ActionParams: (Control.VELOCITY,),
    }.get(type(nominal), (Control.PD,))
    present = getattr(nominal, name)
    values = [*NUMBERS, *OTHERS]
    if isinstance(present, tuple):
        values += vectors(len(present))
    for value in values[half::2]:
        assert_refused_or_flown(
            lambda v: fly_batch(controls, **use(nominal.replace(**{name: v}))), name, value
        )


@pytest.mark.parametrize("drawable", quad_gym.params.randomization.DRAWABLES, ids=lambda d: d.name)
def test_any_range_of_draw_is_refused_by_name_or_flown(drawable):
    keywords = {"sensors": RTK, "world": WorldParams(battery=quad_gym.BatteryParams())}

    def drawn(span):
        part = {drawable.name: quad_gym.Uniform(*span)}
        return fly_batch(**keywords, randomization=part)

    limits = [(-1.0, 1.0), (0.0, 1.0), (1.0, 0.0), (np.nan, 1.0), (-1e15, 1e15), (0.0, np.inf)]
    for span in [*limits, ("a", "b"), (1e-14, 1e-12)]:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                seen = drawn(span)
        except (ValueError, TypeError) as error:
            if not any(word in str(error) for word in (drawable.name, "Uniform", "by mass")):
                pytest.fail(f"{drawable.name} in {span} is refused without its name: {error!r}")
        else:
            assert all(np.isfinite(part).all() for part in seen), span


KINDS = (*fault_kinds.Fault.__subclasses__(), *DirectedFault.__subclasses__())
INHERITED = names_of(fault_kinds.Fault)
FAULTS = [
    (kind, name)
    for k, kind in enumerate(kind for kind in KINDS if kind is not DirectedFault)
    for name in names_of(kind)
    if name not in INHERITED or INHERITED.index(name) == k % len(INHERITED)
]
"""The fields of every kind; those that all have, each with some kinds."""


@pytest.mark.slow  # as above
@pytest.mark.parametrize("half", [0, 1])
@pytest.mark.parametrize(("kind", "name"), FAULTS, ids=lambda part: getattr(part, "__name__", part))
def test_any_value_of_fault_field_is_refused_by_name_or_flown(kind, name, half):
    needed, sensors = {}, RTK
    if kind is fault_kinds.SensorLoss:
        needed, sensors = {"sensor": "barometer"}, RTK.replace(barometer=BarometerParams())
    for value in [*NUMBERS, *OTHERS, *vectors(2), *vectors(3), (0.2, 0.1)][half::2]:
        assert_refused_or_flown(
            lambda v: fly_batch((Control.PD,), sensors=sensors, faults=kind(**{**needed, name: v})),
            name,
            value,
        )


@pytest.mark.parametrize("kind", [quad_gym.UnscentedKalmanFilter, quad_gym.ExtendedKalmanFilter])
@pytest.mark.parametrize(
    ("method", "name"),
    [
        *(("initialize", name) for name in ("gnss_position_G", "gnss_baseline_G", "heading")),
        *(("set_state", name) for name in ("position", "R_BI", "covariance")),
        *(("update", f"gnss_{name}_G") for name in ("position", "baseline", "velocity")),
        ("update", "pixels"),
        ("predict", "gyro"),
        ("predict", "accel"),
    ],
)
def test_any_value_of_filter_argument_is_refused_by_name_or_finite(kind, method, name):
    good = {
        "initialize": {"gnss_position_G": np.ones(3), "gnss_baseline_G": [0.1, 0.1, 0.0]},
        "set_state": at_rest(covariance=np.eye(15) * 1e-2),
        "update": {},
        "predict": {"gyro": np.zeros(3), "accel": np.array([0.0, 0.0, 9.8])},
    }

    def use(value):
        ukf = kind(RTK)
        ukf.initialize(**good["initialize"])
        before = [ukf.position, ukf.velocity, ukf.R_BI, ukf.covariance]
        try:
            with warnings.catch_warnings():  # a filter that keeps its last valid state warns
                warnings.simplefilter("ignore", RuntimeWarning)
                getattr(ukf, method)(**{**good[method], name: value})
        except (ValueError, TypeError):
            for was, now in zip(before, (ukf.position, ukf.velocity, ukf.R_BI), strict=False):
                np.testing.assert_array_equal(was, now)
            assert ukf.status == 0
            raise
        assert None not in np.ravel(np.array(value, object)), f"{name}={value!r} is flown"
        return [ukf.position, ukf.velocity, ukf.R_BI, ukf.covariance]

    more = [np.full((12, 2), np.inf), np.full((3, 3), 1e300), (1.0, 2.0), [0.1, None, 0.1]]
    more += [(np.nan, 0.0, 1.0), (0.0, np.inf, 1.0), np.zeros((3, 2)), [[0, np.inf], [0, 0]]]
    for value in [*NUMBERS, *OTHERS, *vectors(3), *more]:
        assert_refused_or_flown(use, name, value)

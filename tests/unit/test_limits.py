"""Limits of all fields of parameters: the last good value is accepted, the first bad one refused.

The table is made from the rules of the fields. Each kind of rule has its limits here a second time,
so that a rule that forgets one of them, or is off by the smallest step, is found.
"""

import dataclasses
import math
from functools import partial

import numpy as np
import pytest
from scipy.stats import norm

import quad_gym
from baselines import crazyflie_pid, recipes
from quad_gym import TaskParams, configuration, faults
from quad_gym.configuration import FlightConfiguration
from quad_gym.envs.config import EnvConfig
from quad_gym.faults import Fault, SensorLoss, _angle_span, _duration, span
from quad_gym.params import checks as check
from quad_gym.params.camera import _features
from quad_gym.params.checks import Checked, _unless_none
from quad_gym.params.sensor_table import SENSOR_PARAMS
from quad_gym.params.suites import given_suite
from quad_gym.params.task import ONE_TASK_FIELDS
from quad_gym.params.vehicle import Clocks
from quad_gym.params.world import Obstacle
from quad_gym.records import DRAWABLES, MAX_FEATURES, MAX_GATES, Autoreset, Control, Layout, Source

LARGEST, SMALLEST = 1e15, 1e-15


def above(x):
    return math.nextafter(x, math.inf)


def below(x):
    return math.nextafter(x, -math.inf)


def numbers(least=-math.inf, most=LARGEST, open_end=False):
    """Pairs of the last good number and the first bad one, at both ends."""
    if least == -math.inf:
        low = (-LARGEST, below(-LARGEST))
    else:
        low = (above(least), least) if open_end else (least, below(least))
    return [low, (most, above(most)), (most, math.nan), (most, "1")]


TURN = 2.0 * math.pi


def angles(most):
    """Pairs of the last good angle and the first bad one, of which one is in degrees."""
    return [(most, above(most)), (-most, below(-most)), (most, 90.0), (most, math.nan)]


def positives(least=SMALLEST, most=LARGEST):
    return [*numbers(least, most), (least, 0.0)]


def wholes(least=1, most=None):
    end = int(LARGEST) if most is None else most
    return [(least, least - 1), (end, end + 1), (least, least + 0.5), (least, True)]


def vectors(length, least=-math.inf, open_end=False):
    """Vectors in which only the last component is at its limit."""
    pairs = numbers(least, LARGEST, open_end)[:3]
    middle = (1.0,) * (length - 1)
    cases = [((*middle, good), (*middle, bad)) for good, bad in pairs]
    whole = (1.0,) * length
    return [*cases, (whole, whole[1:]), (whole, (*whole, 1.0)), (whole, ("1",) * length)]


def matrices(rows, columns):
    good = np.ones((rows or 4, columns))
    far = good.copy()
    far[-1, -1] = above(LARGEST)
    return [(good, far), (good, good[:, 1:]), (good, good[0])]


def spans(open_end=False):
    """A number of at least 0, or a range of two such numbers in order."""
    ends = numbers(0.0, LARGEST, open_end)
    ranges = [((good, LARGEST), (bad, LARGEST)) for good, bad in ends[:1]]
    return [*ends, *ranges, ((1.0, 1.0), (above(1.0), 1.0)), ((1.0, 2.0), (1.0, 2.0, 3.0))]


def rows_of(most):
    """One to `most` places."""
    many = np.arange(3.0 * (most + 1)).reshape(-1, 3)
    return [(many[:1], many[:0]), (many[:most], many), (many[:1], many[0])]


KINDS = {
    check.number: numbers,
    check.positive: positives,
    check.whole: wholes,
    check.vector: vectors,
    check.matrix: matrices,
    check.positive_or_infinite: lambda: [(math.inf, math.nan), *positives()],
    check.place: lambda: [((0.0, 0.0, -100.0), (0.0, 0.0, below(-100.0)))],
    check.angle: lambda most=TURN: angles(most),
    check.angle_size: lambda: [(SMALLEST, 0.0), *angles(math.pi)[:1], (math.pi, 30.0)],
    check.angles: lambda: [((0.1, 0.2, a), (0.1, 0.2, b)) for a, b in angles(TURN)],
    _angle_span: lambda: [
        *spans(open_end=True)[:1],
        *angles(TURN)[:1],
        ((0.5, TURN), (0.5, above(TURN))),
        ((0.5, 0.5), (above(0.5), 0.5)),
    ],
    check.phase: lambda: [(0.0, below(0.0)), (below(1.0), 1.0), (None, "soon")],
    check.flag: lambda: [(True, 1), (False, "no"), (False, 0.0)],
    span: spans,
    _duration: lambda: [(math.inf, -math.inf), *spans(open_end=True)],
    _features: lambda: rows_of(MAX_FEATURES),
    check.places: rows_of,
    recipes._sizes: lambda: [((1,), ()), ((1,), (0,)), ((64, 1), (64, 0)), ((64,), (1.5,))],
    recipes._rates: lambda: vectors(2, 0.0, open_end=True),
    recipes._read_only: lambda: [({"start": "mixed"}, ["start"]), ({}, None)],
    configuration._vehicle: lambda: [("crazyflie", "crazyfly"), (LAB, 3.0)],
    configuration._task: lambda: [(None, "circle"), (TaskParams(), {})],
    configuration._randomization: lambda: [(None, "mass"), ({}, {"colour": 1.0})],
    configuration._unresolved: lambda: [("calm", "storm"), (quad_gym.WorldParams(), {})],
    given_suite: lambda: [("rtk", "phone"), (quad_gym.sensor_suite("rtk"), 1)],
    check.choice: lambda choices: [(choices[-1], choices[-1].upper() + "x"), (choices[0], None)],
}
"""Limits of each kind of rule, from the arguments that a field gives to it."""

NEAR = 1.0 + 1e-9  #: factor beyond limits that follow from other numbers, and round
RAREST = 200.0 / 100_000  #: actions per second with the longest period, in ticks [Hz]
RARE = norm.isf(1e-6)  #: bound beyond which a normal draw has the least admitted probability
LAB = quad_gym.vehicle_params("lab")
PATH = quad_gym.Trajectory(times=(0.0, 1.0, 2.0), coefficients=np.ones((8, 2, 4)))
THRUST = 4.0 * LAB.thrust_coefficient * (LAB.motor_speed_per_volt * LAB.max_voltage) ** 2
HEAVIEST = THRUST / (LAB.mass * LAB.gravity)  #: thrust at full voltage over weight, from 1 to 1000
FEET = [(x, y, -0.1) for x, y in ((1, 1), (1, -1), (-1, -1), (-1, 1))]


def factors(nominal, low, high):
    """Limits of a number at two factors of its nominal value."""
    return [
        (nominal * low * NEAR, nominal * low / NEAR),
        (nominal * high / NEAR, nominal * high * NEAR),
    ]


def within(most):
    """Vectors with one component at most as far from zero as a limit."""
    return [((1.0, 1.0, side * most), (1.0, 1.0, side * above(most))) for side in (-1.0, 1.0)]


NARROWER = {
    ("ActionParams", "tilt_scale"): [(SMALLEST, 0.0), (below(math.pi / 2), math.pi / 2)],
    ("FilterParams", "false_alarm_probability"): [(0.0, below(0.0)), (below(0.5), 0.5)],
    ("GnssParams", "reference_antenna_G"): [((0.0, 0.0, 6.4e6), (0.0, 0.0, 1.0))],
    ("GroundParams", "feet_B"): [
        (FEET, [(*feet[:2], 0.0) for feet in FEET]),
        (FEET, [*FEET[:3], (-1.0, 1.0, -0.2)]),
        (FEET, [(x, 0.0, -0.1) for x in range(4)]),
    ],
    ("MagnetometerParams", "inclination"): [
        (side * (math.acos(0.01) - 1e-9), side * (math.acos(0.01) + 1e-9)) for side in (-1.0, 1.0)
    ],
    ("RangeFinderParams", "min_range"): [(SMALLEST, 0.0), (below(3.6), 3.6)],
    ("RangeFinderParams", "max_range"): [(above(0.04), 0.04), (LARGEST, above(LARGEST))],
    ("RotorLoss", "share"): [(1.0, above(1.0)), (SMALLEST, 0.0), ((0.5, 1.0), (0.5, above(1.0)))],
    ("RotorLoss", "rotor"): [(0, -1), (3, 4), (None, "first")],
    ("TaskParams", "min_height"): [(-LARGEST, below(-LARGEST)), (0.0, above(0.0))],
    ("TaskParams", "max_tilt"): [(above(0.0), 0.0), (math.pi, above(math.pi))],
    ("Uniform", "low"): [(-LARGEST, below(-LARGEST)), (2.0, above(2.0))],
    ("Uniform", "high"): [(1.0, below(1.0)), (LARGEST, above(LARGEST))],
    ("VehicleParams", "mass"): factors(LAB.mass, HEAVIEST / 1000.0, HEAVIEST),
    ("VehicleParams", "gravity"): factors(LAB.gravity, HEAVIEST / 1000.0, HEAVIEST),
    ("VehicleParams", "thrust_coefficient"): factors(
        LAB.thrust_coefficient, 1.0 / HEAVIEST, 1000.0 / HEAVIEST
    ),
    **{
        ("VehicleParams", name): factors(
            getattr(LAB, name), HEAVIEST**-0.5, (1000.0 / HEAVIEST) ** 0.5
        )
        for name in ("motor_speed_per_volt", "max_voltage")
    },
    ("VehicleParams", "torque_coefficient"): [
        (SMALLEST, 0.0),
        (10.0 * LAB.thrust_coefficient, above(10.0 * LAB.thrust_coefficient)),
    ],
    ("VehicleParams", "rotor_spins"): [
        (LAB.rotor_spins, (*LAB.rotor_spins[:3], above(LAB.rotor_spins[3]))),
        (LAB.rotor_spins, (1.0,) * 4),
    ],
    ("LogUniform", "offset"): [(False, True), (False, 1)],
    ("LogUniform", "low"): [(SMALLEST, 0.0), (2.0, above(2.0))],
    ("LogUniform", "high"): [(1.0, below(1.0)), (LARGEST, above(LARGEST))],
    ("Normal", "low"): [(RARE / NEAR, RARE * NEAR), (-math.inf, math.nan), (0.0, "0")],
    ("Normal", "high"): [(-RARE / NEAR, -RARE * NEAR), (math.inf, math.nan), (0.0, "0")],
    ("Trajectory", "times"): [
        ((0.0, 1.0, above(1.0)), (0.0, 1.0, 1.0)),
        ((0.0, 1.0, 2.0), (SMALLEST, 1.0, 2.0)),
        ((0.0, 1.0, 2.0), (0.0, 1.0)),
        ((0.0, 1.0, 2.0), (0.0, 1.0, math.inf)),
        ((0.0, 1.0, 2.0), 3.0),
    ],
    ("Trajectory", "coefficients"): [
        (np.ones((8, 2, 4)), np.ones(shape)) for shape in ((7, 2, 4), (8, 1, 4), (8, 2, 3), (8, 2))
    ]
    + [(np.ones((8, 2, 4)), np.full((8, 2, 4), bad)) for bad in (math.nan, math.inf, "1")],
    ("FlightConfiguration", "control_rate"): [
        (200.0, 200.0 * (1.0 + 2e-9)),
        (RAREST, RAREST / 2.0),
    ],
    ("FlightConfiguration", "layout"): [(Layout.ABSOLUTE, 3), (Layout.RELATIVE, "absolute")],
    ("FlightConfiguration", "source"): [(Source.MEASUREMENTS, 4), (Source.TRUTH, "truth")],
    ("FlightConfiguration", "control"): [(Control.PD, 6), (Control.MOTOR, "motor")],
    ("FlightConfiguration", "autoreset"): [(Autoreset.DISABLED, 4), (Autoreset.DISABLED, "off")],
    ("FlightConfiguration", "run_filter"): [(True, 1)],
    ("FlightConfiguration", "true_vehicle"): [(LAB, "lab"), (None, 1.0)],
    ("FlightConfiguration", "true_sensors"): [(quad_gym.sensor_suite("standard"), "standard")],
    **{(kind, "center_I"): within(1e4) for kind in ("Obstacle", "Wall", "Cylinder")},
    **{
        (kind, "shift_I"): [within(1e4)[1], ((1.0, 1.0, 0.0), (1.0, 1.0, below(0.0)))]
        for kind in ("Obstacle", "Wall", "Cylinder")
    },
    ("Wall", "size"): [((1.0, 1.0, 1e4), (1.0, 1.0, above(1e4))), ((1, 1, 1), (1, 1, 0.0))],
    ("WorldParams", "wind_I"): [((0.0, 0.0, 200.0), (0.0, 0.0, above(200.0)))],
    ("WorldParams", "geofence"): [(((0, 0, 0), (1, 1, 1)), ((0, 0, 0), (1, 1, 0)))],
}
"""Limits that follow from another rule of the class: of physics, or of another field."""
BY_HAND = {
    ("Clocks", "imu_rate"): "it must divide other rates: tests/unit/test_params.py",
    ("Clocks", "control_rate"): "it must divide the rate of the IMU: tests/unit/test_params.py",
    ("VehicleParams", "inertia"): "a matrix of a body: tests/unit/test_params.py",
    ("VehicleParams", "rotor_positions_B"): "they belong to the inertia: tests/unit/test_params.py",
}
"""Fields without a single limit, and where they are tested."""
FLOWN = FlightConfiguration(1, control=Control.CTBR)
WITHOUT_RULES = [
    *((FLOWN, "substeps", good, bad) for good, bad in wholes(1, 1000)),
    (FlightConfiguration(1), "gains", "tuned", "huge"),
    (FlightConfiguration(1), "gains", quad_gym.PDGains(), {"position": 5.0}),
    (TaskParams(kind="waypoints"), "gate_count", MAX_GATES, MAX_GATES + 1),
    *((TaskParams(kind="trajectory"), "trajectory", PATH, bad) for bad in (3, "nowhere.csv", [])),
    *(
        (quad_gym.WorldParams(), "obstacles", (quad_gym.Wall(),), bad)
        for bad in ("wall", [1.0], quad_gym.Wall())
    ),
]
"""Rows of fields that a class checks otherwise."""


def arguments_of(rule):
    """A field's rule without its arguments, the arguments, and True if the field may be None."""
    given, optional = {}, False
    while isinstance(rule, partial):
        if rule.func is _unless_none:
            rule, optional = rule.args[0], True
            continue
        given, rule = {**rule.keywords, **given}, rule.func
    return rule, given, optional


def examples():
    """An instance of each class of parameters."""
    found = {}

    def collect(value):
        if isinstance(value, Checked):
            found.setdefault(type(value), value)
            for field in dataclasses.fields(value):
                collect(getattr(value, field.name))

    collect(faults.MagnetometerDisturbance(how="iron"))  # the only form with a direction
    for name in ("rtk", "consumer", "crazyflie", "uwb", "indoor"):
        collect(quad_gym.sensor_suite(name))
    for kind in SENSOR_PARAMS.values():  # also those that no suite has yet
        collect(kind())
    collect(LAB)
    for kind in (
        quad_gym.ActionParams,
        quad_gym.PDGains,
        quad_gym.RewardParams,
        TaskParams,
        Clocks,
        quad_gym.WorldParams,
        quad_gym.BatteryParams,
        quad_gym.GroundParams,
        Obstacle,
        quad_gym.Wall,
        quad_gym.Cylinder,
        recipes.Recipe,
        recipes.Plan,
        crazyflie_pid.CrazyflieGains,
        *(getattr(faults, name) for name in faults.__all__),
    ):
        if isinstance(kind, type) and issubclass(kind, Checked) and kind not in (Fault, SensorLoss):
            collect(kind())
    for other in (
        SensorLoss(sensor="barometer"),
        quad_gym.Uniform(1.0, 2.0),
        quad_gym.LogUniform(1.0, 2.0),
        quad_gym.Normal(0.0, 1.0),
        PATH,
        FLOWN,
        EnvConfig.of({}, "hover"),
    ):
        collect(other)
    return found.values()


def table():
    """Rows (instance, name of a field, last good value, first bad value)."""
    rows = list(WITHOUT_RULES)
    for nominal in examples():
        for name, field_rule in type(nominal)._rules.items():
            key = type(nominal).__name__, name
            rule, given, optional = arguments_of(field_rule)
            if key in BY_HAND:
                continue
            if rule is check.instance:
                cases = [(getattr(nominal, name), 3.0)]
            else:
                cases = NARROWER.get(key) or KINDS[rule](**given)
            if optional:
                cases = [*cases, (None, "none")]
            one_task = type(nominal) is TaskParams and ONE_TASK_FIELDS.get(name)
            one = nominal.replace(kind=one_task) if one_task else nominal
            rows += [(one, name, good, bad) for good, bad in cases]
    return rows


TABLE = table()
FIELDS = {(type(nominal), name) for nominal, name, _, _ in TABLE}


def classes(kind=Checked):
    """All classes of parameters of the packages, without classes in tests."""
    for part in kind.__subclasses__():
        if part.__module__.partition(".")[0] in ("quad_gym", "baselines"):
            yield part
        yield from classes(part)


def test_table_has_every_field_with_a_rule():
    missing = [
        (kind.__name__, name)
        for kind in classes()
        for name in kind._rules
        if not any(issubclass(one, kind) and name == other for one, other in FIELDS)
    ]
    assert sorted(set(missing)) == sorted(BY_HAND)
    assert len(FIELDS) > 350
    used = {(kind.__name__, name) for kind, name in FIELDS}
    assert not [key for key in NARROWER if key not in used]


@pytest.mark.parametrize(
    "kind", sorted({kind for kind, _ in FIELDS}, key=lambda kind: kind.__name__)
)
def test_last_good_value_is_accepted_and_first_bad_one_refused(kind):
    for nominal, name, good, bad in TABLE:
        if type(nominal) is not kind:
            continue
        nominal.replace(**{name: good})
        with pytest.raises(ValueError) as error:  # noqa: PT011 - the message is compared below
            nominal.replace(**{name: bad})
        words = str(error.value)
        narrow = kind is quad_gym.VehicleParams  # whose fields depend on each other
        assert name in words.lower() or name in words or narrow, (name, bad, words)
        assert not kind._prefix or kind.__name__ in words, (name, bad, words)


def _without_address(value):
    """A value as text, the same in every process that collects the tests."""
    return type(value).__name__ if type(value) is object else repr(value)


NO_NUMBERS = ["fast", "3", b"3", True, np.True_, 3j, np.array([3.0]), [3.0], {}, object(), None]
NO_NUMBERS += [math.nan, math.inf, -math.inf, 10**400]
NO_VECTORS = [(1.0, 2.0), 1.0, "abc", b"abc", None, (1.0, 2.0, 3.0, 4.0), np.ones((3, 1)), {}]
NO_VECTORS += [(*(1.0, 2.0), bad) for bad in ("3", True, 3j, None, [3.0], math.nan, 10**400)]
NO_VECTORS += [np.ones(3, bool), np.ones(3, complex), [set()] * 3]


@pytest.mark.parametrize("rule", [check.number, check.positive, check.whole])
@pytest.mark.parametrize("bad", NO_NUMBERS, ids=_without_address)
def test_number_of_another_type_is_refused(rule, bad):
    with pytest.raises(ValueError, match=r"^it must be .*, got"):
        rule("it", bad)


@pytest.mark.parametrize(
    "rule", [partial(check.vector, length=3), check.place, partial(check.array, shape=(3,))]
)
@pytest.mark.parametrize("bad", NO_VECTORS, ids=repr)
def test_vector_of_another_type_or_shape_is_refused(rule, bad):
    with pytest.raises(ValueError, match=r"^it must be .*, got|^it must have shape \(3,\), got"):
        rule("it", bad)


def test_types_that_hold_real_numbers_are_accepted():
    for good in (3, np.float32(3), np.int64(3), np.array(3.0), np.uint8(3)):
        assert check.number("it", good) == 3.0
        assert isinstance(check.number("it", good), float)
    for good in ((1, 2, 3), [1, 2.0, np.float32(3)], np.arange(1, 4), np.arange(1.0, 4.0)[::1]):
        assert check.vector("it", good, 3) == (1.0, 2.0, 3.0)


RTK = quad_gym.sensor_suite("rtk")
BATTERY = quad_gym.WorldParams(battery=quad_gym.BatteryParams())
HOLDERS = {
    "vehicle": (LAB, lambda part: {"true_vehicle": part}),
    "world": (BATTERY, lambda part: {"world": part}),
    "battery": (BATTERY.battery, lambda part: {"world": BATTERY.replace(battery=part)}),
    "imu": (RTK.imu, lambda part: {"true_sensors": RTK.replace(imu=part)}),
    "gnss": (RTK.gnss, lambda part: {"true_sensors": RTK.replace(gnss=part)}),
    "antennas": (RTK.gnss, lambda part: {"true_sensors": RTK.replace(gnss=part)}),
    "camera": (RTK.camera, lambda part: {"true_sensors": RTK.replace(camera=part)}),
}
"""Nominal parts that can be drawn, and keywords of flights with such a part."""
DRAWN = [
    drawable
    for drawable in DRAWABLES
    if drawable.of in HOLDERS
    and hasattr(HOLDERS[drawable.of][0], drawable.field)
    and drawable.name not in ("inertia", "position_sigma_I")
]
"""Draws with the rules of their fields; others have their own: `contract/test_refused_input.py`."""


def accepted(name, **keywords):
    """True if flights are accepted; otherwise the error names the field."""
    try:
        FlightConfiguration(1, **{"sensors": RTK, "world": BATTERY, **keywords})
    except ValueError as error:
        words = str(error)
    else:
        return True
    assert name in words or "by mass" in words, words
    return False


@pytest.mark.parametrize("drawable", DRAWN, ids=lambda drawable: drawable.name)
def test_draw_of_one_value_is_accepted_where_the_value_itself_is(drawable):
    part, keywords = HOLDERS[drawable.of]
    nominal = np.array(getattr(part, drawable.field))
    for value in (*nominal.flat[:1], -1.0, 0.0, 1e-12, 0.05, 1.0, 99.0, 101.0, 1e15):
        draws = {drawable.name: quad_gym.Uniform(value, value)}
        try:
            whole = part.replace(**{drawable.field: np.full(nominal.shape, value)})
        except ValueError:
            expected = False
        else:
            expected = accepted(drawable.field, **keywords(whole))
        assert accepted(drawable.name, randomization=draws) == expected, value


def test_limit_in_steps_is_a_whole_number_up_to_a_billion():
    for good, bad in wholes(1, 10**9):
        EnvConfig.of({"max_episode_steps": good}, "hover")
        with pytest.raises(ValueError, match="max_episode_steps must be"):
            EnvConfig.of({"max_episode_steps": bad}, "hover")


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_angle_is_within_one_turn(side):
    turn = side * 2.0 * math.pi
    assert check.angle("yaw", turn) == turn
    with pytest.raises(ValueError, match=r"yaw must be in rad, within ±2 pi"):
        check.angle("yaw", side * above(2.0 * math.pi))
    with pytest.raises(ValueError, match=r"did you mean 1.571\?|did you mean -1.571\?"):
        check.angle("yaw", side * 90.0)

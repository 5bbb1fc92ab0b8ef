"""Limits of all fields of parameters: the last good value is accepted, the first bad one refused.

The table is made from the rules of the fields. Each kind of rule has its limits here a second time,
so that a rule that forgets one of them, or is off by the smallest step, is found.
"""

import dataclasses
import math
from functools import partial

import numpy as np
import pytest

import quad_gym
from quad_gym import TaskParams, faults
from quad_gym.faults import Fault, SensorLoss, _duration, span
from quad_gym.params import checks as check
from quad_gym.params.camera import _features
from quad_gym.params.checks import Checked, _unless_none
from quad_gym.params.uwb_range import _anchors
from quad_gym.params.vehicle import Clocks
from quad_gym.params.world import Obstacle
from quad_gym.records import MAX_FEATURES

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
    check.phase: lambda: [(0.0, below(0.0)), (below(1.0), 1.0), (None, "soon")],
    check.flag: lambda: [(True, 1), (False, "no"), (False, 0.0)],
    span: spans,
    _duration: lambda: [(math.inf, -math.inf), *spans(open_end=True)],
    _features: lambda: rows_of(MAX_FEATURES),
    _anchors: lambda: rows_of(8),
    check.choice: lambda choices: [(choices[-1], choices[-1].upper() + "x"), (choices[0], None)],
}
"""Limits of each kind of rule, from the arguments that a field gives to it."""

NEAR = 1.0 + 1e-9  #: factor beyond limits that follow from other numbers, and round
LAB = quad_gym.vehicle_params("lab")
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
        *(getattr(faults, name) for name in faults.__all__),
    ):
        if isinstance(kind, type) and issubclass(kind, Checked) and kind not in (Fault, SensorLoss):
            collect(kind())
    for other in (SensorLoss(sensor="barometer"), quad_gym.Uniform(1.0, 2.0)):
        collect(other)
    return found.values()


def table():
    """Rows (instance, name of a field, last good value, first bad value)."""
    rows = []
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
            rows += [(nominal, name, good, bad) for good, bad in cases]
    return rows


TABLE = table()
FIELDS = {(type(nominal), name) for nominal, name, _, _ in TABLE}


def test_table_has_every_field_with_a_rule():
    assert len(FIELDS) > 280
    assert len(TABLE) > 1000
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
        assert name in words or narrow, (name, bad, words)
        assert kind.__name__ in words, (name, bad, words)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_angle_is_within_one_turn(side):
    turn = side * 2.0 * math.pi
    assert check.angle("yaw", turn) == turn
    with pytest.raises(ValueError, match=r"yaw must be in rad, within ±2 pi"):
        check.angle("yaw", side * above(2.0 * math.pi))
    with pytest.raises(ValueError, match=r"did you mean 1.571\?|did you mean -1.571\?"):
        check.angle("yaw", side * 90.0)

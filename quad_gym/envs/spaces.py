"""Observation and action spaces, and the table of an observation's parts.

`observation_layout` is the only description of an observation; the kernel `observe` writes in this
order.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from quad_gym.configuration import FlightConfiguration
from quad_gym.params import checks as check
from quad_gym.params.sensor_table import READINGS
from quad_gym.params.suites import SensorSuite, given_suite
from quad_gym.params.world import WorldParams
from quad_gym.records import COLUMNS, MAX_OBSERVATION, Control, Layout, Source

if TYPE_CHECKING:
    from quad_gym.tasks import Task

OBSERVATIONS = {source.name.lower(): source for source in Source}
"""Values of the keyword `observation`."""

ACTIONS = {control.name.lower(): control for control in Control if control is not Control.PD}
"""Values of the keyword `action`."""

LAYOUTS = {"relative": Layout.RELATIVE, "absolute": Layout.ABSOLUTE}
"""Values of the keyword `layout`."""

OWN_LAYOUT = 'with observation="measurements", which has its own'
"""The case in which `layout` has no effect."""

Part = tuple[str, int, str, str, float]
"""Name, size, unit, frame and bound of one part of an observation."""

STATE_NAMES = ("position", "velocity", "attitude", "accel_bias", "gyro_bias")
"""The blocks of the estimated state, three numbers each."""


class ObservationField(NamedTuple):
    """One named part of an observation."""

    name: str  #: name of the part
    slice: slice  #: elements of the flat observation
    unit: str  #: unit of the elements, "-" without one
    frame: str  #: frame of the elements: I: inertial, B: body, C: image, "-": none
    low: float  #: lower bound, to which observations are clipped
    high: float  #: upper bound, to which observations are clipped


Table = tuple[ObservationField, ...]
"""The parts of an observation, in their order."""

_RELATIVE: tuple[Part, ...] = (
    ("position_error", 3, "m", "B", 100.0),
    ("velocity_error", 3, "m/s", "B", 100.0),
    ("up", 3, "-", "B", 1.0),
    ("heading", 3, "-", "B", 1.0),
    ("body_rates", 3, "rad/s", "B", 200.0),
    ("reference_acceleration", 3, "m/s^2", "B", 100.0),
    ("preview_1", 3, "m", "B", 100.0),
    ("preview_2", 3, "m", "B", 100.0),
)
_REFERENCE: tuple[Part, ...] = (
    ("reference_position", 3, "m", "I", 1000.0),
    ("reference_velocity", 3, "m/s", "I", 100.0),
    ("reference_acceleration", 3, "m/s^2", "I", 100.0),
    ("reference_heading", 3, "-", "I", 1.0),
    ("preview_1", 3, "m", "I", 1000.0),
    ("preview_2", 3, "m", "I", 1000.0),
)
_ABSOLUTE: tuple[Part, ...] = (
    ("position", 3, "m", "I", 1000.0),
    ("velocity", 3, "m/s", "I", 200.0),
    ("R_BI", 9, "-", "I to B", 1.0),
    ("accel_bias", 3, "m/s^2", "B", 100.0),
    ("gyro_bias", 3, "rad/s", "B", 10.0),
    ("body_rates", 3, "rad/s", "B", 200.0),
    *_REFERENCE,
)
_PRIVILEGED: tuple[Part, ...] = (
    ("true_position_error", 3, "m", "B", 100.0),
    ("true_velocity_error", 3, "m/s", "B", 100.0),
    ("true_up", 3, "-", "B", 1.0),
    ("true_heading", 3, "-", "B", 1.0),
    ("true_body_rates", 3, "rad/s", "B", 200.0),
    ("true_accel_bias", 3, "m/s^2", "B", 100.0),
    ("true_gyro_bias", 3, "rad/s", "B", 10.0),
    ("rotor_speeds", 4, "of hover", "-", 20.0),
)
PRIVILEGED_NAMES = frozenset(name for name, *_ in _PRIVILEGED)
"""Names by which the privileged part of a table is recognized; parts of a user's task must not have
them."""
_LAST_ACTION: Part = ("last_action", 4, "-", "-", 1.0)
_FLAG = 0.0  #: bound that marks a flag, in [0, 1]


def _sensor_fields(suite: SensorSuite) -> tuple[Part, ...]:
    fields = [
        ("gyro", 3, "rad/s", "B", 200.0),
        ("accel", 3, "m/s^2", "B", 1000.0),
        ("gyro_mean", 3, "rad/s", "B", 200.0),
        ("accel_mean", 3, "m/s^2", "B", 1000.0),
    ]
    for name, reading in READINGS.items():
        count = suite.blocks_of(name) or int(reading.marked)
        for k in range(count):
            block = reading.name_of(k)
            fields.append((block, reading.length, *reading.raw))
            fields.append((f"{block}_valid", 1, "0 or 1", "-", _FLAG))
    return (*fields, *_REFERENCE)


def _world_fields(drawn: Sequence[str], suite: SensorSuite) -> tuple[Part, ...]:
    sizes = {name: columns.stop - columns.start for name, columns in COLUMNS.items()}
    sizes["feature_offsets_I"] = 3 * suite.blocks_of("pixels")
    drawn_sizes = ((name, size) for name, size in sizes.items() if name in drawn)
    parts = ((f"drawn_{name}", size, "of its spread", "-", 10.0) for name, size in drawn_sizes)
    return (("wind", 3, "m/s", "B", 100.0), *parts)


def observation_layout(
    observation: str = "estimate",
    layout: str | None = None,
    *,
    include_std: bool = False,
    privileged: bool = False,
    sensors: SensorSuite | str = "standard",
    drawn: Sequence[str] | None = None,
) -> Table:
    """Return the table of an observation: name, slice, unit, frame and bounds of each part.

    Args:
        observation: The environment's `observation`; "measurements" has its own layout.
        layout: The environment's `layout`; None: "relative".
        include_std: True: append the filter's 15 standard deviations.
        privileged: True: append the truth. Its slices continue the numbering, although the
            environment returns this part under a separate key.
        sensors: The environment's `sensors`, which "measurements" and drawn features depend on.
        drawn: Names of the parameters drawn in every episode, see `quad_gym.Randomization`: the
            truth ends with the wind and the draws. None: it does not, as in a calm world without
            draws.

    Returns:
        The table.

    Raises:
        ValueError: If a name is unknown, or `layout` or `drawn` has no effect.
    """
    check.choice("observation", observation, tuple(OBSERVATIONS))
    check.choice("layout", "relative" if layout is None else layout, tuple(LAYOUTS))
    suite = given_suite("sensors", sensors)
    raw = observation == "measurements"
    without = {"layout": OWN_LAYOUT} if raw else {}
    if not privileged:
        without["drawn"] = "with privileged=False"
    given = {"layout": layout, "drawn": drawn}
    check.effect({name: value for name, value in given.items() if value is not None}, without)
    for name in drawn or ():
        check.choice("drawn", name, tuple(COLUMNS))
    numbered = Layout.MEASUREMENTS if raw else LAYOUTS[layout or "relative"]
    return _table(numbered, suite, include_std, privileged, drawn)


def table_of(c: FlightConfiguration) -> Table:
    """Return the table of the observations of flights."""
    drawn = c.randomization.names
    calm = not drawn and c.world == WorldParams()  # and then no draw and no wind is shown
    return _table(c.layout, c.sensors, c.include_std, c.privileged, None if calm else drawn)


def _table(
    layout: Layout,
    suite: SensorSuite,
    include_std: bool,
    privileged: bool,
    drawn: Sequence[str] | None,
) -> Table:
    """Return the table of an observation, see `observation_layout`."""
    states = {Layout.RELATIVE: _RELATIVE, Layout.ABSOLUTE: _ABSOLUTE}
    parts = (*(states.get(layout) or _sensor_fields(suite)), _LAST_ACTION)
    if include_std:
        units = ("m", "m/s", "rad", "m/s^2", "rad/s")
        frames = ("I", "I", "B", "B", "B")
        parts += tuple(
            (f"{name}_sigma", 3, unit, frame, 1000.0)
            for name, unit, frame in zip(STATE_NAMES, units, frames, strict=True)
        )
    if privileged:
        parts += _PRIVILEGED + (() if drawn is None else _world_fields(drawn, suite))
    fields = []
    for name, size, unit, frame, bound in parts:
        low, high = (0.0, 1.0) if bound == _FLAG else (-bound, bound)
        fields.append(ObservationField(name, slice(0, size), unit, frame, low, high))
    return _numbered(fields)


def _numbered(fields: Iterable[ObservationField]) -> Table:
    """Return parts as a table, in which the slice of each begins where the one before it ends."""
    table, first = [], 0
    for field in fields:
        end = first + field.slice.stop - field.slice.start
        table.append(field._replace(slice=slice(first, end)))
        first = end
    return tuple(table)


def table_with_task(
    table: Table, task: "Task", sizes: Mapping[str, int]
) -> tuple[Table, list[int]]:
    """Return the table of observations with the parts of a user's task.

    Args:
        table: Table of the built-in observation.
        task: The task, whose parts follow the built-in ones that it keeps.
        sizes: Sizes of the arrays that its `observe` returns, by name.

    Returns:
        The table, and the columns of the built-in observation for the policy that it has kept.

    Raises:
        ValueError: If parts of the task have names of built-in ones, or do not exist.
    """
    from quad_gym.tasks.task import ObservationSpec

    unknown = sorted(set(task.observes) - set(sizes))
    if unknown:
        raise ValueError(f"observes has {unknown[0]!r}, which observe does not return")
    split = policy_size(table)
    kept = [
        field
        for field in table
        if field.slice.stop <= split and (not task.replaces_observation or field.name in task.keeps)
    ]
    truth = [field for field in table if field.slice.start >= split]
    taken = ({field.name for field in (*kept, *truth)} | PRIVILEGED_NAMES) & set(sizes)
    if taken:
        raise ValueError(f"observe must not return {min(taken)!r}, a name of a built-in part")
    plain = ObservationSpec()
    own = [
        ObservationField(name, slice(0, size), *task.observes.get(name, plain))
        for name, size in sizes.items()
    ]
    new = _numbered([*kept, *own, *truth])
    if not new:
        raise ValueError("observe must return something where it replaces the observation")
    return new, [k for field in kept for k in range(field.slice.start, field.slice.stop)]


def layout_bounds(table: Table) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the bounds (low, high) of every number of an observation, (n,) each."""
    size = table[-1].slice.stop
    if size > MAX_OBSERVATION:
        raise ValueError(f"an observation must have at most {MAX_OBSERVATION} numbers, got {size}")
    low, high = np.empty((2, size))
    for field in table:
        low[field.slice], high[field.slice] = field.low, field.high
    return low, high


def observation_space(table: Table) -> spaces.Box | spaces.Dict:
    """Return the space of a table: a Box, or a Dict of two with a privileged part."""
    low, high = (bound.astype(np.float32) for bound in layout_bounds(table))
    split = policy_size(table)
    policy = spaces.Box(low[:split], high[:split], dtype=np.float32)
    if split == len(low):
        return policy
    truth = spaces.Box(low[split:], high[split:], dtype=np.float32)
    return spaces.Dict({"policy": policy, "privileged": truth})


def policy_size(table: Table) -> int:
    """Return the number of elements of an observation for the policy; the rest is privileged."""
    for field in table:
        if field.name == _PRIVILEGED[0][0]:
            return int(field.slice.start)
    return int(table[-1].slice.stop)


def action_space() -> spaces.Box:
    """Return the space of actions: four numbers in [-1, 1]."""
    return spaces.Box(-1.0, 1.0, (4,), np.float32)

"""Means of NEES and NIS in many configurations.

Every suite flies every task, from a cold and from a warm start. On one task, every suite also flies
with temporary faults, other latencies and mountings, randomization with and without the drawn
values in the filter, random starts, and wind. A value is the mean over all flights and instants. It
is a miss if it is outside the 95 % band of the mean at one instant, which is conservative: the mean
over instants varies less. Misses are expected if the filter's model differs from the simulation.
"""

import math
from collections.abc import Iterator
from typing import Any, Literal

from quad_gym.analysis.consistency import PARTS, SENSOR_BLOCKS
from quad_gym.analysis.metrics import chi_square_band
from quad_gym.commands.consistency import Case, CaseFlights, fly
from quad_gym.envs.config import TASK_DEFAULTS
from quad_gym.faults import PRESETS, possible
from quad_gym.params.randomization import Randomization, Uniform
from quad_gym.params.suites import SensorSuite, sensor_suite
from quad_gym.records import FREEDOMS
from scripts.consistency.tables import FLOWN, CaseResults, case_table, vehicle_of

STARTS: tuple[Literal["cold", "warm"], ...] = ("cold", "warm")
CONDITIONS_TASK = "random_trajectory"
COLUMN_FREEDOMS = {name: part.stop - part.start for name, part in PARTS.items()} | {
    f"nis_{name}": FREEDOMS[blocks[0]] for name, blocks in SENSOR_BLOCKS.items()
}
"""Degrees of freedom, by column: the means of a consistent filter."""

_LEVER_ARM = (0.05, 0.02, 0.03)
_DISPLACED = Uniform(-0.01, 0.01)


def case_of(
    suite: str,
    task: str,
    start: Literal["cold", "warm"],
    condition: str = "nominal",
    wrong: str = "",
    sensors: SensorSuite | None = None,
    **keywords: Any,
) -> Case:
    """One configuration; `wrong` is a difference between the filter's model and the simulation."""
    flown = sensors or sensor_suite(suite)
    keywords = vehicle_of(suite) | keywords
    expected = {}
    if suite == "lab":
        expected = {"": "the report's filter"}
    elif wrong:
        expected = {"": wrong}
    else:
        if flown.counted_as_noise:
            expected["nis_baseline"] = "counts constant heading errors as noise"
        if flown.imu.accel_error_noise > 0.0 and (task == "waypoints" or "world" in keywords):
            reason = "counts errors of scale as noise"
            expected |= {"velocity": reason, "accel_bias": reason}
    return Case(f"{suite}, {task}, {start}, {condition}", flown, task, start, keywords, expected)


def _late(suite: SensorSuite, periods: int) -> SensorSuite:
    """Suite with latencies of some periods of each sensor."""
    aids = {aid.name.lower(): params for aid, params in suite.aids.items()}
    sensors = {"gnss": suite.gnss, "camera": suite.camera, **aids}
    given = {name: params for name, params in sensors.items() if params is not None}
    return suite.replace(**{k: p.replace(latency=periods / p.rate) for k, p in given.items()})


def _draws(suite: SensorSuite) -> dict[str, Any]:
    """Random noise of the sensors and random mass."""
    names = {"accel_noise_density", "gyro_noise_density"}
    if suite.gnss is not None:
        names |= {"position_sigma_I"} | ({"baseline_sigma"} if suite.gnss.has_baseline else set())
    names |= {"pixel_sigma"} if suite.camera is not None else set()
    return {name: Uniform(1.0, 2.0, relative=True) for name in sorted(names)} | {
        "mass": Uniform(0.8, 1.2, relative=True)
    }


def _mounting(suite: SensorSuite) -> dict[str, Any]:
    """Random errors of the mounting of the sensors."""
    found: dict[str, Any] = {"lever_arm_B": _DISPLACED}
    if suite.gnss is not None:
        found["primary_antenna_B"] = Uniform(-0.01, 0.01, offset=True)
    if suite.camera is not None:
        found["camera_rotation"] = _DISPLACED
    return found


def _conditions(name: str) -> Iterator[dict[str, Any]]:
    """Arguments of `case_of` for the conditions of a suite."""
    suite = sensor_suite(name)
    for fault, parts in PRESETS.items():
        ends = parts and all(getattr(part, "duration", math.inf) != math.inf for part in parts)
        if ends and possible(fault, suite):
            corrupts = fault in ("gnss_jump", "magnetometer_disturbance")
            corrupted = "corrupted measurements" if corrupts else ""
            yield {"condition": fault, "wrong": corrupted, "faults": fault}
    for periods, text in enumerate(("no latency", "one period late", "two periods late")):
        yield {"condition": text, "sensors": _late(suite, periods)}
    arm = suite.replace(imu=suite.imu.replace(lever_arm_B=_LEVER_ARM))
    yield {"condition": "lever arm", "sensors": arm}
    for drawn, draws in (("mounting", _mounting(suite)), ("noise and mass", _draws(suite))):
        for word, wrong in (("known", ""), ("unknown", f"unknown {drawn}")):
            randomization = Randomization(draws, known=not wrong)
            condition = f"{drawn} drawn, {word}"
            yield {"condition": condition, "wrong": wrong, "randomization": randomization}
    starts = {name: Uniform(-0.1, 0.1) for name in ("start_roll", "start_pitch", "start_yaw")}
    starts["start_velocity_I"] = Uniform(-0.5, 0.5)
    yield {"condition": "start drawn", "randomization": Randomization(starts)}
    yield {"condition": "fresh breeze", "world": "fresh_breeze"}


def cases_of(kind: str) -> list[Case]:
    """Cases: "suites" on all tasks, "conditions" on one task, or "all" of these."""
    suites = [case_of(s, task, start) for s in FLOWN for task in TASK_DEFAULTS for start in STARTS]
    conditions = [
        case_of(suite, CONDITIONS_TASK, start, **fields)
        for suite in FLOWN
        for start in STARTS
        for fields in _conditions(suite)
    ]
    return {"suites": suites, "conditions": conditions, "all": suites + conditions}[kind]


def measure(case: Case, flights: CaseFlights) -> dict[str, Any]:
    """Fly a case: values by column, misses, and the configuration."""
    batch = case.batch(flights.count, flights.threads)
    found = fly(batch, flights, every=0.1)
    values = {name: part.overall for name, part in found.nees.items()}
    values |= {f"nis_{name}": part.overall for name, part in found.nis.items()}
    misses = [
        name
        for name, value in values.items()
        if not chi_square_band(COLUMN_FREEDOMS[name], flights.count).holds(value)
    ]
    return {
        "values": values,
        "misses": misses,
        "expected": case.expected,
        "filters_failed": found.failed,
        "flights_astray": int(found.astray.sum()),
        "sensors": batch.sensors,
        "task": batch.task,
        "world": batch.world,
        "faults": batch.faults,
        "randomization": batch.randomization,
    }


def table_of(cells: CaseResults, flights: CaseFlights) -> str:
    """Format the matrix in Markdown: misses bold, or in italics if they are expected."""
    bands = [chi_square_band(n, flights.count) for n in COLUMN_FREEDOMS.values()]
    band = ["95 % band", *(f"{low:.2f} to {high:.2f}" for low, high in bands), ""]
    columns = {name: name.removeprefix("nis_") for name in COLUMN_FREEDOMS}
    first = "suite, task, start, condition"
    lines = [
        f"Mean of NEES, then NIS, over {flights.count} flights. In a consistent filter:",
        "",
        *case_table(first, columns, cells, _text, band),
        "",
        "**Bold**: a miss. *Italics*: a miss that is expected, for the reason given.",
    ]
    return "\n".join(lines) + "\n"


def _text(value: float) -> str:
    return f"{value:.3g}" if value >= 100 else f"{value:.2f}"

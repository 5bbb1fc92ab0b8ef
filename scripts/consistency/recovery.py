"""Recovery of filters after faults, and their false alarms.

Every suite flies each preset fault that it can have. A fault starts at `FAULT_START` and, unless it
is instantaneous, ends after `FAULT_DURATION`; flights are evaluated `RECOVERY_TIME` later. See
`scripts.consistency.recovered` for the definitions. For the rate of false alarms, every suite also
flies without a fault. `scripts.consistency.causes` explains undetected failures.
"""

import math
from collections.abc import Iterator
from typing import Any

from quad_gym.commands.consistency import Case, CaseFlights
from quad_gym.faults import (
    PRESETS,
    AccelBiasStep,
    Fault,
    GnssOutage,
    GyroBiasStep,
    MagnetometerDisturbance,
    PositionJump,
    possible,
)
from quad_gym.params.suites import SensorSuite, sensor_suite
from scripts.consistency.recovered import (
    REQUIRED,
    Recovery,
    follow_recovery,
    measured_coordinates,
)
from scripts.consistency.tables import FLOWN, CaseResults, case_table, vehicle_of

FAULT_START, FAULT_DURATION, RECOVERY_TIME = 3.0, 5.0, 10.0
"""Start and duration of faults, and time that filters have to recover [s]."""
STEP_OF_GYRO, DURING_OUTAGE = "gyro step of 1 deg/s", "gnss_outage with imu_bias_step"
"""Names of two faults that are no presets."""
LONG = 15.0  #: duration of long losses of a sensor, after which priors are wide [s]
CALM_TASKS = ("hover", "random_trajectory", "waypoints")
CALM_DURATION = 60.0  #: length of flights without a fault [s]
INSTANTANEOUS = (AccelBiasStep, GyroBiasStep, PositionJump)  #: faults that end at once

COLUMNS = {
    "consistent_at_end": "consistent at its end [%]",
    "consistent": "consistent 10 s later [%]",
    "flagged": "inconsistent, flagged [%]",
    "undetected": "undetected failures [%]",
    "settling_time": "99 % consistent or flagged after [s]",
    "large_error": "large error for 2 s [%]",
    "missed": "never flagged in that time [%]",
}
CALM_COLUMNS = {
    "alarms_per_hour": "alarms per hour",
    "flagged": "time flagged [%]",
    "hours": "flown [h]",
}


def end_of(faults: tuple[Fault, ...]) -> float:
    """End of the last of some faults [s]."""
    return max(
        float(fault.start) + (0.0 if isinstance(fault, INSTANTANEOUS) else float(fault.duration))  # type: ignore[arg-type]
        for fault in faults
    )


def _timed(fault: Fault) -> Fault:
    """Preset fault with the times of this experiment."""
    times = {} if isinstance(fault, INSTANTANEOUS) else {"duration": FAULT_DURATION}
    return fault.replace(rate=0.0, start=FAULT_START, **times)  # type: ignore[no-any-return]


def cases() -> Iterator[Case]:
    """Every suite with every fault that it can have, and without faults."""
    catalog = {name: tuple(map(_timed, parts)) for name, parts in PRESETS.items() if parts}
    middle = FAULT_START + 0.5 * FAULT_DURATION
    catalog |= {
        f"{name} of {LONG:g} s": tuple(part.replace(duration=LONG) for part in parts)
        for name, parts in catalog.items()
        if name.endswith(("_loss", "_outage")) and name not in ("rotor_loss", "baseline_loss")
    }
    field: dict[str, Any] = {"start": FAULT_START, "duration": FAULT_DURATION}
    catalog |= {
        "magnetometer near iron": (MagnetometerDisturbance(how="iron", **field),),
        "magnetometer frozen": (MagnetometerDisturbance(how="frozen", **field),),
        STEP_OF_GYRO: (GyroBiasStep(start=FAULT_START, size=math.radians(1.0)),),
        DURING_OUTAGE: (
            GnssOutage(start=FAULT_START, duration=FAULT_DURATION),
            AccelBiasStep(start=middle),
            GyroBiasStep(start=middle),
        ),
    }
    for name in FLOWN:
        suite = sensor_suite(name)
        for fault, parts in catalog.items():
            if possible(parts, suite):
                keywords, expected = {"faults": parts} | vehicle_of(name), reason(suite, parts)
                yield Case(f"{name}, {fault}", suite, CALM_TASKS[1], "warm", keywords, expected)
    for name in FLOWN:
        for task in CALM_TASKS:
            yield Case(f"{name}, {task}", sensor_suite(name), task, "warm", vehicle_of(name))


def reason(suite: SensorSuite, faults: tuple[Fault, ...]) -> dict[str, str]:
    """Reason for which a filter cannot recover from faults, by column; empty if it can."""
    if suite.estimator.false_alarm_probability == 0.0:
        return {"": "no gate, so it cannot correct itself"}
    measured, kinds = measured_coordinates(suite), tuple(map(type, faults))
    if PositionJump in kinds and 0 not in measured:
        return {"undetected": "no sensor measures the horizontal position"}
    if GyroBiasStep in kinds and 8 not in measured:
        return {"undetected": "no sensor measures the heading"}
    return {}


def measure(case: Case, flights: CaseFlights) -> dict[str, Any]:
    """Fly a case: values by column, and the configuration."""
    faults = case.keywords.get("faults")
    batch = case.batch(flights.count, flights.threads)
    duration = end_of(faults) + RECOVERY_TIME if faults else CALM_DURATION
    found = follow_recovery(batch, seeds=flights.seeds, duration=duration)
    flagged = 100.0 * found.flagged.mean()
    calm = (found.alarms() / found.hours, flagged, found.hours)
    values: dict[str, float] = dict(zip(CALM_COLUMNS, calm, strict=True))
    if faults:
        values = _after_faults(found, end_of(faults), duration)
    undetected = values.get("undetected", 0.0)
    return {
        "values": values,
        "misses": ["undetected"] if undetected > 100.0 * (1.0 - REQUIRED) + 1e-9 else [],
        "expected": case.expected,
        "filters_failed": int((batch.record("filter_status") != 0).sum()),
        "sensors": batch.sensors,
        "task": batch.task,
        "faults": batch.faults,
    }


def _after_faults(found: Recovery, fault_end: float, end: float) -> dict[str, float]:
    """Values of `COLUMNS`."""
    flagged = found.flagged & ~found.consistent
    return {
        "consistent_at_end": 100.0 * found.share(found.consistent, fault_end),
        "consistent": 100.0 * found.share(found.consistent, end),
        "flagged": 100.0 * found.share(flagged, end),
        "undetected": 100.0 * found.share(found.undetected, end),
        "settling_time": found.time_to(~found.undetected, fault_end),
        "large_error": 100.0 * float(found.long_large_error().mean()),
        "missed": 100.0 * float(found.missed_alarms().mean()),
    }


def table_of(cells: CaseResults, flights: CaseFlights) -> str:
    """Format two tables in Markdown: after faults, and without faults."""
    after = f"{flights.count} flights each, on random trajectories, warm start."
    calm = f"Without a fault, {flights.count} flights of {CALM_DURATION:g} s each."
    tables = {after: ("suite, fault", COLUMNS), calm: ("suite, task", CALM_COLUMNS)}
    parts, text = [], "{:.1f}".format
    for title, (first, columns) in tables.items():
        chosen = {k: cell for k, cell in cells.items() if cell["values"].keys() == columns.keys()}
        if chosen:
            parts.append("\n".join([title, "", *case_table(first, columns, chosen, text)]))
    end = "**Bold**: more than 1 % undetected failures. *Italics*: the same, expected."
    return "\n\n".join([*parts, end]) + "\n"

"""Causes of undetected failures after faults, and sensors with which they are rare.

Each row is a suite and a fault of `scripts.consistency.recovery` with many undetected failures. Its
flights are repeated with one more sensor, or a better one. A cause has a column: no sensor measures
the wrong quantity, the measurements have too little evidence for any test
(`scripts.consistency.evidence`), or the filter was flagged, but has corrected too little.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from quad_gym.commands.consistency import Case, CaseFlights
from quad_gym.params.suites import SensorSuite, sensor_suite
from scripts.consistency import recovery
from scripts.consistency.evidence import REQUIRED, evidence_of
from scripts.consistency.recovered import follow_recovery
from scripts.consistency.recovery import DURING_OUTAGE, FAULT_START, RECOVERY_TIME, STEP_OF_GYRO
from scripts.consistency.tables import CaseResults, case_table

COLUMNS = {
    "undetected": "undetected failures [%]",
    "in_measured": "of these, in a measured quantity [%]",
    "faint": "of these, too faint for an ideal test [%]",
    "flagged_before": "of these, flagged before [%]",
    "remedied": "undetected failures with the remedy [%]",
}
REMEDIES = {
    ("crazyflie", "position_jump"): ("uwb_range", "uwb"),
    ("crazyflie", "imu_bias_step"): ("magnetometer", "consumer"),
    ("crazyflie", STEP_OF_GYRO): ("magnetometer", "consumer"),
    ("uwb", "imu_bias_step"): ("magnetometer", "consumer"),
    ("uwb", STEP_OF_GYRO): ("magnetometer", "consumer"),
    ("field", "imu_bias_step"): ("magnetometer", "consumer"),
    ("field", STEP_OF_GYRO): ("magnetometer", "consumer"),
    ("field", DURING_OUTAGE): ("magnetometer", "consumer"),
}
"""A sensor, and the suite that it is taken from, by suite and fault."""


def remedied(suite: str, fault: str) -> SensorSuite:
    """A suite with the sensor of `REMEDIES`."""
    sensor, source = REMEDIES[suite, fault]
    return sensor_suite(suite).replace(**{sensor: getattr(sensor_suite(source), sensor)})


def cases() -> Iterator[Case]:
    """The cases of `REMEDIES`."""
    known = {case.name: case for case in recovery.cases()}
    for suite, fault in REMEDIES:
        yield known[f"{suite}, {fault}"]


def measure(case: Case, flights: CaseFlights) -> dict[str, Any]:
    """Fly a case: values by column, and the configuration."""
    suite, fault = case.name.split(", ")
    duration = recovery.end_of(case.keywords["faults"]) + RECOVERY_TIME
    fly: dict[str, Any] = {"seeds": flights.seeds, "duration": duration}
    batch = case.batch(flights.count, flights.threads)
    found = follow_recovery(batch, **fly)
    failed = found.undetected[-1]
    causes = {
        "in_measured": ~found.consistent_in_measured[-1],
        "faint": evidence_of(case, **fly, threads=flights.threads) < REQUIRED,
        "flagged_before": found.flagged_since(FAULT_START),
    }
    better = replace(case, sensors=remedied(suite, fault)).batch(flights.count, flights.threads)
    shares = {name: flags[failed].mean() if failed.any() else 0.0 for name, flags in causes.items()}
    shares["undetected"] = failed.mean()
    shares["remedied"] = follow_recovery(better, **fly).undetected[-1].mean()
    sensor, source = REMEDIES[suite, fault]
    return {
        "values": {name: 100.0 * float(shares[name]) for name in COLUMNS},
        "misses": [],
        "expected": {"": f"{sensor} of {source}"},
        "filters_failed": 0,
        "sensors": batch.sensors,
        "task": batch.task,
        "faults": batch.faults,
    }


def table_of(cells: CaseResults, flights: CaseFlights) -> str:
    """Format the table in Markdown."""
    lines = case_table("suite, fault", COLUMNS, cells, "{:.1f}".format)
    head = f"{flights.count} flights each, on random trajectories. Remarks: the remedy."
    return "\n".join([head, "", *lines]) + "\n"

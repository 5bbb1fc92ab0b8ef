"""Effects of filter corrections and of model mismatch on consistency and errors."""

import math
import sys
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any, Literal

import numpy as np

from quad_gym.analysis.consistency import PARTS, Findings
from quad_gym.analysis.reports import text_table
from quad_gym.commands.benchmark import by_turns, lasting
from quad_gym.commands.consistency import Case, CaseFlights, fly
from quad_gym.params.suites import SensorSuite, sensor_suite
from quad_gym.params.vehicle import vehicle_params
from quad_gym.params.world import WorldParams, world_params
from scripts.consistency.tables import CaseResults

SETTLED = 1.0  #: time from which errors count [s]


def cases_of(table: str, suite: SensorSuite, start: Literal["cold", "warm"]) -> list[Case]:
    """Cases of a table: "models" (mismatch) or "filters" (corrections)."""
    cases = _filters(suite) if table == "filters" else _models(suite)
    return [Case(name, sensors, start=start, keywords=more) for name, sensors, more in cases]


Fields = tuple[str, SensorSuite, Mapping[str, Any]]  #: name, sensor suite and keywords of a case


def _models(suite: SensorSuite) -> Iterator[Fields]:
    """The model that the filter assumes, then others."""
    yield "nominal", suite, {}
    nominal, breeze = vehicle_params("lab"), world_params("breeze")
    for name, field, factor in (
        ("mass 20 % less", "mass", 0.8),
        ("mass 20 % more", "mass", 1.2),
        ("motor time constant 0.1 s (assumed 0.05 s)", "motor_time_constant", 2.0),
        ("thrust 10 % less", "thrust_coefficient", 0.9),
    ):
        true = nominal.replace(**{field: factor * getattr(nominal, field)})
        yield name, suite, {"true_vehicle": true}
    for speed in (4.0, 8.0):
        steady = WorldParams(wind_I=(speed, 0.0, 0.0), linear_drag_B=breeze.linear_drag_B)
        yield f"steady wind of {speed:g} m/s", suite, {"world": steady}
    for world in ("breeze", "fresh_breeze"):
        yield f'`world="{world}"`', suite, {"world": world_params(world)}
    for name, true_sensors in _sensors(suite).items():
        yield name, suite, {"true_sensors": true_sensors}


def _sensors(suite: SensorSuite) -> dict[str, SensorSuite]:
    """True sensors that differ from the filter's model."""
    imu, gnss, camera = suite.imu, suite.gnss, suite.camera
    found = {
        "IMU noise doubled": _off(imu, "accel_noise_density", "gyro_noise_density", scale=2.0),
        "IMU biases tripled": _off(imu, "accel_bias_sigma", "gyro_bias_sigma", scale=3.0),
        "IMU displaced by 5 cm": _off(imu, "lever_arm_B", by=(0.05, 0.0, 0.0)),
    }
    if gnss is not None:
        sigmas = ("position_sigma_I", "baseline_sigma", "velocity_sigma")
        antennas = ("primary_antenna_B", "secondary_antenna_B")
        found["GNSS noise doubled"] = _off(gnss, *sigmas, scale=2.0)
        found["antennas displaced by 2 cm"] = _off(gnss, *antennas, by=(0.0, 0.02, 0.0))
    if camera is not None:
        turn = (0.0, 0.0, math.radians(0.5))
        found["pixel noise doubled"] = _off(camera, "pixel_sigma", scale=2.0)
        found["camera turned by 0.5 degrees"] = _off(camera, "attitude", by=turn)
    kinds = {type(imu): "imu", type(gnss): "gnss", type(camera): "camera"}
    return {name: suite.replace(**{kinds[type(p)]: p}) for name, p in found.items()}


def _off(params: Any, *names: str, scale: float = 1.0, by: Any = 0.0) -> Any:
    """Parameters of a sensor with some scaled and moved, as far as they are given."""
    given = {name: getattr(params, name) for name in names}
    changed = {k: (scale * np.array(v) + by).tolist() for k, v in given.items() if v is not None}
    return params.replace(**changed)


def _filters(suite: SensorSuite) -> Iterator[Fields]:
    """UKF and EKF of a suite, and the UKF without each correction."""
    sampled = suite.imu.replace(samples="instant")
    forms: dict[str, dict[str, Any]] = {
        "UKF": {"kind": "ukf"},
        "EKF": {"kind": "ekf"},
        "UKF, no attitude reset": {"attitude_reset": False},
        "UKF, IMU zero-order hold": {"integration": "euler"},
    }
    if suite.camera is not None:
        forms["UKF, no recursive image update"] = {"recursive_update_threshold": None}
        across = {"bearing_noise_at": "measured"}
        forms["UKF, bearing noise at the measured direction"] = across
    start = {"initial_tilt_sigma": None, "initial_covariance_scale": 2.0, "reuse_first_fix": True}
    forms["UKF, the report's initialization"] = start
    for name, changes in forms.items():
        imu = sampled if "integration" in changes else suite.imu
        yield name, suite.replace(imu=imu, estimator=suite.estimator.replace(**changes)), {}
    report = sensor_suite("lab").estimator
    yield "UKF, all of the report's form", suite.replace(imu=sampled, estimator=report), {}


def run_ablation(table: str, cases: list[Case], flights: CaseFlights) -> CaseResults:
    """Fly all cases; with "filters", also time a tick of each."""
    rows: CaseResults = {}
    for number, case in enumerate(cases, 1):
        print(f"  {number} of {len(cases)}: {case.name}", file=sys.stderr, flush=True)
        rows[case.name] = row_of(fly(case.batch(flights.count, flights.threads), flights))
    if table == "filters":
        times = _time_ticks(cases)
        for row, seconds in zip(rows.values(), times, strict=True):
            row["seconds_per_tick"], row["relative_cost"] = seconds, seconds / times[0]
    return rows


def _time_ticks(cases: list[Case]) -> list[float]:
    """Shortest time of a tick of one flight in each case, measured in alternation [s]."""
    count = 128
    batches = [case.batch(count, 1) for case in cases]
    for batch in batches:
        batch.reset(seeds=range(count))
    jobs = [partial(lasting, batch.step, 8) for batch in batches]
    return [timing.best / count for timing in by_turns(jobs, 100)]


def row_of(findings: Findings) -> dict[str, float]:
    """Results of a case."""
    squares = (findings.errors**2)[findings.nees["state"].time >= SETTLED]
    rms = {
        f"rms_{name}": float(np.sqrt(squares[:, part].sum(axis=1).mean()))
        for name, part in PARTS.items()
        if name != "state"
    }
    nees = {f"nees_{name}": part.overall for name, part in findings.nees.items()}
    inside = {f"inside_{name}": part.share_inside for name, part in findings.nees.items()}
    tracked = findings.tracking.spreads(~findings.astray)
    tracking = {name: part.mean for name, part in tracked.items()}
    counts = {"astray": int(findings.astray.sum()), "failed": findings.failed}
    return {**nees, **inside, **rms, **{f"tracking_{k}": v for k, v in tracking.items()}, **counts}


def table_of(table: str, rows: CaseResults) -> str:
    """Format the table for the screen."""
    errors = {
        "position [mm]": ("rms_position", 1e3, 1),
        "attitude [mrad]": ("rms_attitude", 1e3, 1),
        "tracking [mm]": ("tracking_mean", 1e3, 1),
        "astray": ("astray", 1.0, 0),
    }
    nees = {name.replace("_", " "): (f"nees_{name}", 1.0, 2) for name in PARTS}
    cost = {"a tick": ("relative_cost", 1.0, 2)} if table == "filters" else {}
    groups = {table: ["case"], "NEES": list(nees), "errors": list(errors), "cost": list(cost)}
    columns = [*nees.values(), *errors.values(), *cost.values()]
    cells = [
        (name, *(f"{scale * row[key]:.{digits}f}" for key, scale, digits in columns))
        for name, row in rows.items()
    ]
    return text_table({name: group for name, group in groups.items() if group}, cells)


def as_fields(case: Case) -> dict[str, Any]:
    """Fields of a case, for a file."""
    alike = {"true_sensors": None, "true_vehicle": None, "world": WorldParams()}
    return {"name": case.name, "sensors": case.sensors, **alike, **case.keywords}

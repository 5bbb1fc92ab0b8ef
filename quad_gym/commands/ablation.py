"""Ablation: what a wrong model, and each correction of the filter, do to its consistency.

Flies the same seeds case by case, and tabulates the normalized estimation error squared (NEES) of
the state and of each block, 15 and 3 where the covariance is right, beside the errors themselves.

  quad-gym ablation models    vehicle, world and sensors other than they are believed to be
  quad-gym ablation filters   UKF and EKF, and the filter without each correction

Prints the table and writes it with the whole configuration to TABLE.json.
"""

import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from tyro.conf import Positional

from quad_gym import SensorSuite, VehicleParams, WorldParams, sensor_suite, vehicle_params
from quad_gym.analysis.consistency import PARTS
from quad_gym.analysis.consistency_flights import ASTRAY, Findings, endless, measure_consistency
from quad_gym.analysis.reports import require_writable, text_table, versions, write_json
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.commands.options import (
    SuiteName,
    require_at_least,
    usage_errors,
)
from quad_gym.envs.configuration import TASK_DEFAULTS
from quad_gym.params.checks import Vector
from quad_gym.params.world import world_params

SETTLED = 1.0
"""Errors count from here on [s]."""


@dataclass(frozen=True)
class Args:
    """Options of the tables."""

    table: Positional[Literal["models", "filters"]] = "models"
    """which table"""
    sensors: SuiteName = "rtk"
    episodes: int = 1000
    """flights in each case"""
    seed: int = 0
    """of the first flight; the others follow it"""
    duration: float = 10.0
    """length of a flight [s]"""
    filter_start: Literal["cold", "warm"] = "cold"
    """the filter's start"""
    output: Path = Path("results/ablation")
    """folder for the numbers; made if missing"""
    threads: int | None = None
    """threads; if not given, as many as there are cores"""

    def __post_init__(self) -> None:
        """Check the numbers."""
        require_at_least(self, episodes=2, threads=1)
        least = SETTLED + 0.1
        if not (math.isfinite(self.duration) and self.duration >= least):
            raise ValueError(f"--duration must be at least {least:g} s, got {self.duration:g}")


@dataclass(frozen=True)
class Case:
    """What is flown, and what is believed."""

    name: str
    sensors: SensorSuite
    true_sensors: SensorSuite | None = None
    true_vehicle: VehicleParams | None = None
    world: WorldParams = field(default_factory=WorldParams)


# ---- wrong models -------------------------------------------------------------------------------


def vehicles() -> dict[str, dict[str, Any]]:
    """Vehicles and worlds other than they are believed to be, as fields of a case."""
    nominal, breeze = vehicle_params("lab"), world_params("breeze")

    def vehicle(name: str, factor: float) -> dict[str, Any]:
        return {"true_vehicle": nominal.replace(**{name: factor * getattr(nominal, name)})}

    def wind(speed: float) -> dict[str, Any]:
        steady = WorldParams(wind_I=(speed, 0.0, 0.0), linear_drag_B=breeze.linear_drag_B)
        return {"world": steady}

    return {
        "mass 20 % less": vehicle("mass", 0.8),
        "mass 20 % more": vehicle("mass", 1.2),
        "motor lag 0.1 s for 0.05 s": vehicle("motor_time_constant", 2.0),
        "thrust 10 % less": vehicle("thrust_coefficient", 0.9),
        "steady wind of 4 m/s": wind(4.0),
        "steady wind of 8 m/s": wind(8.0),
        "world breeze": {"world": breeze},
        "world fresh_breeze": {"world": world_params("fresh_breeze")},
    }


def moved(vector: Vector, by: Vector) -> Vector:
    """A vector and another added up."""
    return tuple(a + b for a, b in zip(vector, by, strict=True))


def sensors_as_they_are(suite: SensorSuite) -> dict[str, SensorSuite]:
    """Sensors other than the filter believes them to be."""
    imu, gnss, camera = suite.imu, suite.gnss, suite.camera
    found = {
        "IMU noise doubled": suite.replace(
            imu=imu.replace(
                accel_noise_density=2.0 * imu.accel_noise_density,
                gyro_noise_density=2.0 * imu.gyro_noise_density,
            )
        ),
        "IMU biases tripled": suite.replace(
            imu=imu.replace(
                accel_bias_sigma=3.0 * imu.accel_bias_sigma,
                gyro_bias_sigma=3.0 * imu.gyro_bias_sigma,
            )
        ),
        "IMU 5 cm off its place": suite.replace(
            imu=imu.replace(lever_arm_B=moved(imu.lever_arm_B, (0.05, 0.0, 0.0)))
        ),
    }
    if gnss is not None:
        found["GNSS noise doubled"] = suite.replace(
            gnss=gnss.replace(
                position_sigma_I=tuple(2.0 * np.array(gnss.position_sigma_I)),
                baseline_sigma=2.0 * gnss.baseline_sigma,
                velocity_sigma=gnss.velocity_sigma and 2.0 * gnss.velocity_sigma,
            )
        )
        second = gnss.secondary_antenna_B
        found["antennas 2 cm off their places"] = suite.replace(
            gnss=gnss.replace(
                primary_antenna_B=moved(gnss.primary_antenna_B, (0.0, 0.02, 0.0)),
                secondary_antenna_B=second and moved(second, (0.0, 0.02, 0.0)),
            )
        )
    if camera is not None:
        turned = moved(camera.attitude, (0.0, 0.0, math.radians(0.5)))
        doubled = camera.replace(pixel_sigma=2.0 * camera.pixel_sigma)
        found["pixel noise doubled"] = suite.replace(camera=doubled)
        found["camera turned by 0.5 degrees"] = suite.replace(
            camera=camera.replace(attitude=turned)
        )
    return found


def model_cases(suite: SensorSuite) -> list[Case]:
    """The matched model, then wrong ones."""
    vehicle_cases = [Case(name, suite, **changes) for name, changes in vehicles().items()]
    sensor_cases = [
        Case(name, suite, true_sensors=true) for name, true in sensors_as_they_are(suite).items()
    ]
    return [Case("as believed", suite), *vehicle_cases, *sensor_cases]


# ---- forms of the filter ------------------------------------------------------------------------


def filter_cases(suite: SensorSuite) -> list[Case]:
    """The suite's filter, the other kind, and the filter without each correction."""
    report = sensor_suite("lab")

    def form(name: str, **changes: Any) -> Case:
        return Case(name, suite.replace(estimator=suite.estimator.replace(**changes)))

    sampled = suite.imu.replace(samples="instant")
    held = suite.estimator.replace(integration="euler")
    cases = [
        form("UKF", kind="ukf"),
        form("EKF", kind="ekf"),
        form("UKF, covariance not turned", attitude_reset=False),
        Case("UKF, IMU sampled and held", suite.replace(imu=sampled, estimator=held)),
    ]
    if suite.camera is not None:
        cases += [
            form("UKF, images always whole", recursive_update_threshold=None),
            form("UKF, pixel noise across the measured direction", bearing_noise_at="measured"),
        ]
    start = {"initial_tilt_sigma": None, "initial_covariance_scale": 2.0, "reuse_first_fix": True}
    cases.append(form("UKF, the report's start", **start))
    everything = suite.replace(imu=sampled, estimator=report.estimator)
    return [*cases, Case("UKF, all of the report's form", everything)]


# ---- flying -------------------------------------------------------------------------------------


def batch_of(case: Case, args: Args, flights: int, threads: int | None) -> FlightBatch:
    """The flights of a case."""
    return FlightBatch(
        flights,
        sensors=case.sensors,
        gains="tuned",
        task=endless(TASK_DEFAULTS["random_trajectory"]),
        filter_start=args.filter_start,
        innovations=True,
        threads=threads,
        true_vehicle=case.true_vehicle,
        true_sensors=case.true_sensors,
        world=case.world,
    )


def time_ticks(cases: list[Case], args: Args) -> list[float]:
    """Seconds a tick of one flight, sensors and all, of each case: the best of turns about."""
    count, ticks = 128, 8
    batches = [batch_of(case, args, count, 1) for case in cases]
    for batch in batches:
        batch.reset(seeds=range(count))
    times: list[list[float]] = [[] for _ in batches]
    for _ in range(100):  # short turns, some of which nothing disturbs
        for batch, found in zip(batches, times, strict=True):
            began = time.perf_counter()
            for _ in range(ticks):
                batch.step()
            found.append((time.perf_counter() - began) / (ticks * count))
    return [min(found) for found in times]


def row_of(findings: Findings) -> dict[str, float]:
    """The numbers of a case."""
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


def table_of(args: Args, rows: dict[str, dict[str, float]]) -> str:
    """The table, for the screen."""
    columns: dict[str, Callable[[dict[str, float]], str]] = {
        name.replace("_", " "): lambda row, name=name: f"{row[f'nees_{name}']:.2f}"  # type: ignore[misc]
        for name in PARTS
    }
    errors: dict[str, Callable[[dict[str, float]], str]] = {
        "position [mm]": lambda row: f"{1e3 * row['rms_position']:.1f}",
        "attitude [mrad]": lambda row: f"{1e3 * row['rms_attitude']:.1f}",
        "tracking [mm]": lambda row: f"{1e3 * row['tracking_mean']:.1f}",
        "astray": lambda row: f"{row['astray']:.0f}",
    }
    groups = {args.table: ["case"], "NEES": list(columns), "errors": list(errors)}
    shown = columns | errors
    if args.table == "filters":
        groups["cost"] = ["a tick"]
        shown["a tick"] = lambda row: f"{row['relative_cost']:.2f}"
    cells = [(name, *(cell(row) for cell in shown.values())) for name, row in rows.items()]
    return text_table(groups, cells)


def main(args: Args) -> None:
    """Fly case after case."""
    with usage_errors():
        suite = sensor_suite(args.sensors)
        cases = model_cases(suite) if args.table == "models" else filter_cases(suite)
        batches = [batch_of(case, args, 8, 1) for case in cases]
        require_writable("--output", args.output)
    del batches  # they were made to refuse an invalid case before flying any
    rows: dict[str, dict[str, float]] = {}
    for number, case in enumerate(cases, 1):
        print(f"  {number} of {len(cases)}: {case.name}", file=sys.stderr, flush=True)
        findings = measure_consistency(
            batch_of(case, args, args.episodes, args.threads),
            seeds=range(args.seed, args.seed + args.episodes),
            duration=args.duration,
        )
        rows[case.name] = row_of(findings)
    if args.table == "filters":
        times = time_ticks(cases, args)
        for row, seconds in zip(rows.values(), times, strict=True):
            row["seconds_per_tick"], row["relative_cost"] = seconds, seconds / times[0]
    print(
        f"{args.episodes:,} flights of {args.duration:g} s on random trajectories, suite "
        f"{args.sensors}, {args.filter_start} start.\n"
    )
    print(table_of(args, rows))
    print(f"\nErrors are root mean squares after {SETTLED:g} s; a flight {ASTRAY:g} m off its")
    print("reference is astray, and its tracking error does not count.")
    found = {
        "rows": rows,
        "cases": cases,
        "configuration": args,
        "seeds": [args.seed, args.seed + args.episodes - 1],
        "versions": versions("numpy", "numba", "scipy"),
    }
    print(f"\nWrote {write_json(args.output / f'{args.table}.json', found)}.")

"""Benchmark tasks: each is a built-in reference with its own sensors and `Task`."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from quad_gym.faults import GnssOutage
from quad_gym.params.task import TaskParams


class Benchmark(NamedTuple):
    """Definition of a benchmark task; keywords override it."""

    task: TaskParams  #: reference and bounds of the task
    keywords: Mapping[str, Any]  #: keywords of the environment


BENCHMARKS = {
    "look_around": Benchmark(
        TaskParams(
            kind="random_trajectory",
            start="hover",
            radius=2.5,
            height=2.0,
            period=12.0,
            randomize_reference=True,
            duration=15.0,  # the estimate of a vehicle that never looks has diverged by then
            out_of_bounds=8.0,  # room for errors of the estimate, and for recovery
            min_height=-5.0,
        ),
        {"sensors": "one_wall", "task": "quad_gym.tasks.look_around:LookAround"},
    ),
    "stale_race": Benchmark(
        TaskParams(
            kind="waypoints",
            start="hover",
            radius=3.5,
            height=1.5,
            duration=20.0,
            out_of_bounds=12.0,
            gate_count=8,
            gate_radius=0.6,  # several times the delay error of the measurements at racing speed
        ),
        {"sensors": "stale", "task": "quad_gym.tasks.stale_race:StaleRace"},
    ),
    "outage_dash": Benchmark(
        TaskParams(
            kind="hover",
            start="hover",
            radius=60.0,  # the start of the course, which leads through the origin
            height=4.0,
            duration=45.0,  # 27 s at the rewarded speed, and 15 s for the longest outage
            out_of_bounds=300.0,
            min_height=0.0,
        ),
        {
            "sensors": "consumer",
            "action": "velocity",  # the decision is how far to go on, not how to stay upright
            "control_rate": 10.0,
            "world": "slalom",
            "faults": (GnssOutage(start=(2.0, 8.0), duration=(5.0, 15.0)),),
            "task": "quad_gym.tasks.outage_dash:OutageDash",
        },
    ),
}
"""Benchmark tasks by name."""

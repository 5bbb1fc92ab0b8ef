"""Benchmark tasks: each is a built-in reference with sensors and a `Task` of its own."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from quad_gym.faults import GnssOutage
from quad_gym.params.task import TaskParams


class Benchmark(NamedTuple):
    """What a task is unless keywords say otherwise."""

    task: TaskParams
    """its reference and its bounds"""
    keywords: Mapping[str, Any]
    """of the environment"""


BENCHMARKS = {
    "look_around": Benchmark(
        TaskParams(
            kind="random_trajectory",
            start="hover",
            radius=2.5,
            height=2.0,
            period=12.0,
            randomize_reference=True,
            duration=15.0,  # a vehicle that never looks is lost by then
            out_of_bounds=8.0,  # room to be mistaken, and to find oneself again
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
            gate_radius=0.6,  # some times what the measurements are off by at racing speed
        ),
        {"sensors": "stale", "task": "quad_gym.tasks.stale_race:StaleRace"},
    ),
    "outage_dash": Benchmark(
        TaskParams(
            kind="hover",
            start="hover",
            radius=60.0,  # the start of the course, which leads through the origin
            height=4.0,
            duration=45.0,  # 27 s at the speed that is paid for, and 15 s for the longest outage
            out_of_bounds=300.0,
            min_height=0.0,
        ),
        {
            "sensors": "consumer",
            "action": "velocity",  # what to decide is how far to go on, not how to stay upright
            "control_rate": 10.0,
            "world": "slalom",
            "faults": (GnssOutage(start=(2.0, 8.0), duration=(5.0, 15.0)),),
            "task": "quad_gym.tasks.outage_dash:OutageDash",
        },
    ),
}
"""By name."""

"""Cases of an experiment on consistency: configurations, and their flights."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from quad_gym.analysis.consistency_flights import Findings, endless, measure_consistency
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.envs.flights import TASK_DEFAULTS
from quad_gym.params.sensors import SensorSuite


@dataclass(frozen=True)
class CaseFlights:
    """Flights of each case."""

    count: int
    first_seed: int = 0
    duration: float = 10.0
    """length [s]"""
    threads: int | None = None

    @property
    def seeds(self) -> range:
        """Consecutive seeds of the flights."""
        return range(self.first_seed, self.first_seed + self.count)

    @property
    def seed_limits(self) -> list[int]:
        """First and last seed."""
        return [self.seeds[0], self.seeds[-1]]


@dataclass(frozen=True)
class Case:
    """Configuration of flights by PD control."""

    name: str
    sensors: SensorSuite
    task: str = "random_trajectory"
    start: Literal["cold", "warm"] = "cold"
    """start of the filter"""
    keywords: Mapping[str, Any] = field(default_factory=dict)
    """further keywords of `FlightBatch`"""
    expected: Mapping[str, str] = field(default_factory=dict)
    """reasons for misses, by column; "" stands for all columns"""

    def batch(self, count: int, threads: int | None = None) -> FlightBatch:
        """Flights without early endings."""
        return FlightBatch(
            count,
            sensors=self.sensors,
            task=endless(TASK_DEFAULTS[self.task]),
            gains="tuned",
            filter_start=self.start,
            innovations="estimator" not in self.keywords,  # which only the built-in filter has
            threads=threads,
            **self.keywords,
        )


def fly(batch: FlightBatch, flights: CaseFlights, **options: Any) -> Findings:
    """Fly, and compare errors with covariances; for options, see `measure_consistency`."""
    return measure_consistency(batch, seeds=flights.seeds, duration=flights.duration, **options)

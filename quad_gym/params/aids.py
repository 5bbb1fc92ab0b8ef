"""What the parameters of aiding sensors share: rate, phase, latency, noise and slow errors."""

import math
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

from quad_gym.params import checks as check
from quad_gym.params.checks import Checked
from quad_gym.records import Aid


class SlowError(NamedTuple):
    """An error that changes slowly or not at all, which the filter has among its states."""

    sigma: float
    """stationary standard deviation"""
    tau: float = math.inf
    """correlation time [s]; infinite: it is constant in a flight"""


@dataclass(frozen=True, kw_only=True)
class AidParams(Checked):
    """An aiding sensor: one beside IMU, GNSS and camera."""

    rate: float = 50.0
    """[Hz]; a whole division of the IMU's"""
    phase: float | None = None
    """when the first measurement after the start comes, as a share of the period in [0, 1), in
    whole ticks; None: at random in each episode"""
    latency: float = 0.0
    """from when a measurement is taken to when it reaches the filter, with its time stamp, in whole
    ticks; at most MAX_UNDER_WAY periods [s]"""

    aid: ClassVar[Aid]
    raw: ClassVar[tuple[str, str, float]]
    """unit, frame and bound of what it measures in raw observations"""

    def __post_init__(self) -> None:
        self._check(check.positive, "rate")
        self._check(check.phase, "phase")
        self._check(check.number, "latency", least=0.0)

    @property
    def white_sigma(self) -> float:
        """Standard deviation of each number's white noise."""
        raise NotImplementedError

    @property
    def slow_vector(self) -> SlowError | None:
        """The slow error of three numbers, if the sensor has one; each number's."""
        return None

    @property
    def slow_scalar(self) -> SlowError | None:
        """The slow error of one number, if the sensor has one."""
        return None

    @property
    def believed_vector(self) -> SlowError | None:
        """What a filter takes `slow_vector` for, with what it does not model."""
        return self.slow_vector

    @property
    def matrix_sigma(self) -> float:
        """Standard deviation of each error of scale and alignment."""
        return 0.0

    @property
    def scale(self) -> float:
        """What counts as one in observations."""
        return 1.0

    @property
    def numbers(self) -> tuple[float, float, float]:
        """Three more numbers that its kernel reads."""
        return (0.0, 0.0, 0.0)

    def simplified(self) -> "AidParams":
        """A copy without latency and without what a filter does not model."""
        return self.replace(latency=0.0)  # type: ignore[no-any-return]

    def scaled_noise(self, factor: float) -> "AidParams":
        """A copy whose white noise is `factor` times as large."""
        raise NotImplementedError

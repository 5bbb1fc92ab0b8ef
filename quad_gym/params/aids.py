"""Parameters that all aiding sensors share: rate, phase, latency, noise, time-correlated errors."""

import math
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from quad_gym.params import checks as check
from quad_gym.params.checks import Checked

OBSERVED = ("position", "height", "velocity", "heading")
"""States that a sensor can observe: the horizontal position, and with it often the velocity."""


class SlowError(NamedTuple):
    """A time-correlated or constant error, which the filter estimates in augmented states."""

    sigma: float  #: stationary standard deviation, in the unit of the measurement
    tau: float = math.inf  #: correlation time [s]; infinite: the error is constant during a flight


class SensorBase(Checked):
    """Base of the parameters of all sensors."""

    _white_noise: ClassVar[tuple[str, ...]] = ()
    _ideal: ClassVar[Mapping[str, Any]] = {}
    """Values without latency and without errors that the filter does not model."""

    def simplified(self) -> Self:
        """Return a copy without latency and without errors that the filter does not model."""
        return self.replace(**self._ideal)

    def scaled_noise(self, factor: float) -> Self:
        """Return a copy with the white noise multiplied by `factor`."""
        scaled: dict[str, Any] = {}
        for name in self._white_noise:
            sigma = getattr(self, name)
            each = tuple(factor * s for s in sigma) if isinstance(sigma, tuple) else None
            scaled[name] = each or (sigma and factor * sigma)
        return self.replace(**scaled)


class AidParams(SensorBase):
    """An aiding sensor other than IMU, GNSS and camera.

    A measurement has one block of up to three numbers, or several blocks, each of which may be
    missing and is accepted or rejected by itself.
    """

    rate: check.Positive = 50.0
    """measurement rate [Hz]; the IMU rate must be a whole multiple of it"""
    phase: check.Phase = None
    """time of the first measurement after the start as a fraction of the measurement period, in [0,
    1), rounded to whole ticks; None: drawn at random in each episode"""
    latency: check.NonNegative = 0.0
    """delay from a measurement to its arrival at the filter, which receives it with its time stamp
    [s]; rounded to whole ticks, at most MAX_UNDER_WAY measurement periods"""
    noise_sigma: float
    """standard deviation of the white noise, per component"""

    _white_noise = ("noise_sigma",)
    _ideal: ClassVar = {"latency": 0.0}
    length: ClassVar[int] = 1  #: numbers in a block of the measurement, at most three
    most_blocks: ClassVar[int] = 1  #: largest number of blocks
    rows: ClassVar[int] = 1  #: triples in `numbers`
    observes: ClassVar[tuple[str, ...]]
    """OBSERVED states. Where other sensors in use observe all of them, the gate attributes an
    implausible measurement to this sensor; a replay assumes that it corrects them."""
    reads_velocity: ClassVar[bool] = True
    """False if the measurement does not depend on the velocity, which makes updates faster"""
    unit: ClassVar[str]  #: of the measurement
    frame: ClassVar[str]  #: of the measurement
    meaning: ClassVar[str]  #: of the measurement, in a few words
    raw: ClassVar[tuple[str, str, float]]
    """unit, frame and bound of the measurement in raw observations"""

    @classmethod
    def measured(cls, values: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return True for the rows of `values` (n, ...) with a block without a NaN."""
        known = np.isfinite(values.reshape(len(values), -1, cls.length))
        return np.asarray(np.any(np.all(known, axis=2), axis=1))

    @property
    def blocks(self) -> int:
        """Number of blocks of the measurement."""
        return 1

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of a measurement: of a number, of a block, or of several."""
        several = () if self.most_blocks == 1 else (self.blocks,)
        return several if self.length == 1 else (*several, self.length)

    @property
    def places_I(self) -> check.Matrix:
        """Places (n, 3) in I to which it measures [m], for pictures of flights."""
        return ()

    @property
    def slow_vector(self) -> SlowError | None:
        """Time-correlated error of each of three components; None: no such error."""
        return None

    @property
    def slow_scalar(self) -> SlowError | None:
        """Time-correlated error of a single component; None: no such error."""
        return None

    @property
    def assumed_vector(self) -> SlowError | None:
        """`slow_vector` as the filter assumes it, increased by errors without a model."""
        return self.slow_vector

    @property
    def matrix_sigma(self) -> float:
        """Standard deviation of each scale and alignment error."""
        return 0.0

    @property
    def scale(self) -> float:
        """Divisor that normalizes the measurement in observations."""
        return 1.0

    @property
    def numbers(self) -> check.Matrix:
        """Further parameters of the sensor's kernel, at most `rows` triples."""
        return ()

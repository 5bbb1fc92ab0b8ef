"""What all sensors share: readings, schedule, latency, noise, time-correlated errors."""

import math
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from quad_gym.params import checks as check
from quad_gym.params import portable
from quad_gym.params.checks import Checked

OBSERVED = ("position", "height", "velocity", "heading")
"""States that a sensor can observe: the horizontal position, and with it often the velocity."""


MIN_DRIFT = 1e-6
"""Drift that a filter assumes in an axis without drift if another axis has some, in the unit of the
measurement, so that its covariance stays regular."""


class SlowError(NamedTuple):
    """A time-correlated or constant error, which the filter estimates in augmented states."""

    sigma: float  #: stationary standard deviation, in the unit of the measurement
    tau: float = math.inf  #: correlation time [s]; infinite: the error is constant during a flight

    def over(self, time: float) -> tuple[float, float]:
        """Return its decay over a time [s], and the standard deviation of its driving noise."""
        drive = self.sigma * math.sqrt(portable.approached(2.0 * time / self.tau))
        return portable.exp(-time / self.tau), drive


class FirstHeading(NamedTuple):
    """Noise of a sensor that gives the heading with which a filter starts."""

    field: str  #: of the parameters, such as "baseline_sigma"
    sigma: float
    unit: str
    per_radian: float  #: noise that turns the heading by one radian, in the unit
    lasting: bool  #: True for an error that does not change from one measurement to the next
    slope: float = 0.0  #: error of the heading due to an unknown tilt, over that tilt


class FurtherStage(NamedTuple):
    """A stage that the one of a sensor calls, for an error, a limit or a fault of measurements."""

    name: str  #: its function in the sensor's file of kernels, without `_stage`
    needed_by: str  #: setting of the kernels without which it is not compiled
    parts: tuple[str, ...] = ()  #: parts of a flight's record that it uses


class ReadingDefinition(NamedTuple):
    """What a sensor measures: one block of numbers, or several of one kind.

    Each block may be missing, and the gate accepts or rejects it by itself.
    """

    name: str
    length: int  #: numbers in a block, at most three
    unit: str
    frame: str  #: in which users read it
    meaning: str  #: in a few words
    observes: tuple[str, ...]
    """OBSERVED states. Where other sensors in use observe all of them, the gate attributes an
    implausible measurement to this reading; a replay assumes that it corrects them."""
    raw: tuple[str, str, float]  #: unit, frame and bound in raw observations
    sigma: str  #: keyword of a measurement's own standard deviation, per axis, in `sigma_unit`
    sigma_unit: str
    most_blocks: int = 1  #: largest number of blocks
    block: str = ""  #: word for one of several blocks; empty: the name
    word: str = ""  #: short name in reports of one sensor; empty: that of a block
    direction: bool = False
    """True if filters compare unit vectors, which have three numbers and two degrees of freedom"""
    in_G: bool = False  #: True if records have it in G, the frame of GNSS, in place of I
    sigmas: int = 1  #: numbers of the standard deviation: one, or east, north and up
    least_sigma: float = 1e-12  #: smallest standard deviation of a measurement
    reported: bool = False  #: True if receivers report it with every measurement
    noise: str = "noise_sigma"  #: field of the parameters with the white noise
    from_center: bool = False
    """True for a place from the center of the Earth, in logs and in exported filters, which keep it
    in double precision"""
    marked: bool = False
    """True if the mark from which a vehicle starts gives it where there is no such sensor"""

    def name_of(self, k: int) -> str:
        """Return the name of block k."""
        return f"{self.block or self.name}_{k}" if self.most_blocks > 1 else self.name

    @property
    def label(self) -> str:
        """Short name in reports."""
        return self.word or self.block or self.name

    @property
    def together(self) -> str:
        """Name of all of its blocks together."""
        return f"{self.block}s" if self.block else self.name

    @property
    def keyword(self) -> str:
        """Keyword of a filter's `update`: names of vectors in G say so."""
        return f"{self.name}_G" if self.in_G else self.name

    @property
    def in_logs(self) -> tuple[str, ...]:
        """Names in a log: the keyword, and of vectors in G also the name in I."""
        return (self.keyword, f"{self.name}_I") if self.in_G else (self.name,)

    def known(self, values: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return True for the rows of `values` (n, ...) in which one of its blocks has no NaN."""
        known = np.isfinite(values.reshape(len(values), -1, self.length))
        return np.asarray(np.any(np.all(known, axis=2), axis=1))

    @property
    def dimensions(self) -> tuple[str | int, ...]:
        """Dimensions of a measurement, several blocks in words."""
        several = (f"{self.block or 'block'}s",) * (self.most_blocks > 1)
        return several + (self.length,) * (self.length > 1)


class SensorBase(Checked):
    """Base of the parameters of all sensors."""

    measures: ClassVar[tuple[ReadingDefinition, ...]] = ()
    """Quantities of a sensor that has several, or more to say than `AidParams`."""
    words: ClassVar[str] = ""
    """The sensor in messages; empty: an article and its name, such as "a barometer\""""
    stages: ClassVar[tuple[FurtherStage, ...]] = ()
    """Stages besides its own one, which calls them."""
    _ideal: ClassVar[Mapping[str, Any]] = {}
    """Values without latency and without errors that the filter does not model."""

    @classmethod
    def readings(cls, name: str) -> tuple[ReadingDefinition, ...]:
        """Return what the sensor measures; `name` is its field in `SensorTable`."""
        return cls.measures

    @property
    def measured_blocks(self) -> tuple[int, ...]:
        """Number of blocks of each of its readings; 0: this sensor does not measure it."""
        raise NotImplementedError

    @property
    def reads_velocity(self) -> bool:
        """False if measurements do not depend on the velocity, which makes updates faster."""
        return True

    @property
    def drift(self) -> tuple[SlowError, ...]:
        """Slow errors that are zero at the start, and come first among the states of a filter.

        Of the sensors, one may have such errors, of three numbers.
        """
        return ()

    def drift_after(self, time: float) -> tuple[float, ...]:
        """Return the standard deviations of `drift` a time [s] after it was zero."""
        return ()

    @property
    def first_heading(self) -> FirstHeading | None:
        """Noise of the heading with which a filter starts; None: it does not show the heading."""
        return None

    @property
    def counted_as_noise(self) -> tuple[str, ...]:
        """Readings with a constant error that the filter models as white noise."""
        return ()

    def require_filter(self) -> None:
        """Refuse parameters with which a filter would overflow."""

    @property
    def raw_scales(self) -> tuple[float, ...]:
        """Divisor of each of its readings in raw observations."""
        return (1.0,) * len(self.measured_blocks)

    @property
    def raw_spans(self) -> check.Matrix:
        """Further divisors (n, 3) of the numbers of each reading in raw observations."""
        return ((1.0, 1.0, 1.0),) * len(self.measured_blocks)

    @property
    def packed(self) -> dict[str, Any]:
        """Numbers for the kernels, by fields of their parameters; others are in `numbers`."""
        return {}

    @classmethod
    def from_mark(
        cls, sensor: Self | None, position_sigma: float, heading_sigma: float
    ) -> dict[str, Any]:
        """Return numbers with which the mark of a start stands for readings that are not measured.

        Args:
            sensor: Parameters of the suite's sensor; None: it has none.
            position_sigma: Standard deviation of the position of the mark, per axis [m].
            heading_sigma: Standard deviation of the heading of the mark [rad].

        Returns:
            As `packed`, which they replace.
        """
        return {}

    @property
    def options(self) -> dict[str, bool]:
        """Errors and limits of the true sensor, by fields of the kernels' settings."""
        return {}

    def simplified(self) -> Self:
        """Return a copy without latency and without errors that the filter does not model."""
        return self.replace(**self._ideal)

    def _white_noise(self) -> tuple[str, ...]:
        """Return the names of the standard deviations of white noise."""
        return tuple(reading.noise for reading in self.readings(""))

    def scaled_noise(self, factor: float) -> Self:
        """Return a copy with the white noise multiplied by `factor`."""
        scaled: dict[str, Any] = {}
        for name in self._white_noise():
            sigma = getattr(self, name)
            each = tuple(factor * s for s in sigma) if isinstance(sigma, tuple) else None
            scaled[name] = each or (sigma and factor * sigma)
        return self.replace(**scaled)


class AidParams(SensorBase):
    """A sensor of one reading: one block of up to three numbers, or several blocks."""

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

    _ideal: ClassVar = {"latency": 0.0}
    length: ClassVar[int] = 1
    most_blocks: ClassVar[int] = 1
    rows: ClassVar[int] = 1  #: triples in `numbers`
    shows_heading: ClassVar[bool] = False  #: True if its stage can initialize the heading
    observes: ClassVar[tuple[str, ...]]  #: these six as in `ReadingDefinition`
    unit: ClassVar[str]
    frame: ClassVar[str]
    meaning: ClassVar[str]
    raw: ClassVar[tuple[str, str, float]]

    @classmethod
    def readings(cls, name: str) -> tuple[ReadingDefinition, ...]:
        """Return the reading, which has the name of the sensor."""
        return (
            ReadingDefinition(
                name=name,
                length=cls.length,
                unit=cls.unit,
                frame=cls.frame,
                meaning=cls.meaning,
                observes=cls.observes,
                raw=cls.raw,
                sigma=f"{name}_sigma",
                sigma_unit=cls.unit,
                most_blocks=cls.most_blocks,
            ),
        )

    @property
    def measured_blocks(self) -> tuple[int, ...]:
        """Number of blocks."""
        return (self.blocks,)

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
    def raw_scales(self) -> tuple[float, ...]:
        """`scale`."""
        return (self.scale,)

    @property
    def numbers(self) -> check.Matrix:
        """Further parameters of the sensor's kernel, at most `rows` triples."""
        return ()

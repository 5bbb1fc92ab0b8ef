"""The range finder: distance to the ground along the body z axis, and its errors."""

from quad_gym.params import checks as check
from quad_gym.params.aids import AidParams


class RangeFinderParams(AidParams):
    """A time-of-flight sensor that looks down, such as a VL53L1X.

    It measures `h / u + noise` with the height h above a level ground (`WorldParams.ground_height`)
    and the cosine u of the tilt. The sensor returns no measurement outside of `min_range` and
    `max_range`, and at a tilt above 60 degrees.
    """

    rate: float = 25.0
    """measurement rate [Hz]; ST VL53L1X user manual: a timing budget of 33 ms, plus 4 ms"""
    noise_sigma: check.Positive = 0.01
    """standard deviation of the white noise [m]; ST VL53L1X user manual: ranging error +-20 mm, two
    sigma"""
    min_range: check.Positive = 0.04
    """shortest distance [m]; ST VL53L1X user manual"""
    max_range: check.Positive = 3.6
    """longest distance [m]; ST VL53L1X user manual: in the dark, over a light floor"""

    observes = ("height",)
    reads_velocity = False
    unit, frame, meaning = "m", "B", "distance to the ground along body -z"
    raw = ("m", "B", 100.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.max_range <= self.min_range:
            got = f"{self.max_range:g} m and {self.min_range:g} m"
            self._refuse("max_range", "be more than min_range", got)

    @property
    def numbers(self) -> check.Matrix:
        """Shortest and longest distance [m], 0."""
        return ((self.min_range, self.max_range, 0.0),)

"""The optical flow sensor: the angular rate at which the ground passes below, and its errors."""

from quad_gym.params import checks as check
from quad_gym.params.aids import AidParams


class OpticalFlowParams(AidParams):
    """A camera that looks down and measures the motion of the ground, such as a PMW3901.

    It measures `(V_x, V_y) u / h + (-w_y, w_x) + noise` with the velocity V and the body rates w in
    B, the height h above a level ground (`WorldParams.ground_height`) and the cosine u of the tilt.
    The sensor returns no measurement below `min_height`, beyond `max_rate`, and at a tilt above 60
    degrees.
    """

    rate: float = 100.0
    """measurement rate [Hz]; the Crazyflie firmware reads the PMW3901 every 10 ms"""
    noise_sigma: check.Positive = 0.2
    """standard deviation of the white noise, per axis [rad/s]; PX4 assumes 0.15 (EKF2_OF_N_MIN) to
    0.5 over poor texture, the Crazyflie firmware 2 counts of 0.1 pixels in 10 ms, 0.41"""
    min_height: check.Positive = 0.08
    """least height above the ground [m]; PixArt PMW3901 data sheet: focus from 80 mm on"""
    max_rate: check.Positive = 7.4
    """largest rate, per axis [rad/s]; PixArt PMW3901 data sheet"""

    words, length, observes = "optical flow", 2, ("velocity",)
    unit, frame, meaning = "rad/s", "B", "angular rate of the ground below"
    raw = ("rad/s", "B", 20.0)

    @property
    def numbers(self) -> check.Matrix:
        """Least height [m], largest rate [rad/s], 0."""
        return ((self.min_height, self.max_rate, 0.0),)

"""Parameters of the Kalman filter."""

from functools import partial
from typing import Annotated, Literal

from quad_gym.params import checks as check
from quad_gym.params.checks import Checked
from quad_gym.params.vehicle import GRAVITY
from quad_gym.params.world import GROUND_HEIGHT


class FilterParams(Checked):
    """Form and tuning of the Kalman filter; the defaults are the laboratory report's filter."""

    kind: Literal["ukf", "ekf"] = "ukf"
    """"ukf", the unscented filter of the report, or "ekf", an error-state extended Kalman filter
    with the same state, models and noise"""
    integration: Literal["euler", "midpoint"] = "euler"
    """integration of the prediction over a tick: "euler" holds the sample at the start of the tick
    (report); "midpoint" integrates the attitude exactly and rotates the specific force with the
    attitude halfway through the tick, as `ImuParams.samples="average"` requires"""
    attitude_reset: bool = False
    """True: transform the covariance, S^-1 P S^-T, when the mean error angles are added to the
    attitude, to which error angles then refer; False: leave it as it is (report). With suites other
    than "lab" this changes the NEES by less than its sampling error, and errors by at most 1 %"""
    alpha: check.Positive = 1e-3
    """alpha of the unscented transform, the spread of the sigma points; laboratory"""
    beta: check.NonNegative = 2.0
    """beta of the unscented transform, 2 for Gaussian distributions; laboratory"""
    kappa: Annotated[float, partial(check.number, least=-14.0)] = 0.0
    """kappa of the unscented transform, its secondary scaling parameter; laboratory"""
    direction_variance_floor: check.Positive = 1e-8
    """variance added to the diagonal of a direction's noise covariance, which has rank 2 without it
    [-]; report section 3.1"""
    bearing_noise_at: Literal["measured", "predicted", "pinhole"] = "measured"
    """direction u at which the bearing noise of a feature, sigma^2 (I - u u^T), is evaluated: the
    "measured" direction (report) or the "predicted" one, as for the baseline. With the first, the
    filter interprets the angle between the two, tens of milliradians in the first second, as
    information with 0.1 mrad accuracy. "pinhole": the predicted direction, with less noise along
    the radius of the image, where pixels far from its center subtend smaller angles"""
    initial_velocity_variance: check.Positive = 1e-3
    """initial variance of each velocity component [m^2/s^2]; laboratory"""
    initial_covariance_scale: check.Positive = 2.0
    """factor on the covariance of the first fix, from which the filter starts; laboratory"""
    initial_tilt_sigma: check.AngleSize | None = None
    """initial standard deviation of roll and pitch of a filter that starts level [rad]; None: the
    initial attitude solves Wahba's problem for the baseline and the vertical (laboratory)"""
    reuse_first_fix: bool = True
    """True: the fix that starts the filter is also its first measurement (laboratory). The fix is
    then counted twice, so suites other than "lab" have False"""
    recursive_update_threshold: check.Positive | None = None
    """ratio of the second order of measurements, in the filter's covariance, to their noise above
    which they are processed in several steps, each linearized about the estimate after the step
    before [-]; None: always in a single update (report). The second order grows with the variance
    of the state, and exceeds the noise of images, ranges or optical flow at an uncertain start or
    after an outage. With GNSS, features beyond `max_direction_sigma` are then ignored even without
    a gate"""
    false_alarm_probability: check.NonNegative = 0.0
    """probability that the innovation gate rejects a valid measurement: a position, baseline,
    velocity or feature, or a measurement of an aiding sensor, is left out of the update if its
    normalized innovation squared exceeds the chi-square quantile of this probability (Y.
    Bar-Shalom, X. R. Li and T. Kirubarajan, Estimation with Applications to Tracking and
    Navigation, section 5.4); 0: no gate"""
    max_rejections: Annotated[int, check.whole] = 5
    """least number of consecutive rejections of a sensor's measurements before states are reset"""
    reset_timeout: check.Positive = 1.0
    """time for which a sensor is rejected before the states that only it measures are reset to it
    [s]; as `no_aid_timeout_max` of PX4 EKF2"""
    glitch_timeout: check.Positive = 25.0
    """the same if its innovations have begun with a step, which an IMU does not make [s]; ArduPilot
    NavEKF3 waits for 10 s (`posRetryTimeUseVel_ms`), and dead reckoning bridges faults of 20 s"""
    max_direction_sigma: check.AngleSize = 0.2
    """standard deviation of a feature's predicted direction above which a filter with an innovation
    gate ignores the feature [rad]; half the square of this angle, which a linear model neglects, is
    then ten times the noise of a good camera. A filter without GNSS uses all features"""
    delay_compensation: Literal["retrodict", "none"] = "retrodict"
    """processing of delayed measurements: "retrodict" takes the estimate back to the time stamp,
    updates it there, and propagates it forward again; "none" ignores the time stamp"""
    gravity: check.Positive = GRAVITY
    """gravitational acceleration in the prediction of a filter on its own [m/s^2]; in flights the
    vehicle's value is used"""
    ground_height: float = GROUND_HEIGHT
    """height of the ground in I that optical flow and range finder of a filter on its own measure
    [m]; in flights the world's value is used"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.false_alarm_probability >= 0.5:
            self._refuse("false_alarm_probability", "be below 0.5")

"""Parameters of the Kalman filter."""

import math
from dataclasses import dataclass

from quad_gym.params import checks as check
from quad_gym.params.checks import Checked
from quad_gym.params.gravity import GRAVITY


@dataclass(frozen=True, kw_only=True)
class FilterParams(Checked):
    """The Kalman filter's own choices; the defaults are the report's form."""

    kind: str = "ukf"
    """"ukf", the report's unscented filter, or "ekf", an error-state extended one with the same
    state, models and noise; the fields of the unscented transform do not concern it"""
    integration: str = "euler"
    """how the prediction carries the estimate over a tick: "euler", as if the sample of its start
    held (report), or "midpoint", turning the attitude exactly and the force with the attitude
    halfway, which belongs to `ImuParams.samples` "average\""""
    attitude_reset: bool = False
    """whether the covariance is transformed, S^-1 P S^-T, when the mean error angles are added to
    the attitude, as error angles then refer to another attitude; the report's filter leaves it as
    it is. This distinguishes the two forms of the filter and is not a tuning parameter: in the
    other suites it moves the NEES by less than its sampling error, and errors by 1 % at most"""
    alpha: float = 1e-3
    """spread of the sigma points; laboratory"""
    beta: float = 2.0
    """weight of the central point's excess, 2 for Gaussians; laboratory"""
    kappa: float = 0.0
    """secondary scaling; laboratory"""
    direction_variance_floor: float = 1e-8
    """added to the diagonal of a direction's covariance, of rank 2 [-]; report section 3.1"""
    bearing_noise_at: str = "measured"
    """how a feature's noise covariance of rank 2 lies: across its "measured" direction (report) or
    across the "predicted" one, as the baseline's does. The first takes the angle between the two,
    tens of milliradians in the first second, for information that it trusts to 0.1 mrad.
    "pinhole": across the predicted one, and less toward the image's center, as pixels far out
    subtend smaller angles there; the report takes the noise for equal about both axes"""
    initial_velocity_variance: float = 1e-3
    """[m^2/s^2]; laboratory"""
    initial_covariance_scale: float = 2.0
    """factor on the first fix's covariance; laboratory"""
    initial_tilt_sigma: float | None = None
    """how level the start is, per axis [rad]: the filter starts level, looking as the baseline
    says; None: the attitude solves Wahba's problem for the baseline and the vertical, with the
    baseline's noise about every axis, as in the laboratory"""
    reuse_first_fix: bool = True
    """whether the fix that starts the filter is also its first measurement, as in the laboratory;
    that counts it twice, so suites other than "lab" do not"""
    recursive_update_threshold: float | None = None
    """deviation of a feature's predicted direction above which images are processed in steps, each
    about the estimate that the one before has left [rad]; None: always whole (report). The
    derivatives of pixels are off by the square of that error, more than a precise camera's noise at
    a rough start or after an outage. Without a gate, features beyond `max_direction_sigma` are
    then left out where there is GNSS, as by a gate"""
    false_alarm_probability: float = 0.0
    """probability that a valid measurement is rejected: a position, baseline, velocity or feature
    whose normalized innovation squared exceeds the chi-square quantile of this alarm level is left
    out of the update (Y. Bar-Shalom, X. R. Li and T. Kirubarajan, Estimation with Applications to
    Tracking and Navigation, section 5.4); 0: everything is taken"""
    max_rejections: int = 10
    """positions, baselines, velocities or images rejected in a row after which the filter doubts
    itself instead: it adds the square of the innovation to the covariance of what the sensor
    measures, and takes the next one"""
    max_direction_sigma: float = 0.2
    """[rad] a gating filter leaves out features whose direction it predicts more vaguely than that,
    as after a long outage: what its model neglects, half the square, is ten times the noise of a
    good camera then. GNSS has to bring such a filter home; one without GNSS takes all features, as
    it has nothing else"""
    delay_compensation: str = "retrodict"
    """processing of delayed measurements: "retrodict" takes the estimate back to the time stamp
    over the IMU samples since then, updates it there, and propagates it forward again; "none"
    ignores the time stamp"""
    gravity: float = GRAVITY
    """[m/s^2] that a filter which works by itself subtracts; in flights it is the vehicle's"""

    def __post_init__(self) -> None:
        self._check(
            check.positive,
            "alpha",
            "direction_variance_floor",
            "initial_velocity_variance",
            "initial_covariance_scale",
            "max_direction_sigma",
            "gravity",
        )
        self._check(check.number, "beta", least=0.0)
        self._check(check.choice, "kind", choices=("ukf", "ekf"))
        self._check(check.choice, "integration", choices=("euler", "midpoint"))
        self._check(check.flag, "attitude_reset")
        self._check(check.choice, "delay_compensation", choices=("retrodict", "none"))
        self._check(check.choice, "bearing_noise_at", choices=("measured", "predicted", "pinhole"))
        self._check(check.flag, "reuse_first_fix")
        if self.initial_tilt_sigma is not None:
            self._check(check.positive, "initial_tilt_sigma", most=math.pi)
        if self.recursive_update_threshold is not None:
            self._check(check.positive, "recursive_update_threshold")
        self._check(check.whole, "max_rejections")
        self._check(check.number, "false_alarm_probability", least=0.0)
        if self.false_alarm_probability >= 0.5:
            raise ValueError(
                "FilterParams.false_alarm_probability must be below 0.5, got "
                f"{self.false_alarm_probability}"
            )
        self._check(check.number, "kappa", least=-14.0)

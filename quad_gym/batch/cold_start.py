"""Cold starts: limits of the uncertainty of a filter's first estimate.

A filter starts level, with a linearized model, whose error is half the square of the attitude
error. This error enters velocity and position before the first fix, where the covariance lacks it;
updates in steps, as of images, do not remove it. Up to the bounds below, the mean NEES of 15 states
stays under 17, see `tests/statistical/test_vague_starts.py`.
"""

import math
import warnings
from collections.abc import Iterator

from quad_gym.params.randomization import DrawingTable
from quad_gym.params.sensors import SensorSuite

MAX_START_TILT = 0.15
"""Root mean square of a drawn roll or pitch, and of the error of the magnetic heading by it [rad].

No sensor measures the tilt of a start: the accelerometer of a vehicle that hovers measures its
thrust, which is along the body z axis at any tilt."""

MAX_BASELINE_SIGMA = 0.15  #: standard deviation of the heading from the first baseline [rad]
MAX_HEADING_SIGMA = 0.1
"""Standard deviation of the heading of a mark, or due to hard iron, with GNSS or flow [rad]."""
MAX_HEADING_SIGMA_INDOORS = 1.0
"""The same with a camera and without GNSS: images correct it in steps [rad]."""
MAX_POSITION_SIGMA = 1.0
"""Standard deviation of the position of a mark without GNSS, with features 8 m away [m]."""

STEEP = 0.2
"""Level share of a baseline that is too steep for a heading; as in `kernels/filter/align.py`."""


def check_cold_start(sensors: SensorSuite, draws: DrawingTable) -> None:
    """Refuse tilts from which a filter cannot start, and warn of too uncertain starts."""
    magnetometer = sensors.magnetometer if sensors.heading_aid is not None else None
    slope = 0.0 if magnetometer is None else abs(math.tan(magnetometer.inclination))
    most = MAX_START_TILT / max(slope, 1.0)
    for name in ("start_roll", "start_pitch"):
        if name not in draws.names:
            continue
        tilt = math.sqrt(draws.mean_square(name)[0])
        if tilt > most:
            by = "" if slope <= 1.0 else ", as it turns the magnetic heading"
            uniform = math.floor(1000.0 * math.sqrt(3.0) * most) / 1000.0
            raise ValueError(
                f"{name} must have a root mean square of at most {most:.3g} rad (uniform within "
                f"+-{uniform:g} rad) with filter_start='cold'{by}, got {tilt:.3g} rad: a cold "
                "filter assumes a level vehicle; filter_start='warm' takes any tilt"
            )
    for field, value, bound, unit in _vague(sensors):
        warnings.warn(
            f"{field} is {value:.3g} {unit}, more than {bound:.3g} {unit}: after a cold start the "
            "filter is overconfident, as its linearized model does not hold for errors so large; "
            "filter_start='warm' (of quad-gym train: --env filter_start=warm) begins with a "
            "converged filter, if these sensors let it converge in 10 s of hovering",
            UserWarning,
            stacklevel=4,
        )


def _vague(sensors: SensorSuite) -> Iterator[tuple[str, float, float, str]]:
    """Fields that exceed their bounds: name, value, bound and unit."""
    gnss, magnetometer, pose = sensors.gnss, sensors.magnetometer, sensors.initial_pose
    share, bounds = 0.0, []  # level share of the baseline of a level vehicle
    if gnss is not None and gnss.has_baseline:
        x, y, z = gnss.baseline_B
        share = math.hypot(x, y) / math.hypot(x, y, z)
    if gnss is not None and share >= STEEP:
        most = MAX_BASELINE_SIGMA * share
        bounds.append(("GnssParams.baseline_sigma", gnss.baseline_sigma, most, "rad"))
    elif sensors.heading_aid is not None and magnetometer is not None:
        most = MAX_HEADING_SIGMA * math.hypot(*magnetometer.field_I[:2])
        iron = magnetometer.hard_iron_sigma
        bounds.append(("MagnetometerParams.hard_iron_sigma", iron, most, "T"))
    else:
        most = MAX_HEADING_SIGMA
        if gnss is None and sensors.camera is not None:
            most = MAX_HEADING_SIGMA_INDOORS
        bounds.append(("InitialPoseParams.heading_sigma", pose.heading_sigma, most, "rad"))
    if gnss is None:
        sigma = pose.position_sigma
        bounds.append(("InitialPoseParams.position_sigma", sigma, MAX_POSITION_SIGMA, "m"))
    return ((name, value, most, unit) for name, value, most, unit in bounds if value > most)

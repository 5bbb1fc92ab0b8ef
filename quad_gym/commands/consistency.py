"""Test the consistency of the filter: compare errors with their estimated covariance.

  quad-gym consistency                             the suite "standard"
  quad-gym consistency circle --sensors indoor --filter-start warm
  quad-gym consistency --sensors lab               the report's filter
  quad-gym consistency --sensors lab --form corrected   the same sensors, all corrections
  quad-gym consistency --estimator ekf             an extended Kalman filter
  quad-gym consistency --estimator module:Class    a quad_gym.Estimator of your own
  quad-gym consistency --noise-factor 1.5          sensors noisier than the filter assumes

The flights follow random trajectories (or another task) by PD control. The normalized estimation
error squared (NEES) is computed for the 15 states and for each part of three, over time, and the
normalized innovation squared (NIS) for each sensor. For a consistent filter, means over 1,000
flights are inside known bands at 95 % of the instants, and innovations are white. Prints tables and
a verdict, and writes figures (PNG and SVG) and consistency.json, which has all numbers with the
configuration and the seeds.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from quad_gym import FilterParams, SensorSuite, sensor_suite
from quad_gym.analysis.plots import require_matplotlib
from quad_gym.analysis.reports import require_writable
from quad_gym.commands import options
from quad_gym.envs import IDS
from quad_gym.envs.config import own_estimator
from quad_gym.experiments.consistency import Case, CaseFlights, run_single
from quad_gym.params import checks as check
from quad_gym.params.suites import FIELD_FILTER
from quad_gym.records import Source


@dataclass(frozen=True)
class ConsistencyArgs:
    """Options of the experiment."""

    env_id: options.TrackingId = "QuadGym/RandomTrajectory-v0"

    episodes: int = 4000
    """number of flights"""
    seed: int = 0
    """seed of the first flight; the others have consecutive seeds"""
    duration: float = 10.0
    """length of a flight [s]"""
    observation: Literal["estimate", "truth"] = "estimate"
    """observation of the controller"""
    filter_start: Literal["cold", "warm"] = "cold"
    """start of the filter: cold (from its first fix), or warm (after some seconds of hovering)"""
    settle: float = 0.0
    """initial transient excluded from averages [s]"""
    output: Path = Path("results/consistency")
    """folder for figures and numbers"""
    threads: options.Threads = None

    sensors: options.SuiteName = "standard"
    form: Literal["suite", "report", "corrected"] = "suite"
    """form of filter and IMU: the suite's, the report's, or the one with all corrections"""
    estimator: options.EstimatorName = None
    camera: bool = True
    """measure with the camera, if the suite has one"""
    world: str = "calm"
    """air, ground and battery: calm, breeze or fresh_breeze"""
    faults: str | None = None
    """faults of sensors and rotors: presets joined by +, such as gnss_outage+rotor_loss"""
    noise_factor: float = 1.0
    """true white noise, relative to the noise that the filter assumes"""

    def __post_init__(self) -> None:
        """Check the numbers."""
        options.require_at_least(self, episodes=2, seed=0, threads=1)
        full_id = options.known_id("ENV_ID", self.env_id, options.TRACKING)
        object.__setattr__(self, "env_id", full_id)
        for name in ("duration", "noise_factor"):
            check.positive(options.option_name(name), getattr(self, name))
        if not 0.0 <= self.settle < self.duration:
            raise ValueError(f"--settle must be at least 0 and before the end, got {self.settle}")
        if self.own_estimator is not None and self.form != "suite":
            raise ValueError(
                f"--form {self.form} has no effect with an own --estimator, and must not be given"
            )

    @property
    def own_estimator(self) -> str | None:
        """A user's estimator; None for built-in filters."""
        return own_estimator(self.estimator)


def suite_of(args: ConsistencyArgs) -> SensorSuite:
    """Sensor suite of the options."""
    suite = sensor_suite(args.sensors)
    if not args.camera:
        suite = suite.replace(camera=None)
    samples, form = {
        "suite": (suite.imu.samples, suite.estimator),
        "report": ("instant", FilterParams()),
        "corrected": ("average", FIELD_FILTER),
    }[args.form]
    if args.estimator is not None and args.own_estimator is None:
        form = form.replace(kind=args.estimator)
    return suite.replace(imu=suite.imu.replace(samples=samples), estimator=form)


def case_of(args: ConsistencyArgs) -> Case:
    """Configuration of the options."""
    suite = suite_of(args)
    keywords: dict[str, Any] = {
        "source": Source[args.observation.upper()],
        "true_sensors": suite.scaled_noise(args.noise_factor),
        "world": args.world,
        "faults": args.faults,
    }
    if args.own_estimator is not None:
        keywords["estimator"] = args.own_estimator
    return Case(title_of(suite, args), suite, IDS[args.env_id], args.filter_start, keywords)


def title_of(suite: SensorSuite, args: ConsistencyArgs) -> str:
    """Title of the report and of the figures."""
    choices = suite.estimator
    if args.own_estimator is not None:
        return f"{args.estimator}, suite {args.sensors}, {args.filter_start} start"
    parts = [
        f"{choices.kind.upper()}, suite {args.sensors}, {args.filter_start} start",
        f"{suite.imu.samples} samples",
        choices.integration,
        f"attitude reset {'on' if choices.attitude_reset else 'off'}",
    ]
    if suite.camera is not None:
        parts.append(f"bearing noise at the {choices.bearing_noise_at} direction")
    return ", ".join(parts)


def main(args: ConsistencyArgs) -> None:
    """Run the experiment."""
    with options.usage_errors():
        require_matplotlib()
        case = case_of(args)
        case.batch(8, 1)  # rejects an invalid configuration
        require_writable("--output", args.output)
    run_single(
        case,
        CaseFlights(args.episodes, args.seed, args.duration, args.threads),
        args.output,
        settle=args.settle,
        configuration=args,
    )

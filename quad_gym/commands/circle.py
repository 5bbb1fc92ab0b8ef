"""Reproduce the report's circle experiment: true state, and estimates with and without a camera.

    quad-gym circle
    quad-gym circle --episodes 100 --gains tuned --gnss-rate 10

A quadrotor starts at rest on the ground, below a point that moves on a horizontal circle, and a PD
controller tracks that point at every IMU sample. The controller receives either the true state or
the estimate of an unscented Kalman filter that fuses GNSS, IMU and camera. How much accuracy is
lost by flying on the estimate, and does the camera help? Flights with equal seeds have the same
noise and biases, so cases are compared flight by flight.

Prints a table, and writes figures (PNG and SVG), the numbers of every flight (flights.csv), and a
summary with the whole configuration (summary.json).
"""

import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from quad_gym import TaskParams, pd_gains, sensor_suite
from quad_gym.analysis.plots import require_matplotlib
from quad_gym.analysis.reports import require_writable
from quad_gym.commands.options import Threads, require_at_least, usage_errors
from quad_gym.experiments import circle
from quad_gym.records import Source


@dataclass(frozen=True)
class CircleArgs:
    """Options of the experiment."""

    episodes: int = 1000
    """number of flights in each case"""
    seed: int = 0
    """seed of the first flight; the others have consecutive seeds"""
    duration: float = 10.0
    """length of a flight [s]"""
    output: Path = Path("results/circle")
    """folder for figures and numbers, created if it is missing"""
    threads: Threads = None

    radius: float = 4.0
    """radius of the circle [m]"""
    period: float = 10.0
    """time for one lap [s]"""
    height: float = 1.0
    """height of the circle above the start [m]"""

    gains: Literal["lab", "tuned"] = "lab"
    """gains of the report, or gains tuned for the smallest error"""

    camera: bool = True
    """include the case with the camera"""
    gnss_rate: float | None = None
    """rate of GNSS fixes [Hz]; defaults to the IMU rate"""
    estimator: Literal["ukf", "ekf"] = "ukf"
    """filter: ukf, the report's, or ekf"""
    bearing_noise_at: Literal["measured", "predicted"] = "measured"
    """direction to which the filter assumes camera noise is perpendicular: measured, as in the
    report, makes it overconfident; predicted hardly does"""


def configure(args: CircleArgs) -> circle.Setup:
    """Check all options before the flights."""
    require_at_least(args, episodes=1, seed=0, threads=1)
    task = TaskParams(
        kind="circle",
        start="ground",
        pad=False,  # the report has none
        radius=args.radius,
        period=args.period,
        height=args.height,
        duration=0.0,
        out_of_bounds=3.0 + args.height,  # do not count the climb from the ground as a crash
    )
    suite = sensor_suite("lab").with_rates(gnss=args.gnss_rate)
    estimator = suite.estimator.replace(kind=args.estimator, bearing_noise_at=args.bearing_noise_at)
    suite = suite.replace(estimator=estimator)
    cases = {circle.TRUTH: (Source.TRUTH, suite)}
    if args.camera:
        cases[circle.ESTIMATE] = (Source.ESTIMATE, suite)
    cases[circle.NO_CAMERA] = (Source.ESTIMATE, suite.replace(camera=None))
    if not (math.isfinite(args.duration) and args.duration * suite.imu.rate >= 2.0):
        raise ValueError(
            f"--duration must be at least {2.0 / suite.imu.rate:g} s, two IMU samples, "
            f"got {args.duration:g} s"
        )
    require_matplotlib()
    require_writable("--output", args.output)
    return circle.Setup(
        cases=cases,
        gains=pd_gains(args.gains),
        task=task,
        seeds=range(args.seed, args.seed + args.episodes),
        ticks=round(args.duration * suite.imu.rate),
        threads=args.threads,
        output=args.output,
    )


def main(args: CircleArgs) -> None:
    """Run the experiment."""
    with usage_errors():
        setup = configure(args)
    print(
        f"Circle of radius {args.radius:g} m, period {args.period:g} s, height {args.height:g} m; "
        f"{args.episodes:,} flights of {args.duration:g} s per case, from seed {args.seed}.\n"
    )
    began = time.perf_counter()
    results = {case: setup.fly(case) for case in setup.cases}
    seconds = time.perf_counter() - began
    print(circle.error_table(results))
    print("Mean ± standard deviation over the flights that did not end early (survivors).\n")
    print(circle.consistency_table(results), end="\n\n")
    print(circle.in_words(results, setup.cases[circle.TRUTH][1]), end="\n\n")
    written = circle.write_numbers(results, setup, seconds, args)
    written += circle.write_figures(results, setup)
    print(f"Wrote {len(written)} files to {setup.output} after {seconds:.1f} s.")

"""Show a flight live in a window or as a video, and save its data.

    quad-gym fly lemniscate
    quad-gym fly circle --no-camera --faults gnss_outage --fault-time 4 7
    quad-gym fly circle --faults rotor_loss --output results/outage.mp4
    quad-gym fly --replay results/outage.npz --view chase

The blue vehicle is the truth. The orange ghost is the filter's estimate, with its 3-sigma
ellipsoid; the controller flies on the estimate unless --observation selects another source.

The window shows one episode after the other until it is closed.
"""

import itertools
import math
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import gymnasium
from tqdm import tqdm
from tyro.conf import arg

from baselines.policies import keywords_of_policy, load_policy
from quad_gym import IDS, Flight, sensor_suite
from quad_gym.analysis.reports import require_writable
from quad_gym.commands import options
from quad_gym.commands.evaluate import gates_of
from quad_gym.envs.config import Observation
from quad_gym.evaluation import Policy
from quad_gym.faults import PRESETS, faults_of
from quad_gym.params import checks as check
from quad_gym.rendering import Renderer, save_video
from quad_gym.rendering.renderer import WINDOW_RATE, Window
from quad_gym.rendering.video import VIDEO_ENDINGS, checked_video_path, fly_steps

FAULTS = tuple(name for name in PRESETS if name != "none")
ENDINGS = (*VIDEO_ENDINGS, ".npz", ".csv")


@dataclass(frozen=True)
class FlyArgs:
    """Options of the flight."""

    env_id: options.EnvId = "QuadGym/Circle-v0"
    policy: str = "pd"
    """policy: pd (tuned gains), pd:lab (gains of the report), pretrained (the included policy for
    the task), or a file of quad-gym train (.zip or .npz)"""
    observation: Observation = options.OBSERVATION
    """observation of the controller"""
    seed: int = 0
    """seed of the episode; in the window, the next episodes have consecutive seeds"""
    duration: float | None = None
    """time limit [s]; defaults to the task's default"""
    env: options.Keywords = field(default_factory=dict)
    """further keywords of the environment, such as action=motor control_rate=200 world=breeze"""

    normalization: options.Normalized = None
    sensors: options.OwnSuite = None
    estimator: options.EstimatorName = None
    camera: bool = True
    """measure with the camera, if the suite has one"""
    faults: Annotated[
        tuple[str, ...],
        arg(
            help="faults, one or several (also joined by +), which replace the task's own: "
            f"{', '.join(FAULTS)}; or none"
        ),
    ] = ()
    fault_time: tuple[float, float] | None = None
    """start and end of the faults [s]; defaults to the defaults of each fault"""

    view: Literal["fixed", "chase"] = "fixed"
    """view of the whole scene from outside, or from behind the vehicle"""
    size: tuple[int, int] = (640, 480)
    """width and height of a frame [pixels]"""
    speed: float = 1.0
    """playback speed, in seconds of flight per second; 0.5: slow motion"""
    fps: float = 25.0
    """frames per second of a video"""
    output: Path | None = None
    """file to write instead of opening a window: a video (.mp4, .gif or .webp), saved with the
    flight as .npz; or only the flight (.npz or .csv)"""
    overwrite: bool = False
    """replace these files if they exist"""
    replay: Path | None = None
    """saved flight (.npz) to show instead of a new one"""


def check_options(args: FlyArgs) -> None:
    """Check the options before the flight."""
    options.require_at_least(args, seed=0)
    for name in ("speed", "fps"):
        check.positive(f"--{name}", getattr(args, name))
    if args.fault_time is not None:
        start, end = args.fault_time
        if not 0.0 <= start < end:
            raise ValueError(f"--fault-time must be a start and a later end, got {start:g} {end:g}")
        if not args.faults:
            raise ValueError("--fault-time needs --faults")
    if args.replay is None:
        sensor_suite(options.sensors_of(args.env_id, args.sensors))  # before missing packages
    ending = None if args.output is None else args.output.suffix.lower()
    if args.output is not None:
        if ending not in ENDINGS:
            raise ValueError(f"--output must end in one of {', '.join(ENDINGS)}, got {args.output}")
        if ending in VIDEO_ENDINGS:
            checked_video_path(args.output, args.fps)
        require_writable("--output", args.output.parent)
        for file in files_of(args.output, args):
            options.refuse_overwriting(file, args.overwrite)
    if ending is None or ending in VIDEO_ENDINGS:
        Renderer(args.view, args.size)


def make_env(args: FlyArgs) -> Any:
    """Make an environment with one flight."""
    args = options.with_full_id(args)
    suite = sensor_suite(options.sensors_of(args.env_id, args.sensors))
    keywords = keywords_of_policy(args.policy, args.env_id)
    keywords |= options.environment_of(args, sensors=suite)
    if args.faults:
        faults = faults_of(args.faults, suite if args.camera else suite.replace(camera=None))
        if args.fault_time is not None:
            start, end = args.fault_time
            timed = {"start": start, "duration": end - start, "rate": 0.0}
            faults = tuple(fault.replace(**timed) for fault in faults)
        if args.fault_time is not None and not faults:
            raise ValueError("--fault-time needs --faults other than none")
        keywords["faults"] = faults
    return gymnasium.make_vec(args.env_id, num_envs=1, autoreset_mode="Disabled", **keywords)


def fly(env: Any, policy: Policy, seed: int, about: Any) -> Iterator[Flight]:
    """Run an episode, and yield the flight so far after each step."""
    for flight, ending in fly_steps(policy, env, seed, about | {"seed": seed}):  # noqa: B007
        yield flight
    ended = "ended by the task" if ending == "task" else ending.replace("_", " ")
    words = f"seed {seed}: {ended} after {flight['time'][-1]:.2f} s, "
    gates = gates_of(env)
    if gates:
        words += f"{int(flight['gates_passed'][-1])} of {gates} gates passed"
    else:
        words += f"mean tracking error {1e3 * flight['position_error'].mean():.1f} mm"
    if flight.scene.observation != "truth":
        words += f", mean estimation error {1e3 * flight['estimation_error'].mean():.1f} mm"
    print(words)


def watch(flights: Iterator[Flight], args: FlyArgs, window: Window) -> None:
    """Show a flight in a window, until it ends or the window is closed."""
    renderer, waiting = Renderer(args.view, args.size), math.inf
    for flight in flights:
        waiting += 1.0 / flight.scene.control_rate / args.speed
        if waiting >= 0.999 / WINDOW_RATE:
            window.show(renderer.draw(flight), min(waiting, 1.0))
            waiting = 0.0
        if window.closed:
            return


def files_of(path: Path, args: FlyArgs) -> tuple[Path, ...]:
    """Return the files that are written: of a video of a new flight, also the flight."""
    alone = path.suffix.lower() not in VIDEO_ENDINGS or args.replay is not None
    return (path,) if alone else (path, path.with_suffix(".npz"))


def write(flight: Flight, path: Path, args: FlyArgs) -> tuple[Path, ...]:
    """Write the flight to a file, for videos together with its data; return the files."""
    ending = path.suffix.lower()
    if ending in (".npz", ".csv"):
        return (flight.save(path) if ending == ".npz" else flight.to_csv(path),)

    def progress(times: Iterable[float]) -> Iterator[float]:
        yield from tqdm(times, desc="rendering", unit=" frames")
        print(f"encoding {path} ...", file=sys.stderr, flush=True)

    look: dict[str, Any] = {name: getattr(args, name) for name in ("view", "size", "fps", "speed")}
    save_video(flight, path, progress=progress, **look)
    files = files_of(path, args)
    for data in files[1:]:
        flight.save(data)
    return files


def flights_of(args: FlyArgs) -> Callable[[int], Iterator[Flight]]:
    """Check the options; return a function that runs the episode of a seed, or the saved flight."""
    check_options(args)
    if args.replay is not None:
        saved = Flight.load(args.replay)
        return lambda seed: (saved.until(time) for time in saved["time"])
    env = make_env(args)
    if args.output and not env.unwrapped.flights.batch.max_steps:
        raise ValueError("--output needs a flight with a time limit: a --duration above 0")
    policy, sensors = (
        load_policy(args.policy, env, args.normalization),
        options.sensors_of(args.env_id, args.sensors),
    )
    about: dict[str, Any] = {"task": IDS[args.env_id], "policy": args.policy, "sensors": sensors}
    about["faults"] = args.faults
    return lambda seed: fly(env, policy, seed, about)


def main(args: FlyArgs) -> None:
    """Fly or replay, and show or write."""
    with options.usage_errors():
        args = options.with_full_id(args)
        flights = flights_of(args)
    if args.output:
        with options.filter_hints():
            *_, flight = flights(args.seed)
        for file in write(flight, args.output, args):
            print(f"Wrote {file} ({file.stat().st_size / 1e6:.1f} MB).")
        return
    with options.usage_errors():
        try:
            window = Window(args.size, f"quad_gym: {IDS[args.env_id]}")
        except RuntimeError as error:
            hint = "without a display, --output writes a video instead"
            raise OSError(f"{error}; {hint}") from None
    for seed in itertools.count(args.seed):
        with options.filter_hints():
            watch(flights(seed), args, window)
        if window.closed:
            break

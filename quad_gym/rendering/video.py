"""Flights as videos: fly a policy, record the flight, and write a video of one or several."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from quad_gym.flights import Flight, FlightRecorder
from quad_gym.params import checks as check
from quad_gym.records import Ending
from quad_gym.rendering import canvas as colors
from quad_gym.rendering.canvas import Canvas
from quad_gym.rendering.renderer import Renderer, checked_size, errors_of, legend_of

# --------------------------------------------------------------------------------------------------
# Flights as videos: fly a policy, record the flight, and write a video of it.
# --------------------------------------------------------------------------------------------------

VIDEO_ENDINGS = (".mp4", ".gif", ".webp")  #: file name endings of the videos that can be written
_UNITS = {".gif": 10, ".webp": 1}  #: in which these files have the durations of pictures [ms]
_MOST_FRAMES = 10**6  #: largest number of frames of a video
_SHORTEST = 20.0
"""Shortest duration that browsers show in these files [ms]; they replace shorter ones by 100 ms."""
Progress = Callable[[Iterable[Any]], Iterable[Any]]


def record_flight(
    policy: Any, env_id: str, *, seed: int = 0, about: dict[str, Any] | None = None, **keywords: Any
) -> Flight:
    """Run a policy for one episode and return the flight.

    Args:
        policy: Any object with the `predict` method of Stable-Baselines3; it acts on a batch of one
            observation, as in `quad_gym.evaluation.roll_out`.
        env_id: Id from `quad_gym.IDS`.
        seed: Seed of the episode.
        about: Information to be stored with the flight, in addition to the id and the seed.
        keywords: Keywords of the environment.

    Returns:
        Flight, from its start to the ending of the episode.

    Raises:
        ValueError: If the environment has no time limit, or a keyword is invalid.
    """
    env = gymnasium.make_vec(env_id, num_envs=1, autoreset_mode="Disabled", **keywords)
    if env.unwrapped.flights.batch.max_steps == 0:  # type: ignore[attr-defined]
        raise ValueError("env must have a time limit: a duration or max_episode_steps above 0")
    known = {"seed": seed, "env_id": env_id, **(about or {})}
    *_, (flight, _) = fly_steps(policy, env, seed, known)
    return flight


def fly_steps(
    policy: Any, env: Any, seed: int, about: dict[str, Any]
) -> Iterator[tuple[Flight, str]]:
    """Run an episode; yield the flight so far, at the start and after each step, and its ending.

    Args:
        policy: As in `record_flight`.
        env: A vector environment of one flight.
        seed: Seed of the episode.
        about: Information to be stored with the flight.
    """
    batch = env.unwrapped.flights.batch
    recorder = FlightRecorder(batch, about=about)
    observation, _ = env.reset(seed=seed)
    recorder.keep()
    yield recorder.flight, "none"
    state, starts, over = None, np.ones(1, bool), False
    while not over:
        action, state = policy.predict(
            observation, state=state, episode_start=starts, deterministic=True
        )
        observation, _, terminated, truncated, info = env.step(action)
        starts, over = np.zeros(1, bool), bool(terminated[0] or truncated[0])
        recorder.keep()
        yield recorder.flight, str(Ending(info["ending"][0]))


def times_of(
    end: float, fps: float, speed: float, progress: Progress | None = None
) -> Iterable[float]:
    """Return the times of the frames of a video [s], the end included."""
    if end * fps / check.positive("speed", speed) > _MOST_FRAMES:
        raise ValueError(
            f"speed must be at least {end * fps / _MOST_FRAMES:.3g}, with which {end:g} s at "
            f"{fps:g} frames per second are a video that has {_MOST_FRAMES:,} frames, got {speed:g}"
        )
    times = np.append(np.arange(0.0, end - 1e-9, speed / fps), end)
    return progress(times) if progress else times


def save_video(
    flight: Flight,
    path: Path | str,
    *,
    view: str = "fixed",
    size: tuple[int, int] = (640, 480),
    fps: float = 25.0,
    speed: float = 1.0,
    progress: Progress | None = None,
) -> Path:
    """Write a flight as MP4 (H.264), animated GIF or WebP, depending on the file name's ending.

    Args:
        flight: Flight to show.
        path: Path of the file; missing folders are created.
        view: "fixed" or "chase".
        size: Width and height [pixels].
        fps: Frames per second.
        speed: Seconds of flight per second of video; below 1 for slow motion.
        progress: Wrapper of the times of the frames, such as `tqdm.tqdm`.

    Returns:
        Path of the file.

    Raises:
        ValueError: If an argument is invalid.
        ImportError: If a library that writes the file is not installed.
    """
    target = checked_video_path(path, fps)
    times = times_of(float(flight["time"][-1]), fps, speed, progress)
    renderer = Renderer(view, checked_size(size), path_I=flight["position"])
    frames = (renderer.draw(flight.until(t)) for t in times)
    write_frames(frames, target, fps=fps)
    return target


def checked_video_path(path: Path | str, fps: float = 25.0) -> Path:
    """Return the path of a video, if its ending is known and its library installed.

    Args:
        path: The path.
        fps: Frames per second, which the format must be able to show.
    """
    target, most, rate = Path(path), 1000.0 / _SHORTEST, check.positive("fps", fps)
    ending = check.choice("the ending of the video's path", target.suffix.lower(), VIDEO_ENDINGS)
    if ending in _UNITS and rate > most:
        raise ValueError(f"fps must be at most {most:g} for a {ending} video, got {fps:g}")
    module = "imageio_ffmpeg" if ending == ".mp4" else "PIL.Image"
    check.package(module, f"a {target.suffix} video", "render")
    return target


def write_frames(
    frames: Iterable[NDArray[np.uint8]], path: Path, *, fps: float, lossless: bool = False
) -> None:
    """Write frames (height, width, 3) as a video in the format of the file name's extension.

    The file is renamed when it is complete: an interrupted run leaves an earlier file unchanged.
    Lossless compression (WebP only) makes files smaller if most of the picture does not change.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f"{path.stem}.part{path.suffix}")
    try:
        if path.suffix.lower() == ".mp4":
            _write_mp4(iter(frames), unfinished, fps)
        else:
            _write_animation(frames, unfinished, fps, lossless)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def _write_mp4(frames: Iterator[NDArray[np.uint8]], path: Path, fps: float) -> None:
    import imageio_ffmpeg

    first = next(frames)
    writer = imageio_ffmpeg.write_frames(
        str(path),
        first.shape[1::-1],
        fps=fps,
        macro_block_size=2,
        quality=8,
        output_params=["-movflags", "+faststart"],
        ffmpeg_log_level="error",
    )
    writer.send(None)
    try:
        writer.send(first)
        for frame in frames:
            writer.send(frame)
    finally:
        writer.close()


def _write_animation(
    frames: Iterable[NDArray[np.uint8]], path: Path, fps: float, lossless: bool
) -> None:
    from PIL import Image

    pictures = [Image.fromarray(frame) for frame in frames]
    if path.suffix.lower() == ".webp":
        # lossless: quality is the effort, and more than this saves no bytes. Key frames, which only
        # seeking needs, take most of the time and a seventh of the bytes
        effort = (
            {"quality": 20, "method": 1, "kmax": 0} if lossless else {"quality": 70, "method": 4}
        )
        options: dict[str, Any] = {**effort, "minimize_size": False, "lossless": lossless}
    else:
        # one palette for all, so that colors do not flicker
        palette = pictures[len(pictures) // 2].quantize(128, dither=Image.Dither.NONE)
        pictures = [p.quantize(palette=palette, dither=Image.Dither.NONE) for p in pictures]
        options = {"optimize": False}
    pictures[0].save(
        path,
        save_all=True,
        append_images=pictures[1:],
        duration=_durations(len(pictures), fps, path.suffix),
        loop=0,
        **options,
    )


def _durations(count: int, fps: float, suffix: str) -> list[int]:
    """Return the durations of pictures [ms], so rounded that their sums keep time."""
    unit = _UNITS[suffix.lower()]
    ends = np.round(np.arange(count + 1) * (1000.0 / fps) / unit).astype(int) * unit
    return [int(duration) for duration in np.diff(ends)]


# --------------------------------------------------------------------------------------------------
# Videos of one episode flown by several policies, side by side.
# --------------------------------------------------------------------------------------------------

SIDE = (480, 470)  #: width and height of one flight [pixels]
HOLD = 2.5  #: duration of the last picture, to read how the flights ended [s]
AFTER = 4.0  #: time for which other flights are shown after the last crash [s]
BAND, LEGEND = 64, 34  #: heights of the label above a flight, and of the legend below [pixels]
_LARGE, _SMALL = 24, 20  #: sizes of text


def ending_for_readers(ending: str) -> str:
    """Words for an ending, such as "below minimum height" for "below_min_height"."""
    return ending.replace("_min_", "_minimum_").replace("_", " ")


@dataclass(frozen=True, eq=False)
class Side:
    """One flight of a video side by side.

    Args:
        flight: Flight, from its start to its ending.
        label: Name of the policy, for readers.
        ending: Ending of the episode, for readers, such as "collision".
        crashed: True if the ending was a crash.
        course: Name and number of the objects passed on a course, such as ("gates", 8).
    """

    flight: Flight
    label: str
    ending: str
    crashed: bool
    course: tuple[str, int] | None = None

    @property
    def end(self) -> float:
        """Time at which the flight ended [s]."""
        return float(self.flight["time"][-1])

    @property
    def outcome(self) -> str:
        """How the flight ended, and when."""
        how = "crashed" if self.crashed else "ended"
        return f"{how} at {self.end:.1f} s: {ending_for_readers(self.ending)}"

    def status(self, time: float) -> str:
        """Errors or progress on the course at a time [s]; after the end, how the flight ended."""
        if time > self.end - 1e-9:
            return self.outcome
        if self.course is None:
            return errors_of(self.flight.until(time))
        now, (what, total) = self.flight.until(time).rows[-1], self.course
        speed = np.linalg.norm(now["velocity"])
        return f"{int(now['gates_passed'])} of {total} {what}, {speed:.1f} m/s"


class SideBySide:
    """Renderer of flights of one episode, side by side; ended flights stay at their last instant.

    If some flights crash and others do not, the film ends `AFTER` seconds after the last crash, and
    its last picture has the outcome of the others.

    Args:
        sides: Flights, from left to right.
        speed: Seconds of flight per second of video, for the legend.

    Raises:
        ValueError: If there is no flight.
        ImportError: If pygame is not installed.
    """

    def __init__(self, sides: Sequence[Side], speed: float = 1.0) -> None:
        self.sides, self.end, self._speed = tuple(sides), end_of(sides), speed
        width, height = SIDE
        views = [_view_of(side.flight) for side in sides]
        self._on_course = "course" in views
        size = (width, height - BAND - LEGEND)
        path_I = np.concatenate([side.flight["position"] for side in sides])
        # both views of a scene are the same, and contain both flights
        self._renderers = [Renderer(view, size, legend=False, path_I=path_I) for view in views]
        self._band = Canvas(width, BAND)
        self._legend = Canvas(width * len(sides), LEGEND)

    def draw(self, time: float) -> NDArray[np.uint8]:
        """Draw a picture (height, width, 3) of red, green, blue at a time [s]."""
        parts = []
        for side, renderer in zip(self.sides, self._renderers, strict=True):
            over = side.crashed and time > side.end - 1e-9
            picture = renderer.draw(side.flight.until(time), "crashed" if over else "")
            parts.append(np.concatenate([self._label(side, time), picture]))
            parts[-1][:, -2:] = colors.GREY
        return np.concatenate([np.concatenate(parts, axis=1), self._footer(time)])

    def _label(self, side: Side, time: float) -> NDArray[np.uint8]:
        """Draw the band above a flight: its label, and its status below."""
        band, over = self._band, time > min(side.end, self.end) - 1e-9
        ending = colors.VERMILLION if side.crashed else colors.GREEN
        band.clear(ending if over else colors.PALE)
        band.finish()
        ink = colors.WHITE if over else colors.INK
        band.text(band.fitting([side.label], _LARGE, band.width), 12.0, 8.0, _LARGE, ink)
        status = side.outcome if over else side.status(time)
        if side.end > self.end + 1e-9 and over:
            status = f"flew on, and {status}"
        band.text(status, 12.0, 14.0 + band.line_height(_LARGE), _SMALL, ink)
        return band.pixels()

    def _footer(self, time: float) -> NDArray[np.uint8]:
        """Draw the time and the legend below all flights."""
        canvas, flight = self._legend, self.sides[0].flight
        canvas.clear(colors.WHITE)
        canvas.finish()
        clock = f"{time:4.1f} s" + ("" if self._speed == 1.0 else f", {self._speed:.2g}x speed")
        x = 12.0 + canvas.text(clock, 12.0, 9.0, _SMALL) + 20.0
        legend = legend_of(flight.until(min(time, self.sides[0].end)))
        legend = legend[1:] if self._on_course else legend  # a course has no reference
        legend += [("marker", ("box", colors.INK))] if flight.scene.has_camera else []
        for words, mark in legend:
            canvas.mark(mark, x, 9.0, _SMALL)
            x += 34.0 + canvas.text(words, x + 16.0, 9.0, _SMALL)
        return canvas.pixels()


def end_of(sides: Sequence[Side]) -> float:
    """Time at which a video of some flights ends [s]."""
    if not sides:
        raise ValueError("sides must be at least one, got none")
    last = max(side.end for side in sides)
    crashes = [side.end for side in sides if side.crashed]
    return min(last, max(crashes) + AFTER) if crashes else last


def _view_of(flight: Flight) -> str:
    """View of a flight: a course of obstacles is too long for one picture, gates fit into one."""
    if len(flight.scene.obstacles):
        return "course"
    return "fixed" if len(flight.scene.gates_I) else "follow"


def save_side_by_side(
    sides: Sequence[Side],
    path: Path | str,
    *,
    fps: float = 12.5,
    speed: float = 1.0,
    progress: Progress | None = None,
) -> Path:
    """Write flights of one episode as a video, from left to right.

    Other arguments and the result are as in `save_video`.

    Raises:
        ValueError: If an argument is invalid.
        ImportError: If a library for drawing or writing is not installed.
    """
    target = checked_video_path(path, fps)
    film = SideBySide(sides, speed)
    times = times_of(film.end, fps, speed, progress)

    def frames() -> Iterator[NDArray[np.uint8]]:
        for time in times:
            last = film.draw(time)
            yield last
        for _ in range(round(HOLD * fps)):
            yield last

    write_frames(frames(), target, fps=fps, lossless=True)
    return target

"""Frames per second of the renderer, on one core."""

import itertools
from collections.abc import Iterator

import gymnasium
import numpy as np

from baselines import PDPolicy
from quad_gym import IDS, Flight
from quad_gym.experiments.benchmark import timing
from quad_gym.rendering import VIEWS, Renderer, flight_of

SIZE = (640, 480)
INSTANTS = 40


def time_rendering(effort: timing.Effort) -> list[timing.Row]:
    """Time frames of every task from both views, at instants distributed over a flight."""
    rows: list[timing.Row] = []
    for env_id, task in IDS.items():
        env = gymnasium.make_vec(env_id, 1, autoreset_mode="Disabled", threads=1)
        flight = flight_of(PDPolicy(env), env)
        times = np.linspace(0.0, flight["time"][-1], INSTANTS)
        for view in VIEWS:
            renderer = Renderer(view, SIZE)
            moments = itertools.cycle([flight.until(time) for time in times])

            def frames(renderer: Renderer = renderer, moments: Iterator[Flight] = moments) -> None:
                for _ in range(INSTANTS):
                    renderer.draw(next(moments))

            timed = timing.measure(frames, effort).per(INSTANTS)
            rows.append(
                timing.report(f"{task}, {view} view", timed, task=task, view=view, size=SIZE)
            )
    return rows


def rendering_table(rows: list[timing.Row]) -> str:
    """Format the section."""
    times = timing.column("seconds", ".2f", 1e3)
    columns = {
        "task": timing.NAME,
        "ms": times,
        "frames/s": timing.per_second,
        "spread": timing.SPREAD,
    }
    return timing.table(f"Frames of {SIZE[0]} x {SIZE[1]}, one core", rows, columns)

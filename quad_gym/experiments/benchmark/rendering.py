"""Frames per second of the renderer, on one core."""

import itertools
from collections.abc import Iterator

import gymnasium
import numpy as np

from baselines import PDPolicy
from quad_gym import IDS, Flight
from quad_gym.experiments.benchmark.timing import (
    NAME,
    SPREAD,
    Effort,
    Row,
    column,
    measure,
    per_second,
    report,
    table,
)
from quad_gym.rendering import VIEWS, Renderer, flight_of

SIZE = (640, 480)
INSTANTS = 40


def time_rendering(effort: Effort) -> list[Row]:
    """Time frames of every task from both views, at instants distributed over a flight."""
    rows: list[Row] = []
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

            timing = measure(frames, effort).per(INSTANTS)
            rows.append(report(f"{task}, {view} view", timing, task=task, view=view, size=SIZE))
    return rows


def rendering_table(rows: list[Row]) -> str:
    """Format the section."""
    times = column("seconds", ".2f", 1e3)
    columns = {"task": NAME, "ms": times, "frames/s": per_second, "spread": SPREAD}
    return table(f"Frames of {SIZE[0]} x {SIZE[1]}, one core", rows, columns)

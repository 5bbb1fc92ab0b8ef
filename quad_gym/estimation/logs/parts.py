"""Parts of a log between pauses: each is flown by itself."""

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from quad_gym.estimation.logs.clocks import PAUSE
from quad_gym.estimation.logs.log import Log

RUNNING = 0.4  #: command of running motors, over their largest [-]
SHORTEST = 1.0  #: shorter parts of a log with pauses are left out [s]


def running_motors(log: Log) -> Any:
    """Return True for the rows of `log.motors` with running motors, or None without commands."""
    if log.motors is None or not len(log.motors):
        return None
    commands = next(iter(log.motors.values.values())).mean(axis=1)
    most = float(np.nanpercentile(commands, 95.0))
    return commands > RUNNING * most if most > 0.0 else None


def parts_of(log: Log) -> list[Log]:
    """Return the parts of a log, between pauses of the IMU longer than `PAUSE`.

    Parts shorter than `SHORTEST` are left out, unless all are.
    """
    time = log.imu.time
    steps = np.diff(time)
    if np.median(steps) > PAUSE:  # no pauses, but another unit
        return [log]
    begins = [0, *(np.flatnonzero(steps > PAUSE) + 1).tolist(), len(time)]
    if len(begins) == 2:
        return [log]
    pairs = list(itertools.pairwise(begins))
    long = [(a, b) for a, b in pairs if time[b - 1] - time[a] >= SHORTEST]
    return [_part(log, a, b) for a, b in long or pairs if b - a > 1]


def _part(log: Log, first: int, end: int) -> Log:
    """Return a part from one IMU sample up to another, with the measurements that arrive then."""
    time = log.imu.time
    low = time[first] - PAUSE if first else -np.inf
    high = time[end] - PAUSE if end < len(time) else np.inf
    changes: dict[str, Any] = {"imu": log.imu.rows(slice(first, end))}
    others = {**log.streams, "motors": log.motors, "battery": log.battery}
    for name, stream in others.items():
        if name != "imu" and stream is not None:
            changes[name] = stream.rows((stream.received >= low) & (stream.received < high))
    return replace(log, **changes)


def longest_part(log: Log) -> Log:
    """Return the longest part of a log, with a sentence if there are others."""
    parts = parts_of(log)
    if len(parts) == 1:
        return parts[0]
    best = max(parts, key=lambda part: float(np.ptp(part.imu.time)))
    first, last = best.imu.time[[0, -1]]
    sentence = (
        f"the log has {len(parts) - 1} pauses: its longest part is used, from {first:.2f} s to "
        f"{last:.2f} s (--from, --until choose another)"
    )
    return replace(best, notes=(*best.notes, sentence))


@contextmanager
def naming(log: Log) -> Iterator[None]:
    """Name the file of a log in errors about it."""
    try:
        yield
    except ValueError as error:
        name, text = str(log.about.get("file", "")), str(error)
        if not name or name in text:
            raise
        kind = ValueError if isinstance(error, np.linalg.LinAlgError) else type(error)
        raise kind(f"{name}: {text}") from error

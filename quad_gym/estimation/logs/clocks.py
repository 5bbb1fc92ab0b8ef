"""Times of a log: stamps that increase, rows that count once, and one clock for all sensors.

Rows are taken in the order of the file. The stamps that fit together are the longest sequence of
them that does not decrease; a row far from its neighbors there has a wrong stamp. A single wrong
stamp therefore costs one row, wherever it is and however far ahead.
"""

import bisect
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from quad_gym.estimation.logs.log import Floats
from quad_gym.estimation.logs.repeats import spread
from quad_gym.estimation.logs.source import COMMANDS, LogSource, RawLog
from quad_gym.params.aid_table import AID_PARAMS

LATE = (
    1.0  #: largest delay of a measurement behind a later one, beyond which its stamp is wrong [s]
)
OTHER_CLOCK = 10.0  #: difference of two clocks with nothing in common [s]
PAUSE = 1.0  #: step between samples of the IMU that divides a log into parts [s]
_FEW = 3  #: samples of a part that are wrong stamps
_REPEATED, _CHANGES = 0.5, 10
"""Share of rows that repeat the one before, and number of changes, in a stream of copies."""
_OF_IMU = ("imu", "gyro", "accel")

DOUBLED, WRONG, COPIES = "repeated stamp", "wrong time stamp", "copy of the measurement before"
OUTSIDE = "outside of the time of the IMU"


def longest_increase(time: Floats) -> Any:
    """Return True for the rows of the longest sequence of stamps that does not decrease."""
    if (np.diff(time) >= 0.0).all():
        return np.ones(len(time), bool)
    ends: list[float] = []  # least last stamp of the sequences of each length
    rows: list[int] = []  # their last rows
    before = np.full(len(time), -1)
    for k, stamp in enumerate(time.tolist()):
        place = bisect.bisect_right(ends, stamp)
        if place:
            before[k] = rows[place - 1]
        ends[place : place + 1], rows[place : place + 1] = [stamp], [k]
    found = np.zeros(len(time), bool)
    k = rows[-1]
    while k >= 0:
        found[k] = True
        k = int(before[k])
    return found


def cleaned(recording: RawLog, source: LogSource) -> LogSource:
    """Return a source with correct stamps, in which each row counts once."""
    if source.received is not None:
        source = _stamped(recording, source)
    source = source.keep(np.isfinite(source.time), "no time stamp")
    if not len(source):
        return source
    time, fits = source.time, longest_increase(source.time)
    if source.sensor not in _OF_IMU:
        before = np.maximum.accumulate(np.where(fits, time, -np.inf))
        after = np.minimum.accumulate(np.where(fits, time, np.inf)[::-1])[::-1]
        fits |= (time > before - LATE) & (time < after + LATE)
    source = _without_lone_stamps(source.keep(fits, WRONG))
    source = _without_doubles(source)
    if source.sensor in _OF_IMU or source.sensor in AID_PARAMS:
        source = spread(recording, source, PAUSE)
    return _once(source)


def _stamped(recording: RawLog, source: LogSource) -> LogSource:
    """Return a source that has its times of arrival as stamps, if none was ever set."""
    assert source.received is not None
    known = source.time[np.isfinite(source.time)]
    if len(source) > 1 and (not len(known) or np.ptp(known) == 0.0 < np.ptp(source.received)):
        recording.notes.append(
            f"{source.name}: its stamps were never set; it is placed by its times of recording"
        )
        return replace(source, time=source.received)
    return source


def _without_lone_stamps(source: LogSource) -> LogSource:
    """Return an IMU without samples apart from all others: they fit, but only at an end."""
    if source.sensor not in _OF_IMU or len(source) <= _FEW:
        return source
    part = np.concatenate([[0], np.cumsum(np.diff(source.time) > PAUSE)])
    sizes = np.bincount(part)
    return source.keep(sizes[part] > min(_FEW, sizes.max() - 1), WRONG)


def _without_doubles(source: LogSource) -> LogSource:
    """Return a source without rows that equal another one with the same stamp."""
    if len(source) < 2 or source.sensor in COMMANDS:
        return source
    columns = (v.reshape(len(source), -1) for v in source.values.values())
    table = np.nan_to_num(np.column_stack([source.time, *columns]), nan=np.inf)
    order = np.argsort(source.time, kind="stable")
    fresh = np.ones(len(source), bool)
    fresh[order[1:]] = (table[order[1:]] != table[order[:-1]]).any(axis=1)
    return source.keep(fresh, DOUBLED)


def _once(source: LogSource) -> LogSource:
    """Return a source with a row for each stamp, and without copies of the measurement before."""
    if len(source) < 2:
        return source
    order = np.argsort(source.time, kind="stable")
    fresh = np.ones(len(source), bool)
    fresh[order[1:]] = np.diff(source.time[order]) > 0.0
    if source.sensor != "motors":
        source = source.keep(fresh, DOUBLED)
    if source.sensor in _OF_IMU or source.sensor in COMMANDS:
        return source
    table = np.column_stack([v.reshape(len(source), -1) for v in source.values.values()])
    table = np.nan_to_num(table, nan=np.inf)
    changed = np.concatenate([[True], (table[1:] != table[:-1]).any(axis=1)])
    if changed.sum() < _CHANGES or changed.mean() > _REPEATED:
        return source
    period = float(np.median(np.diff(source.time[changed])))
    kept, last = changed.copy(), -np.inf
    for k, stamp in enumerate(source.time.tolist()):
        kept[k] |= stamp > last + 1.5 * period
        last = stamp if kept[k] else last
    return source.keep(kept, COPIES)


def on_one_clock(recording: RawLog, sources: Sequence[LogSource]) -> list[LogSource]:
    """Return sources on one clock.

    Stamps of another clock than the recorder's are moved by the median difference, unless all
    sources have the same one, as in a log that was recorded again.
    """
    lags = [
        0.0 if s.received is None or not len(s) else float(np.median(s.received - s.time))
        for s in sources
    ]
    known = [lag for s, lag in zip(sources, lags, strict=True) if s.received is not None and len(s)]
    apart = bool(known) and max(known) - min(known) > OTHER_CLOCK
    found = []
    for source, lag in zip(sources, lags, strict=True):
        if source.received is None or abs(lag) <= OTHER_CLOCK:
            found.append(source)
        elif apart:
            recording.problems.append(
                f"{source.name}: its stamps are of another clock, {lag:.1f} s from the recorder's; "
                "it is placed by its times of recording"
            )
            found.append(replace(source, time=source.time + lag))
        else:
            found.append(replace(source, received=source.received - lag))
    return _arrived(_within(recording, found))


def _within(recording: RawLog, sources: Sequence[LogSource]) -> list[LogSource]:
    """Return sources without measurements outside of the time of the IMU."""
    samples = [s.time for s in sources if s.sensor in _OF_IMU and len(s)]
    if not samples:
        return list(sources)
    first, last = min(t[0] for t in samples), max(t[-1] for t in samples)
    found = []
    for source in sources:
        inside = (source.time > first - OTHER_CLOCK) & (source.time < last + OTHER_CLOCK)
        if len(source) and not inside.any():
            raise ValueError(
                f"{recording.where}the clocks of a log must have times in common, got "
                f"{source.sensor} ({source.name}) from {source.time.min():.3f} s to "
                f"{source.time.max():.3f} s, and the IMU from {first:.3f} s to {last:.3f} s"
            )
        found.append(source.keep(inside, OUTSIDE))
    return found


def _arrived(sources: Sequence[LogSource]) -> list[LogSource]:
    """Return sources of a table with their times of arrival: no row before the row above it."""
    rows = [s.row for s in sources if s.row is not None and s.received is None and len(s)]
    if not rows:
        return list(sources)
    latest = np.full(1 + max(int(r.max()) for r in rows), -np.inf)
    for s in sources:
        if s.row is not None and s.received is None:
            np.maximum.at(latest, s.row, s.time)
    latest = np.maximum.accumulate(latest)
    return [
        replace(s, received=latest[s.row]) if s.row is not None and s.received is None else s
        for s in sources
    ]

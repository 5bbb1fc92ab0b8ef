"""Times of a log: repeated rows, increasing stamps, one clock, and parts between pauses."""

import bisect
import itertools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from quad_gym.logs.formats.log import COMMANDS, Floats, Log, LogSource, RawLog
from quad_gym.params.sensor_table import AID_PARAMS

# --------------------------------------------------------------------------------------------------
# Rows that are no measurements of their own: repeated values, and batches of stamps.
#
# A sensor or its driver that hangs repeats its last value bit for bit. Real sensors repeat values,
# too, by their resolution, but not for long: a run of equal values that chance does not explain, by
# how often values repeat elsewhere in the log, counts once.
#
# Drivers that read several samples at once stamp them when they arrive: with the same stamp, or
# with stamps microseconds apart. Such samples were taken evenly over the time since the batch
# before.
# --------------------------------------------------------------------------------------------------

CHANCE = 1e-3  #: expected number of equally long runs by chance, below which a run counts once
LEAST_SHARE = 0.01  #: share of rows, at least, that repeat the one before by chance
LONGEST_RUNS = 3, 0.02  #: number and share of the longest runs that do not show what is usual
MIN_CHANGES = 10  #: changes that show how often values repeat
BATCHED = 0.3  #: share of steps inside of batches, at least
APART = 5.0  #: ratio of the steps between and inside of batches, at least
BETWEEN = (1.5, 0.6)  #: multiples of both, between which there are hardly any steps
HARDLY = 0.1  #: share of these
LONGEST_BATCH = 3.0  #: time of a batch, over that of its samples at the mean rate
FEW = 20  #: rows, and batches, that show that a sensor is read in batches
ALIKE = 0.8  #: share of the batches whose size is the usual one, up to a factor of two

FROZEN = "repeats the measurement before"


def repeats(values: Floats) -> Any:
    """Return True for the rows (n, ...) of long runs of equal values, from their second row on.

    Rows without a measurement, NaN, are skipped.
    """
    table = values.reshape(len(values), -1)
    rows = np.flatnonzero(np.isfinite(table).all(axis=1))
    found = np.zeros(len(values), bool)
    if len(rows) < MIN_CHANGES:
        return found
    same = (table[rows[1:]] == table[rows[:-1]]).all(axis=1)
    begins = np.flatnonzero(np.concatenate([[True], ~same]))
    lengths = np.diff(np.append(begins, len(rows)))
    if len(lengths) < MIN_CHANGES:
        return found
    few, of_all = LONGEST_RUNS
    usual = np.sort(lengths)[: len(lengths) - max(few, round(of_all * len(lengths)))]
    share = max(1.0 - len(usual) / usual.sum(), LEAST_SHARE)
    long = len(rows) * share ** (lengths - 1.0) < CHANCE
    for begin, length in zip(begins[long].tolist(), lengths[long].tolist(), strict=True):
        found[rows[begin + 1 : begin + length]] = True
    return found


def without_repeats(recording: RawLog, source: LogSource) -> LogSource:
    """Return a source whose repeated measurements count once, with a sentence about them.

    Positions, velocities and baselines of a receiver count by themselves, both halves of an IMU
    together.
    """
    if len(source) < MIN_CHANGES:
        return source
    values = {name: v for name, v in source.values.items() if "sigma" not in name}
    if source.sensor == "gnss":
        frozen = {name: repeats(v) for name, v in values.items()}
    else:
        joint = np.column_stack([v.reshape(len(source), -1) for v in values.values()])
        frozen = dict.fromkeys(values, repeats(joint))
    if not any(rows.any() for rows in frozen.values()):
        return source
    kept = dict(source.values)
    for name, rows in frozen.items():
        if rows.any():
            word = source.sensor if source.sensor != "gnss" else f"{name.split('_')[1]} of GNSS"
            recording.notes.append(_sentence(word, source, rows))
            kept[name] = values[name].copy()
            kept[name][rows] = np.nan
    nothing = np.all([rows | _unmeasured(values[n]) for n, rows in frozen.items()], axis=0)
    some = np.any(list(frozen.values()), axis=0)
    return replace(source, values=kept).keep(~(nothing & some), FROZEN)


def _unmeasured(values: Floats) -> Any:
    return ~np.isfinite(values.reshape(len(values), -1)).all(axis=1)


def _sentence(word: str, source: LogSource, rows: Any) -> str:
    """Return a sentence on repeated measurements."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], rows.astype(int), [0]])))
    first, last = edges[::2], edges[1::2] - 1
    begins = source.time[np.maximum(first - 1, 0)]
    spans = source.time[last] - begins
    k = int(np.argmax(spans))
    times = "" if len(first) == 1 else f", the longest of {len(first)} times"
    return (
        f"{word} ({source.name}) repeats one measurement for {spans[k]:.1f} s from "
        f"{begins[k]:.1f} s on{times}: it counts once, as the sensor or its driver hangs"
    )


def spread(recording: RawLog, source: LogSource, longest: float) -> LogSource:
    """Return a source whose batches of stamps are spread evenly, with a sentence about them.

    Args:
        recording: The file; it receives the sentence.
        source: A source whose stamps do not decrease, but for single ones.
        longest: Longest time between two batches [s].
    """
    if len(source) < FEW:
        return source
    order = np.argsort(source.time, kind="stable")
    time = source.time[order]
    steps = np.diff(time)
    usual = steps[steps < longest]
    if not len(usual) or np.ptp(usual) == 0.0:
        return source
    mean = float(usual.mean())
    short, long = float(np.median(usual[usual < mean])), float(np.median(usual[usual >= mean]))
    low, high = BETWEEN[0] * short, BETWEEN[1] * long
    between = float(((usual > low) & (usual < high)).mean())
    if (usual < mean).mean() < BATCHED or long < APART * short or between > HARDLY:
        return source
    tiny = steps < 0.5 * (low + high)
    last = np.append(np.flatnonzero(~tiny), len(time) - 1)  # of each batch
    first = np.concatenate([[0], last[:-1] + 1])
    counts = last - first + 1
    alike = np.abs(np.log2(counts / np.median(counts))) <= 1.0
    if len(counts) < FEW or alike.mean() < ALIKE:
        return source  # some pauses
    ends = time[last]
    spans = np.diff(ends, prepend=ends[0] - counts[0] * mean)
    spans = np.where(spans > LONGEST_BATCH * counts * mean, counts * mean, spans)
    batch = np.repeat(np.arange(len(counts)), counts)
    place = np.arange(len(time)) - first[batch] + 1
    even = np.empty_like(time)
    even[order] = ends[batch] - spans[batch] * (1.0 - place / counts[batch])
    recording.notes.append(
        f"{source.sensor} ({source.name}) is stamped in batches of {np.median(counts):.0f}, at "
        "their arrival: the samples are spread evenly over the time since the batch before"
    )
    return replace(source, time=even)


# --------------------------------------------------------------------------------------------------
# Times of a log: stamps that increase, rows that count once, and one clock for all sensors.
#
# Rows are taken in the order of the file. The stamps that fit together are the longest sequence of
# them that does not decrease; a row far from its neighbors there has a wrong stamp. A single wrong
# stamp therefore costs one row, wherever it is and however far ahead.
# --------------------------------------------------------------------------------------------------

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


# --------------------------------------------------------------------------------------------------
# Parts of a log between pauses: each is flown by itself.
# --------------------------------------------------------------------------------------------------

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

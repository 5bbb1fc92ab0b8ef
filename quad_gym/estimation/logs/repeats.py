"""Rows that are no measurements of their own: repeated values, and batches of stamps.

A sensor or its driver that hangs repeats its last value bit for bit. Real sensors repeat values,
too, by their resolution, but not for long: a run of equal values that chance does not explain, by
how often values repeat elsewhere in the log, counts once.

Drivers that read several samples at once stamp them when they arrive: with the same stamp, or with
stamps microseconds apart. Such samples were taken evenly over the time since the batch before.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from quad_gym.estimation.logs.log import Floats
from quad_gym.estimation.logs.source import LogSource, RawLog

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
            word = source.sensor if source.sensor != "gnss" else f"{name.split('_')[0]} of GNSS"
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

"""Selection of one source for each sensor: never the first one for being the first.

The caller's choice comes first. Then, among the sources with nearly as much valid data as the best,
the one that the autopilot used or prefers; without a preference, the compass with the most constant
field, and the source with the most data.

A compass must first have the Earth's field at the place of the flight, in strength and in the angle
to the vertical: an autopilot may have used the one that iron and currents disturb.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from quad_gym.estimation.logs.earth_field import earth_field
from quad_gym.estimation.logs.log import Floats
from quad_gym.estimation.logs.source import SENSORS, LogSource, RawLog
from quad_gym.params.checks import keywords

_NEARLY = 0.9  #: share of the best source's time that makes another one eligible
SAME_STRENGTH = 0.15  #: relative difference from the Earth's field, which calibrations leave
SAME_ANGLE = math.radians(20.0)  #: difference of the angles to the vertical, which tilt leaves
_LOST = 3.0  #: time without data in which another source has some, to be reported [s]


def select(
    recording: RawLog,
    sources: Sequence[LogSource],
    instance: Mapping[str, int] | None = None,
    topic: Mapping[str, str] | None = None,
) -> dict[str, LogSource]:
    """Return a source for each sensor of a file.

    Args:
        recording: The file; it receives sentences on the choice.
        sources: Its sources, cleaned.
        instance: Numbers that the caller chooses, by sensor.
        topic: Topics that the caller chooses, by sensor.
    """
    keywords(instance or {}, SENSORS, "instance")
    keywords(topic or {}, SENSORS, "topic")
    found: dict[str, LogSource] = {}
    for sensor in SENSORS:
        known = [s for s in sources if s.sensor == sensor]
        chosen = _asked(recording, sensor, known, (instance or {}).get(sensor), "instance")
        if topic and sensor in topic:
            chosen = _asked(recording, sensor, chosen, topic[sensor], "topic")
        recording.notes += [_empty(s) for s in known if not len(s) and s.dropped]
        full = [s for s in chosen if len(s)]
        if not full:
            continue
        fit = _field_fits(full, found) if sensor == "magnetometer" else {}
        found[sensor] = best = _best(full, fit)
        others = [s for s in known if s is not best and len(s)]
        if others:
            recording.notes.append(_taken(sensor, best, others, fit))
            recording.notes += _could_take_over(sensor, best, others)
    return found


def _asked(
    recording: RawLog, sensor: str, known: list[LogSource], asked: Any, word: str
) -> list[LogSource]:
    """Return the sources that the caller's choice leaves."""
    if asked is None:
        return known
    chosen = [s for s in known if getattr(s, word) == asked]
    if not chosen:
        have = ", ".join(sorted({str(getattr(s, word)) for s in known})) or "none"
        raise ValueError(
            f"{recording.where}{word} of {sensor} must be one in the log ({have}), got {asked}"
        )
    if word == "instance":
        least = min(s.tier for s in chosen)
        return [s for s in chosen if s.tier == least]
    return chosen


def _empty(source: LogSource) -> str:
    """Return a sentence on a source of which nothing is left."""
    reasons = ", ".join(f"{n} rows: {reason}" for reason, n in source.dropped.items())
    return f"{source.sensor} ({source.name}) is left out: {reasons}"


def _seconds(source: LogSource) -> Any:
    """Return the numbers of the seconds with data."""
    return np.unique(np.floor(source.time))


class _FieldFit(NamedTuple):
    """A compass compared with the Earth's field."""

    strength: float  #: median strength of its field [T]
    expected: float  #: strength of the Earth's field [T]
    fits: bool


def _field_fits(
    compasses: list[LogSource], chosen: Mapping[str, LogSource]
) -> dict[int, _FieldFit]:
    """Return a comparison with the Earth's field by compass, its `id`; empty: no place is known."""
    gnss, imu = chosen.get("gnss"), chosen.get("imu") or chosen.get("accel")
    places = None if gnss is None else gnss.values.get("position_G")
    if places is None or not np.isfinite(places).all(axis=1).any():
        return {}
    place = np.median(places[np.isfinite(places).all(axis=1)], axis=0)
    earth = earth_field(place)
    strength = float(np.linalg.norm(earth))
    found = {}
    for source in compasses:
        field = source.values["magnetometer"]
        sizes = np.linalg.norm(field, axis=1)
        off = np.abs(sizes / strength - 1.0)
        fits = float(np.median(off)) < SAME_STRENGTH
        if imu is not None and len(imu):  # thrust points up on average
            f = [np.interp(source.time, imu.time, axis) for axis in imu.values["accel"].T]
            up = (np.transpose(f) * field).sum(axis=1) / (np.linalg.norm(f, axis=0) * sizes)
            angle = math.acos(min(max(float(np.median(up)), -1.0), 1.0))
            fits &= abs(angle - math.acos(float(earth[2]) / strength)) < SAME_ANGLE
        found[id(source)] = _FieldFit(float(np.median(sizes)), strength, bool(fits))
    return found


def _best(sources: list[LogSource], fit: Mapping[int, _FieldFit]) -> LogSource:
    """Return the source to take of some with data."""
    right = [s for s in sources if id(s) in fit and fit[id(s)].fits]
    sources = right or sources
    covered = [len(_seconds(s)) for s in sources]
    eligible = [
        s for s, n in zip(sources, covered, strict=True) if n >= _NEARLY * max(covered) and len(s)
    ]
    return min(eligible, key=lambda s: (s.tier, -s.rank, _unsteady(s), -len(s), s.instance))


def _unsteady(source: LogSource) -> float:
    """Return the relative spread of the magnetic field [-]; 0 for other sensors."""
    if source.sensor != "magnetometer":
        return 0.0
    size = np.linalg.norm(source.values["magnetometer"], axis=1)
    return round(float(size.std() / size.mean()), 2) if size.any() else np.inf


def _taken(
    sensor: str, best: LogSource, others: list[LogSource], fit: Mapping[int, _FieldFit]
) -> str:
    """Return a sentence on the source that was taken."""
    why = f" ({best.because})" if best.because else ""
    mine = fit.get(id(best))
    wrong = [s for s in others if id(s) in fit and not fit[id(s)].fits]
    if mine is not None and mine.fits and wrong:
        fields = ", ".join(f"{s.name} {1e4 * fit[id(s)].strength:.2f} G" for s in wrong)
        why = (
            f" (its field of {1e4 * mine.strength:.2f} G is the Earth's, "
            f"{1e4 * mine.expected:.2f} G and its inclination; {fields})"
        )
    rest = ", ".join(sorted({s.name for s in others}))
    text = f"{sensor}: {best.name} is taken{why}, not {rest}"
    if sensor == "magnetometer":
        spreads = [(_unsteady(s), s.name) for s in others]
        least, name = min(spreads)
        if (own := _unsteady(best)) > 2.0 * least + 0.05:
            text += (
                f"; the field of {name} is steadier ({100.0 * least:.0f} % against "
                f"{100.0 * own:.0f} %)"
            )
    return text


def _could_take_over(sensor: str, best: LogSource, others: list[LogSource]) -> list[str]:
    """Return a sentence on other sources with data where the one that was taken has none."""
    have: Floats = _seconds(best)
    for other in others:
        gain = np.setdiff1d(_seconds(other), have)
        if len(gain) > _LOST and sensor in ("gnss", "magnetometer", "barometer"):
            return [
                f"{sensor}: {best.name} has no data in {len(gain)} s in which {other.name} has, "
                f"from {gain[0]:.0f} s on: --instance {sensor}={other.instance}"
            ]
    return []

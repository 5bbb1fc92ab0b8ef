"""Selection of one source for each sensor: never the first one for being the first.

The caller's choice comes first. Then, among the sources with nearly as much valid data as the best,
the one that the autopilot used or prefers; without a preference, the compass with the most constant
field, and the source with the most data.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from quad_gym.estimation.logs.log import Floats
from quad_gym.estimation.logs.source import SENSORS, LogSource, RawLog
from quad_gym.params.checks import keywords

_NEARLY = 0.9  #: share of the best source's time that makes another one eligible
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
        found[sensor] = best = _best(full)
        others = [s for s in known if s is not best and len(s)]
        if others:
            recording.notes.append(_taken(sensor, best, others))
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


def _best(sources: list[LogSource]) -> LogSource:
    """Return the source to take of some with data."""
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


def _taken(sensor: str, best: LogSource, others: list[LogSource]) -> str:
    """Return a sentence on the source that was taken."""
    why = f" ({best.because})" if best.because else ""
    rest = ", ".join(sorted({s.name for s in others}))
    text = f"{sensor}: {best.name} is taken{why}, not {rest}"
    if sensor == "magnetometer":
        spreads = [(_unsteady(s), s.name) for s in others]
        least, name = min(spreads)
        if (mine := _unsteady(best)) > 2.0 * least + 0.05:
            text += (
                f"; the field of {name} is steadier ({100.0 * least:.0f} % against "
                f"{100.0 * mine:.0f} %)"
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

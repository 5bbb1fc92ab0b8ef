"""`read_log`: from a table or a file of any format to a log, with one source per sensor."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, TypedDict

import numpy as np

from quad_gym.logs.formats import clocks, euroc, quantities, tables
from quad_gym.logs.formats.clocks import without_repeats
from quad_gym.logs.formats.earth_field import earth_field
from quad_gym.logs.formats.log import COMMANDS, SENSORS, Floats, Log, LogSource, RawLog, Stream
from quad_gym.params import checks as check
from quad_gym.params.checks import keywords

# --------------------------------------------------------------------------------------------------
# Selection of one source for each sensor: never the first one for being the first.
#
# The caller's choice comes first. Then, among the sources with nearly as much valid data as the
# best, the one that the autopilot used or prefers; without a preference, the compass with the most
# constant field, and the source with the most data.
#
# A compass must first have the Earth's field at the place of the flight, in strength and in the
# angle to the vertical: an autopilot may have used the one that iron and currents disturb.
# --------------------------------------------------------------------------------------------------

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
    places = None if gnss is None else gnss.values.get("gnss_position_G")
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


# --------------------------------------------------------------------------------------------------
# `read_log`: from a table or a file of any format to a log, in the same steps for all.
# --------------------------------------------------------------------------------------------------


class Reading(TypedDict, total=False):
    """Keywords of `read_log` that other functions with a log hand on."""

    body: str
    instance: Mapping[str, int] | None
    topic: Mapping[str, str] | None
    columns: Path | str | None
    from_: float | None
    until: float | None


def read_log(
    log: Any,
    *,
    body: str = "flu",
    instance: Mapping[str, int] | None = None,
    topic: Mapping[str, str] | None = None,
    columns: Path | str | None = None,
    from_: float | None = None,
    until: float | None = None,
) -> Log:
    """Read a log from a table or a file.

    Rows with wrong stamps, doubled rows and copies of measurements are dropped. `notes`, `problems`
    and `sources` of the result report this, and the choice of sensors.

    Args:
        log: A pandas DataFrame, a mapping of columns, or a path: of a comma-separated table with a
            line of names (.csv, .csv.gz), of a log of PX4 (.ulg) or ArduPilot (.bin), of a bag of
            ROS 1 (.bag) or ROS 2 (a folder), or of a folder in the format of EuRoC; see the modules
            of `quad_gym.logs.formats`. A mapping may hold the numbers of a quantity together,
            such as `"gyro"` (n, 3). See LOG_COLUMNS.
        body: Axes of IMU and magnetometer in a table: "flu" (x forward, y left, z up), or "frd" (x
            forward, y right, z down).
        instance: Numbers of the sensors to take, such as `{"magnetometer": 1}`; of others, the one
            that the autopilot used or prefers, else the one with the most valid data.
        topic: Topics to take, such as `{"imu": "/mavros/imu/data_raw"}`.
        columns: File (.toml) that maps the columns of a table of others, see
            `logs/formats/tables.py`.
        from_: Time of arrival at which to begin, in the log's clock [s].
        until: Time of arrival at which to end [s].

    Raises:
        ValueError: If columns are missing, unknown, or of unequal length, hold values that are
            infinite or not numbers, or clocks have nothing in common.
        ImportError: If the library that reads this format is not installed.
        OSError: If there is no such file.
    """
    check.choice("body", body, ("flu", "frd"))
    for name, value in (("from_", from_), ("until", until)):
        if value is not None:
            check.number(name, value)
    for sensor, number in (instance or {}).items():
        check.whole(f"instance of {sensor}", number, least=0)
    if isinstance(log, Log):
        if instance or topic or columns:
            raise ValueError("instance, topic and columns must be None for a log that was read")
        found = log
    else:
        found = _log_of(_recording(log, body, columns), instance, topic)
    return found if from_ is None is until else found.between(from_, until)


def _recording(log: Any, body: str, columns: Path | str | None) -> RawLog:
    """Translate a log."""
    if isinstance(log, (str, Path)):
        path = Path(log)
        if columns is not None:
            return tables.read_table(path, Path(columns))
        if path.suffix.lower() in (".ulg", ".ulog"):
            from quad_gym.logs.formats.px4 import read_ulog

            return read_ulog(path)
        if path.suffix.lower() == ".bin":
            from quad_gym.logs.formats.ardupilot import read_bin

            return read_bin(path)
        if path.suffix.lower() == ".bag" or (path / "metadata.yaml").is_file():
            from quad_gym.logs.formats.ros import read_bag

            return read_bag(path)
        if euroc.is_euroc(path):
            return euroc.read_euroc(path)
        given = tables.csv_columns(path)
        try:
            return tables.recording_of(tables.checked_columns(given), body, path.name)
        except ValueError as error:
            raise ValueError(f"{path.name}: {error}") from None
    if isinstance(log, Mapping):
        given = log
    elif hasattr(log, "columns") and hasattr(log, "to_numpy"):
        given = {name: log[name] for name in log.columns}
    else:
        why = f", an episode: {tables.EPISODE}" if hasattr(log, "scene") else ""
        raise ValueError(
            "log must be a DataFrame, a mapping of columns, or a path of a .csv, .ulg, .bin, bag "
            f"or folder, got {type(log).__name__}{why}"
        )
    if columns is not None:
        return tables.mapped(given, Path(columns), "the table")
    return tables.recording_of(tables.checked_columns(given), body, "")


def _log_of(
    recording: RawLog,
    instance: Mapping[str, int] | None,
    topic: Mapping[str, str] | None,
) -> Log:
    """Return the log of a file."""
    sources = [
        quantities.measured(recording, clocks.cleaned(recording, s)) for s in recording.sources
    ]
    sources = [s if s.sensor in COMMANDS else without_repeats(recording, s) for s in sources]
    chosen = select(recording, sources, instance, topic)
    if "imu" not in chosen and {"gyro", "accel"} <= set(chosen):
        chosen["imu"] = _joined(recording, chosen["gyro"], chosen["accel"])
    if "imu" not in chosen:
        raise ValueError(_without_imu(recording, sources))
    for half in ("gyro", "accel"):
        chosen.pop(half, None)
    names, kept = list(chosen), clocks.on_one_clock(recording, list(chosen.values()))
    chosen = dict(zip(names, kept, strict=True))
    streams: dict[str, Any] = {n: source.stream() for n, source in chosen.items() if len(source)}
    if (velocities := streams.pop("gnss_velocity", None)) is not None:
        streams["gnss"] = _stacked(streams.get("gnss"), velocities)
    about = {"file": recording.file} if recording.file else {}
    try:
        return Log(
            **streams,
            barometer_from_start=recording.barometer_from_start,
            about=about,
            sources=_report(chosen, sources),
            notes=tuple(recording.notes + _dropped(chosen)),
            problems=tuple(recording.problems),
        )
    except ValueError as error:
        why = "".join(f"; {note}" for note in _dropped(chosen))
        raise ValueError(f"{recording.where}{error}{why}") from None


def _without_imu(recording: RawLog, sources: Sequence[LogSource]) -> str:
    """Return an error about a log without samples of gyro and accelerometer."""
    names = {s.sensor for s in sources if s.sensor in ("gyro", "accel") and len(s)}
    why = "".join(f"; {note}" for note in recording.notes)
    half = f" with both halves (it has only the {names.pop()})" if len(names) == 1 else ""
    return f"{recording.where}a log must have at least two IMU samples{half}, got 0{why}"


def _joined(recording: RawLog, gyro: LogSource, accel: LogSource) -> LogSource:
    """Return an IMU of a gyro and an accelerometer, at the times of the faster one."""
    gyro, accel = clocks.on_one_clock(recording, [gyro, accel])
    fast, slow = sorted((gyro, accel), key=len, reverse=True)
    inside = (fast.time >= slow.time[0]) & (fast.time <= slow.time[-1])
    fast = fast.keep(inside, "outside of the time of the other half of the IMU")
    other = next(iter(slow.values.values()))
    at = np.column_stack([np.interp(fast.time, slow.time, axis) for axis in other.T])
    recording.notes.append(f"gyro of {gyro.name} and accelerometer of {accel.name} are joined")
    values = {**fast.values, slow.sensor: at}
    return replace(fast, sensor="imu", topic=f"{gyro.topic} and {accel.topic}", values=values)


def _stacked(positions: Stream | None, velocities: Stream) -> Stream:
    """Return positions, and velocities in separate rows, in the order of arrival."""
    if positions is None:
        return velocities
    count = len(positions), len(velocities)
    values = {}
    for name, example in {**positions.values, **velocities.values}.items():
        parts = [
            s.values[name] if name in s.values else np.full((n, *example.shape[1:]), np.nan)
            for s, n in zip((positions, velocities), count, strict=True)
        ]
        values[name] = np.concatenate(parts)
    time = np.concatenate([positions.time, velocities.time])
    received = np.concatenate([positions.received, velocities.received])
    return Stream(time, received, values).rows(np.argsort(received, kind="stable"))


def _report(chosen: Mapping[str, LogSource], sources: Sequence[LogSource]) -> dict[str, Any]:
    """Return the sources that were taken, by sensor."""
    found: dict[str, Any] = {}
    for sensor, source in chosen.items():
        others = {s.name for s in sources if s.sensor == sensor} - {source.name}
        found[sensor] = {
            "taken": source.name,
            "because": source.because,
            "rows": len(source),
            "dropped": dict(source.dropped),
            "others": sorted(others),
        }
    return found


def _dropped(chosen: Mapping[str, LogSource]) -> list[str]:
    """Return sentences on rows that were dropped."""
    sentences = []
    for source in chosen.values():
        reasons = {r: n for r, n in source.dropped.items() if r not in ("no fix",)}
        if reasons:
            listed = ", ".join(f"{n} ({reason})" for reason, n in reasons.items())
            total = sum(reasons.values())
            rows = "row" if total == 1 else "rows"
            sentences.append(f"{source.sensor} ({source.name}): {total} {rows} dropped: {listed}")
    return sentences

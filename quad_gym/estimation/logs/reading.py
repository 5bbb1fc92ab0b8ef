"""`read_log`: from a table or a file of any format to a log, in the same steps for all."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypedDict

import numpy as np

from quad_gym.estimation.logs import clocks, euroc, maps, quantities, tables
from quad_gym.estimation.logs.log import Log, Stream
from quad_gym.estimation.logs.repeats import without_repeats
from quad_gym.estimation.logs.selection import select
from quad_gym.estimation.logs.source import COMMANDS, LogSource, RawLog
from quad_gym.params import checks as check


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
            of `quad_gym.estimation.logs`. A mapping may hold the numbers of a quantity together,
            such as `"gyro"` (n, 3). See LOG_COLUMNS.
        body: Axes of IMU and magnetometer in a table: "flu" (x forward, y left, z up), or "frd" (x
            forward, y right, z down).
        instance: Numbers of the sensors to take, such as `{"magnetometer": 1}`; of others, the one
            that the autopilot used or prefers, else the one with the most valid data.
        topic: Topics to take, such as `{"imu": "/mavros/imu/data_raw"}`.
        columns: File (.toml) that maps the columns of a table of others, see `logs/maps.py`.
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
            return maps.read_table(path, Path(columns))
        if path.suffix.lower() in (".ulg", ".ulog"):
            from quad_gym.estimation.logs.px4 import read_ulog

            return read_ulog(path)
        if path.suffix.lower() == ".bin":
            from quad_gym.estimation.logs.ardupilot import read_bin

            return read_bin(path)
        if path.suffix.lower() == ".bag" or (path / "metadata.yaml").is_file():
            from quad_gym.estimation.logs.ros import read_bag

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
        raise ValueError(
            "log must be a DataFrame, a mapping of columns, or a path of a .csv, .ulg, .bin, bag "
            f"or folder, got {type(log).__name__}"
        )
    if columns is not None:
        return maps.mapped(given, Path(columns), "the table")
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
    for name in {**positions.values, **velocities.values}:
        parts = [
            s.values[name] if name in s.values else np.full((n, *_shape(name)), np.nan)
            for s, n in zip((positions, velocities), count, strict=True)
        ]
        values[name] = np.concatenate(parts)
    time = np.concatenate([positions.time, velocities.time])
    received = np.concatenate([positions.received, velocities.received])
    return Stream(time, received, values).rows(np.argsort(received, kind="stable"))


def _shape(name: str) -> tuple[int, ...]:
    """Return the shape of a value of GNSS."""
    return () if name == "velocity_sigma" else (3,)


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

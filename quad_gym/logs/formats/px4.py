"""Logs of PX4: sensor data of its file format ULog, in the frames of this package.

PX4's body is FRD (x forward, y right, z down) and its world NED (north, east, down); a body here is
FLU (x forward, y left, z up) and the world ENU (east, north, up):

    (x, y, z)_FLU = (x, -y, -z)_FRD,    (e, n, u)_ENU = (e, n, -d) of (n, e, d)_NED

| topic | contents used |
|---|---|
| `sensor_combined` | gyro and accelerometer: means over the time before `timestamp` |
| `vehicle_gps_position`, else `sensor_gps` | position, velocity, and their reported accuracy |
| `vehicle_air_data`, else `sensor_baro` | height from static pressure, relative to another level |
| `vehicle_magnetometer`, else `sensor_mag` | magnetic field [gauss] |
| `vehicle_optical_flow`, else `optical_flow` | angles of the flow and of the body over a time |
| `distance_sensor` | distance to the ground, of sensors that look down |
| `vehicle_mocap_odometry`, `vehicle_visual_odometry` | without GNSS: position, attitude |
| `actuator_motors`, else `actuator_outputs` | commands of the motors from 0 to 1 |
| `battery_status` | voltage of the battery |

Compass and barometer of logs before 2017 are in `sensor_combined`. Of several compasses with the
Earth's field, the one is taken that has the highest priority (CAL_MAGn_PRIO), or that the estimator
used (`estimator_status`), as of other sensors. Flow about the axes x and y of FRD is positive for
right-hand turns of the sensor:
(V_y / h + w_x, V_x / h - w_y) in FLU. A sample's `timestamp_sample` is its time stamp, and
`timestamp` its time of arrival. For a GNSS receiver without time stamps, the delay is PX4's
parameter EKF2_GPS_DELAY, or 0.11 s. Where heights above the ellipsoid are not filled, those above
mean sea level are used.

Source: the PX4 user guide, "ULog File Format" and the definitions of these messages.
"""

import io
from collections.abc import Iterator, Mapping
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

from quad_gym.logs.formats.log import (
    TO_FLU,
    Floats,
    LogSource,
    RawLog,
    ecef_of,
    positive,
    reading,
    stack,
)

GNSS_DELAY = 0.11  #: delay of receivers if the log does not contain it [s]: PX4's default

MIN_FIX = 3  #: smallest `fix_type` of a three-dimensional position

_GAUSS = 1e-4  #: [T]
_NED = 1  #: `pose_frame` of a known heading
_HEIGHTS = ("baro_alt_meter", "altitude", "baro_pressure_pa", "pressure")
"""Fields of barometers: heights, else pressures."""
_DOWN = 25  #: `orientation` of a distance sensor that looks down
_EARLIEST = 1e-6  #: stamps up to this are not set [s]
_PWM = (1000.0, 1000.0)  #: least pulse and range of `actuator_outputs` [us]

_Topic = Mapping[str, Any]


class _Fields(dict[str, Any]):
    """Fields of a topic. One that a damaged log lacks holds NaN."""

    def __missing__(self, name: str) -> Floats:
        return np.full(len(next(iter(self.values()))), np.nan)


def read_ulog(path: Path | str) -> RawLog:
    """Read a log of PX4.

    Args:
        path: Path of a `.ulg` file.

    Raises:
        ImportError: If pyulog is not installed.
        ValueError: If the file is not a ULog, or is damaged.
        OSError: If there is no such file.
    """
    with reading(path, "a ULog", "logs of PX4", "pyulog", "ulog") as file:
        from pyulog import ULog

        with redirect_stdout(io.StringIO()) as printed:  # the library's messages about damage
            ulog = ULog(str(file))
        topics: dict[str, dict[int, _Topic]] = {}
        for data in ulog.data_list:
            if len(data.data["timestamp"]):
                topics.setdefault(data.name, {})[data.multi_id] = _Fields(data.data)
        parameters = dict(ulog.initial_parameters)
        damaged = ulog.file_corruption or bool(printed.getvalue())
    if "sensor_combined" not in topics:
        raise ValueError(f"{file.name} must have the topic sensor_combined, got {sorted(topics)}")
    return RawLog(
        file=file.name,
        sources=[*_inertial(topics), *_gnss(topics, parameters), *_aids(topics, parameters)],
        barometer_from_start=True,
        notes=["damaged parts of the file are left out"] if damaged else [],
    )


_Topics = Mapping[str, Mapping[int, _Topic]]


def _each(topics: _Topics, *names: str) -> Iterator[tuple[int, str, int, _Topic]]:
    """Yield tier, name, instance and contents of some topics."""
    for tier, name in enumerate(names):
        for instance, topic in topics.get(name, {}).items():
            yield tier, name, instance, topic


def _source(
    sensor: str, name: str, topic: _Topic, delay: float = 0.0, **contents: Any
) -> LogSource:
    """Return a source with its times; `delay` if only the time of arrival is known [s]."""
    received = 1e-6 * np.asarray(topic["timestamp"], np.float64)
    taken = received - delay
    if "timestamp_sample" in topic:
        stamps = 1e-6 * np.asarray(topic["timestamp_sample"], np.float64)
        taken = np.where(stamps > _EARLIEST, np.minimum(stamps, received), taken)
    return LogSource(sensor=sensor, topic=name, time=taken, received=received, **contents)


def _three(topic: _Topic, name: str) -> Floats:
    """Return a field of three numbers, in arrays or single ones."""
    names = [f"{name}[{i}]" for i in range(3)]
    return stack(topic, names if names[0] in topic else list("xyz"))


def _inertial(topics: _Topics) -> Iterator[LogSource]:
    for tier, name, instance, topic in _each(topics, "sensor_combined"):
        values = {
            "gyro": _three(topic, "gyro_rad") * TO_FLU,
            "accel": _three(topic, "accelerometer_m_s2") * TO_FLU,
        }
        yield _source("imu", name, topic, instance=instance, tier=tier, values=values)


def _gnss(topics: _Topics, parameters: Mapping[str, Any]) -> Iterator[LogSource]:
    """Yield positions and velocities with a fix."""
    delay = 1e-3 * float(parameters.get("EKF2_GPS_DELAY", 1e3 * GNSS_DELAY))
    for tier, name, instance, topic in _each(topics, "vehicle_gps_position", "sensor_gps"):
        if "latitude_deg" in topic:
            lat, lon, height, sea = stack(
                topic, ["latitude_deg", "longitude_deg", "altitude_ellipsoid_m", "altitude_msl_m"]
            ).T
        else:  # before PX4 1.14
            lat, lon, height, sea = stack(topic, ["lat", "lon", "alt_ellipsoid", "alt"]).T
            lat, lon, height, sea = 1e-7 * lat, 1e-7 * lon, 1e-3 * height, 1e-3 * sea
        if not np.ptp(np.nan_to_num(height)) and np.isfinite(sea).any():
            height = sea
        fixed = np.asarray(topic["fix_type"]) >= MIN_FIX
        fixed &= (np.abs(lat) <= 90.0) & ((lat != 0.0) | (lon != 0.0))
        place = np.where(fixed, np.stack([lat, lon, height]), np.nan)
        velocity = stack(topic, ["vel_e_m_s", "vel_n_m_s", "vel_d_m_s"]) * [1.0, 1.0, -1.0]
        valid = np.asarray(topic.get("vel_ned_valid", np.ones(len(fixed))), bool) & fixed
        values = {
            "gnss_position_G": ecef_of(*place),
            "gnss_velocity_I": np.where(valid[:, np.newaxis], velocity, np.nan),
            "gnss_sigma": positive(stack(topic, ["eph", "eph", "epv"])),
            "velocity_sigma": positive(stack(topic, ["s_variance_m_s"])[:, 0]),
        }
        source = _source("gnss", name, topic, delay, instance=instance, tier=tier, values=values)
        yield source.keep(fixed, "no fix")


def _used(topics: _Topics) -> set[int]:
    """Return the device identifiers of sensors that the primary estimator used."""
    selector = topics.get("estimator_selector_status", {}).get(0, {})
    primary = int(np.median(selector["primary_instance"])) if "primary_instance" in selector else 0
    status = topics.get("estimator_status", {}).get(primary, {})
    found = {int(np.median(status[n])) for n in status if str(n).endswith("_device_id")}
    selected = topics.get("sensor_selection", {}).get(0, {})
    found |= {int(selected[n][-1]) for n in selected if str(n).endswith("_device_id")}
    return found - {0}


def _compasses(topics: _Topics, parameters: Mapping[str, Any]) -> Iterator[LogSource]:
    used = _used(topics)
    names = ("vehicle_magnetometer", "sensor_mag", "sensor_combined")
    for tier, name, instance, topic in _each(topics, *names):
        if name == "sensor_combined" and "magnetometer_ga[0]" not in topic:
            continue
        device = int(np.asarray(topic["device_id"])[-1]) if "device_id" in topic else 0
        number = next(
            (k for k in range(4) if device and parameters.get(f"CAL_MAG{k}_ID") == device), instance
        )
        priority = parameters.get(f"CAL_MAG{number}_PRIO")
        rank, because = 0.0, ""
        if priority is not None:
            rank, because = float(priority), f"CAL_MAG{number}_PRIO {priority:g}"
        if device in used:
            rank += 0.5  # of equal priority
            because = f"{because}, the estimator used it" if because else "the estimator used it"
        values = {"magnetometer": _three(topic, "magnetometer_ga") * _GAUSS * TO_FLU}
        yield _source(
            "magnetometer",
            name,
            topic,
            instance=instance,
            tier=tier,
            values=values,
            rank=rank,
            because=because,
        )


def _barometers(topics: _Topics) -> Iterator[LogSource]:
    used = _used(topics)
    names = ("vehicle_air_data", "sensor_baro", "sensor_combined")
    for tier, name, instance, topic in _each(topics, *names):
        field = next((n for n in _HEIGHTS if n in topic), None)
        if field is None:
            continue
        key = "barometer" if "alt" in field else "pressure"
        device = int(np.asarray(topic["device_id"])[-1]) if "device_id" in topic else 0
        yield _source(
            "barometer",
            name,
            topic,
            instance=instance,
            tier=tier,
            values={key: np.asarray(topic[field], np.float64)},
            rank=float(device in used),
            because="the estimator used it" if device in used else "",
        )


def _aids(topics: _Topics, parameters: Mapping[str, Any]) -> Iterator[LogSource]:
    """Yield compasses, barometers, flow, distances, headings, motors and batteries."""
    yield from _compasses(topics, parameters)
    yield from _barometers(topics)
    for tier, name, i, topic in _each(topics, "vehicle_optical_flow", "optical_flow"):
        if (flow := _flow(topic)) is not None:
            values = {"optical_flow": flow}
            yield _source("optical_flow", name, topic, instance=i, tier=tier, values=values)
    for tier, name, i, topic in _each(topics, "distance_sensor"):
        distance = np.asarray(topic["current_distance"], np.float64)
        low, high = stack(topic, ["min_distance", "max_distance"]).T
        good = ~((distance < low) | (distance > high)) & (distance > 0.0)
        good &= np.asarray(topic.get("signal_quality", np.ones(len(good)))) != 0
        good &= np.asarray(topic.get("orientation", np.full(len(good), _DOWN))) == _DOWN
        values = {"range_finder": distance}
        source = _source("range_finder", name, topic, instance=i, tier=tier, values=values)
        yield source.keep(good, "no distance downward")
    for tier, name, i, topic in _each(topics, "vehicle_mocap_odometry", "vehicle_visual_odometry"):
        if np.any(np.asarray(topic.get("pose_frame", _NED)) != _NED):
            continue  # of unknown heading
        names = [f"position[{k}]" for k in (1, 0, 2)] if "position[0]" in topic else ["y", "x", "z"]
        values = {"gnss_position_I": stack(topic, names) * [1.0, 1.0, -1.0]}
        yield _source("gnss", name, topic, instance=i, tier=2 + tier, values=values)
        values = {"quaternion": _to_enu(stack(topic, [f"q[{k}]" for k in range(4)]))}
        yield _source("attitude", name, topic, instance=i, tier=tier, values=values)
    for tier, name, i, topic in _each(topics, "actuator_motors", "actuator_outputs"):
        key = "control" if "control[0]" in topic else "output"
        commands = stack(topic, [f"{key}[{k}]" for k in range(4)])
        if key == "output" and np.nanmedian(commands) > 2.0:
            commands = (commands - _PWM[0]) / _PWM[1]
        values = {"commands": np.clip(commands, 0.0, 1.0)}
        yield _source("motors", name, topic, instance=i, tier=tier, values=values)
    for tier, name, i, topic in _each(topics, "battery_status"):
        values = {"battery": np.asarray(topic["voltage_v"], np.float64)}
        yield _source("battery", name, topic, instance=i, tier=tier, values=values)


def _flow(topic: _Topic) -> Floats | None:
    """Return rates of the ground (n, 2), from integrals of either layout; None: unknown."""
    new, old = (
        ("pixel_flow[0]", "pixel_flow[1]"),
        ("pixel_flow_x_integral", "pixel_flow_y_integral"),
    )
    names = next((n for n in (new, old) if n[0] in topic), None)
    spans = [n for n in ("integration_timespan_us", "integration_timespan") if n in topic]
    if names is None or not spans:
        return None
    seconds = 1e-6 * np.asarray(topic[spans[0]], np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        rates = stack(topic, names) / seconds[:, np.newaxis]
    rates[~(seconds > 0.0) | (np.asarray(topic.get("quality", seconds + 1.0)) <= 0.0)] = np.nan
    return rates[:, ::-1]


def _to_enu(q: Floats) -> Floats:
    """Return quaternions (w, x, y, z) from FLU to ENU of those from FRD to NED."""
    w, x, y, z = q.T
    half = np.sqrt(0.5)  # NED to ENU swaps axes: a turn by 180 degrees about (1, 1, 0)
    return half * np.column_stack([w + z, x + y, x - y, w - z])

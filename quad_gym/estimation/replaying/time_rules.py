"""Rules of the verdict on times: clocks, times without a correction, and the end of the log."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from quad_gym.estimation.logs import Floats
from quad_gym.estimation.logs.clocks import PAUSE
from quad_gym.estimation.replaying.cases import (
    MEASURED_BY,
    NAMES,
    OF_SENSOR,
    Case,
    lost,
    note,
    uncertain,
)
from quad_gym.estimation.replaying.findings import Finding
from quad_gym.estimation.replaying.fits import exceeds
from quad_gym.estimation.replaying.results import Measured
from quad_gym.estimation.replaying.sensor_rules import LONG_RUN, MAX_REJECTED, PATIENCE

LATE = 0.5  #: share of late measurements above which the clocks do not agree [-]
MANY_LOST = 0.05  #: share of lost samples of the IMU that is worth a note [-]
SHORT_PAUSE = 0.3  #: time without samples of the IMU in which a vehicle turns by some degrees [s]
BLOCK = 20  #: measurements in a row that are late together, so that a clock has changed


def late(case: Case) -> Iterator[Finding]:
    """Measurements that are older than the window at their arrival."""
    for sensor, ages in case.result.late.items():
        stream = case.log.streams[sensor]
        count, name = len(stream), sensor.replace("gnss", "GNSS").replace("_", " ")
        share = len(ages) / count
        low, middle, high = np.percentile(ages, [5.0, 50.0, 95.0])
        text = f"{len(ages)} of {count} measurements of {name} arrive too late for the window"
        since, length = _late_block(stream.received - stream.time, float(ages.min()))
        stepped = length > max(BLOCK, LONG_RUN * count) and 0 < since < count - length + 1
        if high - low < 0.2 * middle and stepped:
            text += (
                f", all from {stream.received[since]:.1f} s on, by about {middle:.2f} s: the time "
                "stamps step back there, as with a leap second or a clock that is set; use "
                f"--until {stream.received[since]:.1f}, or correct the stamps"
            )
        elif high - low < 0.2 * middle:
            text += (
                f", all by about {middle:.2f} s: the clocks differ, use log_delays.{sensor} = "
                f"{-middle:.2f} in the suite, or a longer window"
            )
        quantity = OF_SENSOR.get(sensor, "position")
        if share > LATE or stepped:
            yield lost(quantity, text)
        elif exceeds(np.arange(count) < len(ages), MAX_REJECTED):
            yield uncertain(quantity, text)


def _late_block(ages: Floats, least: float) -> tuple[int, int]:
    """Return begin and length of the longest run of ages that are at least `least`."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], ages >= least - 1e-9, [0]])))
    if not len(edges):
        return 0, 0
    k = int(np.argmax(edges[1::2] - edges[::2]))
    return int(edges[2 * k]), int(edges[2 * k + 1] - edges[2 * k])


def gaps(case: Case) -> Iterator[Finding]:
    """Times without a measurement that corrects position or height, over all parts of a log.

    A pause of the IMU is no flown time, and no correction: without GNSS, a part begins where the
    part before has ended.
    """
    result, sensors = case.result, case.sensors
    steps = np.diff(result.time)
    flown = np.concatenate([[0.0], np.cumsum(np.where(steps > PAUSE, 0.0, steps))])
    for quantity in ("position", "height"):
        some = [sensors[name] for name in MEASURED_BY[quantity] if name in sensors]
        times = np.concatenate([np.empty(0), *(m.time[~m.gated] for m in some)])
        edges = np.sort(np.concatenate([result.time[[0, -1]], times]))
        lengths = np.diff(np.interp(edges, result.time, flown))
        k = int(np.argmax(lengths))
        since, until, length = float(edges[k]), float(edges[k + 1]), float(lengths[k])
        if length < PATIENCE and len(times):
            continue
        text = f"nothing corrects it for {length:.0f} s"
        inside = [n for n in MEASURED_BY[quantity] if _refused(sensors, n, since, until)]
        if inside:
            text = f"{NAMES[inside[0]]} refused for {length:.0f} s in a row"
        axes = slice(0, 2) if quantity == "position" else slice(2, 3)
        during = (result.time >= since) & (result.time <= until)
        sigma = float(np.linalg.norm(result.sigma[during, axes], axis=1).max())
        known = "" if math.isnan(sigma) else f", standard deviation up to {sigma:.3g} m"
        where = f" from {since:.1f} s on" if len(times) else ", the whole log"
        yield lost(quantity, f"{text}{where}: dead reckoning{known}")
        if quantity == "position":
            return  # which the height shares


def _refused(sensors: Mapping[str, Measured], name: str, since: float, until: float) -> bool:
    """Return True if a sensor was refused between two times."""
    m = sensors.get(name)
    return m is not None and bool((m.gated & (m.time > since) & (m.time < until)).any())


def lost_samples(case: Case) -> Iterator[Finding]:
    """Samples of the IMU that the log lacks."""
    steps = np.diff(case.log.imu.time)
    steps = steps[steps <= PAUSE]
    if len(steps) < BLOCK:
        return
    usual = float(np.quantile(steps, 0.2))
    missing = float(np.maximum(np.round(steps / usual) - 1.0, 0.0)[steps > 1.5 * usual].sum())
    share = missing / (missing + len(steps))
    most = float(steps.max())
    count = int((steps > max(SHORT_PAUSE, 10.0 * usual)).sum())
    if count:
        yield uncertain(
            "attitude",
            f"the IMU has {count} {'pause' if count == 1 else 'pauses'} of up to {most:.2f} s, in "
            "which the attitude is extrapolated",
        )
    elif share > MANY_LOST:
        yield note(
            "attitude",
            f"the log lacks about {100.0 * share:.0f} % of the IMU's samples, for up to "
            f"{most:.3f} s: of averaged samples nothing is lost, of others motion is",
        )


def flagged(case: Case) -> Iterator[Finding]:
    """A filter that is flagged as diverged at the end, of the log or of a part before a pause."""
    result = case.result
    ends = [*np.flatnonzero(np.diff(result.time) > PAUSE).tolist(), len(result) - 1]
    for row in ends:
        if not np.asarray(result.diverged)[row]:
            continue
        time = float(result.time[row])
        names = [name for name, m in case.sensors.items() if _ends_refused(m, time)]
        if not names:
            continue  # accepted since
        refused = " and ".join(NAMES[name] for name in names)
        quantities = [OF_SENSOR.get(name, "position") for name in names]
        quantity = "position" if "position" in quantities else quantities[0]
        where = "at the end" if row == ends[-1] else f"at {time:.1f} s, before a pause"
        yield lost(quantity, f"the filter is flagged as diverged {where}, as it refuses {refused}")
        return


def _ends_refused(m: Measured, time: float) -> Any:
    """Return True if the last two measurements before a time were rejected."""
    last = m.rejected[m.time <= time][-2:]
    return len(last) == 2 and last.all()

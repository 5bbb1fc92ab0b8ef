"""Rules of the verdict on the heading: that of the motion contradicts a compass or a start."""

import math
from collections.abc import Iterator

import numpy as np

from quad_gym.logs.replaying.results import Finding, Replay, Severity
from quad_gym.logs.replaying.rules import Evidence, lost, uncertain

LARGE, SURE = math.radians(10.0), 4.0
"""Difference of two headings that matters [rad], and its least number of standard deviations."""
KNOWN = math.radians(15.0)  #: standard deviation below which the motion shows a heading [rad]
LASTING = 2.0  #: time for which headings contradict each other without a reset of the filter [s]
_TURNS = (45.0, 90.0, 135.0, 180.0)  #: angles by which autopilots assume compasses turned


def contradicted(case: Evidence) -> Iterator[Finding]:
    """Headings that the GNSS velocities contradict, and compasses that were left out."""
    log, suite, result = case.log, case.suite, case.result
    apart, sigma = np.abs(result.heading_apart), np.asarray(result.motion_sigma)
    compass = suite.magnetometer is not None and "magnetometer" in log.streams
    known = (sigma < KNOWN) & np.asarray(result.heading_known, bool)
    wrong = known & (apart > np.maximum(LARGE, SURE * sigma))
    out = np.asarray(result.compass_out, bool)
    rises = np.flatnonzero(out[1:] & ~out[:-1]) + 1
    for first, last in _runs(wrong):
        begin, end = float(result.time[first]), float(result.time[last])
        reset = any(first <= k <= last + 1 for k in rises)
        if reset or end - begin >= LASTING:
            k = first + int(np.argmax((apart / sigma)[first : last + 1]))
            yield _contradiction(result, compass, begin, end, k, reset)
            return
    unknown = [k for k in rises if not result.heading_known[k]]
    if unknown:
        yield _thrown(result, compass, int(unknown[0]))
    elif compass and len(rises):
        text = _left_out(result, out, int(rises[0]))
        yield uncertain(
            "heading",
            f"the magnetometer {text}: it contradicts the motion. It is turned, near iron, frozen "
            "or disturbed",
        )
    elif compass and len(sigma) and np.isfinite(sigma).any() and not (sigma < KNOWN).any():
        yield Finding(
            quantity="heading",
            severity=Severity.NOTE,
            text="no motion shows the heading: the magnetometer alone determines it",
        )


def _thrown(result: Replay, compass: bool, k: int) -> Finding:
    """A heading that was found wrong in row k, before the motion showed the right one."""
    later = np.flatnonzero(np.asarray(result.heading_known, bool)[k:])
    until = f"until {result.time[k + later[0]]:.1f} s" if len(later) else "until the end"
    what = "the heading of the magnetometer" if compass else "the given heading (--heading)"
    return lost(
        "heading",
        f"{what} contradicts the GNSS velocities, as it tilts the estimate: it was wrong until "
        f"{result.time[k]:.1f} s, and unknown {until}",
    )


def _contradiction(
    result: Replay, compass: bool, begin: float, end: float, k: int, reset: bool
) -> Finding:
    """A heading that contradicts the motion, most clearly in row k."""
    angle = math.degrees(abs(result.heading_apart[k]))
    ratio = abs(result.heading_apart[k]) / result.motion_sigma[k]
    what = "the heading" if compass else "the given heading (--heading)"
    text = (
        f"{what} contradicts the GNSS velocities by {angle:.0f} degrees ({ratio:.0f} standard "
        f"deviations) from {begin:.1f} to {end:.1f} s"
    )
    if reset:
        text += "; it was wrong before, and was reset to that of the motion"
    if compass:
        text += ". The magnetometer is turned, near iron, or disturbed: check its orientation"
        near = [turn for turn in _TURNS if abs(angle - turn) < 10.0]
        if near:
            text += f" (turned by about {near[0]:.0f} degrees about the vertical axis?)"
        out = np.asarray(result.compass_out, bool)
        if out.any():
            text += f". It {_left_out(result, out, int(np.argmax(out)))}"
    return lost("heading", text)


def _left_out(result: Replay, out: np.ndarray, first: int) -> str:
    """Say for how long a compass was left out from a row on."""
    back = np.flatnonzero(~out[first:])
    last = first + int(back[0]) if len(back) else len(out) - 1
    time = float(result.time[last] - result.time[first])
    return f"was left out for {time:.0f} s" + ("" if len(back) else ", until the end")


def _runs(rows: np.ndarray) -> list[tuple[int, int]]:
    """Return the first and the last row of each run of True."""
    steps = np.diff(np.concatenate([[0], rows.astype(np.int8), [0]]))
    firsts, ends = np.flatnonzero(steps == 1), np.flatnonzero(steps == -1)
    return list(zip(firsts.tolist(), (ends - 1).tolist(), strict=True))

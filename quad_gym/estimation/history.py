"""What a filter was given within its window of time, so that it can include late measurements.

A late measurement is put where it belongs by its time stamp, and everything since then is filtered
again: the result is, to the bit, that of the same samples and measurements in the order of their
stamps. A sample of the IMU in whose time a stamp lies is split there, the same sample on both
sides.

Flights in an environment use another method, `kernels/filter/late.py`: they keep what the IMU
has summed up, and carry estimate and covariance back over it. That costs less, but needs stamps on
ticks and sensors whose measurements arrive in order, and it is exact to first order alone.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from quad_gym.estimation.samples import Measurement, Sample

SAME_TIME = 1e-6
"""Time stamps that differ by less are equal [s]; PX4 counts microseconds."""

_EVERY = 8  # events between two copies of the state: a copy costs about as much as an event


@dataclass
class _Event:
    given: Sample | Measurement
    time: float
    """after it"""
    before: Any = None
    """a copy of the state before it, or None"""

    @property
    def start(self) -> float:
        """When it begins."""
        return self.time - self.given.dt if isinstance(self.given, Sample) else self.time


class History:
    """The samples and measurements of a window of time, and states to filter them again from.

    Args:
        window: Its length [s].
        apply: Gives the filter a sample or a measurement.
        copy: Returns a copy of the filter's state.
        restore: Goes back to such a copy.
    """

    def __init__(
        self,
        window: float,
        apply: Callable[[Sample | Measurement], None],
        copy: Callable[[], Any],
        restore: Callable[[Any], None],
    ) -> None:
        self.window = window
        self._apply, self._copy, self._restore = apply, copy, restore
        self._events: list[_Event] = []
        self._since_copy = 0
        self.time = 0.0

    def begin(self, time: float) -> None:
        """Begin anew at a time [s]."""
        self.time, self._events = time, []

    @property
    def oldest(self) -> float:
        """The earliest time stamp that can still be included [s]."""
        reach = self.time - self.window
        return max(reach, self._events[0].start) if self._events else self.time

    def add(self, given: Sample | Measurement) -> None:
        """Give the filter what comes next."""
        time = self.time + (given.dt if isinstance(given, Sample) else 0.0)
        event = _Event(given, time)
        if self.window > 0.0:
            self._since_copy += 1
            if not self._events or self._since_copy >= _EVERY:
                event.before, self._since_copy = self._copy(), 0
            self._events.append(event)
        self.time = time
        self._apply(given)
        self._forget()

    def insert(self, measurement: Measurement, time: float) -> None:
        """Include a measurement of a time that is past, and filter again what came after it.

        Args:
            measurement: What was measured.
            time: When, at least `oldest` and less than the present [s].
        """
        events = self._events
        i = next(k for k, e in enumerate(events) if e.time > time + SAME_TIME)
        first = max(k for k in range(i + 1) if events[k].before is not None)
        old = events[i]
        assert isinstance(old.given, Sample)
        added, elapsed = _Event(measurement, time), time - old.start
        if elapsed > SAME_TIME:
            one, two = old.given.split(elapsed)
            events[i : i + 1] = [_Event(one, time, old.before), added, _Event(two, old.time)]
        else:
            added.before, old.before = old.before, None
            added.time = old.start
            events.insert(i, added)
        self._restore(events[first].before)
        for k in range(first, len(events)):
            if k > first and events[k].before is not None:
                events[k].before = self._copy()
            self._apply(events[k].given)

    def _forget(self) -> None:
        """Drop what lies before the last copy that is older than the window."""
        reach, events = self.time - self.window, self._events
        keep = 0
        for k, event in enumerate(events):
            if event.start > reach:
                break
            if event.before is not None:
                keep = k
        del events[:keep]

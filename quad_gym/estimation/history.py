"""Inputs of a filter within a window of time, for the processing of delayed measurements.

A delayed measurement is inserted at its time stamp, and everything since then is filtered again:
the result is bitwise the result with the same samples and measurements in the order of their
stamps. An IMU sample whose interval contains the stamp is split there, with the same sample on both
sides.

Flights in an environment use another method, `kernels/filter/delayed.py`: they keep sums of the IMU
samples, and retrodict estimate and covariance over them. That costs less, but requires stamps on
ticks and sensors whose measurements arrive in order, and is exact to first order only.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from quad_gym.estimation.samples import Measurement, Sample

SAME_TIME = 1e-6  #: time stamps that differ by less are equal [s]; PX4 counts microseconds

_EVERY = 8  #: events between two copies of the state: a copy costs about as much as an event


@dataclass(slots=True)
class _Event:
    given: Sample | Measurement
    time: float  #: time after the event
    start: float  #: time at which the event begins
    before: Any = None  #: copy of the state before the event, or None


class InputHistory:
    """The samples and measurements of a window of time, and states to filter them again from.

    Args:
        window: Length of the window [s].
        apply: Processes a sample or a measurement with the filter.
        copy: Returns a copy of the filter's state.
        restore: Restores such a copy.
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
        """Begin at a time [s], with no events."""
        self.time, self._events = time, []

    @property
    def oldest(self) -> float:
        """Earliest time stamp that can still be included [s]."""
        reach = self.time - self.window
        return max(reach, self._events[0].start) if self._events else self.time

    def add(self, given: Sample | Measurement) -> None:
        """Process the next input."""
        time = self.time + (given.dt if isinstance(given, Sample) else 0.0)
        event = _Event(given, time, self.time)
        if self.window > 0.0:
            self._since_copy += 1
            if not self._events or self._since_copy >= _EVERY:
                event.before, self._since_copy = self._copy(), 0
            self._events.append(event)
        self.time = time
        self._apply(given)
        self._forget()

    def insert(self, measurement: Measurement, time: float) -> None:
        """Insert a measurement at an earlier time, and filter again all inputs after it."""
        events = self._events
        i = len(events) - 1  # the first event that ends later
        while i and events[i - 1].time > time + SAME_TIME:
            i -= 1
        first = i
        while events[first].before is None:
            first -= 1
        old = events[i]
        assert isinstance(old.given, Sample)
        elapsed = time - old.start
        if elapsed > SAME_TIME:
            one, two = old.given.split(elapsed)
            first_part = _Event(one, time, old.start, old.before)
            events[i : i + 1] = [
                *(first_part, _Event(measurement, time, time)),
                _Event(two, old.time, time),
            ]
        else:
            events.insert(i, _Event(measurement, old.start, old.start, old.before))
            old.before = None
        self._restore(events[first].before)
        for k in range(first, len(events)):
            if k > first and events[k].before is not None:
                events[k].before = self._copy()
            self._apply(events[k].given)

    def _forget(self) -> None:
        """Drop events before the last copy that is older than the window."""
        reach, events = self.time - self.window, self._events
        keep = 0
        for k, event in enumerate(events):
            if event.start > reach:
                break
            if event.before is not None:
                keep = k
        del events[:keep]

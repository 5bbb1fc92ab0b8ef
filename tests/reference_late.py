"""A filter that processes a late measurement by filtering again from its time stamp. It stores its
state at every tick, every IMU sample and every measurement, and makes no approximation."""

from collections import defaultdict


class Rewinding:
    """A filter of `tests.reference_ukf` with a history.

    Args:
        plain: The filter, at tick 0.
    """

    def __init__(self, plain):
        self.plain, self.tick = plain, 0
        self._samples, self._measured = [], defaultdict(list)
        self._states = [self._state()]

    def _state(self):
        f = self.plain
        return tuple(part.copy() for part in (f.r, f.v, f.R, f.b_a, f.b_g, f.d, f.P))

    def predict(self, gyro, accel):
        """Predict over a tick."""
        self._samples.append((gyro, accel))
        self._predict(self.tick)
        self.tick += 1

    def _predict(self, tick):
        self.plain.predict(*self._samples[tick])
        del self._states[tick + 1 :]
        self._states.append(self._state())

    def update(self, taken_at, **measurement):
        """Process a measurement that was taken at the present tick or an earlier one."""
        self._measured[taken_at].append(measurement)
        f = self.plain
        f.r, f.v, f.R, f.b_a, f.b_g, f.d, f.P = (part.copy() for part in self._states[taken_at])
        for tick in range(taken_at, self.tick + 1):
            for known in self._measured[tick]:
                f.update(**known)
            if tick < self.tick:
                self._predict(tick)

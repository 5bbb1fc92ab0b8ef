"""References of many flights: the finite Fourier series of `quad_gym.kernels.task.reference`.

Arrays have the flights as their last axis here, which is how NumPy works fastest on three numbers.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class Series(NamedTuple):
    """r*(t) = center + sum_k cos_k cos(k w t) + sin_k sin(k w t), and the rule of the heading."""

    omega: Floats
    """(n,) [rad/s]"""
    center: Floats
    """(3, n) in I [m]"""
    cos: Floats
    """(harmonics, 3, n) in I [m]"""
    sin: Floats
    """likewise"""
    rule: Floats
    """(n,) 0: toward the point; 1: along it; 2: along the velocity"""
    point: Floats
    """(3, n) in I [m]"""

    @classmethod
    def of(cls, rows: Callable[[str], NDArray[Any]], harmonics: int) -> "Series":
        """The series of all flights.

        Args:
            rows: Gives a field of the flights with these as its last axis.
            harmonics: Terms in use.
        """
        return cls(
            rows("ref_omega"),
            rows("ref_center"),
            rows("ref_cos")[:harmonics].copy(),
            rows("ref_sin")[:harmonics].copy(),
            rows("ref_heading_rule"),
            rows("ref_heading_point"),
        )

    def terms(self, time: Floats) -> tuple[Floats, Floats]:
        """cos(k w t) and sin(k w t), (harmonics, n) each."""
        angle = np.arange(1.0, len(self.cos) + 1.0)[:, np.newaxis] * (self.omega * time)
        return np.cos(angle), np.sin(angle)

    def position(self, time: Floats) -> Floats:
        """(3, n) position in I [m] at the times (n,) [s]."""
        if not len(self.cos):
            return self.center
        c, s = self.terms(time)
        r = self.center
        for k in range(len(self.cos)):
            r = r + self.cos[k] * c[k] + self.sin[k] * s[k]
        return r

    def derivatives(self, time: Floats) -> tuple[Floats, Floats]:
        """(3, n) velocity [m/s] and acceleration [m/s^2] in I."""
        v, a = np.zeros_like(self.center), np.zeros_like(self.center)
        if not len(self.cos):
            return v, a
        c, s = self.terms(time)
        for k in range(len(self.cos)):
            rate = (k + 1.0) * self.omega
            v += rate * (self.sin[k] * c[k] - self.cos[k] * s[k])
            a -= rate * rate * (self.cos[k] * c[k] + self.sin[k] * s[k])
        return v, a

    def heading(self, position: Floats, velocity: Floats) -> Floats:
        """(3, n) horizontal unit direction that body x is to point in, in I."""
        toward = self.rule == 0.0
        x, y = (
            np.where(
                toward, self.point[i] - position[i], np.where(self.rule == 1.0, self.point[i], v)
            )
            for i, v in enumerate(velocity[:2])
        )
        square = x * x + y * y
        usable = square > 1e-60
        length = np.sqrt(np.where(usable, square, 1.0))
        return np.stack([np.where(usable, x / length, 1.0), np.where(usable, y / length, 0.0), 0.0 * x])

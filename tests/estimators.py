"""Estimators for tests: simple ones, and the modules of docs/gallery/estimators."""

from pathlib import Path
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

import quad_gym
from tests.examples import example

FOLDER = Path(__file__).parents[1] / "docs" / "gallery" / "estimators"


def gallery(name):
    """A module of docs/gallery/estimators."""
    return example(name, FOLDER)


class Simple(quad_gym.Estimator):
    """Constant-gain filter of positions, with initial velocities and integrated gyro rates."""

    state: ClassVar = {"r": np.zeros(3), "v": np.zeros(3), "R": np.eye(3), "ticks": 0}

    def reset(self, view, mask):
        self.state.r, self.state.v, self.state.R = view.position, view.velocity, view.R_BI
        return self.estimate()

    def update(self, measurements):
        s, fix = self.state, measurements.gnss_position
        s.ticks += 1
        s.r += measurements.dt * s.v
        turns = Rotation.from_rotvec(-measurements.dt * measurements.gyro)
        s.R = turns.as_matrix() @ s.R
        if fix is not None:
            s.r += np.where(fix.new[:, np.newaxis], 0.2 * (fix.value - s.r), 0.0)
        return self.estimate()

    def estimate(self):
        s = self.state
        return {"position": s.r, "velocity": s.v, "R_BI": s.R}


class Certain(Simple):
    """`Simple` with a covariance and biases."""

    def estimate(self):
        n = len(self.state.r)
        return super().estimate() | {
            "accel_bias": np.full((n, 3), 0.01),
            "gyro_bias": np.full((n, 3), 0.02),
            "covariance": np.tile(np.diag(np.arange(1.0, 16.0) ** 2), (n, 1, 1)),
        }


class Diverges(Simple):
    """`Simple` with NaN positions in every update."""

    def update(self, measurements):
        return super().update(measurements) | {"position": np.full((measurements.count, 3), np.nan)}


class Given(quad_gym.Estimator):
    """Constant estimate, in which the caller can replace or omit values."""

    def __init__(self, **changes):
        self.changes = changes

    def reset(self, view, mask):
        return self.update(view)

    def update(self, measurements):
        n = measurements.count
        estimate = {
            "position": np.tile([1.0, 2.0, 3.0], (n, 1)),
            "velocity": np.tile([0.1, 0.2, 0.3], (n, 1)),
            "R_BI": np.tile(np.eye(3), (n, 1, 1)),
        }
        estimate |= {name: value(n) for name, value in self.changes.items() if value is not None}
        return {name: value for name, value in estimate.items() if name not in self.without}

    @property
    def without(self):
        return [name for name, value in self.changes.items() if value is None]

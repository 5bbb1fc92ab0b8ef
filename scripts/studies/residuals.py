"""Residual model of estimation errors, fitted to flights, for training on the truth.

The method is the one of E. Kaufmann et al., "Champion-level drone racing using deep reinforcement
learning", Nature 620, 2023: fly, record the difference between estimate and truth, fit a model of
it (`scripts.studies.fitting`), and train on the truth plus errors drawn from the model. They use
Gaussian processes; this model is a linear autoregression with the velocity as input, because
delayed measurements cause errors that depend on it:

    e' = A e + B (v, 1) + L w,  w normal with unit covariance,

with the error e (12): position and velocity in I, attitude as a rotation vector in B, and body
rates in B, from one control step to the next.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from quad_gym.evaluation import Policy, roll_out

Floats = NDArray[np.float64]

SIZE = 12  #: number of components of an error

FITTED = Path(__file__).resolve().parent / "fitted"  #: folder of the included models, by task


@dataclass(frozen=True, eq=False)
class ResidualModel:
    """Linear autoregression of errors."""

    A: Floats
    """Transition matrix, (12, 12)"""
    B: Floats
    """Input matrix for the true velocity in I and a constant 1, (12, 4)"""
    L: Floats
    """Lower Cholesky factor of the covariance of the residuals of the fit, (12, 12)"""

    def advance(self, error: Floats, velocity: Floats, noise: Floats) -> Floats:
        """Compute the errors (n, 12) one step later.

        Velocities (n, 3) are true ones in I [m/s]; the noise (n, 12) is standard normal.
        """
        return error @ self.A.T + _inputs(velocity) @ self.B.T + noise @ self.L.T

    def save(self, file: Path) -> None:
        """Write the model as JSON."""
        numbers = {name: getattr(self, name).tolist() for name in ("A", "B", "L")}
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(numbers) + "\n", encoding="utf-8")

    @classmethod
    def load(cls, file: Path) -> "ResidualModel":
        """Read a model written by `save`."""
        numbers = json.loads(file.read_text(encoding="utf-8"))
        return cls(**{name: np.array(values) for name, values in numbers.items()})


def fit(errors: Floats, velocities: Floats) -> ResidualModel:
    """Fit a model by least squares.

    Args:
        errors: Errors of n flights at successive control steps, (t, n, 12); NaN after the end of a
            flight.
        velocities: True velocities, (t, n, 3) in I [m/s].
    """
    before, after, moving = errors[:-1], errors[1:], velocities[:-1]
    whole = np.isfinite(after).all(axis=2) & np.isfinite(before).all(axis=2)
    x = np.concatenate([before[whole], _inputs(moving[whole])], axis=1)
    if len(x) < 10 * x.shape[1]:
        raise ValueError(f"errors must have at least {10 * x.shape[1]} steps, got {len(x)}")
    y = after[whole]
    # errors differ by orders of magnitude: scale each column
    scale = np.maximum(np.sqrt((x * x).mean(axis=0)), 1e-12)
    found, *_ = np.linalg.lstsq(x / scale, y, rcond=None)
    found = (found / scale[:, np.newaxis]).T
    rest = y - x @ found.T
    A, covariance = found[:, :SIZE], np.cov(rest.T)
    largest = float(np.abs(np.linalg.eigvals(A)).max())
    if largest >= 1.0:
        raise ValueError(f"errors must be stationary, got a model with eigenvalue {largest:.4f}")
    L: Floats = np.linalg.cholesky(covariance + 1e-18 * np.eye(SIZE)).astype(np.float64)
    return ResidualModel(A, found[:, SIZE:], L)


def record(
    policy: Policy, env: gymnasium.vector.VectorEnv[Any, Any, Any], seed: int = 0
) -> tuple[Floats, Floats]:
    """Run an episode in each flight; return errors (t, n, 12) and true velocities (t, n, 3).

    Errors are NaN after the end of a flight, and of a flight that crashes, whose errors belong
    to a lost vehicle.
    """
    errors, velocities = [], []

    def watch(step: int, batch: Any, flying: NDArray[np.bool_]) -> None:
        errors.append(np.where(flying[:, np.newaxis], error_of(batch.view), np.nan))
        velocities.append(batch.view.velocity.copy())

    crashed = roll_out(policy, env, seed=seed, watch=watch).crashed
    found = np.array(errors)
    found[:, crashed] = np.nan
    return found, np.array(velocities)


def error_of(view: Any) -> Floats:
    """Error of the observed state: observed minus true, (n, 12)."""
    seen, truth = view.observed, view.truth
    turn = Rotation.from_matrix(seen.R_BI @ truth.R_BI.transpose(0, 2, 1)).as_rotvec()
    dr, dv = seen.position - truth.position, seen.velocity - truth.velocity
    return np.concatenate([dr, dv, turn, seen.body_rates - truth.body_rates], axis=1)


def _inputs(velocity: Floats) -> Floats:
    return np.concatenate([velocity, np.ones((*velocity.shape[:-1], 1))], axis=-1)

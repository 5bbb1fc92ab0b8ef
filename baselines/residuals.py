"""A model of what an estimate is off by, fitted to flights, to train on the truth with.

The way of E. Kaufmann and others, "Champion-level drone racing using deep reinforcement learning",
Nature 620, 2023: fly, record how the estimate differs from the truth, fit a model of it, and train
on the truth plus what the model draws. Theirs are Gaussian processes; this one is a linear
autoregression that knows the velocity, which late measurements make errors depend on:

    e' = A e + B (v, 1) + L w,  w normal, of unit covariance,

with the error e (12): of position and velocity in I, of the attitude as a rotation vector in B, and
of the body rates in B, one control step after the other.
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

SIZE = 12
"""Numbers of an error."""

FITTED = Path(__file__).resolve().parent / "residuals"
"""Folder of the models that ship, by task."""


@dataclass(frozen=True, eq=False)
class ResidualModel:
    """A linear autoregression of errors."""

    A: Floats
    """(12, 12)"""
    B: Floats
    """(12, 4) of the true velocity in I, and of 1"""
    L: Floats
    """(12, 12) factor of the covariance of what the rest leaves over"""

    def advance(self, error: Floats, velocity: Floats, noise: Floats) -> Floats:
        """(n, 12) errors a step later, from errors (n, 12), velocities (n, 3), noise (n, 12)."""
        return error @ self.A.T + _inputs(velocity) @ self.B.T + noise @ self.L.T

    def save(self, file: Path) -> None:
        """Write it as JSON."""
        numbers = {name: getattr(self, name).tolist() for name in ("A", "B", "L")}
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(numbers) + "\n", encoding="utf-8")

    @classmethod
    def load(cls, file: Path) -> "ResidualModel":
        """Read what `save` wrote."""
        numbers = json.loads(file.read_text(encoding="utf-8"))
        return cls(**{name: np.array(values) for name, values in numbers.items()})


def fit(errors: Floats, velocities: Floats) -> ResidualModel:
    """The model that fits best by least squares.

    Args:
        errors: (t, n, 12) of n flights at successive control steps; NaN where they are over.
        velocities: (t, n, 3) true ones in I [m/s].

    Raises:
        ValueError: If there are too few, or if what they say would grow without end.
    """
    before, after, moving = errors[:-1], errors[1:], velocities[:-1]
    whole = np.isfinite(after).all(axis=2) & np.isfinite(before).all(axis=2)
    x = np.concatenate([before[whole], _inputs(moving[whole])], axis=1)
    if len(x) < 10 * x.shape[1]:
        raise ValueError(f"errors must hold at least {10 * x.shape[1]} steps, got {len(x)}")
    y = after[whole]
    # errors differ in size by orders of magnitude: each column on its own scale
    scale = np.maximum(np.sqrt((x * x).mean(axis=0)), 1e-12)
    found, *_ = np.linalg.lstsq(x / scale, y, rcond=None)
    found = (found / scale[:, np.newaxis]).T
    rest = y - x @ found.T
    A, covariance = found[:, :SIZE], np.cov(rest.T)
    largest = float(np.abs(np.linalg.eigvals(A)).max())
    if largest >= 1.0:
        raise ValueError(
            f"errors must be those of a stationary model, got eigenvalue {largest:.4f}"
        )
    L: Floats = np.linalg.cholesky(covariance + 1e-18 * np.eye(SIZE)).astype(np.float64)
    return ResidualModel(A, found[:, SIZE:], L)


def record(
    policy: Policy, env: gymnasium.vector.VectorEnv[Any, Any, Any], seed: int = 0
) -> tuple[Floats, Floats]:
    """Fly an episode in every flight; return errors (t, n, 12) and true velocities (t, n, 3)."""
    errors, velocities = [], []

    def watch(step: int, batch: Any, flying: NDArray[np.bool_]) -> None:
        error = error_of(batch.view)
        error[~flying] = np.nan
        errors.append(error)
        velocities.append(batch.view.velocity.copy())

    roll_out(policy, env, seed=seed, watch=watch)
    return np.array(errors), np.array(velocities)


def error_of(view: Any) -> Floats:
    """(n, 12) what is seen, less what is so."""
    seen, truth = view.observed, view.truth
    turn = Rotation.from_matrix(seen.R_BI @ truth.R_BI.transpose(0, 2, 1)).as_rotvec()
    return np.concatenate(
        [
            seen.position - truth.position,
            seen.velocity - truth.velocity,
            turn,
            seen.body_rates - truth.body_rates,
        ],
        axis=1,
    )


def _inputs(velocity: Floats) -> Floats:
    return np.concatenate([velocity, np.ones((*velocity.shape[:-1], 1))], axis=-1)


def fit_task(env_id: str, policy: str = "pd", episodes: int = 500) -> ResidualModel:
    """Fit the model to episodes of a task, flown on the estimate.

    Args:
        env_id: One of `quad_gym.IDS`.
        policy: By name or file, see `baselines.policies.load_policy`.
        episodes: How many; they have the seeds of trainings (`baselines.seeds`), not of tests.
    """
    from baselines.policies import load_policy
    from baselines.seeds import first_seed

    env = gymnasium.make_vec(env_id, num_envs=episodes)
    errors, velocities = record(load_policy(policy, env), env, first_seed("training", 0, episodes))
    return fit(errors, velocities)

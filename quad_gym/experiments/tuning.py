"""Search for the gains of PD control, and test flights of the gains that were found."""

import math
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from baselines.pd import PDPolicy
from quad_gym import PDGains
from quad_gym.analysis.intervals import in_brackets, paired_difference
from quad_gym.analysis.reports import text_table
from quad_gym.evaluation import roll_out

Floats = NDArray[np.float64]

CRASH_FACTOR = 10.0  #: error of an episode that crashed, relative to the initial error
RANGE = 3.0  #: gains are searched from 1 / RANGE to RANGE times the initial gains
POPULATION = 8  #: candidates of a generation, for each gain


class _AllFlownError(Exception):
    """All candidates have flown."""


class Search:
    """Search by differential evolution for the logarithms of factors on the initial gains.

    `torques` is True if Kd has a separate effect; with commands of rates or tilt, only K / Kd has.
    Every candidate flies the same episodes, from `seed` on.
    """

    def __init__(self, envs: Mapping[str, Any], start: PDGains, torques: bool, seed: int) -> None:
        self.start, self.rows = start, list[dict[str, float]]()
        self._envs, self._seed, self._size = envs, seed, 6 if torques else 4
        self._flown: list[PDGains] = []
        self._initial: dict[str, float] = {}
        """Mean error of each task with the initial gains [m]"""

    def gains(self, x: Floats) -> PDGains:
        """Gains at a point: position, velocity, attitude (tilt, yaw), body rates (tilt, yaw)."""
        f, start = np.exp(np.append(x, np.zeros(6 - len(x)))), self.start
        return PDGains(
            position=f[0] * start.position,
            velocity=f[1] * start.velocity,
            attitude=tuple(f[[2, 2, 3]] * start.attitude),
            body_rates=tuple(f[[4, 4, 5]] * start.body_rates),
        )

    def cost(self, x: Floats) -> float:
        """Logarithm of the mean error relative to the initial one, mean over tasks."""
        gains, logs = self.gains(np.asarray(x)), []
        for env_id, env in self._envs.items():
            episodes = roll_out(PDPolicy(env, gains=gains), env, seed=self._seed)
            errors = np.where(episodes.crashed, np.nan, episodes.mean_error)
            if env_id not in self._initial:  # the first candidate
                if episodes.crashed.all():
                    raise ValueError(f"every episode of {env_id} crashes with the initial gains")
                self._initial[env_id] = float(np.nanmean(errors))
            scale = self._initial[env_id]
            logs.append(math.log(np.nan_to_num(errors, nan=CRASH_FACTOR * scale).mean() / scale))
        cost = float(np.mean(logs))
        self.rows.append({"relative_error": math.exp(cost), **flat(gains)})
        self._flown.append(gains)
        return cost

    def run(self, candidates: int, seed: int) -> PDGains:
        """Fly a number of candidates; returns the gains with the smallest error."""
        from scipy.optimize import differential_evolution

        initial = self.cost(np.zeros(self._size))
        with tqdm(total=candidates, initial=1, desc="tuning", unit=" candidates") as bar:

            def cost(x: Floats) -> float:
                if not x.any():
                    return initial
                if len(self.rows) == candidates:
                    raise _AllFlownError
                value = self.cost(x)
                bar.update()
                bar.set_postfix(error=f"{min(row['relative_error'] for row in self.rows):.1%}")
                return value

            limits = [(-math.log(RANGE), math.log(RANGE))] * self._size
            options = {"popsize": POPULATION, "maxiter": candidates, "polish": False, "tol": 0.0}
            with suppress(_AllFlownError):
                differential_evolution(cost, limits, x0=np.zeros(self._size), rng=seed, **options)
        return self._flown[int(np.argmin([row["relative_error"] for row in self.rows]))]


def flat(gains: PDGains) -> dict[str, float]:
    """Gains by name, with the axes of vectors."""
    found = {"position": gains.position, "velocity": gains.velocity}
    for name in ("attitude", "body_rates"):
        found |= {f"{name}_{axis}": k for axis, k in zip("xyz", getattr(gains, name), strict=True)}
    return found


def compare_gains(
    envs: Mapping[str, Any], gains: Mapping[str, PDGains], seed: int
) -> tuple[str, dict[str, Any]]:
    """Fly two gains in new episodes; returns a table and the numbers."""
    rows, numbers = [], {}
    for env_id, env in envs.items():
        flown = {k: roll_out(PDPolicy(env, gains=g), env, seed=seed) for k, g in gains.items()}
        start, tuned = flown.values()
        change = paired_difference(tuned.mean_error, start.mean_error)
        row = [env_id]
        for episodes in (start, tuned):
            row += [f"{1e3 * episodes.mean_error.mean():.1f}", f"{episodes.crashed.mean():.1%}"]
        rows.append([*row, in_brackets(change.spread.mean, change.interval, "+.1f", 1e3)])
        numbers[env_id] = {name: episodes.summary() for name, episodes in flown.items()}
    groups = {name: ["error [mm]", "crashed"] for name in gains}
    return text_table({"": ["task"], **groups, "change": ["[mm]"]}, rows), numbers

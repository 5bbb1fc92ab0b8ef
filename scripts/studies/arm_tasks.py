"""Variants of tasks for the arms of studies, mostly for training."""

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from baselines.arm_tasks import Parts, Scaled, WithStd, WithUncertainty
from quad_gym.params import checks as check
from quad_gym.tasks.look_around import LookAround
from quad_gym.tasks.outage_dash import OutageDash, gaps_of
from quad_gym.tasks.rewards import Crash
from quad_gym.tasks.stale_race import StaleRace
from quad_gym.tasks.task import ObservationSpec
from scripts.studies import residuals

if TYPE_CHECKING:
    from quad_gym.tasks.task import FlightRandom
    from quad_gym.tasks.view import View

REMEMBERED = 4  #: number of instants in a history

RACE_STD = {
    "position_sigma": ("m", "I", 0.008),
    "velocity_sigma": ("m/s", "I", 0.042),
    "attitude_sigma": ("rad", "B", 0.004),
    "accel_bias_sigma": ("m/s^2", "B", 0.13),
    "gyro_bias_sigma": ("rad/s", "B", 0.011),
}
"""Standard deviations in the observation of a race: unit, frame, and median in 200 episodes of the
included policy."""

CONSTANT_CRASH_COST = 100.0  #: cost of a crash in `ConstantCrashCost`

_CRASH = Crash()


REPORTED_STD_X1_4, REPORTED_STD_X1_2, REPORTED_STD_X2, REPORTED_STD_X4 = map(
    WithStd, (0.25, 0.5, 2.0, 4.0)
)
"""Tasks in which the controller observes a wrong multiple of the standard deviation."""


def _remember(view: "View", every: int, *now: NDArray[np.float64]) -> None:
    """Append present values (n, ...) to `past` every few steps, and drop the oldest ones."""
    due = (view.step % every == 0)[:, np.newaxis, np.newaxis]
    latest, past = np.concatenate(now, axis=1)[:, np.newaxis], view.state.past
    view.state.past = np.where(due, np.concatenate([latest, past[:, :-1]], axis=1), past)


class WithStdHistory(WithStd):
    """`WithStd` whose observation also contains the observations 0.2, 0.4, 0.6 and 0.8 s ago.

    At the start of an episode, the history is zero.
    """

    state: Mapping[str, ArrayLike] = {"past": np.zeros((REMEMBERED, 18))}
    observes: Mapping[str, ObservationSpec] = {
        **WithStd.observes,
        "past": ObservationSpec("mixed", "B"),
    }

    def update(self, view: "View", rng: "FlightRandom") -> None:
        """Append the present observation to the history every 0.2 s."""
        seen, direction = view.observed, LookAround.observe(self, view)["features_direction"]
        errors = (seen.position_error, seen.velocity_error)
        _remember(view, 10, *errors, seen.up, seen.heading, seen.body_rates, direction)

    def observe(self, view: "View") -> Parts:
        """Return the observation of `WithStd`, and `past` (n, 72)."""
        return {**super().observe(view), "past": view.state.past.reshape(view.count, -1)}


class CertaintyReward(LookAround):
    """`LookAround` that also rewards a small standard deviation, which is not observed.

    The reward is 0.3 (1 - min(sigma / 0.5 m, 1)) per step, where sigma is the largest standard
    deviation of the position along an axis; 0.25 m costs as much as the heading can earn. It is a
    bonus rather than a penalty: if the rewards of a lost vehicle were negative, a policy would
    learn to crash at once.
    """

    def reward(self, view: "View") -> Parts:
        """Return the terms of the reward described in the class, (n,) each."""
        sigma = view.estimate.position_sigma.max(axis=1)
        return super().reward(view) | {"certainty": 0.3 * (1.0 - np.minimum(sigma / 0.5, 1.0))}


class WithStdCertaintyReward(CertaintyReward, WithStd):
    """`WithStd` with the additional reward of `CertaintyReward`."""


class RaceWithHistory(StaleRace):
    """`StaleRace` whose observation also contains the observations 0.1, 0.2, 0.3 and 0.4 s ago.

    The effect of a delayed measurement on the estimate depends on the past motion of the vehicle.
    At the start of an episode, the history is zero.
    """

    state: Mapping[str, ArrayLike] = {"past": np.zeros((REMEMBERED, 12))}
    observes: Mapping[str, ObservationSpec] = {"past": ObservationSpec("mixed", "B")}

    def update(self, view: "View", rng: "FlightRandom") -> None:
        """Append the present observation to the history every 0.1 s."""
        seen = view.observed
        _remember(view, 5, seen.position_error, seen.velocity_error, seen.up, seen.body_rates)

    def observe(self, view: "View") -> Parts:
        """Return `past` (n, 48)."""
        return {"past": view.state.past.reshape(view.count, -1)}


class ObservedRace(StaleRace):
    """`StaleRace` with the observation of `ResidualRace`, but without residuals."""

    replaces_observation = True
    keeps: Collection[str] = ("last_action",)
    observes: Mapping[str, ObservationSpec] = {
        "position_error": ObservationSpec("m", "B"),
        "velocity_error": ObservationSpec("m/s", "B"),
        "up": ObservationSpec("-", "B"),
        "heading": ObservationSpec("-", "B"),
        "body_rates": ObservationSpec("rad/s", "B"),
        "preview_1": ObservationSpec("m", "B"),
        "preview_2": ObservationSpec("m", "B"),
    }

    def residual(self, view: "View") -> NDArray[np.float64]:
        """Return the residual that is added to the observed state, (n, 12).

        See `scripts.studies.residuals`.
        """
        return np.zeros((view.count, residuals.SIZE))

    def observe(self, view: "View") -> Parts:
        """Return the gates relative to the observed state plus the residual."""
        residual, seen = self.residual(view), view.observed
        R_BI = Rotation.from_rotvec(residual[:, 6:9].copy()).as_matrix() @ seen.R_BI

        def in_body(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.ascontiguousarray((R_BI @ vectors[:, :, np.newaxis])[:, :, 0])

        gate, later = view.reference_position, view.preview
        return {
            "position_error": in_body(gate - seen.position - residual[:, :3]),
            "velocity_error": in_body(view.reference_velocity - seen.velocity - residual[:, 3:6]),
            "up": np.ascontiguousarray(R_BI[:, :, 2]),
            "heading": in_body(view.reference_heading),
            "body_rates": seen.body_rates + residual[:, 9:],
            "preview_1": in_body(later[:, 0] - gate),
            "preview_2": in_body(later[:, 1] - gate),
        }


class ResidualRace(ObservedRace):
    """`ObservedRace` with residuals drawn from a model of recorded estimation errors.

    It is for training on the truth (`observation="truth"`). Residuals are zero at the start of an
    episode.
    """

    state: Mapping[str, ArrayLike] = {"residual": np.zeros(residuals.SIZE)}

    def __init__(self) -> None:
        super().__init__()
        self._model = residuals.ResidualModel.load(residuals.FITTED / "stale_race.json")

    def update(self, view: "View", rng: "FlightRandom") -> None:
        """Draw the next residual."""
        noise = rng.normal(size=(view.count, residuals.SIZE))
        view.state.residual = self._model.advance(view.state.residual, view.velocity, noise)

    def residual(self, view: "View") -> NDArray[np.float64]:
        """Return the residual drawn for this step, (n, 12)."""
        return view.state.residual


class ConstantCrashCost(Scaled):
    """`Scaled` for training, with a constant crash cost, and starts along the course.

    A crash costs `CONSTANT_CRASH_COST` and forfeits no reward. Hurrying therefore becomes
    worthwhile late in the course, but losing rewards of up to 660 at once makes learning unstable.
    So do flights that reach a gap and lose GNSS simultaneously: a batch then covers only one part
    of the course, and the policy forgets the other parts. Episodes begin before the first wall or
    halfway between two walls, with equal probability.
    """

    def reset(self, view: "View", rng: "FlightRandom") -> Mapping[str, ArrayLike]:
        """Draw start positions; returns "position" (n, 3) in I [m]."""
        x = gaps_of(view).centers[:, :-1, 0]
        before = np.floor(x.shape[1] * rng.random()).astype(np.int64)
        halfway = x[np.arange(view.count), before] + 0.5 * (x[:, 0] - x[:, 1])
        start = view.reference_position.copy()
        start[:, 0] = np.where(before == 0, start[:, 0], halfway)
        return {"position": start}

    def reward(self, view: "View") -> Parts:
        """Return the terms of the reward described in the class, (n,) each."""
        less = self._crash_cost + view.state.earned - CONSTANT_CRASH_COST
        return super().reward(view) | {"kept": _CRASH(view) * less}


class ConstantCrashCostWithUncertainty(ConstantCrashCost, WithUncertainty):
    """`WithUncertainty` for training, with the changes of `ConstantCrashCost`."""


class WithUncertaintyForRule(WithUncertainty):
    """`WithUncertainty` whose observation also contains the parts of `OutageDash`, for rules.

    It is for training by imitation: the rule reads its parts, and the policy those of
    `WithUncertainty`.
    """

    observes: Mapping[str, ObservationSpec] = {**WithUncertainty.observes, **OutageDash.observes}

    def observe(self, view: "View") -> Parts:
        """Return both observations."""
        return {**OutageDash.observe(self, view), **super().observe(view)}


class WithTimeSinceFix(WithUncertainty):
    """`WithUncertainty` whose observation also contains the time since the last fix of GNSS.

    It is observed as log2(1 + t / 1 s), and is known to every controller that receives the fixes.
    """

    state: Mapping[str, ArrayLike] = {**WithUncertainty.state, "since_fix": 0.0}
    observes: Mapping[str, ObservationSpec] = {
        **WithUncertainty.observes,
        "since_fix": ObservationSpec("log2", "-", 0.0, 10.0),
    }

    def update(self, view: "View", rng: "FlightRandom") -> None:
        """Count the time since the last fix [s], (n,)."""
        super().update(view, rng)
        missing = np.isnan(view.measured.gnss_position[:, 0])
        view.state.since_fix = np.where(missing, view.state.since_fix + view.period, 0.0)

    def observe(self, view: "View") -> Parts:
        """Return the observation of `WithUncertainty`, and `since_fix` (n,)."""
        return {**super().observe(view), "since_fix": np.log2(1.0 + view.state.since_fix)}


class ConstantCrashCostWithTimeSinceFix(ConstantCrashCost, WithTimeSinceFix):
    """`WithTimeSinceFix` for training, with the changes of `ConstantCrashCost`."""


class MaskedStd(StaleRace):
    """`StaleRace` with the 15 standard deviations in its observation, some of them masked.

    Masked standard deviations are replaced by their constant medians of `RACE_STD`, so that a
    policy trained with `include_std=True` can be tested without this information.

    Args:
        masked: Names from `RACE_STD` of the standard deviations to mask.
    """

    observes: Mapping[str, ObservationSpec] = {
        name: ObservationSpec(unit, frame, 0.0) for name, (unit, frame, _) in RACE_STD.items()
    }

    def __init__(self, *masked: str) -> None:
        super().__init__()
        for name in masked:
            check.choice("masked", name, tuple(RACE_STD))
        self._masked = masked

    def observe(self, view: "View") -> Parts:
        """Return the standard deviations by name, (n, 3) each."""
        shown = {name: getattr(view.estimate, name) for name in RACE_STD}
        medians = {name: RACE_STD[name][2] for name in self._masked}
        return {**shown, **{k: np.full((view.count, 3), value) for k, value in medians.items()}}


ALL_SHOWN = MaskedStd()
POSITION_MASKED, VELOCITY_MASKED, ATTITUDE_MASKED, ACCEL_BIAS_MASKED, GYRO_BIAS_MASKED = (
    MaskedStd(name) for name in RACE_STD
)
ONLY_POSITION, ONLY_VELOCITY, ONLY_ATTITUDE, ONLY_ACCEL_BIAS, ONLY_GYRO_BIAS = (
    MaskedStd(*(other for other in RACE_STD if other != name)) for name in RACE_STD
)
NONE_SHOWN = MaskedStd(*RACE_STD)
"""Tasks that differ in which of the standard deviations a controller observes."""

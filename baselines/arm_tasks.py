"""Variants of tasks for the arms of a study: for training, and some for evaluation."""

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from baselines import residuals
from baselines.pd import MARGIN, SIGMAS
from quad_gym.params import checks as check
from quad_gym.tasks.look_around import LookAround
from quad_gym.tasks.outage_dash import OutageDash, gaps_of
from quad_gym.tasks.rewards import Crash
from quad_gym.tasks.stale_race import StaleRace
from quad_gym.tasks.task import ObservationSpec

if TYPE_CHECKING:
    from quad_gym.tasks.draws import FlightRandom
    from quad_gym.tasks.view import View

TYPICAL = 0.03
"""Standard deviation of the position of a filter that sees markers [m]."""

EVERY = 10
"""Steps between what is remembered: 0.2 s at 50 Hz."""

REMEMBERED = 4
"""How many instants are remembered."""

_SEEN = 18
"""What is remembered of each: errors of position and velocity, vertical, heading, body rates and
the direction of the features."""

RECALLED_EVERY = 5
"""Steps between what is recalled in a race: 0.1 s."""

_RECALLED = 12
"""What is recalled of each: errors of position and velocity, vertical, body rates."""

_SCALES = {"position_error": 6.0, "velocity_error": 4.0, "body_rates": 2.0, "next_gap": 12.0}
"""What parts of the observation of `OutageDash` are divided by, in their units."""

_MIDDLE_WIDTH, _HALF_RANGE = 4.5, 1.5
"""Of the gaps of `OutageDash` [m]."""

_WIDTHS = ("gap_width", "next_width")

_ACTUAL = "actual_"
"""Before the names of parts that show the truth, scaled alike."""

RACE_STD = {
    "position_sigma": ("m", "I", 0.008),
    "velocity_sigma": ("m/s", "I", 0.042),
    "attitude_sigma": ("rad", "B", 0.004),
    "accel_bias_sigma": ("m/s^2", "B", 0.13),
    "gyro_bias_sigma": ("rad/s", "B", 0.011),
}
"""Standard deviations in the observation of a race: unit, frame, and the median in 200 episodes of
the policy that ships."""

CONSTANT_CRASH_COST = 100.0
"""Of a crash in `ConstantCrashCost`."""

_CRASH = Crash()

Parts = dict[str, NDArray[np.float64]]


class WithStd(LookAround):
    """`LookAround` whose observation also says how sure the filter is of its position.

    As log10(sigma / TYPICAL) of the largest standard deviation, so that a network sees a doubling
    alike whether it is of millimeters or of meters.

    Args:
        factor: The standard deviation is multiplied by this before it is observed.
    """

    def __init__(self, factor: float = 1.0) -> None:
        super().__init__()
        self._factor = check.positive("factor", factor)

    observes: Mapping[str, ObservationSpec] = {
        **LookAround.observes,
        "log_sigma": ObservationSpec("log10", "I", -1.0, 6.0),
    }

    def observe(self, view: "View") -> Parts:
        """`features_direction` (n, 3), and `log_sigma` (n,)."""
        try:
            sigma = self._factor * view.estimate.position_sigma.max(axis=1)
        except ValueError:  # no filter runs: who sees the truth has no doubt
            sigma = np.zeros(view.count)
        return {**super().observe(view), "log_sigma": np.log10(np.maximum(sigma, 1e-9) / TYPICAL)}


REPORTED_STD_X1_4, REPORTED_STD_X1_2, REPORTED_STD_X2, REPORTED_STD_X4 = map(
    WithStd, (0.25, 0.5, 2.0, 4.0)
)
"""Tasks in which the controller observes a wrong multiple of the standard deviation."""


class WithStdHistory(WithStd):
    """`WithStd` whose observation also has what was observed 0.2, 0.4, 0.6 and 0.8 s ago.

    At the start of an episode, the past is zero.
    """

    state: Mapping[str, ArrayLike] = {"past": np.zeros((REMEMBERED, _SEEN))}
    observes: Mapping[str, ObservationSpec] = {
        **WithStd.observes,
        "past": ObservationSpec("mixed", "B"),
    }

    def update(self, view: "View", rng: "FlightRandom") -> None:
        """Every so often, remember the present, and forget the oldest."""
        due = (view.step % EVERY == 0)[:, np.newaxis, np.newaxis]
        seen = view.observed
        direction = LookAround.observe(self, view)["features_direction"]
        now = [seen.position_error, seen.velocity_error, seen.up, seen.heading, seen.body_rates]
        latest = np.concatenate([*now, direction], axis=1)[:, np.newaxis]
        past = view.state.past
        view.state.past = np.where(due, np.concatenate([latest, past[:, :-1]], axis=1), past)

    def observe(self, view: "View") -> Parts:
        """As `WithStd`, and `past` (n, 72)."""
        return {**super().observe(view), "past": view.state.past.reshape(view.count, -1)}


class CertaintyReward(LookAround):
    """`LookAround` that also pays for a sure filter, which the controller does not see.

    0.3 (1 - min(sigma / 0.5 m, 1)) a step, sigma the largest standard deviation of the position:
    what a doubt of 0.25 m costs is as much as the heading can bring. A payment, not a fine: where
    the rewards of a lost vehicle add up to less than zero, a policy learns to crash at once.
    """

    def reward(self, view: "View") -> NDArray[np.float64]:
        """(n,) see the class."""
        sigma = view.estimate.position_sigma.max(axis=1)
        return super().reward(view) + 0.3 * (1.0 - np.minimum(sigma / 0.5, 1.0))


class WithStdCertaintyReward(CertaintyReward, WithStd):
    """`WithStd` that also pays for a sure filter, as `CertaintyReward` does."""


class RaceWithHistory(StaleRace):
    """`StaleRace` whose observation also has what was observed 0.1, 0.2, 0.3 and 0.4 s ago.

    What a late measurement does to the estimate depends on how the vehicle has been moving. At the
    start of an episode, the past is zero.
    """

    state: Mapping[str, ArrayLike] = {"past": np.zeros((REMEMBERED, _RECALLED))}
    observes: Mapping[str, ObservationSpec] = {"past": ObservationSpec("mixed", "B")}

    def update(self, view: "View", rng: "FlightRandom") -> None:
        """Every so often, remember the present, and forget the oldest."""
        due = (view.step % RECALLED_EVERY == 0)[:, np.newaxis, np.newaxis]
        seen = view.observed
        now = [seen.position_error, seen.velocity_error, seen.up, seen.body_rates]
        latest = np.concatenate(now, axis=1)[:, np.newaxis]
        past = view.state.past
        view.state.past = np.where(due, np.concatenate([latest, past[:, :-1]], axis=1), past)

    def observe(self, view: "View") -> Parts:
        """`past` (n, 48)."""
        return {"past": view.state.past.reshape(view.count, -1)}


class ObservedRace(StaleRace):
    """`StaleRace` observed as `ResidualRace` is: what is seen, without a model of residuals."""

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
        """(n, 12) what is added to the seen state; see `baselines.residuals`."""
        return np.zeros((view.count, residuals.SIZE))

    def observe(self, view: "View") -> Parts:
        """The gates relative to a state that is off by the residual."""
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
    """`ObservedRace` with residuals that a model of recorded estimation errors draws.

    To be trained in on the truth (`observation="truth"`); the episode begins without an error.
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
        """(n, 12) the drawn one."""
        return view.state.residual


def _scaled(name: str, value: Any) -> Any:
    """What `Scaled` shows for a value of a part of `OutageDash`."""
    if name in _WIDTHS:
        return (value - _MIDDLE_WIDTH) / _HALF_RANGE
    return value / _SCALES.get(name.removeprefix(_ACTUAL), 1.0)


def _shown_as(name: str) -> str:
    """The name that `Scaled` gives to a part of `OutageDash`."""
    return f"{name}_scaled" if name.removeprefix(_ACTUAL) in (*_SCALES, *_WIDTHS) else name


def scaled_parts(parts: Parts) -> Parts:
    """Parts of an observation of `OutageDash`, by the names and in the units of `Scaled`."""
    return {_shown_as(name): _scaled(name, part) for name, part in parts.items()}


def _in_numbers(name: str, part: ObservationSpec) -> ObservationSpec:
    """A part of `OutageDash` as `Scaled` declares it: without a unit, its bounds scaled."""
    if _shown_as(name) == name:
        return part
    return ObservationSpec("-", part.frame, _scaled(name, part.low), _scaled(name, part.high))


class Scaled(OutageDash):
    """`OutageDash` whose observation is in numbers of the order of one.

    Gaps are 12 m apart, and body rates a few tenths of rad/s: in units of SI, a network learns
    from the former alone for long. The position error is divided by 6 m, the velocity error by
    4 m/s, the body rates by 2 rad/s, the way from gap to gap by 12 m; widths w become
    (w - 4.5 m) / 1.5 m. Such parts have names of their own, as `position_error_scaled`, so that
    policies that fly `OutageDash` are refused here, and those of here are refused there.
    """

    observes: Mapping[str, ObservationSpec] = {
        _shown_as(name): _in_numbers(name, part) for name, part in OutageDash.observes.items()
    }

    def observe(self, view: "View") -> Parts:
        """As `OutageDash`, scaled."""
        return scaled_parts(super().observe(view))


class WithUncertainty(Scaled):
    """`Scaled` whose observation also says how unsure the filter is for the next two gaps.

    As log4(2 sigma / room), sigma the largest standard deviation of the position, and room what is
    left beside a vehicle in the middle of the gap: half its width, less 0.5 m. Above 0, two
    standard deviations do not fit through.
    """

    observes: Mapping[str, ObservationSpec] = {
        **Scaled.observes,
        "uncertainty": ObservationSpec("log4", "-", -4.0, 4.0),
    }

    def observe(self, view: "View") -> Parts:
        """As `Scaled`, and `uncertainty` (n, 2)."""
        parts = super().observe(view)
        scaled = np.stack([parts[f"{name}_scaled"] for name in _WIDTHS], axis=1)
        return {
            **parts,
            "uncertainty": normalized_uncertainty(view, _HALF_RANGE * scaled + _MIDDLE_WIDTH),
        }


class ConstantCrashCost(Scaled):
    """`Scaled` for training: crashes cost the same everywhere, and episodes begin along the course.

    A crash costs `CONSTANT_CRASH_COST`, and forfeits nothing. That makes hurrying pay late in the
    course, but sums of up to 660 that are lost all at once make learning unsteady. So do flights
    that come to the same gap, and lose GNSS, at the same time: a batch shows one part of the course
    alone, and what was learned of the others is lost. Episodes begin before the first wall, or
    halfway between two walls, with equal chances.
    """

    def reset(self, view: "View", rng: "FlightRandom") -> Mapping[str, ArrayLike]:
        """Draw where episodes begin."""
        x = gaps_of(view).centers[:, :-1, 0]
        before = np.floor(x.shape[1] * rng.random()).astype(np.int64)
        halfway = x[np.arange(view.count), before] + 0.5 * (x[:, 0] - x[:, 1])
        start = view.reference_position.copy()
        start[:, 0] = np.where(before == 0, start[:, 0], halfway)
        return {"position": start}

    def reward(self, view: "View") -> NDArray[np.float64]:
        """(n,) see the class."""
        less = self._crash_cost + view.state.earned - CONSTANT_CRASH_COST
        return super().reward(view) + _CRASH(view) * less


class ConstantCrashCostWithUncertainty(ConstantCrashCost, WithUncertainty):
    """`WithUncertainty` for training, as `ConstantCrashCost` is."""


def normalized_uncertainty(view: "View", widths: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, k) log4(2 sigma / room) for gaps of widths (n, k) [m]; see `WithUncertainty`."""
    try:
        sigma = view.estimate.position_sigma.max(axis=1)
    except ValueError:  # no filter runs: who sees the truth has no doubt
        sigma = np.zeros(view.count)
    ratio = SIGMAS * sigma[:, np.newaxis] / (0.5 * widths - MARGIN)
    return np.asarray(0.5 * np.log2(np.maximum(ratio, 2.0**-8)))


class MaskedStd(StaleRace):
    """`StaleRace` with the 15 standard deviations in its observation, some of them masked.

    A masked one is shown as its constant median of `RACE_STD`, so that a policy that was
    trained with `include_std=True` can be flown without that part.

    Args:
        masked: Names of `RACE_STD`.
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
        """Each (n, 3)."""
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

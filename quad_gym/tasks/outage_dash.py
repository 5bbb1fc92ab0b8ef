"""`OutageDash`: a task in which the best action depends on the filter's uncertainty."""

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.params import checks as check
from quad_gym.params.task import RewardParams
from quad_gym.params.world import Wall
from quad_gym.tasks.rewards import ActionRate, BodyRates, Crash, Term
from quad_gym.tasks.task import ObservationSpec, Task

if TYPE_CHECKING:
    from quad_gym.params.suites import SensorSuite
    from quad_gym.params.world import WorldParams
    from quad_gym.tasks.task import FlightRandom
    from quad_gym.tasks.view import View

Floats = NDArray[np.float64]

PROGRESS_WEIGHT = 5.0  #: reward for each meter along the course, up to the rewarded speed [1/m]

REWARDED_SPEED = 5.0
"""Highest rewarded speed [m/s]; at higher speeds, many gaps would be flown in one outage."""

CRASH_COST = 50.0
"""Cost of a crash, in addition to the rewards for progress so far. With a constant cost alone,
hurrying through an outage late in the course would be worthwhile."""

_WEIGHTS = RewardParams()
_ACTION_RATE: Term = -_WEIGHTS.action_rate * ActionRate()
_BODY_RATES: Term = -_WEIGHTS.body_rates * BodyRates()
_CRASH = Crash()

PAST = 0.7  #: distance beyond a wall at which the whole vehicle is through its gap [m]
FINISH_WIDTH = 6.0  #: width in observations for the finish, which follows the last gap [m]


class Gaps(NamedTuple):
    """Gaps of a course in order, followed by the finish."""

    centers: Floats  #: centers, (n, gaps + 1, 3) in I [m]
    widths: Floats  #: widths, (n, gaps + 1) [m]


class OutageDash(Task):
    """Fly through the gaps of ten walls while GNSS is lost again and again, for 5 to 15 s.

    The sensors are typical of hobby vehicles (`consumer`). With GNSS the position error of the
    filter is 0.2 m; without it the error grows to 0.25 m after two seconds, 0.8 m after five, 2 m
    after eight, and 4 m after twelve (root mean square). Gaps are 3 to 6 m wide, walls 12 m apart.
    A controller that continues through an outage hits a wall; one that waits for GNSS needs time,
    and drifts. The best distance to continue depends on the filter's uncertainty and on the width
    of the next gap. Outages recur, so that waiting for the first one to end, before the first wall,
    wins nothing.

    At 5 m/s the course takes 27 s of the 90 s, and time that remains is not rewarded: there is
    enough time to wait for the end of most outages, but not to fly the whole course slowly.

    Actions command velocities (`action="velocity"`) at 10 Hz (`control_rate=10`), and an inner loop
    tracks them on the estimate: the task is to decide when to continue, not to stabilize the
    vehicle. The keywords `action` and `control_rate` select others.

    ## Course
    The course leads from east to west, from (60, 0, 4) through the origin. The walls are at
    x = 48, 36, ..., -60 m, each with one gap. For each episode, the northern edge of each gap is
    drawn within 1.5 m of its nominal place, alternately 0.75 and 3.75 m north of the course line,
    and the width uniformly in [3, 6] m. A geofence keeps the vehicle within 14 m of the line and
    below 12 m.

    GNSS (position and velocity) fails at random instants, 0.1 per second of availability, for a
    duration in [5, 15] s each: half of the time on average.

    ## Reward
    In each step of h seconds, with the true speed v to the west [m/s] until 12 m behind the last
    gap, the norm d of the change of the action and the norm w of the body rates [rad/s]

        5 h min(v, 5) - 0.02 d^2 - 0.002 w^2

    At most 2.5 per step of 0.1 s, and 660 for the course of 132 m. A crash costs 50, and forfeits
    the sum of 5 h min(v, 5) so far.

    ## Observation
    It replaces the built-in observation. Position, velocity and attitude are the observed ones:

    | name | meaning | unit | frame |
    |---|---|---|---|
    | position_error (3) | vector from the vehicle to the center of the next gap | m | B |
    | velocity_error (3) | negative velocity | m/s | B |
    | up (3) | vertical | - | B |
    | heading (3) | direction of the course | - | B |
    | body_rates (3) | angular rate | rad/s | B |
    | gap_width (1) | width of the next gap | m | - |
    | next_gap (3) | vector from the center of the next gap to the gap after it | m | B |
    | next_width (1) | width of the gap after the next | m | - |
    | course_share (1) | share of the course completed, 1 at the finish | - | - |

    It is preceded by `last_action` (4) and, with `include_std=True`, by the filter's 15 standard
    deviations, which reveal the loss of GNSS. The next gap is the first one that is not yet 0.7 m
    behind the vehicle; the last one is followed by the finish, 12 m further.

    ## Endings
    The finish, 12 m behind the last wall; contact with a wall, leaving the geofence, the ground at
    height 0, tipping over, and the time limit of 90 s, as in `QuadEnv`. `info["gates_passed"]`
    counts the gaps that are at least 0.7 m behind the vehicle.

    Args:
        progress_weight: Weight of h v in the reward [1/m].
        crash_cost: Cost of a crash, in addition to the forfeited reward.

    Raises:
        ValueError: If a number is negative or not finite.
    """

    replaces_observation = True
    keeps: Collection[str] = (
        "last_action",
        "position_sigma",
        "velocity_sigma",
        "attitude_sigma",
        "accel_bias_sigma",
        "gyro_bias_sigma",
    )
    observes: Mapping[str, ObservationSpec] = {
        "position_error": ObservationSpec("m", "B", -200.0, 200.0),
        "velocity_error": ObservationSpec("m/s", "B", -100.0, 100.0),
        "up": ObservationSpec("-", "B", -1.0, 1.0),
        "heading": ObservationSpec("-", "B", -1.0, 1.0),
        "body_rates": ObservationSpec("rad/s", "B", -200.0, 200.0),
        "gap_width": ObservationSpec("m", "-", 0.0, 100.0),
        "next_gap": ObservationSpec("m", "B", -100.0, 100.0),
        "next_width": ObservationSpec("m", "-", 0.0, 100.0),
        "course_share": ObservationSpec("-", "-", -1.0, 2.0),
    }
    state: Mapping[str, ArrayLike] = {"earned": 0.0, "gates_passed": 0}

    def __init__(
        self, progress_weight: float = PROGRESS_WEIGHT, crash_cost: float = CRASH_COST
    ) -> None:
        self._weight = check.number("progress_weight", progress_weight, least=0.0)
        self._crash_cost = check.number("crash_cost", crash_cost, least=0.0)

    def _require(self, sensors: "SensorSuite", world: "WorldParams") -> None:
        walls = world.obstacles
        if len(walls) < 2 or len(walls) % 2 or not all(isinstance(wall, Wall) for wall in walls):
            raise ValueError(
                "world must have pairs of walls for OutageDash, as those of world='slalom', got "
                f"{len(walls)} obstacles"
            )

    def update(self, view: "View", rng: "FlightRandom") -> None:
        """Add up the rewards for progress, `view.state.earned` (n,), and count gaps."""
        view.state.earned = view.state.earned + self._weight * view.period * westward(view)
        behind = gaps_behind(gaps_of(view), view.position)
        view.state.gates_passed = np.maximum(view.state.gates_passed, behind)

    def reward(self, view: "View") -> dict[str, Floats]:
        """Return the terms of the reward described in the class, (n,) each."""
        return {
            "action_rate": _ACTION_RATE(view),
            "body_rates": _BODY_RATES(view),
            "progress": self._weight * view.period * westward(view),
            "crash": -_CRASH(view) * (self._crash_cost + view.state.earned),
        }

    def terminated(self, view: "View") -> NDArray[np.bool_]:
        """Return True where the vehicle has crashed or is beyond the finish, (n,)."""
        finish = gaps_of(view).centers[:, -1, 0]
        return view.builtin.terminated | (view.position[:, 0] < finish)

    def observe(self, view: "View") -> dict[str, Floats]:
        """Return the observation described in the class, by name."""
        seen, gaps = view.observed, gaps_of(view)
        through = gaps_behind(gaps, seen.position)
        every, last = np.arange(view.count), gaps.widths.shape[1] - 1
        after = np.minimum(through + 1, last)
        here, there = gaps.centers[every, through], gaps.centers[every, after]
        start, finish = view.reference_position[:, 0], gaps.centers[:, -1, 0]

        def in_body(vectors: Floats) -> Floats:
            return np.ascontiguousarray((seen.R_BI @ vectors[:, :, np.newaxis])[:, :, 0])

        return {
            "position_error": in_body(here - seen.position),
            "velocity_error": in_body(-seen.velocity),
            "up": seen.up,
            "heading": seen.heading,
            "body_rates": seen.body_rates,
            "gap_width": gaps.widths[every, through],
            "next_gap": in_body(there - here),
            "next_width": gaps.widths[every, after],
            "course_share": np.asarray((start - seen.position[:, 0]) / (start - finish)),
        }


def gaps_of(view: "View") -> Gaps:
    """Find the gaps between pairs of walls; of each pair, the northern wall is listed first."""
    walls = view.world.obstacles
    half = np.array([wall.half_size[1] for wall in walls])
    middle = view.obstacles
    north, south = middle[:, ::2, 1] - half[::2], middle[:, 1::2, 1] + half[1::2]
    centers = middle[:, ::2].copy()
    centers[:, :, 1] = 0.5 * (north + south)
    centers[:, :, 2] = view.reference_position[:, 2:]
    finish = centers[:, -1:].copy()
    finish[:, :, 0] -= centers[:, :1, 0] - centers[:, 1:2, 0] if len(walls) > 2 else 10.0
    widths = np.concatenate([north - south, np.full((view.count, 1), FINISH_WIDTH)], axis=1)
    return Gaps(np.concatenate([centers, finish], axis=1), widths)


def gaps_behind(gaps: Gaps, position: Floats) -> NDArray[np.intp]:
    """Number of gaps behind a vehicle at a position (n, 3) in I, (n,)."""
    return (position[:, :1] < gaps.centers[:, :-1, 0] - PAST).sum(axis=1)


def westward(view: "View") -> Floats:
    """Rewarded true speed along the course, (n,) [m/s]; 0 beyond the finish."""
    finish = gaps_of(view).centers[:, -1, 0]
    speed = np.minimum(-view.velocity[:, 0], REWARDED_SPEED)
    return np.where(view.position[:, 0] > finish, speed, 0.0)

"""`View`: the arrays that methods of a task read; `fields.py` lists them in a table."""

from typing import TYPE_CHECKING, NoReturn

import numpy as np
from numpy.typing import NDArray

from quad_gym.records import SHOWN
from quad_gym.tasks.builtin import Builtin
from quad_gym.tasks.groups import Estimate, Measured, Observed, Truth
from quad_gym.tasks.lazy import Attribute, Group, Lazy, Shown
from quad_gym.tasks.state import State
from quad_gym.tasks.task import HiddenTruthError

if TYPE_CHECKING:
    from quad_gym.params.world import WorldParams
    from quad_gym.tasks.batch import TaskBatch

Floats = NDArray[np.float64]
Truths = NDArray[np.bool_]

_GATE_NEXT = SHOWN["gate_next"].start


class View(Group):
    """State of all flights at the end of a step, in the episode to which the step belongs.

    Arrays have one row per flight, are computed when first read, and are read-only.
    `quad_gym.tasks.fields.VIEW_FIELDS` lists them all with shapes, units and frames. They are
    grouped: `truth`, `estimate` (of the filter), `observed` (by the controller), `measured`, and
    `builtin` (built-in reward and endings). `view.position` is short for `view.truth.position`, and
    so for the other true states. `view.state` holds the task's own variables.
    """

    __slots__ = (
        *("_hidden", "_builtin", "_truth"),
        *("estimate", "measured", "observed", "state"),
    )

    estimate: Estimate
    observed: Observed
    measured: Measured
    state: State

    def __init__(self, flights: "TaskBatch", state: State) -> None:
        of_instant: list[Attribute] = []
        super().__init__(flights, of_instant)
        self._hidden = False
        self._truth, self._builtin = Truth(flights, of_instant, self), Builtin(flights, [])
        for name, group in (
            ("estimate", Estimate(flights, of_instant)),
            ("measured", Measured(flights, of_instant)),
            ("observed", Observed(flights, of_instant)),
            ("state", state),
        ):
            object.__setattr__(self, name, group)

    def step_over(self) -> None:
        """Drop all arrays after a step."""
        self.forget()
        self._builtin.step_over()

    def begin(self, chosen: Truths) -> None:
        """Drop arrays of the last episodes of flights that have begun new ones."""
        self.forget()
        self._builtin.begin(chosen)

    def hide(self, hidden: bool) -> None:
        """Hide the truth, as for `observe`, or show it again."""
        object.__setattr__(self, "_hidden", hidden)  # past the check against writing

    # ---- hidden from `observe`, unless the task is privileged ---------------------------------

    def _refuse(self, name: str) -> NoReturn:
        raise HiddenTruthError(
            f"observe cannot read the truth (view.{name}), which is not available to controllers: "
            "read view.observed or view.estimate, or set privileged = True in the task"
        )

    @property
    def truth(self) -> Truth:
        """True state; `observe` may read it only if the task is privileged."""
        if self._hidden:
            self._refuse("truth")
        return self._truth

    @property
    def builtin(self) -> Builtin:
        """Built-in reward and endings of the step, computed from the truth."""
        if self._hidden:
            self._refuse("builtin")
        return self._builtin

    @property
    def position(self) -> Floats:
        """True position, (n, 3) in I [m]."""
        if self._hidden:
            self._refuse("position")
        return self._truth.position

    @property
    def velocity(self) -> Floats:
        """True velocity, (n, 3) in I [m/s]."""
        if self._hidden:
            self._refuse("velocity")
        return self._truth.velocity

    @property
    def R_BI(self) -> Floats:
        """True attitude, (n, 3, 3), v_B = R_BI v_I."""
        if self._hidden:
            self._refuse("R_BI")
        return self._truth.R_BI

    @property
    def quaternion(self) -> Floats:
        """True attitude as a quaternion (w, x, y, z), (n, 4), B to I."""
        if self._hidden:
            self._refuse("quaternion")
        return self._truth.quaternion

    @property
    def body_rates(self) -> Floats:
        """True body rates, (n, 3) in B [rad/s]."""
        if self._hidden:
            self._refuse("body_rates")
        return self._truth.body_rates

    @property
    def rotor_speeds(self) -> Floats:
        """True rotor speeds, (n, 4) [rad/s]."""
        if self._hidden:
            self._refuse("rotor_speeds")
        return self._truth.rotor_speeds

    @property
    def accel_bias(self) -> Floats:
        """True accelerometer bias, (n, 3) in B [m/s^2]."""
        if self._hidden:
            self._refuse("accel_bias")
        return self._truth.accel_bias

    @property
    def gyro_bias(self) -> Floats:
        """True gyro bias, (n, 3) in B [rad/s]."""
        if self._hidden:
            self._refuse("gyro_bias")
        return self._truth.gyro_bias

    @property
    def position_error(self) -> Floats:
        """Distance of the true position from the reference, (n,) [m]."""
        if self._hidden:
            self._refuse("position_error")
        return self._truth.position_error

    @property
    def estimation_error(self) -> Floats:
        """Distance between observed and true position, (n,) [m]."""
        if self._hidden:
            self._refuse("estimation_error")
        return self._truth.estimation_error

    @property
    def obstacle_distance(self) -> Floats:
        """Distance of the true position from the nearest obstacle surface, (n,) [m]."""
        if self._hidden:
            self._refuse("obstacle_distance")
        return self._truth.obstacle_distance

    # ---- never hidden -------------------------------------------------------------------------

    @property
    def count(self) -> int:
        """Number of flights, n."""
        return self._flights.count  # type: ignore[no-any-return]

    @property
    def period(self) -> float:
        """Control period, the duration of a step [s]."""
        return self._flights.period  # type: ignore[no-any-return]

    time = Shown("time", "Time since the start of the episode, (n,) [s].")

    step = Shown("step", "Steps since the start of the episode, (n,).")

    @Lazy
    def is_first(self) -> Truths:
        """True where an episode has just begun and no step of it has been flown, (n,)."""
        return self._flights.began.copy()

    action = Shown("action", "Action of this step, (n, 4) in [-1, 1].")

    last_action = Shown("last_action", "Action of the step before, (n, 4) in [-1, 1].")

    reference_position = Shown(
        "r_ref", "Reference position, (n, 3) in I [m]; on a course, the next gate."
    )

    reference_velocity = Shown("v_ref", "Velocity of the reference, (n, 3) in I [m/s].")

    reference_acceleration = Shown("a_ref", "Acceleration of the reference, (n, 3) in I [m/s^2].")

    reference_heading = Shown(
        "x_ref", "Desired heading: horizontal unit vector for body x, (n, 3) in I."
    )

    preview = Shown(
        "preview",
        "Reference at two later times, (n, 2, 3) in I [m]; on a course, the two gates after the "
        "next.",
    )

    @Lazy
    def gates(self) -> Floats:
        """Gates of a course in order, (n, gates, 3) in I [m]; (n, 0, 3) in other tasks."""
        return self._flights.gates()

    @Lazy
    def gates_passed(self) -> NDArray[np.int64]:
        """Number of gates passed in this episode, (n,)."""
        return self._flights.shown[_GATE_NEXT].astype(np.int64)

    @Lazy
    def gate_passed(self) -> Truths:
        """True where this step passed a gate, (n,)."""
        return (self.gates_passed > self._flights.gates_before) & ~self._flights.began

    @Lazy
    def features(self) -> Floats:
        """Positions of the markers as mapped in the filter, (n, m, 3) in I [m]."""
        return self._flights.feature_places()

    @property
    def world(self) -> "WorldParams":
        """Nominal world, without parameters drawn for the episode."""
        return self._flights.world  # type: ignore[no-any-return]

    @Lazy
    def obstacles(self) -> Floats:
        """Centers of the obstacles in this episode, (n, o, 3) in I [m], in the order given."""
        return self._flights.obstacle_centers()

    @Lazy
    def observation(self) -> NDArray[np.float32]:
        """Built-in observation without its privileged part, (n, k)."""
        return self._flights.builtin_observation().copy()

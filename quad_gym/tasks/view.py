"""`View`: what the methods of a task read of all flights; `fields.py` has it as a table."""

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
    """All flights at the end of a step, in the episode that the step belongs to.

    Arrays have one row per flight, are made when they are first read, and cannot be written to.
    `quad_gym.tasks.fields.VIEW_FIELDS` lists them all with shapes, units and frames. They are in
    groups: `truth`, `estimate` (of the filter), `observed` (what the controller sees), `measured`,
    `builtin` (built-in reward and endings). `view.position` is short for `view.truth.position`,
    likewise the other states. `view.state` holds what the task keeps.
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
        """Forget all arrays, as a step has been flown."""
        self.forget()
        self._builtin.step_over()

    def begin(self, chosen: Truths) -> None:
        """Forget what belongs to the last episodes of flights that have begun others."""
        self.forget()
        self._builtin.begin(chosen)

    def hide(self, hidden: bool) -> None:
        """Whether the truth is hidden, as from `observe`."""
        object.__setattr__(self, "_hidden", hidden)  # without asking whether it may be set

    # ---- what may be hidden -------------------------------------------------------------------

    def _refuse(self, name: str) -> NoReturn:
        raise HiddenTruthError(
            f"observe cannot read the truth (view.{name}), which no controller knows: read "
            "view.observed or view.estimate, or set privileged = True in the task"
        )

    @property
    def truth(self) -> Truth:
        """The true state; `observe` reads it only if the task is privileged."""
        if self._hidden:
            self._refuse("truth")
        return self._truth

    @property
    def builtin(self) -> Builtin:
        """Built-in reward and endings of the step, which follow from the truth."""
        if self._hidden:
            self._refuse("builtin")
        return self._builtin

    @property
    def position(self) -> Floats:
        """(n, 3) true position in I [m]."""
        if self._hidden:
            self._refuse("position")
        return self._truth.position

    @property
    def velocity(self) -> Floats:
        """(n, 3) true velocity in I [m/s]."""
        if self._hidden:
            self._refuse("velocity")
        return self._truth.velocity

    @property
    def R_BI(self) -> Floats:
        """(n, 3, 3) true attitude, v_B = R_BI v_I."""
        if self._hidden:
            self._refuse("R_BI")
        return self._truth.R_BI

    @property
    def quaternion(self) -> Floats:
        """(n, 4) true attitude (w, x, y, z), B to I."""
        if self._hidden:
            self._refuse("quaternion")
        return self._truth.quaternion

    @property
    def body_rates(self) -> Floats:
        """(n, 3) true body rates [rad/s]."""
        if self._hidden:
            self._refuse("body_rates")
        return self._truth.body_rates

    @property
    def rotor_speeds(self) -> Floats:
        """(n, 4) true rotor speeds [rad/s]."""
        if self._hidden:
            self._refuse("rotor_speeds")
        return self._truth.rotor_speeds

    @property
    def accel_bias(self) -> Floats:
        """(n, 3) true bias of the accelerometer in B [m/s^2]."""
        if self._hidden:
            self._refuse("accel_bias")
        return self._truth.accel_bias

    @property
    def gyro_bias(self) -> Floats:
        """(n, 3) true bias of the gyro [rad/s]."""
        if self._hidden:
            self._refuse("gyro_bias")
        return self._truth.gyro_bias

    @property
    def position_error(self) -> Floats:
        """(n,) distance of the true position from the reference [m]."""
        if self._hidden:
            self._refuse("position_error")
        return self._truth.position_error

    @property
    def estimation_error(self) -> Floats:
        """(n,) distance of the seen from the true position [m]."""
        if self._hidden:
            self._refuse("estimation_error")
        return self._truth.estimation_error

    @property
    def obstacle_distance(self) -> Floats:
        """(n,) distance of the true position from the nearest obstacle's surface [m]."""
        if self._hidden:
            self._refuse("obstacle_distance")
        return self._truth.obstacle_distance

    # ---- what everybody knows -----------------------------------------------------------------

    @property
    def count(self) -> int:
        """How many flights there are, n."""
        return self._flights.count  # type: ignore[no-any-return]

    @property
    def period(self) -> float:
        """Of control, from step to step [s]."""
        return self._flights.period  # type: ignore[no-any-return]

    time = Shown("time", "(n,) since the start of the episode [s].")

    step = Shown("step", "(n,) steps since the start of the episode.")

    @Lazy
    def is_first(self) -> Truths:
        """(n,) whether the episode has just begun, and nothing was flown in it."""
        return self._flights.began.copy()

    action = Shown("action", "(n, 4) action of this step, in [-1, 1].")

    last_action = Shown("last_action", "(n, 4) the one before it.")

    reference_position = Shown(
        "r_ref", "(n, 3) where the vehicle should be, in I [m]; on a course, the next gate."
    )

    reference_velocity = Shown("v_ref", "(n, 3) of the reference in I [m/s].")

    reference_acceleration = Shown("a_ref", "(n, 3) of the reference in I [m/s^2].")

    reference_heading = Shown(
        "x_ref", "(n, 3) horizontal direction that body x is to point in, in I."
    )

    preview = Shown(
        "preview",
        "(n, 2, 3) the reference a little later in I [m]; on a course, the gates after the next.",
    )

    @Lazy
    def gates(self) -> Floats:
        """(n, gates, 3) of a course in I [m], in order; none elsewhere."""
        return self._flights.gates()

    @Lazy
    def gates_passed(self) -> NDArray[np.int64]:
        """(n,) in this episode."""
        return self._flights.shown[_GATE_NEXT].astype(np.int64)

    @Lazy
    def gate_passed(self) -> Truths:
        """(n,) whether this step passed a gate."""
        return (self.gates_passed > self._flights.gates_before) & ~self._flights.began

    @Lazy
    def features(self) -> Floats:
        """(n, m, 3) markers that the camera sees, in I [m], as the filter knows them."""
        return self._flights.feature_places()

    @property
    def world(self) -> "WorldParams":
        """The world, without draws and shifts."""
        return self._flights.world  # type: ignore[no-any-return]

    @Lazy
    def obstacles(self) -> Floats:
        """(n, k, 3) where the middles of the world's obstacles are in this episode, in I [m]."""
        return self._flights.obstacle_centers()

    @Lazy
    def observation(self) -> NDArray[np.float32]:
        """(n, k) the built-in observation, less its privileged part."""
        return self._flights.builtin_observation().copy()

"""`View`: the fields that methods of a task read, and a table of them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_gym.params.world import WorldParams
from quad_gym.records.state import State
from quad_gym.tasks.fields import Group, GroupField, field, quantity, shown
from quad_gym.tasks.groups import BuiltinView, EstimateView, MeasuredView, ObservedView, TruthView
from quad_gym.tasks.memory import ReadableBatch

Floats = NDArray[np.float64]
Truths = NDArray[np.bool_]


class HiddenTruthError(RuntimeError):
    """Error raised when `observe` of a task that is not privileged reads the true state."""


class Short(property):
    """Field of `view.truth` as an attribute of the view, unless the truth is hidden."""

    def __init__(self, name: str) -> None:
        def read(view: "View") -> Floats:
            view._require_open(name)
            return getattr(view._truth, name)

        super().__init__(read)


# fmt: off
class View(Group):
    """State of all flights at the end of a step, in the episode to which the step belongs.

    Arrays have one row per flight, are computed when first read, and are read-only. `VIEW_FIELDS`
    lists them with shapes, units and frames. They are grouped: `truth`, `estimate` (of the filter),
    `observed` (by the controller), `measured`, and `builtin` (built-in reward and endings).
    `view.position` is short for `view.truth.position`, and so for the other true states.
    `view.state` holds the task's own variables.
    """

    __slots__ = ("_builtin", "_hidden", "_truth", "estimate", "measured", "observed", "state")
    estimate: EstimateView
    observed: ObservedView
    measured: MeasuredView
    state: State

    def __init__(self, flights: ReadableBatch, state: State) -> None:
        super().__init__(flights)
        estimate = EstimateView(flights)
        self._truth, self._builtin, self._hidden = TruthView(flights, estimate), BuiltinView(flights), False
        object.__setattr__(self, "estimate", estimate)
        object.__setattr__(self, "observed", ObservedView(flights))
        object.__setattr__(self, "measured", MeasuredView(flights))
        object.__setattr__(self, "state", state)

    def forget(self) -> None:
        """Drop all values, after a step or when episodes have begun."""
        super().forget()
        for group in (self._truth, self._builtin, self.estimate, self.observed, self.measured):
            group.forget()

    def hide(self, hidden: bool) -> None:
        """Hide the truth, as for `observe`, or show it again."""
        self._hidden = hidden

    def _require_open(self, name: str) -> None:
        if self._hidden:
            raise HiddenTruthError(
                f"observe cannot read the truth (view.{name}), which is not available to "
                "controllers: read view.observed or view.estimate, or set privileged = True in "
                "the task"
            )

    @property
    def truth(self) -> TruthView:
        """True state; `observe` may read it only if the task is privileged."""
        self._require_open("truth")
        return self._truth

    @property
    def builtin(self) -> BuiltinView:
        """Built-in reward and endings of the step; `observe` may read them as it may the truth."""
        self._require_open("builtin")
        return self._builtin

    position, velocity, R_BI = Short("position"), Short("velocity"), Short("R_BI")
    quaternion, body_rates = Short("quaternion"), Short("body_rates")
    rotor_speeds, accel_bias = Short("rotor_speeds"), Short("accel_bias")
    gyro_bias, position_error = Short("gyro_bias"), Short("position_error")
    estimation_error, obstacle_distance = Short("estimation_error"), Short("obstacle_distance")

    # ---- never hidden -------------------------------------------------------------------------

    @field("", "-", "-", "number of flights, n")
    def count(self) -> int:
        return self._flights.count

    @field("", "s", "-", "control period, the duration of a step")
    def period(self) -> float:
        return self._flights.period

    time, step = quantity("time"), quantity("step")

    @field("(n,) bool", "-", "-", "True where an episode has just begun and no step of it has been flown")
    def is_first(self) -> Truths:
        return self._flights.began.copy()

    action = quantity("action")
    last_action = quantity("last_action")
    reference_position = quantity("reference_position", "r_ref")
    reference_velocity = quantity("reference_velocity", "v_ref")
    reference_acceleration = quantity("reference_acceleration", "a_ref")
    reference_heading = quantity("reference_heading", "x_ref")
    preview = shown("preview", "(n, 2, 3)", "m", "I", "reference after each of the two times `preview`; on a course, the two gates after the next")

    gates, gates_passed = quantity("gates"), quantity("gates_passed")

    @field("(n,) bool", "-", "-", "True where this step passed a gate")
    def gate_passed(self) -> Truths:
        return self._flights.gate_passed()

    features = quantity("features")

    @field("", "-", "-", "nominal `WorldParams`, without parameters drawn for the episode")
    def world(self) -> WorldParams:
        return self._flights.world

    obstacles = quantity("obstacles")

    @field("(n, k)", "mixed", "mixed", "built-in observation without its privileged part")
    def observation(self) -> NDArray[np.float32]:
        return self._flights.builtin_observation()
# fmt: on


class ViewField(NamedTuple):
    """Description of one field of a view."""

    name: str  #: name with its group, such as "truth.position"
    shape: str
    unit: str
    frame: str
    meaning: str


GROUPS: dict[str, type[Group]] = {
    "": View,
    "truth.": TruthView,
    "estimate.": EstimateView,
    "observed.": ObservedView,
    "measured.": MeasuredView,
    "builtin.": BuiltinView,
}
"""Groups of a view by their prefixes."""


_SHORT = {
    f"truth.{n}": f"; short: `view.{n}`" for n, v in vars(View).items() if isinstance(v, Short)
}
VIEW_FIELDS = tuple(
    ViewField(name, v.shape, v.unit, v.frame, v.meaning + _SHORT.get(name, ""))
    for prefix, group in GROUPS.items()
    for name, v in ((prefix + n, v) for n, v in vars(group).items())
    if isinstance(v, GroupField)
)
"""All fields of a view; for `quad_gym.tasks.fields.GroupField`, see the meaning of shapes and frames."""

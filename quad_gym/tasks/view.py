"""The view of the flights that a task receives: its groups, fields, and readable memory."""

from collections.abc import Callable
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from quad_gym.analysis.metrics import nees, state_error
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.batch.memory import Calls, State
from quad_gym.batch.quantities import QUANTITIES
from quad_gym.batch.starts import hidden_points, nearest_obstacle
from quad_gym.configuration import FlightConfiguration
from quad_gym.params.sensor_table import READINGS
from quad_gym.params.world import WorldParams
from quad_gym.records import (
    SHOWN,
    SHOWN_SHAPES,
    SHOWN_SIZE,
    Command,
    Result,
    covariance_block_of,
    covariance_of,
    in_double,
    variances_of,
)

# --------------------------------------------------------------------------------------------------
# `ReadableBatch`: flights whose state the views of a task can read.
# --------------------------------------------------------------------------------------------------

Floats = NDArray[np.float64]
Truths = NDArray[np.bool_]

_GAP = 8  #: padding between two rows of the memory: a cache line
_JUDGED = slice(int(Result.REWARD), int(Result.ENDING) + 1)


class ReadableBatch(FlightBatch):
    """`FlightBatch` with quantities that only views of a task need; methods return new arrays."""

    def __init__(self, c: FlightConfiguration, split: int) -> None:
        super().__init__(c)  # type: ignore[arg-type]
        self._split = split
        self._settings["shown"] = True
        self._choose_stages()
        # rows at distances of a power of two would compete for a few cache lines
        self._shown = np.zeros((SHOWN_SIZE, len(self._actions) + _GAP))
        self.period = 1.0 / self.clocks.control_rate
        self.reward_scale = self.period if self.task.reward_per == "second" else 1.0
        self.began: Truths = np.zeros(self.count, bool)
        self.judged = np.zeros((_JUDGED.stop, self.count))
        self.remember()

    began: Truths
    """True for flights that have begun an episode since the last step, (n,)."""
    judged: Floats
    """Reward, terminated, truncated and ending of the built-in task in the last step, (4, n)."""
    error_before: Floats
    """Distance from the reference before the step, (n,) [m]."""
    gates_before: Floats
    """Number of gates passed before the step, (n,)."""

    def remember(self) -> None:
        """Store the quantities that the next step is compared with."""
        self.error_before, self.gates_before = self.rows("position_error"), self.rows("gate_next")

    def gate_passed(self) -> Truths:
        """True for flights that have passed a gate in the last step, (n,)."""
        return (self.rows("gate_next") > self.gates_before) & ~self.began

    def step(self, actions: NDArray[Any] | None = None) -> NDArray[np.float32]:
        """Fly one control period; see `FlightBatch.step`."""
        self.remember()
        observations = super().step(actions)
        self.judged = self._results[_JUDGED, : self.count].copy()
        return observations

    def restore(self, snapshot: NDArray[Any]) -> None:
        """Restore all flights from a snapshot."""
        super().restore(snapshot)
        flights, exchange = self._blocks.copy(), self._exchange.copy()
        self._resets[:] = 0
        self._run(Command.RESET)  # resets no flight, but computes `shown` and the observations
        # padding lanes of the last block have begun again
        self._blocks[:], self._exchange[:] = flights, exchange
        self.remember()  # the step before is unknown: no progress, no gate passed

    def _calls_of_threads(self) -> Calls:
        calls = super()._calls_of_threads()
        calls.show_into(self._shown)
        return calls

    def shown(self, name: str) -> Floats:
        """Read a field of `quad_gym.records.SHOWN`, (n, ...)."""
        values, shape = self._shown[SHOWN[name], : self.count], SHOWN_SHAPES[name]
        if len(shape) == 1:
            return values.copy().T
        # memory layout of a single flight, so that products have the same bits in any batch
        return np.ascontiguousarray(values.T).reshape(-1, *shape)

    def rows(self, name: str, kind: type[np.generic] = np.float64) -> NDArray[Any]:
        """Read a field of the flights' records, (n, ...), as numbers of a kind."""
        values = self.record(name)
        values = values > 0.0 if kind is np.bool_ else values.astype(kind, copy=False)
        return np.asfortranarray(values) if values.ndim == 2 else values  # faster by columns

    def builtin_observation(self) -> NDArray[np.float32]:
        """Read the built-in observation without its privileged part, (n, k)."""
        return self._observations[:, : self._split].copy()

    def nominal(self) -> dict[str, Any]:
        """Parameters of the nominal camera, and the rotation from G to I, by name."""
        names = ("camera", "R_CB", "focal_length", "half_image", "R_IG")
        return {name: in_double(self._world[name][0, ..., 0]) for name in names}

    def finite(self, flights: NDArray[np.intp]) -> Truths:
        """True where the true state of some flights is finite."""
        state = np.hstack([self.record(name, flights) for name in ("r", "v", "q", "w")])
        return np.isfinite(state).all(axis=1)


# --------------------------------------------------------------------------------------------------
# Fields of a view: descriptors that compute an array when it is first read.
# --------------------------------------------------------------------------------------------------

T = TypeVar("T")


class GroupField(Generic[T]):
    """Read-only value of a `Group`, computed from it by `read` and stored until the next step.

    Shapes: n: flights, m: features of the camera, o: obstacles, k: values of an observation.
    Frames: I: inertial (east, north, up), B: body, C: image; "-": none.
    """

    def __init__(
        self, read: Callable[[Any], T], shape: str, unit: str, frame: str, meaning: str
    ) -> None:
        self._read, self.__doc__ = read, meaning
        self.shape, self.unit, self.frame, self.meaning = shape, unit, frame, meaning

    def __set_name__(self, owner: type, name: str) -> None:
        """Store the name of the attribute."""
        self._name = name

    @overload
    def __get__(self, group: None, owner: type) -> "GroupField[T]": ...

    @overload
    def __get__(self, group: "Group", owner: type) -> T: ...

    def __get__(self, group: "Group | None", owner: type) -> Any:
        """Compute the value and store it as an ordinary attribute of the group."""
        if group is None:
            return self
        group._require()
        return vars(group).setdefault(self._name, frozen(self._read(group)))


def field(
    shape: str, unit: str, frame: str, meaning: str
) -> Callable[[Callable[[Any], T]], GroupField[T]]:
    """Make a field of the method that computes it."""
    return lambda read: GroupField(read, shape, unit, frame, meaning)


_LETTERS = {"features": "m", "obstacles": "o"}


def quantity(name: str, shown: str | None = None) -> GroupField[NDArray[Any]]:
    """Make a field of one of QUANTITIES, from the field `shown` of SHOWN or from the records."""
    q = QUANTITIES[name]
    kind: type[np.generic] = {bool: np.bool_, int: np.int64}.get(q.kind, np.float64)

    def read(group: Group) -> NDArray[Any]:
        if shown is not None:
            return group._flights.shown(shown)
        of = q.of
        return group._flights.rows(of, kind) if isinstance(of, str) else group._flights.read(name)

    sizes = "".join(f" {_LETTERS.get(str(size), size)}," for size in q.shape)
    shape = f"(n,{sizes})".replace(",)", ")") if sizes else "(n,)"
    kinds = "" if q.kind is float else f" {q.kind.__name__}"
    return GroupField(read, shape + kinds, q.unit, q.frame, q.meaning)


def record(name: str, shape: str, unit: str, frame: str, meaning: str) -> GroupField[NDArray[Any]]:
    """Make a field of the flights' records that is not among QUANTITIES."""
    return GroupField(lambda group: group._flights.rows(name), shape, unit, frame, meaning)


def shown(name: str, shape: str, unit: str, frame: str, meaning: str) -> GroupField[Floats]:
    """Make a field of `quad_gym.records.SHOWN` that is not among QUANTITIES."""
    return GroupField(lambda group: group._flights.shown(name), shape, unit, frame, meaning)


def frozen(value: Any) -> Any:
    """Make an array, or the arrays of a dictionary, read-only."""
    if isinstance(value, np.ndarray):
        value.flags.writeable = False
    elif isinstance(value, dict):
        return MappingProxyType({name: frozen(part) for name, part in value.items()})
    return value


class Group:
    """Group of fields of a view."""

    __slots__ = ("__dict__", "_flights")

    def __init__(self, flights: ReadableBatch) -> None:
        self._flights = flights

    def _require(self) -> None:
        """Raise a ValueError if the configuration lacks the fields of this group."""

    def forget(self) -> None:
        """Drop the stored values."""
        vars(self).clear()

    def __setattr__(self, name: str, value: Any) -> None:
        if name[0] != "_":
            raise AttributeError(f"view.{name} is read-only; store your own data in view.state")
        super().__setattr__(name, value)

    def __delattr__(self, name: str) -> None:
        raise AttributeError(f"view.{name} cannot be deleted")


# --------------------------------------------------------------------------------------------------
# Groups of a view: estimate, truth, observed state, measurements, built-in reward and endings.
# --------------------------------------------------------------------------------------------------


# fmt: off
def _block(first: int, unit: str, frame: str, of: str) -> tuple[GroupField[Floats], GroupField[Floats]]:
    """Fields of a block of the covariance and the square roots of its diagonal."""
    squared = f"({unit})^2" if "/" in unit else f"{unit}^2"

    @field("(n, 3, 3)", squared, frame, f"covariance of the {of}")
    def covariance(self: "EstimateView") -> Floats:
        return covariance_block_of(self._flights.rows("P"), self._flights.rows("arc"), first)

    @field("(n, 3)", unit, frame, f"standard deviations of the {of}")
    def sigma(self: "EstimateView") -> Floats:
        return self.sigma[:, first : first + 3]

    return covariance, sigma


class MissingFilterError(ValueError):
    """Error raised if a task reads the filter or its sensors where they do not run."""


class EstimateView(Group):
    """Estimate of the filter and its covariance."""

    def _require(self) -> None:
        if not self._flights.run_filter:
            raise MissingFilterError(
                'view.estimate needs a filter: observation="estimate" or "measurements", or '
                "run_filter=True, include_std=True or innovations=True"
            )

    position = quantity("estimated_position")
    velocity = quantity("estimated_velocity")
    R_BI = quantity("estimated_R_BI")
    quaternion, body_rates = quantity("estimated_quaternion"), quantity("estimated_body_rates")
    accel_bias = quantity("estimated_accel_bias")
    gyro_bias = quantity("estimated_gyro_bias")

    @field("(n, 15, 15)", "mixed", "mixed", "covariance of position and velocity in I, attitude, accelerometer and gyro bias in B")
    def covariance(self) -> Floats:
        return covariance_of(self._flights.rows("P"), self._flights.rows("arc"))

    factor = record("L", "(n, 15, 15)", "mixed", "mixed", "lower Cholesky factor of the covariance, without the second order of a heading's error")

    @field("(n, 15)", "mixed", "mixed", "standard deviations, square roots of the diagonal of the covariance")
    def sigma(self) -> Floats:
        return np.sqrt(variances_of(self._flights.rows("P"), self._flights.rows("arc")))

    position_covariance, position_sigma = _block(0, "m", "I", "position")
    velocity_covariance, velocity_sigma = _block(3, "m/s", "I", "velocity")
    attitude_covariance, attitude_sigma = _block(6, "rad", "B", "attitude")
    accel_bias_covariance, accel_bias_sigma = _block(9, "m/s^2", "B", "accelerometer bias")
    gyro_bias_covariance, gyro_bias_sigma = _block(12, "rad/s", "B", "gyro bias")
    status = quantity("filter_status")
    diverged = quantity("filter_diverged")
    nis = quantity("nis")
    nis_dimension = quantity("nis_dimension")


class TruthView(Group):
    """True state."""

    __slots__ = ("_estimate",)

    def __init__(self, flights: ReadableBatch, estimate: EstimateView) -> None:
        super().__init__(flights)
        self._estimate = estimate

    position = quantity("position")
    velocity = quantity("velocity")
    R_BI = quantity("R_BI", "R_BI")

    @field("(n, 3)", "-", "I", "body x axis, the first row of R_BI")
    def forward(self) -> Floats:
        return np.asfortranarray(self.R_BI[:, 0])

    @field("(n, 3)", "-", "B", "vertical, the last column of R_BI; its z component is the cosine of the tilt")
    def up(self) -> Floats:
        return np.asfortranarray(self.R_BI[:, :, 2])

    quaternion = quantity("quaternion")
    body_rates = quantity("body_rates")
    rotor_speeds = quantity("rotor_speeds")
    accel_bias = quantity("accel_bias")
    gyro_bias = quantity("gyro_bias")
    wind = quantity("wind")
    position_error = quantity("position_error")
    estimation_error = quantity("estimation_error")

    @field("(n,)", "m/s", "-", "speed toward the reference; on a course, toward the gate that was next")
    def progress(self) -> Floats:
        flights, distance = self._flights, self.position_error
        gates = flights.read("gates")
        if gates.shape[1]:
            last = np.maximum(flights.rows("gate_next", np.int64) - 1, 0)
            target = gates[np.arange(flights.count), last]
            of_gate = np.linalg.norm(target - self.position, axis=1)
            distance = np.where(flights.gate_passed(), of_gate, distance)
        return np.where(flights.began, 0.0, (flights.error_before - distance) / flights.period)

    @field("(n,)", "-", "-", "normalized estimation error squared; 15 on average if the filter is consistent")
    def nees(self) -> Floats:
        names = ("position", "velocity", "R_BI", "accel_bias", "gyro_bias")
        error = state_error(
            {name: getattr(self, name) for name in names},
            {name: getattr(self._estimate, name) for name in names},
            rotation_vector=self._flights.sensors.flow_alone,
        )
        return nees(error, self._estimate.covariance)

    @field("(n, m) bool", "-", "-", "True for markers in the field of view of the nominal camera that no obstacle hides")
    def features_in_view(self) -> Truths:
        p, features = self._flights.nominal(), self._flights.feature_places()
        R_BI, r = self.R_BI[:, np.newaxis], self.position[:, np.newaxis]
        X_B = (R_BI @ (features - r)[..., np.newaxis])[..., 0] - p["camera"]
        X_C = (p["R_CB"] @ X_B[..., np.newaxis])[..., 0]
        in_front = X_C[..., 2] > 1e-9
        per_depth = p["focal_length"] / np.where(in_front, X_C[..., 2], 1.0)
        pixels = X_C[..., :2] * per_depth[..., None]
        seen = in_front & (np.abs(pixels) <= p["half_image"]).all(axis=-1)
        obstacles, centers = self._flights.world.obstacles, self._flights.read("obstacles")
        if obstacles:
            eyes = self.position + (p["camera"] @ self.R_BI)
            seen &= ~hidden_points(obstacles, centers, eyes, features)
        return seen

    obstacle_distance = quantity("obstacle_distance")
    obstacle_vector = record("obstacle_vector", "(n, 3)", "m", "I", "vector from the vehicle to the nearest point of an obstacle surface")
    on_ground = quantity("on_ground")

    @field("dict of (n,) bool", "-", "-", "active faults, by name")
    def faults(self) -> Any:
        return self._flights.active_faults()

    @field("dict of (n, ...)", "mixed", "mixed", "parameters drawn for the episode, by name, see `randomization`")
    def drawn(self) -> Any:
        return self._flights.drawn()


class ObservedView(Group):
    """State observed by the controller: the estimate, the truth, or the truth with noise."""

    position = quantity("observed_position")
    velocity = quantity("observed_velocity")
    R_BI = quantity("observed_R_BI")
    body_rates = quantity("observed_body_rates", "w_seen")
    position_error = shown("position_gap", "(n, 3)", "m", "B", "reference position minus observed position")
    velocity_error = shown("velocity_gap", "(n, 3)", "m/s", "B", "reference velocity minus observed velocity")
    up = shown("up", "(n, 3)", "-", "B", "vertical")
    heading = shown("heading", "(n, 3)", "-", "B", "desired heading: horizontal unit vector for body x")
    reference_acceleration = shown("acceleration", "(n, 3)", "m/s^2", "B", "acceleration of the reference")
    preview = shown("ahead", "(n, 2, 3)", "m", "B", "`view.preview` minus the present reference position")

    @field("(n,)", "m", "-", "distance of the observed position from the nearest obstacle surface, negative inside, infinite without obstacles")
    def obstacle_distance(self) -> Floats:
        return self._nearest_obstacle()[0]

    @field("(n, 3)", "m", "B", "vector from the observed position to the nearest point of an obstacle surface")
    def obstacle_vector(self) -> Floats:
        vector = self._nearest_obstacle()[1][:, :, np.newaxis]
        return np.ascontiguousarray((self.R_BI @ vector)[:, :, 0])

    def _nearest_obstacle(self) -> tuple[Floats, Floats]:
        """Distance from the nearest obstacle and the vector to it in I."""
        flights = self._flights
        return nearest_obstacle(flights.world.obstacles, flights.read("obstacles"), self.position)


class MeasuredView(Group):
    """Last measurement of each kind in the step; NaN if there was none."""

    def _require(self) -> None:
        if not self._flights.run_filter:
            raise MissingFilterError(
                'view.measured needs simulated sensors: observation="estimate" or "measurements", '
                "or run_filter=True, include_std=True or innovations=True"
            )

    gyro, accel = quantity("gyro"), quantity("accel")
    vars().update({reading: quantity(reading) for reading in READINGS})

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Floats: ...


class BuiltinView(Group):
    """Reward and endings of the built-in task; zero where an episode has begun since."""

    @field("(n,)", "-", "-", "reward of the built-in task, per step")
    def reward(self) -> Floats:
        return self._flights.judged[0] / self._flights.reward_scale

    @field("(n,) bool", "-", "-", "True where the built-in task terminates the episode")
    def terminated(self) -> Truths:
        return self._flights.judged[1] > 0.0

    @field("(n,) bool", "-", "-", "True at the time limit, after a failure of the filter, or after divergence with `truncate_when_diverged`; may be True together with `terminated`")
    def truncated(self) -> Truths:
        return self._flights.judged[2] > 0.0

    @field("(n,) int", "-", "-", "reason of the ending, see `quad_gym.records.Ending`")
    def ending(self) -> NDArray[np.int64]:
        return self._flights.judged[3].astype(np.int64)
# fmt: on


# --------------------------------------------------------------------------------------------------
# `View`: the fields that methods of a task read, and a table of them.
# --------------------------------------------------------------------------------------------------


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
"""All fields of a view; for `quad_gym.tasks.view.GroupField`, see the meaning of shapes and frames."""

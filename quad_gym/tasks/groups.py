"""Groups of a view: estimate, truth, observed state, measurements, built-in reward and endings."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.analysis.metrics import nees, state_error
from quad_gym.batch.surroundings import hidden_points, nearest_obstacle
from quad_gym.records import covariance_of
from quad_gym.tasks.fields import Group, GroupField, field, quantity, record, shown
from quad_gym.tasks.memory import ReadableBatch

Floats = NDArray[np.float64]
Truths = NDArray[np.bool_]


# fmt: off
def _block(first: int, unit: str, frame: str, of: str) -> tuple[GroupField[Floats], GroupField[Floats]]:
    """Fields of a block of the covariance and the square roots of its diagonal."""
    squared = f"({unit})^2" if "/" in unit else f"{unit}^2"

    @field("(n, 3, 3)", squared, frame, f"covariance of the {of}")
    def covariance(self: "EstimateView") -> Floats:
        rows = np.ascontiguousarray(self.factor[:, first : first + 3, : first + 3])
        P = rows @ rows.transpose(0, 2, 1)
        if first < 6:
            arc = self._flights.rows("arc")[:, first : first + 3]
            P += arc[:, :, np.newaxis] * arc[:, np.newaxis]
        return P

    @field("(n, 3)", unit, frame, f"standard deviations of the {of}")
    def sigma(self: "EstimateView") -> Floats:
        return self.sigma[:, first : first + 3]

    return covariance, sigma


class EstimateView(Group):
    """Estimate of the filter and its covariance."""

    def _require(self) -> None:
        if not self._flights.run_filter:
            raise ValueError(
                'view.estimate needs a filter: observation="estimate" or "measurements", or '
                "include_std=True or innovations=True"
            )

    position = quantity("estimated_position")
    velocity = quantity("estimated_velocity")
    R_BI = quantity("estimated_R_BI")
    quaternion, body_rates = quantity("estimated_quaternion"), quantity("estimated_body_rates")
    accel_bias = quantity("estimated_accel_bias")
    gyro_bias = quantity("estimated_gyro_bias")

    @field("(n, 15, 15)", "mixed", "mixed", "covariance of position and velocity in I, attitude, accelerometer and gyro bias in B")
    def covariance(self) -> Floats:
        return covariance_of(self.factor, self._flights.rows("arc"))

    factor = record("L", "(n, 15, 15)", "mixed", "mixed", "lower Cholesky factor of the covariance, without the second order of a heading's error")

    @field("(n, 15)", "mixed", "mixed", "standard deviations, square roots of the diagonal of the covariance")
    def sigma(self) -> Floats:
        variances = (self.factor * self.factor).sum(axis=2)
        variances[:, :6] += self._flights.rows("arc") ** 2
        return np.sqrt(variances)

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
            raise ValueError(
                'view.measured needs simulated sensors: observation="estimate" or "measurements", '
                "or include_std=True or innovations=True"
            )

    gyro, accel = quantity("gyro"), quantity("accel")
    gnss_position, gnss_baseline = quantity("gnss_position"), quantity("gnss_baseline")
    gnss_velocity, pixels = quantity("gnss_velocity"), quantity("pixels")


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

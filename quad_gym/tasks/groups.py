"""Groups of a view: truth, estimate, observed state, measurements."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.analysis.metrics import nees, state_error
from quad_gym.batch.surroundings import hidden_points, nearest_obstacle
from quad_gym.records import BASELINE_BLOCK, FEATURE_SLICE, POSITION_BLOCK
from quad_gym.rotations import dcm_to_quaternion
from quad_gym.tasks.lazy import Attribute, Group, Lazy, Shown

if TYPE_CHECKING:
    from quad_gym.tasks.view import View

Floats = NDArray[np.float64]
Truths = NDArray[np.bool_]


class Truth(Group):
    """True state."""

    __slots__ = ("_view",)

    def __init__(self, flights: Any, kept: list[Attribute], view: "View") -> None:
        super().__init__(flights, kept)
        self._view = view

    position = Shown("r", "Position of the center of mass, (n, 3) in I [m].")

    velocity = Shown("v", "Velocity of the center of mass, (n, 3) in I [m/s].")

    quaternion = Shown("q", "Attitude as a quaternion (w, x, y, z), (n, 4), B to I.")

    R_BI = Shown("R_BI", "Attitude, (n, 3, 3), v_B = R_BI v_I.")

    forward = Shown("R_BI", "Body x axis, (n, 3) in I, the first row of `R_BI`.", slice(0, 3))

    up = Shown("R_BI", "Vertical, (n, 3) in B, the last column of `R_BI`.", slice(2, None, 3))

    body_rates = Shown("w", "Body rates, (n, 3) in B [rad/s].")

    @Lazy
    def rotor_speeds(self) -> Floats:
        """Rotor speeds, (n, 4) [rad/s]."""
        return self._flights.rows("rotor_speeds")

    @Lazy
    def accel_bias(self) -> Floats:
        """Accelerometer bias, (n, 3) in B [m/s^2]."""
        return self._flights.rows("b_a")

    @Lazy
    def gyro_bias(self) -> Floats:
        """Gyro bias, (n, 3) in B [rad/s]."""
        return self._flights.rows("b_g")

    @Lazy
    def wind(self) -> Floats:
        """Wind velocity, (n, 3) in I [m/s]."""
        return self._flights.rows("wind")

    position_error = Shown("position_error", "Distance from the reference position, (n,) [m].")

    @Lazy
    def estimation_error(self) -> Floats:
        """Distance between observed and true position, (n,) [m]."""
        return self._flights.columns("estimation_error")

    @Lazy
    def progress(self) -> Floats:
        """Speed toward the reference; on a course, toward the gate that was next, (n,) [m/s]."""
        view, distance = self._view, self.position_error
        if view.gates.shape[1]:
            every = np.arange(view.count)
            target = view.gates[every, np.maximum(view.gates_passed - 1, 0)]
            of_gate = np.linalg.norm(target - self.position, axis=1)
            distance = np.where(view.gate_passed, of_gate, distance)
        speed = (self._flights.error_before - distance) / view.period
        return np.where(view.is_first, 0.0, speed)

    @Lazy
    def nees(self) -> Floats:
        """Normalized estimation error squared, (n,)."""
        names = ("position", "velocity", "R_BI", "accel_bias", "gyro_bias")
        estimate = self._view.estimate
        error = state_error(
            {name: getattr(self, name) for name in names},
            {name: getattr(estimate, name) for name in names},
        )
        return nees(error, estimate.covariance)

    @Lazy
    def features_in_view(self) -> Truths:
        """True for markers in the nominal camera's field of view that no obstacle hides, (n, m)."""
        p = self._flights.nominal()
        R_BI, r = self.R_BI[:, np.newaxis], self.position[:, np.newaxis]
        X_B = (R_BI @ (self._view.features - r)[..., np.newaxis])[..., 0] - p["camera"]
        X_C = (p["R_CB"] @ X_B[..., np.newaxis])[..., 0]
        in_front = X_C[..., 2] > 1e-9
        per_depth = p["focal_length"] / np.where(in_front, X_C[..., 2], 1.0)
        pixels = X_C[..., :2] * per_depth[..., None]
        seen = in_front & (np.abs(pixels) <= p["half_image"]).all(axis=-1)
        obstacles = self._flights.world.obstacles
        if obstacles:
            eyes = self.position + (p["camera"] @ self.R_BI)
            seen &= ~hidden_points(obstacles, self._view.obstacles, eyes, self._view.features)
        return seen

    @Lazy
    def obstacle_distance(self) -> Floats:
        """Distance from the nearest obstacle surface, (n,) [m].

        Negative inside an obstacle, infinite without obstacles.
        """
        if not self._flights.world.obstacles:
            return np.full(self._view.count, np.inf)
        return self._flights.columns("obstacle_distance")

    @Lazy
    def obstacle_vector(self) -> Floats:
        """Vector from the vehicle to the nearest point of an obstacle surface, (n, 3) in I [m]."""
        return self._flights.rows("obstacle_vector")

    @Lazy
    def on_ground(self) -> Truths:
        """True where the ground supports a foot, (n,); False in worlds without ground contact."""
        return np.asarray(self._flights.columns("footing") > 0.0)

    @Lazy
    def faults(self) -> Any:
        """Active faults: (n,) bool by name."""
        return self._flights.active_faults()

    @Lazy
    def drawn(self) -> Any:
        """Parameters drawn for the episode: (n, ...) by name."""
        return self._flights.drawn()


def _covariance(name: str, first: int) -> tuple[Lazy[Floats], Lazy[Floats]]:
    """Make attributes for a block of the covariance and the square roots of its diagonal."""

    def block(self: "Estimate") -> Floats:
        rows = np.ascontiguousarray(self.factor[:, first : first + 3, : first + 3])
        return rows @ rows.transpose(0, 2, 1)

    def sigma(self: "Estimate") -> Floats:
        return self.sigma[:, first : first + 3]

    block.__doc__ = f"Covariance of {name}, (n, 3, 3)."
    sigma.__doc__ = f"Standard deviations of {name}, (n, 3)."
    return Lazy(block), Lazy(sigma)


class Estimate(Group):
    """Estimate of the filter and its covariance."""

    def _need_filter(self) -> None:
        if not self._flights.run_filter:
            raise ValueError(
                'view.estimate needs a filter: observation="estimate" or "measurements", or '
                "include_std=True or innovations=True"
            )

    def _rows(self, name: str) -> Floats:
        self._need_filter()
        return self._flights.rows(name)  # type: ignore[no-any-return]

    @Lazy
    def position(self) -> Floats:
        """Estimated position, (n, 3) in I [m]."""
        return self._rows("r_hat")

    @Lazy
    def velocity(self) -> Floats:
        """Estimated velocity, (n, 3) in I [m/s]."""
        return self._rows("v_hat")

    @Lazy
    def R_BI(self) -> Floats:
        """Estimated attitude, (n, 3, 3), v_B = R_BI v_I."""
        return self._rows("R_hat")

    @Lazy
    def quaternion(self) -> Floats:
        """Estimated attitude as a quaternion (w, x, y, z), (n, 4), B to I."""
        return dcm_to_quaternion(self.R_BI)

    @Lazy
    def body_rates(self) -> Floats:
        """Body rates: gyro measurement minus estimated bias, (n, 3) in B [rad/s]."""
        return self._rows("w_meas") - self.gyro_bias

    @Lazy
    def accel_bias(self) -> Floats:
        """Estimated accelerometer bias, (n, 3) in B [m/s^2]."""
        return self._rows("b_a_hat")

    @Lazy
    def gyro_bias(self) -> Floats:
        """Estimated gyro bias, (n, 3) in B [rad/s]."""
        return self._rows("b_g_hat")

    @Lazy
    def factor(self) -> Floats:
        """Lower Cholesky factor of the covariance, (n, 15, 15)."""
        return self._rows("L")

    @Lazy
    def covariance(self) -> Floats:
        """Covariance of position, velocity, attitude, accelerometer and gyro bias, (n, 15, 15)."""
        L = self.factor
        return L @ L.transpose(0, 2, 1)

    @Lazy
    def sigma(self) -> Floats:
        """Standard deviations, square roots of the diagonal of the covariance, (n, 15)."""
        L = self.factor
        return np.sqrt((L * L).sum(axis=2))

    position_covariance, position_sigma = _covariance("position in I [m]", 0)
    velocity_covariance, velocity_sigma = _covariance("velocity in I [m/s]", 3)
    attitude_covariance, attitude_sigma = _covariance("attitude [rad]", 6)
    accel_bias_covariance, accel_bias_sigma = _covariance("accelerometer bias [m/s^2]", 9)
    gyro_bias_covariance, gyro_bias_sigma = _covariance("gyro bias [rad/s]", 12)

    _status = Shown("filter_status", "Numerical failures so far, (n,).")

    @property
    def status(self) -> NDArray[np.int64]:
        """Numerical failures so far, (n,), see `FilterStatus`; 0: none."""
        self._need_filter()
        return self._status

    @Lazy
    def diverged(self) -> Truths:
        """True where the filter flags itself as diverged, (n,)."""
        self._need_filter()
        return self._flights.columns("diverged") > 0.0

    @Lazy
    def nis(self) -> Floats:
        """Normalized innovation squared of the last update, (n,)."""
        self._need_filter()
        return self._flights.columns("nis")

    @Lazy
    def nis_dimension(self) -> NDArray[np.int64]:
        """Number of scalar measurements in the last update, (n,)."""
        self._need_filter()
        return self._flights.counts("nis_dimension")  # type: ignore[no-any-return]


class Observed(Group):
    """State observed by the controller: the estimate, the truth, or the truth with noise."""

    position = Shown("r_seen", "Observed position, (n, 3) in I [m].")

    velocity = Shown("v_seen", "Observed velocity, (n, 3) in I [m/s].")

    R_BI = Shown("R_seen", "Observed attitude, (n, 3, 3), v_B = R_BI v_I.")

    body_rates = Shown("w_seen", "Observed body rates, (n, 3) in B [rad/s].")
    position_error = Shown(
        "position_gap", "Reference position minus observed position, (n, 3) in B [m]."
    )
    velocity_error = Shown(
        "velocity_gap", "Reference velocity minus observed velocity, (n, 3) in B [m/s]."
    )
    up = Shown("up", "Vertical, (n, 3) in B.")
    heading = Shown("heading", "Desired heading: unit vector for body x, (n, 3) in B.")
    reference_acceleration = Shown(
        "acceleration", "Acceleration of the reference, (n, 3) in B [m/s^2]."
    )
    preview = Shown(
        "ahead", "Reference at two later times minus the present one, (n, 2, 3) in B [m]."
    )

    @Lazy
    def _obstacle(self) -> Any:
        """Distance from the nearest obstacle and the vector to it in I, by name."""
        distance, vector = nearest_obstacle(
            self._flights.world.obstacles, self._flights.obstacle_centers(), self.position
        )
        return {"distance": distance, "vector": vector}

    @Lazy
    def obstacle_distance(self) -> Floats:
        """Distance of the observed position from the nearest obstacle surface, (n,) [m].

        Negative inside an obstacle, infinite without obstacles.
        """
        return self._obstacle["distance"]

    @Lazy
    def obstacle_vector(self) -> Floats:
        """Vector from the observed position to the nearest obstacle surface, (n, 3) in B [m]."""
        vector = self._obstacle["vector"][:, :, np.newaxis]
        return np.ascontiguousarray((self.R_BI @ vector)[:, :, 0])


class Measured(Group):
    """Last measurement of each kind in the step; NaN if there was none."""

    def _need_sensors(self) -> None:
        if not self._flights.run_filter:
            raise ValueError(
                'view.measured needs simulated sensors: observation="estimate" or "measurements", '
                "or include_std=True or innovations=True"
            )

    @Lazy
    def gyro(self) -> Floats:
        """Angular rate measured by the gyro, (n, 3) in B [rad/s]."""
        self._need_sensors()
        return self._flights.rows("gyro")

    @Lazy
    def accel(self) -> Floats:
        """Specific force measured by the accelerometer, (n, 3) in B [m/s^2]."""
        self._need_sensors()
        return self._flights.rows("accel")

    @Lazy
    def gnss_valid(self) -> Truths:
        """True where a position was measured in this step, (n,)."""
        self._need_sensors()
        return self._flights.rows("block_fresh")[:, POSITION_BLOCK] > 0.0

    @Lazy
    def baseline_valid(self) -> Truths:
        """True where a baseline was measured in this step, (n,)."""
        self._need_sensors()
        return self._flights.rows("block_fresh")[:, BASELINE_BLOCK] > 0.0

    @Lazy
    def features_seen(self) -> Truths:
        """True for features in an image of this step, (n, m)."""
        self._need_sensors()
        count = self._flights.feature_places().shape[1]
        return self._flights.rows("block_fresh")[:, FEATURE_SLICE][:, :count] > 0.0

    def _in_I(self, name: str, valid: Truths) -> Floats:
        """Vector in G rotated to I; NaN where it was not measured."""
        x, y, z = self._flights.columns(name)
        turned = [row[0] * x + row[1] * y + row[2] * z for row in self._flights.nominal()["R_IG"]]
        return np.where(valid, turned, np.nan).T

    @Lazy
    def gnss_position(self) -> Floats:
        """Measured position of the primary antenna, (n, 3) in I [m]."""
        return self._in_I("gnss_position", self.gnss_valid)

    @Lazy
    def gnss_baseline(self) -> Floats:
        """Measured baseline from the primary to the secondary antenna, (n, 3) in I [m]."""
        return self._in_I("gnss_baseline", self.baseline_valid)

    @Lazy
    def gnss_velocity(self) -> Floats:
        """Measured velocity of the primary antenna, (n, 3) in I [m/s]."""
        gnss = self._flights.sensors.gnss
        gives = gnss is not None and gnss.velocity_sigma is not None
        return self._in_I("gnss_velocity", self.gnss_valid & gives)

    @Lazy
    def pixels(self) -> Floats:
        """Image coordinates of the features, relative to the image center, (n, m, 2) [pixels]."""
        seen = self.features_seen
        pixels = self._flights.rows("pixels")[:, : seen.shape[1]]
        return np.where(seen[:, :, np.newaxis], pixels, np.nan)

"""The groups of a view: truth, estimate, what is seen, what was measured."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from quad_gym.analysis.metrics import nees, state_error
from quad_gym.batch.surroundings import hidden_points, nearest_obstacle
from quad_gym.rotations import dcm_to_quaternion
from quad_gym.tasks.lazy import Attribute, Group, Lazy, Shown

if TYPE_CHECKING:
    from quad_gym.tasks.view import View

Floats = NDArray[np.float64]
Truths = NDArray[np.bool_]


class Truth(Group):
    """What is so."""

    __slots__ = ("_view",)

    def __init__(self, flights: Any, kept: list[Attribute], view: "View") -> None:
        super().__init__(flights, kept)
        self._view = view

    position = Shown("r", "(n, 3) in I [m].")

    velocity = Shown("v", "(n, 3) in I [m/s].")

    quaternion = Shown("q", "(n, 4) (w, x, y, z), B to I.")

    R_BI = Shown("R_BI", "(n, 3, 3), v_B = R_BI v_I.")

    forward = Shown("R_BI", "(n, 3) the body x axis in I, first row of `R_BI`.", slice(0, 3))

    up = Shown("R_BI", "(n, 3) the vertical in B, last column of `R_BI`.", slice(2, None, 3))

    body_rates = Shown("w", "(n, 3) [rad/s].")

    @Lazy
    def rotor_speeds(self) -> Floats:
        """(n, 4) [rad/s]."""
        return self._flights.rows("rotor_speeds")

    @Lazy
    def accel_bias(self) -> Floats:
        """(n, 3) in B [m/s^2]."""
        return self._flights.rows("b_a")

    @Lazy
    def gyro_bias(self) -> Floats:
        """(n, 3) [rad/s]."""
        return self._flights.rows("b_g")

    @Lazy
    def wind(self) -> Floats:
        """(n, 3) velocity of the air in I [m/s]."""
        return self._flights.rows("wind")

    position_error = Shown("position_error", "(n,) distance from the reference [m].")

    @Lazy
    def estimation_error(self) -> Floats:
        """(n,) distance of the seen from the true position [m]."""
        return self._flights.columns("estimation_error")

    @Lazy
    def progress(self) -> Floats:
        """(n,) speed toward the reference; on a course, toward the gate that was next [m/s]."""
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
        """(n,) normalized estimation error squared."""
        names = ("position", "velocity", "R_BI", "accel_bias", "gyro_bias")
        estimate = self._view.estimate
        error = state_error(
            {name: getattr(self, name) for name in names},
            {name: getattr(estimate, name) for name in names},
        )
        return nees(error, estimate.covariance)

    @Lazy
    def features_in_view(self) -> Truths:
        """(n, m) whether the camera faces a marker and no obstacle hides it, nominally."""
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
        """(n,) from the nearest obstacle's surface, negative inside; infinite: none there [m]."""
        if not self._flights.world.obstacles:
            return np.full(self._view.count, np.inf)
        return self._flights.columns("obstacle_distance")

    @Lazy
    def obstacle_vector(self) -> Floats:
        """(n, 3) from the vehicle to the nearest point of that surface, in I [m]."""
        return self._flights.rows("obstacle_vector")

    @Lazy
    def on_ground(self) -> Truths:
        """(n,) whether the ground pushes a foot; nowhere in a world whose ground carries nobody."""
        return np.asarray(self._flights.columns("footing") > 0.0)

    @Lazy
    def faults(self) -> Any:
        """Which are there now: (n,) bool by name."""
        return self._flights.active_faults()

    @Lazy
    def drawn(self) -> Any:
        """Parameters of the episode: (n, ...) by name."""
        return self._flights.drawn()


def _covariance(name: str, first: int) -> tuple[Lazy[Floats], Lazy[Floats]]:
    """A block of the covariance, and the square roots of its diagonal."""

    def block(self: "Estimate") -> Floats:
        rows = np.ascontiguousarray(self.factor[:, first : first + 3, : first + 3])
        return rows @ rows.transpose(0, 2, 1)

    def sigma(self: "Estimate") -> Floats:
        return self.sigma[:, first : first + 3]

    block.__doc__ = f"(n, 3, 3) covariance of {name}."
    sigma.__doc__ = f"(n, 3) standard deviations of {name}."
    return Lazy(block), Lazy(sigma)


class Estimate(Group):
    """What the filter estimates, and how sure it is."""

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
        """(n, 3) in I [m]."""
        return self._rows("r_hat")

    @Lazy
    def velocity(self) -> Floats:
        """(n, 3) in I [m/s]."""
        return self._rows("v_hat")

    @Lazy
    def R_BI(self) -> Floats:
        """(n, 3, 3), v_B = R_BI v_I."""
        return self._rows("R_hat")

    @Lazy
    def quaternion(self) -> Floats:
        """(n, 4) (w, x, y, z), B to I."""
        return dcm_to_quaternion(self.R_BI)

    @Lazy
    def body_rates(self) -> Floats:
        """(n, 3) measured rates less the estimated bias [rad/s]."""
        return self._rows("w_meas") - self.gyro_bias

    @Lazy
    def accel_bias(self) -> Floats:
        """(n, 3) in B [m/s^2]."""
        return self._rows("b_a_hat")

    @Lazy
    def gyro_bias(self) -> Floats:
        """(n, 3) [rad/s]."""
        return self._rows("b_g_hat")

    @Lazy
    def factor(self) -> Floats:
        """(n, 15, 15) lower Cholesky factor of the covariance."""
        return self._rows("L")

    @Lazy
    def covariance(self) -> Floats:
        """(n, 15, 15) in the order position, velocity, attitude, accelerometer and gyro bias."""
        L = self.factor
        return L @ L.transpose(0, 2, 1)

    @Lazy
    def sigma(self) -> Floats:
        """(n, 15) square roots of the covariance's diagonal."""
        L = self.factor
        return np.sqrt((L * L).sum(axis=2))

    position_covariance, position_sigma = _covariance("position in I [m]", 0)
    velocity_covariance, velocity_sigma = _covariance("velocity in I [m/s]", 3)
    attitude_covariance, attitude_sigma = _covariance("attitude [rad]", 6)
    accel_bias_covariance, accel_bias_sigma = _covariance("accelerometer bias [m/s^2]", 9)
    gyro_bias_covariance, gyro_bias_sigma = _covariance("gyro bias [rad/s]", 12)

    _status = Shown("filter_status", "(n,) what has failed so far.")

    @property
    def status(self) -> NDArray[np.int64]:
        """(n,) what has failed so far, see `FilterStatus`; 0: nothing."""
        self._need_filter()
        return self._status

    @Lazy
    def diverged(self) -> Truths:
        """(n,) whether the filter flags itself as diverged."""
        self._need_filter()
        return self._flights.columns("diverged") > 0.0

    @Lazy
    def nis(self) -> Floats:
        """(n,) normalized innovation squared of the last update."""
        self._need_filter()
        return self._flights.columns("nis")

    @Lazy
    def nis_dimension(self) -> NDArray[np.int64]:
        """(n,) measurements in it."""
        self._need_filter()
        return self._flights.counts("nis_dimension")  # type: ignore[no-any-return]


class Observed(Group):
    """What the controller goes by: the estimate, the truth, or the truth with noise."""

    position = Shown("r_seen", "(n, 3) in I [m].")

    velocity = Shown("v_seen", "(n, 3) in I [m/s].")

    R_BI = Shown("R_seen", "(n, 3, 3), v_B = R_BI v_I.")

    body_rates = Shown("w_seen", "(n, 3) [rad/s].")
    position_error = Shown("position_gap", "(n, 3) reference less position, in B [m].")
    velocity_error = Shown("velocity_gap", "(n, 3) reference less velocity, in B [m/s].")
    up = Shown("up", "(n, 3) the vertical in B.")
    heading = Shown("heading", "(n, 3) direction that body x is to point in, in B.")
    reference_acceleration = Shown("acceleration", "(n, 3) of the reference in B [m/s^2].")
    preview = Shown(
        "ahead", "(n, 2, 3) the reference a little later, less the present one, in B [m]."
    )

    @Lazy
    def _obstacle(self) -> Any:
        """Distance from the nearest obstacle, and the vector there in I, by name."""
        distance, vector = nearest_obstacle(
            self._flights.world.obstacles, self._flights.obstacle_centers(), self.position
        )
        return {"distance": distance, "vector": vector}

    @Lazy
    def obstacle_distance(self) -> Floats:
        """(n,) of the seen position from the nearest obstacle's surface, negative inside [m]."""
        return self._obstacle["distance"]

    @Lazy
    def obstacle_vector(self) -> Floats:
        """(n, 3) from the seen position to the nearest point of that surface, in B [m]."""
        vector = self._obstacle["vector"][:, :, np.newaxis]
        return np.ascontiguousarray((self.R_BI @ vector)[:, :, 0])


class Measured(Group):
    """What was measured in the step, the last of each kind; NaN where there was none."""

    def _need_sensors(self) -> None:
        if not self._flights.run_filter:
            raise ValueError(
                'view.measured needs sensors that run: observation="estimate" or "measurements", '
                "or include_std=True or innovations=True"
            )

    @Lazy
    def gyro(self) -> Floats:
        """(n, 3) in B [rad/s]."""
        self._need_sensors()
        return self._flights.rows("gyro")

    @Lazy
    def accel(self) -> Floats:
        """(n, 3) specific force in B [m/s^2]."""
        self._need_sensors()
        return self._flights.rows("accel")

    @Lazy
    def gnss_valid(self) -> Truths:
        """(n,) whether a position was measured."""
        self._need_sensors()
        return self._flights.columns("position_fresh") > 0.0

    @Lazy
    def baseline_valid(self) -> Truths:
        """(n,) whether a baseline was measured."""
        self._need_sensors()
        return self._flights.columns("baseline_fresh") > 0.0

    @Lazy
    def features_seen(self) -> Truths:
        """(n, m) whether an image of this step has the feature."""
        self._need_sensors()
        count = self._flights.feature_places().shape[1]
        return self._flights.rows("feature_fresh")[:, :count] > 0.0

    def _in_I(self, name: str, valid: Truths) -> Floats:
        """A vector in G turned to I, where it was measured."""
        x, y, z = self._flights.columns(name)
        turned = [row[0] * x + row[1] * y + row[2] * z for row in self._flights.nominal()["R_IG"]]
        return np.where(valid, turned, np.nan).T

    @Lazy
    def gnss_position(self) -> Floats:
        """(n, 3) primary antenna in I [m]."""
        return self._in_I("gnss_position", self.gnss_valid)

    @Lazy
    def gnss_baseline(self) -> Floats:
        """(n, 3) primary to secondary antenna in I [m]."""
        return self._in_I("gnss_baseline", self.baseline_valid)

    @Lazy
    def gnss_velocity(self) -> Floats:
        """(n, 3) of the primary antenna in I [m/s]."""
        gnss = self._flights.sensors.gnss
        gives = gnss is not None and gnss.velocity_sigma is not None
        return self._in_I("gnss_velocity", self.gnss_valid & gives)

    @Lazy
    def pixels(self) -> Floats:
        """(n, m, 2) features from the image's center [pixels]."""
        seen = self.features_seen
        pixels = self._flights.rows("pixels")[:, : seen.shape[1]]
        return np.where(seen[:, :, np.newaxis], pixels, np.nan)

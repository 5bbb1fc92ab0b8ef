"""`FlightScene`: surroundings and vehicle of a flight, which pictures need besides the rows."""

import functools
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from quad_gym.params.trajectories import Trajectory

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class FlightScene:
    """Constants of a flight: vehicle, sensors, reference and surroundings."""

    task: str
    """Kind of task, see `TaskParams`"""
    observation: str
    """source of the controller's observations: "truth", "estimate", "noisy" or "measurements\""""
    control_rate: float
    """Control rate, and so rows per second [Hz]"""
    rotor_positions_B: Floats
    """(4, 3) positions of the rotor hubs in B [m]"""
    max_rotor_speed: float
    """Rotor speed at full voltage [rad/s]"""
    hover_rotor_speed: float
    """Rotor speed in hover [rad/s]"""
    antennas_B: Floats
    """(2, 3) positions of the primary and the secondary antenna in B [m]; NaN: missing"""
    camera_B: Floats
    """(3,) projection center in B [m]; NaN: no camera"""
    R_CB: Floats
    """(3, 3) rotation from body to camera"""
    camera_rate: float
    """Images per second [Hz]; 0: no camera"""
    focal_length: float
    """Focal length [pixels]"""
    half_image: Floats
    """(2,) half width and half height of the image [pixels]"""
    features_I: Floats
    """(n, 3) positions of the features in I [m]"""
    anchors_I: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """(n, 3) places in I to which other sensors measure, such as anchors of radio ranges [m]"""
    gates_I: Floats
    """(n, 3) centers of the course's gates in I; (0, 3) for other tasks [m]"""
    gate_radius: float
    """Distance from the center of a gate below which the gate is passed [m]"""
    reference_omega: float
    """Fundamental frequency of the reference [rad/s]"""
    reference_center: Floats
    """(3,) constant term of the reference in I [m]"""
    reference_cos: Floats
    """(k, 3) cosine coefficients of the reference in I [m]"""
    reference_sin: Floats
    """(k, 3) sine coefficients of the reference in I [m]"""
    obstacles: Floats = field(default_factory=lambda: np.zeros((0, 9)))
    """(n, 9) obstacles: shape (see `records.Shape`), center in I, half length, half thickness and
    half height (cylinder: radius, radius, half height), horizontal direction of the length [m]"""
    geofence_I: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """(2, 3) lowest and highest corner of the geofence in I; (0, 3): no geofence [m]"""
    trajectory_times: Floats = field(default_factory=lambda: np.zeros(0))
    """(m + 1,) times of the segments of a trajectory as the reference; (0,): no trajectory [s]"""
    trajectory_coefficients: Floats = field(default_factory=lambda: np.zeros((8, 0, 4)))
    """(8, m, 4) coefficients as in `quad_gym.Trajectory`, rotated as in the flight"""
    trajectory_closed: bool = False
    """True: the trajectory repeats"""
    trajectory_phase: float = 0.0
    """Time on the trajectory at which the episode begins [s]"""

    @property
    def has_camera(self) -> bool:
        """True if there is a camera, with at least one feature."""
        return len(self.features_I) > 0

    @property
    def has_gnss(self) -> bool:
        """True if there is GNSS."""
        return bool(np.isfinite(self.antennas_B[0]).all())

    def reference(self, times: Floats) -> Floats:
        """Return the position (n, 3) of the reference in I [m] at times [s]."""
        if len(self.trajectory_times):
            return self._trajectory(np.atleast_1d(times) + self.trajectory_phase)
        harmonics = np.arange(1, len(self.reference_cos) + 1)
        angles = self.reference_omega * np.outer(times, harmonics)[..., np.newaxis]
        swing = self.reference_cos * np.cos(angles) + self.reference_sin * np.sin(angles)
        return np.asarray(self.reference_center + swing.sum(axis=1))

    @property
    def reference_period(self) -> float:
        """Time after which the reference repeats or ends [s]; 0: a fixed point."""
        if len(self.trajectory_times):
            return float(self.trajectory_times[-1])
        moves = bool(np.any(self.reference_cos) or np.any(self.reference_sin))
        return 2.0 * np.pi / self.reference_omega if moves else 0.0

    @property
    def pieces(self) -> int:
        """Number of line segments that draw the whole reference."""
        return max(160, min(8 * len(self.trajectory_times), 2000))

    @functools.cached_property
    def _trajectory(self) -> Trajectory:
        return Trajectory(
            times=self.trajectory_times,
            coefficients=self.trajectory_coefficients,
            closed=bool(self.trajectory_closed),
        )

    def project_features(self, position: Floats, R_BI: Floats) -> Floats:
        """Project the features into the image of a camera at a pose.

        Args:
            position: (..., 3) position of the center of mass in I [m].
            R_BI: (..., 3, 3) rotation from inertial to body.

        Returns:
            (..., n, 2) pixels from the center of the image, also outside the image; NaN for a
            feature behind the camera.
        """
        X_B = (self.features_I - position[..., np.newaxis, :]) @ np.swapaxes(R_BI, -1, -2)
        X_C = (X_B - self.camera_B) @ self.R_CB.T
        in_front = X_C[..., 2:] > 1e-9
        depth = np.where(in_front, X_C[..., 2:], np.nan)
        return np.asarray(self.focal_length * X_C[..., :2] / depth)

    def frustum_corners(self, position: Floats, R_BI: Floats, depth: float) -> Floats:
        """Return the projection center, and the image's corners at a depth along the optical axis.

        Returns:
            (5, 3) in I [m].
        """
        x, y = self.half_image / self.focal_length
        corners_C = depth * np.array([[x, y, 1.0], [-x, y, 1.0], [-x, -y, 1.0], [x, -y, 1.0]])
        corners_B = self.camera_B + np.concatenate([np.zeros((1, 3)), corners_C @ self.R_CB])
        return np.asarray(position + corners_B @ R_BI)

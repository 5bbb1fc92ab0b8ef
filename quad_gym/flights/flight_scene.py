"""`FlightScene`: place and vehicle of a flight, which a picture needs besides the rows."""

import functools
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from quad_gym.params.trajectories import Trajectory

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class FlightScene:
    """What stays as it is during a flight."""

    task: str
    """kind of task"""
    observation: str
    """what the controller saw: "truth", "estimate", "noisy" or "measurements" """
    control_rate: float
    """rows per second [Hz]"""
    rotor_positions_B: Floats
    """(4, 3) [m]"""
    max_rotor_speed: float
    """[rad/s]"""
    hover_rotor_speed: float
    """[rad/s]"""
    antennas_B: Floats
    """(2, 3) primary and secondary antenna [m]; NaN: there is no GNSS"""
    camera_B: Floats
    """(3,) projection center [m]; NaN: there is no camera"""
    R_CB: Floats
    """(3, 3) body to camera"""
    camera_rate: float
    """images per second [Hz]; 0: there is no camera"""
    focal_length: float
    """[pixels]"""
    half_image: Floats
    """(2,) half the image's width and height [pixels]"""
    features_I: Floats
    """(n, 3) [m]"""
    gates_I: Floats
    """(n, 3) centers of the course's gates; (0, 3) on other tasks [m]"""
    gate_radius: float
    """[m]"""
    reference_omega: float
    """fundamental frequency of the reference [rad/s]"""
    reference_center: Floats
    """(3,) its constant term [m]"""
    reference_cos: Floats
    """(k, 3) its cosine coefficients [m]"""
    reference_sin: Floats
    """(k, 3) its sine coefficients [m]"""
    obstacles: Floats = field(default_factory=lambda: np.zeros((0, 9)))
    """(n, 9) shape (see `records.Shape`), center in I, half length, thickness and height (of a
    cylinder: radius, radius, half height), level direction of the length [m]"""
    geofence_I: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    """(2, 3) lowest and highest corner of the geofence; (0, 3): there is none [m]"""
    trajectory_times: Floats = field(default_factory=lambda: np.zeros(0))
    """(m + 1,) of the segments of a trajectory, the reference then; (0,): there is none [s]"""
    trajectory_coefficients: Floats = field(default_factory=lambda: np.zeros((8, 0, 4)))
    """(8, m, 4) of `quad_gym.Trajectory`, turned as it is flown"""
    trajectory_closed: bool = False
    """whether it repeats"""
    trajectory_phase: float = 0.0
    """time on it at which the episode begins [s]"""

    @property
    def has_camera(self) -> bool:
        """Whether there is a camera with a feature to see."""
        return len(self.features_I) > 0

    @property
    def has_gnss(self) -> bool:
        """Whether there is GNSS."""
        return bool(np.isfinite(self.antennas_B[0]).all())

    def reference(self, times: Floats) -> Floats:
        """Where the reference is at times [s], (n, 3) in I [m]: a series or a trajectory."""
        if len(self.trajectory_times):
            return self._trajectory(np.atleast_1d(times) + self.trajectory_phase)
        harmonics = np.arange(1, len(self.reference_cos) + 1)
        angles = self.reference_omega * np.outer(times, harmonics)
        swing = np.cos(angles) @ self.reference_cos + np.sin(angles) @ self.reference_sin
        return np.asarray(self.reference_center + swing)

    @property
    def reference_period(self) -> float:
        """Time after which the reference repeats, or ends [s]; 0: it stands still."""
        if len(self.trajectory_times):
            return float(self.trajectory_times[-1])
        moves = bool(np.any(self.reference_cos) or np.any(self.reference_sin))
        return 2.0 * np.pi / self.reference_omega if moves else 0.0

    @property
    def pieces(self) -> int:
        """Straight lines that show the whole reference."""
        return max(160, min(8 * len(self.trajectory_times), 2000))

    @functools.cached_property
    def _trajectory(self) -> Trajectory:
        return Trajectory(
            times=self.trajectory_times,
            coefficients=self.trajectory_coefficients,
            closed=bool(self.trajectory_closed),
        )

    def project_features(self, position: Floats, R_BI: Floats) -> Floats:
        """Where the features are in the image of a camera at a pose.

        Args:
            position: (..., 3) of the center of mass in I [m].
            R_BI: (..., 3, 3) inertial to body.

        Returns:
            (..., n, 2) pixels from the image's center; NaN for a feature that is behind the camera.
            Those outside the image are not left out.
        """
        X_B = (self.features_I - position[..., np.newaxis, :]) @ np.swapaxes(R_BI, -1, -2)
        X_C = (X_B - self.camera_B) @ self.R_CB.T
        in_front = X_C[..., 2:] > 1e-9
        depth = np.where(in_front, X_C[..., 2:], np.nan)
        return np.asarray(self.focal_length * X_C[..., :2] / depth)

    def frustum_corners(self, position: Floats, R_BI: Floats, depth: float) -> Floats:
        """Projection center and the image's four corners at a depth along the optical axis, in I.

        Returns:
            (5, 3) [m].
        """
        x, y = self.half_image / self.focal_length
        corners_C = depth * np.array([[x, y, 1.0], [-x, y, 1.0], [-x, -y, 1.0], [x, -y, 1.0]])
        corners_B = self.camera_B + np.concatenate([np.zeros((1, 3)), corners_C @ self.R_CB])
        return np.asarray(position + corners_B @ R_BI)

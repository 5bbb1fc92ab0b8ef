"""User-defined references: trajectories, their construction, and checks of their feasibility."""

from quad_gym.params.trajectories.trajectory import Trajectory

__all__ = ["Trajectory"]

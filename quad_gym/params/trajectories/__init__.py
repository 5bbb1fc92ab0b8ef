"""User-defined references: trajectories, their construction, and checks of their feasibility.

| file | contents |
|---|---|
| `trajectory.py` | `Trajectory`: piecewise polynomials and their evaluation |
| `splines.py` | minimum snap and jerk through points at given times |
| `timing.py` | the times of segments, from bounds of speed and acceleration |
| `fitting.py` | piecewise polynomials for any function of time |
| `reading.py` | points from a table |
| `headings.py` | heading along a trajectory |
| `flatness.py` | thrust, attitude and body rates that a motion requires |
| `feasibility.py` | comparison of these with the limits of a vehicle |
"""

from quad_gym.params.trajectories.trajectory import Trajectory

__all__ = ["Trajectory"]

"""Users' references: trajectories, how they are made, and whether a vehicle can fly them.

| file | what |
|---|---|
| `trajectory.py` | `Trajectory`: piecewise polynomials, and how they are evaluated |
| `splines.py` | minimum snap and jerk through points at given times |
| `timing.py` | the times of segments, from bounds of speed and acceleration |
| `fitting.py` | piecewise polynomials for any function of time |
| `reading.py` | points from a table |
| `headings.py` | what the heading follows |
| `flatness.py` | thrust, attitude and body rates that a motion takes |
| `feasibility.py` | whether a vehicle has them |
"""

from quad_gym.params.trajectories.trajectory import Trajectory

__all__ = ["Trajectory"]

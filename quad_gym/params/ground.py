"""The ground that supports vehicles: feet, friction, and limits of a safe touchdown."""

import math
from functools import partial
from typing import Annotated

import numpy as np

from quad_gym.params import checks as check
from quad_gym.params.checked import Checked

FARTHEST_FOOT = 10.0  #: largest distance of a foot from the center of mass [m]
GROUND_HEIGHT = -0.1
"""Height of the ground in I [m]: a vehicle that stands on the laboratory's legs is at height 0."""


class GroundParams(Checked):
    """A level plane at `WorldParams.ground_height` that supports a vehicle anywhere.

    Four feet and the four rotor hubs can touch it. Contact is a constraint on velocities that is
    solved once per tick: the plane stops points that would move below it and pushes but never
    pulls; impacts are inelastic, and friction is Coulomb friction. After the tick of an impact,
    points of a tumbling vehicle may be 15 mm below the plane, and with a friction of 5, 5 cm. The
    contact has no stiffness, so every step size is stable (J. J. Moreau, "Unilateral contact
    and dry friction in finite freedom dynamics", 1988; D. E. Stewart, J. C. Trinkle, "An implicit
    time-stepping scheme for rigid body dynamics with inelastic collisions and Coulomb friction",
    Int. J. Numerical Methods in Engineering 39, 1996).
    """

    feet_B: check.Matrix43 = (
        (0.15, -0.15, -0.1),
        (0.15, 0.15, -0.1),
        (-0.15, 0.15, -0.1),
        (-0.15, -0.15, -0.1),
    )
    """(4, 3) positions of the soles of the feet relative to the center of mass, in B [m], in a
    level plane below all rotor hubs; default: legs of 0.1 m under the laboratory vehicle's arms"""
    friction: Annotated[float, check.between(0.0, 100.0)] = 0.6
    """Coulomb friction coefficient, for sticking and sliding; rubber on concrete has 0.6 to 0.85;
    0: no friction"""
    max_touchdown_speed: Annotated[float, partial(check.positive, least=0.2)] = 1.5
    """speed of the center of mass toward the ground above which a touchdown is a crash [m/s]; a
    free fall from 0.11 m ends at the default"""
    max_touchdown_tilt: Annotated[float, partial(check.positive, most=math.pi)] = math.radians(30.0)
    """angle between the body z axis and the vertical above which touching the ground is a crash
    [rad]; touching it with a rotor always is"""

    def __post_init__(self) -> None:
        super().__post_init__()
        feet = np.array(self.feet_B)
        if np.abs(feet).max() > FARTHEST_FOOT:
            self._refuse("feet_B", f"be within {FARTHEST_FOOT:g} m")
        if np.linalg.svd(feet[:, :2] - feet[:, :2].mean(axis=0))[1][1] < 1e-3 or not (
            np.ptp(feet[:, 2]) <= 1e-9 and feet[0, 2] < 0.0
        ):
            must = "be four points of a level plane below the center of mass, not all on one line"
            self._refuse("feet_B", must)

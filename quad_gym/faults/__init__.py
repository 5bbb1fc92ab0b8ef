"""Faults of sensors and rotors, and when they occur; frozen parameters with sources.

Every environment and `FlightBatch` take `faults=`: one fault, several, or the names of presets. ::

    import gymnasium
    from quad_gym import FlightBatch
    from quad_gym.faults import CameraOcclusion, GnssOutage, GnssOutliers, WrongAssociations

    gymnasium.make("QuadGym/Circle-v0", sensors="rtk", faults="gnss_outage")
    gymnasium.make("QuadGym/Circle-v0", sensors="rtk", faults="gnss_outliers+rotor_loss")
    FlightBatch(1000, sensors="rtk", faults=(
        GnssOutage(start=20.0, duration=60.0),           # scheduled
        CameraOcclusion(start=(18.0, 20.0), duration=62.0),  # from a drawn instant on
        GnssOutliers(share=0.05, size=(10.0, 100.0)),    # all the time
        WrongAssociations(rate=0.1, duration=1.0),       # now and then: a Poisson process
    ))

Which faults are active is told by `info["faults"]` (name: True or False), by
`FlightBatch.active_faults()`, and by the fields of a flight's record, such as "fault_active",
"outlier" and "feature_mistaken", for `FlightBatch.read`. Filter and controller are not told.
"""

from quad_gym.faults import aids, base, camera, gnss, imu, vehicle
from quad_gym.faults.aids import *
from quad_gym.faults.base import *
from quad_gym.faults.camera import *
from quad_gym.faults.gnss import *
from quad_gym.faults.imu import *
from quad_gym.faults.vehicle import *

# each file says what of it is public
__all__ = (
    aids.__all__ + base.__all__ + camera.__all__ + gnss.__all__ + imu.__all__ + vehicle.__all__
)

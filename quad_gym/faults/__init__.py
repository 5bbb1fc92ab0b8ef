"""Faults of sensors and rotors, with their schedules: frozen parameters with sources.

All environments and `FlightBatch` take `faults=`: a fault, several, or names of presets. ::

    import gymnasium
    from quad_gym import FlightBatch
    from quad_gym.faults import CameraOcclusion, GnssOutage, GnssOutliers, WrongAssociations

    gymnasium.make("QuadGym/Circle-v0", sensors="rtk", faults="gnss_outage")
    gymnasium.make("QuadGym/Circle-v0", sensors="rtk", faults="gnss_outliers+rotor_loss")
    FlightBatch(1000, sensors="rtk", faults=(
        GnssOutage(start=20.0, duration=60.0),           # scheduled
        CameraOcclusion(start=(18.0, 20.0), duration=62.0),  # from a random instant on
        GnssOutliers(share=0.05, size=(10.0, 100.0)),    # all the time
        WrongAssociations(rate=0.1, duration=1.0),       # now and then: a Poisson process
    ))

The active faults are in `info["faults"]` (name: True or False), in `FlightBatch.active_faults()`,
and in fields of a flight's record for `FlightBatch.record`, such as "fault_active", "outlier" and
"feature_mistaken". They are hidden from filter and controller.
"""

from quad_gym.faults import base, kinds
from quad_gym.faults.base import *
from quad_gym.faults.kinds import *

__all__ = base.__all__ + kinds.__all__

"""Vehicle states in the form of the public classes and in the form of records."""

import numpy as np
from scipy.spatial.transform import Rotation

from quad_gym.rotations import dcm_to_quaternion, quaternion_to_dcm


def random_state(seed):
    """Return the state of a vehicle that turns in flight."""
    rng = np.random.default_rng(seed)
    return {
        "position": rng.normal(0.0, 0.1, 3),
        "velocity": rng.normal(0.0, 3.0, 3),
        "R_BI": Rotation.random(rng=rng).as_matrix(),
        "body_rates": rng.normal(0.0, 3.0, 3),
        "rotor_speeds": rng.uniform(500.0, 1500.0, 4),
    }


def put_state(flight, state):
    """Set the state of a flight's record."""
    flight["r"], flight["v"] = state["position"], state["velocity"]
    flight["q"], flight["w"] = dcm_to_quaternion(state["R_BI"]), state["body_rates"]
    flight["rotor_speeds"] = state["rotor_speeds"]


def state_of(record, flight):
    """Return the state of a flight; `record(name)` returns a field of all flights."""
    return {
        "position": record("r")[flight],
        "velocity": record("v")[flight],
        "R_BI": quaternion_to_dcm(record("q")[flight]),
        "body_rates": record("w")[flight],
        "rotor_speeds": record("rotor_speeds")[flight],
    }

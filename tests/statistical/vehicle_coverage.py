"""Coverage of the intervals of a fitted vehicle on simulated flights.

python -m tests.statistical.vehicle_coverage --sensors mocap --flights 11    # 4 s a flight
"""

import argparse
import math

import numpy as np

import quad_gym
from quad_gym import WorldParams
from quad_gym.estimation import fit_vehicle
from tests.logged_flights import Recorded, flown

LAB = quad_gym.VehicleParams()
TRUE = LAB.replace(
    thrust_coefficient=1.2 * LAB.thrust_coefficient, motor_time_constant=0.08, drag_coefficient=3.0
)
DRAG = (0.5, 0.3)  #: linear drag over the mass [1/s]
SECONDS = 12.0
FREE = {"out_of_bounds": 1e3, "min_height": -1e3, "max_tilt": math.pi}  #: no ends of flights
NUMBERS = {
    "thrust_over_mass": TRUE.thrust_coefficient / TRUE.mass,
    "motor_time_constant": TRUE.motor_time_constant,
    "drag_over_mass": 1.5 * TRUE.disc_area * TRUE.air_density / TRUE.mass,
    "sag": 0.0,
}


def fitted(suite, seed):
    """Return the fit to a random trajectory."""
    world = WorldParams(linear_drag_B=(*(TRUE.mass * d for d in DRAG), 0.0))
    flight = flown(
        suite, SECONDS, seed=seed, task="random_trajectory", vehicle=TRUE, world=world, **FREE
    )
    log = Recorded(flight, suite, seed=seed, lost=0.0, jitter=0.0, max_ticks=1).table()
    motors = {"time": flight["time"][:-1], "voltages": flight.about["voltages"][1:]}
    return fit_vehicle(log, sensors=suite, motors=motors)


def main():
    """Print the share of intervals that contain the true values."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sensors", default="mocap")
    parser.add_argument("--flights", type=int, default=11)
    args = parser.parse_args()
    inside = []
    for seed in range(args.flights):
        found = fitted(quad_gym.sensor_suite(args.sensors), seed)
        pairs = [(true, getattr(found, name)) for name, true in NUMBERS.items()]
        pairs += zip(DRAG, found.linear_drag_over_mass, strict=True)
        inside.append([number.low <= true <= number.high for true, number in pairs])
    each = dict(zip([*NUMBERS, "along", "across"], np.sum(inside, axis=0).tolist(), strict=True))
    print(f"{args.sensors}: {np.sum(inside)} of {np.size(inside)} inside; by number {each}")


if __name__ == "__main__":
    main()

"""Fields of records that a world which is not calm adds, and what a field is."""

from enum import IntEnum
from typing import NamedTuple

from quad_gym.randomization import DRAWN_SIZE


class Supply(IntEnum):
    """What limits the motor voltages beside the controller."""

    NOMINAL = 0
    """nothing: the controller knows the largest voltage"""
    LIMIT = 1
    """a largest voltage that the controller does not know"""
    BATTERY = 2
    """a battery, see `quad_gym.BatteryParams`"""


class Field(NamedTuple):
    """One named quantity of a flight."""

    name: str
    shape: tuple[int, ...]
    unit: str
    meaning: str
    kind: str = "f8"


# fmt: off
WORLD_STATE_FIELDS = (
    Field("wind", (3,), "m/s", "velocity of the air in I"),
    Field("gust", (5,), "-", "states of the Dryden gusts u, v, w, see `kernels.dryden`"),
    Field("air_force", (3,), "N", "force of the air in I, less thrust and disc drag"),
    Field("air_torque", (3,), "N m", "torque of the air in B, less that of the rotors' thrust far from the ground"),
    Field("charge", (), "-", "charge of the battery, 1: full"),
    Field("drawn", (DRAWN_SIZE,), "mixed", "parameters of this episode, see `quad_gym.randomization`"),
)

WORLD_PARAMS_FIELDS = (
    Field("kN", (), "N m/(rad/s)^2", "torque coefficient"),
    Field("half_disc", (), "kg/m", "Ad rho / 2"),
    Field("rotors", (4, 3), "m", "rotor hubs in B"),
    Field("wind", (3,), "m/s", "steady wind in I"),
    Field("wind_speed", (), "m/s", "its horizontal speed"),
    Field("wind_direction", (), "rad", "its direction, from east toward north"),
    Field("gust_wind_speed", (), "m/s", "W20"),
    Field("linear_drag", (3,), "N s/m", "linear drag in B"),
    Field("rotor_drag", (3,), "N s/m per rad/s", "linear drag in B per rotor speed"),
    Field("rotor_radius", (), "m", "radius of the rotors"),
    Field("ground_height", (), "m", "height of the ground in I"),
    Field("battery_charge", (), "-", "charge at the start"),
    Field("battery_energy", (), "J", "energy of a full battery"),
    Field("battery_empty", (), "-", "voltage of an empty over that of a full battery"),
    Field("battery_resistance", (), "ohm", "resistance of the battery"),
    Field("motor_efficiency", (), "-", "mechanical over electrical power"),
)

WORLD_SETTINGS_FIELDS = (
    Field("air", (), "0 or 1", "whether the air does more than in a calm world", "i8"),
    Field("gusts", (), "0 or 1", "whether there are gusts", "i8"),
    Field("linear_drag", (), "0 or 1", "whether there is linear drag", "i8"),
    Field("ground_effect", (), "0 or 1", "whether there is ground effect", "i8"),
    Field("supply", (), "-", "what limits the motor voltages, see Supply", "i8"),
    Field("randomized", (), "0 or 1", "whether flights draw parameters of their own", "i8"),
    Field("observe_world", (), "0 or 1", "whether the truth in an observation ends with wind and draws", "i8"),
    Field("known", (), "0 or 1", "whether filter and controller know the world as it is", "i8"),
    Field("draw_kind", (DRAWN_SIZE,), "-", "how a column is drawn, see `quad_gym.distributions`", "i8"),
    Field("draw_a", (DRAWN_SIZE,), "mixed", "of the distribution"),
    Field("draw_b", (DRAWN_SIZE,), "mixed", "of the distribution"),
    Field("draw_c", (DRAWN_SIZE,), "-", "of the distribution"),
    Field("draw_d", (DRAWN_SIZE,), "-", "of the distribution"),
    Field("draw_low", (DRAWN_SIZE,), "mixed", "least draw"),
    Field("draw_high", (DRAWN_SIZE,), "mixed", "largest draw"),
    Field("draw_center", (DRAWN_SIZE,), "mixed", "middle of the draws, subtracted in observations"),
    Field("draw_spread", (DRAWN_SIZE,), "mixed", "scale of the draws, divided by in observations"),
)
# fmt: on

"""What a field of a record is, and the sizes of what records hold."""

from typing import NamedTuple

from quad_gym.records.enums import AID_FREEDOMS, BLOCK_FREEDOMS, Aid, Block, FaultKind, Sensor
from quad_gym.records.width import WIDTH as WIDTH

MAX_HARMONICS = 6
"""Terms of the Fourier series of a reference."""
FOLLOWED = -1
"""In place of that number: the reference is a user's trajectory."""
TERMS = 8
"""Coefficients of a segment of such a trajectory, of degree 7."""
HEADING_TOWARD, HEADING_ALONG, HEADING_VELOCITY, HEADING_GIVEN = 0.0, 1.0, 2.0, 3.0
"""Rules of a reference's heading: toward a point, along a direction, along the velocity, a yaw."""
MAX_GATES = 8
"""Gates of a course."""
MAX_START_VELOCITY, MAX_START_RATE = 1.5, 2.0
"""A moving start has at most so much on each axis: [m/s], [rad/s]."""
MAX_FEATURES = 16
"""Features of a camera."""
MAX_OBSTACLES = 32
"""Obstacles of a world."""
MAX_UNDER_WAY = 2
"""Longest latency of a sensor, in its periods: as many measurements can be in transit."""
DELAY_SLOTS = MAX_UNDER_WAY + 1
"""Measurements that wait: at a latency of MAX_UNDER_WAY periods one is taken as another arrives."""
MAX_ACTION_DELAY = 10
"""Longest delay of an action, in control steps."""
SENSORS = len(Sensor)
"""Sensors other than the IMU."""
KINDS = 1 << SENSORS
"""Sets of sensors that can measure at an instant."""
AIDS = len(Aid)
"""Those with parameters in the fields `aid_...`, which come last."""
FIRST_AID = SENSORS - AIDS
"""The first of them."""
POSITION_BLOCK = int(Block.POSITION)
BASELINE_BLOCK = int(Block.BASELINE)
VELOCITY_BLOCK = int(Block.VELOCITY)
FEATURE_BLOCKS = int(Block.FEATURES)
"""Where the blocks stand in a flight's fields of innovations; feature i is FEATURE_BLOCKS + i."""
AID_BLOCKS = FEATURE_BLOCKS + MAX_FEATURES
"""Blocks of the other sensors begin here; that of aid i is AID_BLOCKS + i."""
MAX_BLOCKS = AID_BLOCKS + AIDS
"""Blocks of the measurement: antenna position, baseline, velocity, features, other sensors."""
FIRST_BLOCK = (POSITION_BLOCK, FEATURE_BLOCKS, *range(AID_BLOCKS, MAX_BLOCKS))
"""First block of each sensor."""
FEATURE_SLICE = slice(FEATURE_BLOCKS, AID_BLOCKS)
"""Blocks of the features."""
MAX_MEASUREMENTS = 3 * MAX_BLOCKS
"""Length of the stacked measurement; a direction has three numbers."""
AID_GROUPS = len(Block)
"""Groups of the other sensors begin here."""
SENSOR_GROUPS = AID_GROUPS + AIDS
"""Groups of the gate: positions, baselines, velocities, images, and the other sensors."""
FIRST_GROUP = (POSITION_BLOCK, FEATURE_BLOCKS, *range(AID_GROUPS, SENSOR_GROUPS))
"""First group of each sensor."""
GROUP_COUNT = (FEATURE_BLOCKS, *[1] * (SENSORS - 1))
"""Groups of each sensor."""
BLOCK_NUMBERS = (3, 3, *AID_FREEDOMS)
"""Numbers in a block of each sensor: a direction is a unit vector."""
FREEDOMS = (*BLOCK_FREEDOMS, *BLOCK_FREEDOMS[-1:] * (MAX_FEATURES - 1), *AID_FREEDOMS)
"""Degrees of freedom of the blocks: a direction has two."""
MAX_OBSERVATION = 512
"""Numbers that an observation can hold."""
WARM_DRAWS = 21
"""Standard normals that make the errors of a warm start: fifteen, and those of the true biases."""
MAX_SLOW = 9
"""Slow errors of sensors that a filter can have among its states, a multiple of three: the drift of
GNSS positions, the hard iron of a magnetometer, and one number of each other sensor."""
MAX_STATES = 15 + MAX_SLOW
"""States of a filter with all of them."""
WARM_SLOW_DRAWS = 2 * MAX_SLOW
"""More of these normals, for slow errors: by threes those of their own, and those of the true ones."""
STAMP = 28
"""Numbers of a time stamp: the tick; C, V, X and B of the IMU's sums; body rates."""
FAULT_KINDS = len(FaultKind)
"""Number of kinds of faults."""


class Field(NamedTuple):
    """One named quantity of a flight."""

    name: str
    shape: tuple[int, ...]
    unit: str
    meaning: str
    kind: str = "f8"


for _aid in Aid:
    assert Sensor[_aid.name] == FIRST_AID + _aid

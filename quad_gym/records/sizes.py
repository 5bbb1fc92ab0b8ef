"""What a field of a record is, and the sizes of what records hold."""

from typing import NamedTuple

from quad_gym.records.enums import FaultKind
from quad_gym.records.width import WIDTH as WIDTH

MAX_HARMONICS = 6
"""Terms of the Fourier series of a reference."""
MAX_GATES = 8
"""Gates of a course."""
MAX_FEATURES = 16
"""Features of a camera."""
MAX_UNDER_WAY = 2
"""Longest latency of a sensor, in its periods: as many measurements can be in transit."""
DELAY_SLOTS = MAX_UNDER_WAY + 1
"""Measurements that wait: at a latency of MAX_UNDER_WAY periods one is taken as another arrives."""
MAX_ACTION_DELAY = 10
"""Longest delay of an action, in control steps."""
MAX_BLOCKS = 3 + MAX_FEATURES
"""Blocks of the stacked measurement: antenna position, baseline, velocity, features."""
MAX_MEASUREMENTS = 3 * MAX_BLOCKS
"""Length of the stacked measurement; a direction has three numbers."""
SENSOR_GROUPS = 4
"""Kinds of measurements: positions, baselines, velocities, images."""
POSITION_BLOCK, BASELINE_BLOCK, VELOCITY_BLOCK, FEATURE_BLOCKS = 0, 1, 2, 3
"""Where the blocks stand in a flight's fields of innovations; feature i is FEATURE_BLOCKS + i."""
FREEDOMS = (3, 2, 3, *[2] * MAX_FEATURES)
"""Degrees of freedom of the blocks: a direction has two."""
MAX_OBSERVATION = 256
"""Numbers that an observation can hold."""
WARM_DRAWS = 21
"""Standard normals that make the errors of a warm start: fifteen, and those of the true biases."""
WARM_DRIFT_DRAWS = 6
"""More of them, for the slow error of GNSS positions: three, and three that make the true one."""
FAULT_KINDS = len(FaultKind)
"""Number of kinds of faults."""


class Field(NamedTuple):
    """One named quantity of a flight."""

    name: str
    shape: tuple[int, ...]
    unit: str
    meaning: str
    kind: str = "f8"

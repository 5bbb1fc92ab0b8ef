"""Enumerations of the values that records hold."""

import os
from enum import IntEnum, IntFlag

from quad_gym.params.sensor_table import SENSOR_SHAPES


class FilterStatus(IntFlag):
    """Flags of a filter's numerical failures since its start; 0: none."""

    PREDICTION_FAILED = 1
    """The predicted covariance was not positive definite; the filter kept its last good state."""
    UPDATE_FAILED = 2
    """The result of a measurement update was not finite; the filter kept the state before it."""


class FilterForm(IntFlag):
    """Options of a filter as flags; 0 is the UKF of the report."""

    EKF = 1  #: extended Kalman filter: derivatives of the models instead of sigma points
    MIDPOINT = 2
    """midpoint rule: exact rotation over a tick, and force rotated by the attitude at mid-tick"""
    TURN = 4  #: rotation of the covariance when the error angles are reset to zero
    INNOVATIONS = 8
    """innovations, their predicted standard deviations and their NIS are stored for each block"""
    GATE = 16  #: blocks whose NIS exceeds the gate are rejected; innovations are stored, too
    LEVER_AVERAGES = 64
    """the accelerometer is off the center of mass, and a sample is the mean over a tick"""
    LEVER_SAMPLES = 128
    """the accelerometer is off the center of mass, and a sample is the value at a tick's start"""
    GRADUAL = 32  #: images are processed in several steps while the attitude is uncertain
    FIRST_ESTIMATES = 256
    """derivatives at the first estimate of an instant, which keep an unobservable heading so"""


class GateDecision(IntEnum):
    """Decision of the innovation gate on a block of the last measurement."""

    NONE = 0  #: not measured since the start of the episode
    ACCEPTED = 1  #: used in the update
    REJECTED = 2  #: excluded from the update, as the innovation exceeds the gate
    FAILED = 3  #: part of an update that failed as a whole, see `FilterStatus`
    UNSURE = 4  #: excluded feature, with a predicted direction too uncertain for a linear model
    WEAKENED = 5  #: used with so much more noise that its innovation is at the gate


class Source(IntEnum):
    """Source of the state that the controller observes."""

    TRUTH = 0  #: the true state
    ESTIMATE = 1  #: the filter's estimate
    NOISY = 2  #: the true state with independent noise
    MEASUREMENTS = 3  #: the raw measurements


class Control(IntEnum):
    """Meaning of the four numbers of an action."""

    MOTOR = 0  #: voltages of the four motors
    WRENCH = 1  #: thrust and torque
    CTBR = 2  #: collective thrust and body rates
    ATTITUDE = 3  #: thrust, roll, pitch and yaw rate
    VELOCITY = 4  #: velocity ahead, to the left and up, and yaw rate
    PD = 5  #: none: the report's PD controller follows the reference at every tick


class Sensor(IntEnum):
    """Sensors other than the IMU, each a stage with a clock and a latency.

    Their rows in the stacked measurement, and delayed updates, are in this order.
    """

    _ignore_ = "number word"
    for number, word in enumerate(SENSOR_SHAPES):
        vars()[word.upper()] = number


_SENSOR_SHAPES = tuple(SENSOR_SHAPES.values())
_SHAPES = [reading for sensor in _SENSOR_SHAPES for reading in sensor.readings]
READINGS = tuple(shape.name for shape in _SHAPES)
"""Names of the sensors' readings, in the order of the sensors. Each is a group of the gate."""
LENGTHS = tuple(shape.length for shape in _SHAPES)  #: numbers in a block of each reading
ROOM = tuple(map(int, os.environ.get("QUAD_GYM_ROOM", "").split()))
"""Sizes of the records of a process that exports a filter for a processor with little memory:
blocks of each reading, blocks of an instant, and slow errors; empty: the largest ones. Set by
`baselines.exporting` alone."""
ALLOWED_BLOCKS = tuple(shape.most_blocks for shape in _SHAPES)
"""Largest numbers of their blocks in a suite."""
MOST_BLOCKS = ROOM[:-2] or ALLOWED_BLOCKS  #: largest numbers for which records have room
LEAST_SIGMA = tuple(shape.least_sigma for shape in _SHAPES)
"""Smallest standard deviations of a measurement of each reading."""
DIRECTIONS = tuple(shape.direction for shape in _SHAPES)
"""True for readings that filters compare as unit vectors, of three numbers."""
GROUP_FREEDOMS = tuple(2 if shape.direction else shape.length for shape in _SHAPES)
"""Degrees of freedom of a block of each reading: a direction has two."""
IN_G = tuple(int(shape.in_G) for shape in _SHAPES)
"""1 for readings that records have in G, the frame of GNSS, in place of I."""
MARKED = tuple(int(shape.marked) for shape in _SHAPES)
"""1 for readings that the mark of a start gives where no sensor does."""
GROUP_COUNT = tuple(len(sensor.readings) for sensor in _SENSOR_SHAPES)
"""Number of readings of each sensor, each a group of the gate."""


class Aid(IntEnum):
    """Sensors of one reading, with parameters in `aid_...`: the last of `Sensor`, in this order.

    The name in lower case is the field of `SensorSuite`. The fault that silences a sensor
    (`LOSSES`), its stage, its blocks of the measurement and its part of a raw observation are
    derived from it.
    """

    _ignore_ = "number word"
    for number, word in enumerate(name for name, shape in SENSOR_SHAPES.items() if shape.aid):
        vars()[word.upper()] = number


AID_FREEDOMS = LENGTHS[-len(Aid) :]
"""Numbers in a block of each aiding sensor, in the order of `Aid`."""
AID_MOST = MOST_BLOCKS[-len(Aid) :]  #: largest numbers of their blocks
AID_TRIPLES = tuple(shape.rows for shape in _SENSOR_SHAPES if shape.aid)
"""Triples of their further parameters."""


class Observes(IntFlag):
    """States that a group of measurements observes, for fault isolation."""

    POSITION = 1  #: horizontal
    HEIGHT = 2
    VELOCITY = 4
    HEADING = 8


GROUP_OBSERVES = tuple(
    sum(int(Observes[word.upper()]) for word in shape.observes) for shape in _SHAPES
)
"""The same of each group, as numbers."""
QUANTITIES = len(Observes)  #: number of the bits of `Observes`
OWN_ERRORS = tuple(shape.own_error for shape in _SENSOR_SHAPES if shape.aid)
"""True for aiding sensors with an error of their own among the states of a filter."""


class Act(IntEnum):
    """Tasks of a sensor's stage."""

    BEGIN = 0  #: begin an episode: draw constant errors, set the clock
    SAMPLE = 1  #: measure when due, queue delayed measurements, and deliver the ones that arrive
    EXPECT = 2  #: predict the measurement: its value at the estimate, its noise and its columns
    RESET = 3  #: reset states to the sensor after it was refused for too long
    ALIGN = 4  #: initialize the heading, if the sensor is the `heading_sensor` of the settings


class TaskKind(IntEnum):
    """Kind of task."""

    HOVER = 1
    CIRCLE = 2
    LEMNISCATE = 3
    RANDOM_TRAJECTORY = 4
    WAYPOINTS = 5
    TRAJECTORY = 6


class Start(IntEnum):
    """Kind of initial state of an episode."""

    GROUND = 0
    """At rest below the reference at height 0, with the rotors stopped: the start of the report."""
    HOVER = 1  #: hovering nearly at rest, within some decimeters of the reference
    MIXED = 2
    """GROUND or HOVER, each with probability 0.5: a policy in training learns to hover and, once it
    can, to take off."""
    MOVING = 3  #: HOVER with an additional velocity and body rates, as after a disturbance


class Layout(IntEnum):
    """Contents of an observation."""

    RELATIVE = 0
    ABSOLUTE = 1
    MEASUREMENTS = 2


class Autoreset(IntEnum):
    """Time at which a flight whose episode is over begins the next one."""

    DISABLED = 0
    NEXT_STEP = 1
    SAME_STEP = 2


class Ending(IntEnum):
    """Reason for the end of an episode.

    `info["ending"]` is its number, as libraries that store infos in tensors expect:
    `info["ending"] == Ending.COLLISION`. Its name is `str(Ending(info["ending"]))`, as "collision".
    """

    NONE = 0  #: the episode has not ended
    TIME_LIMIT = 1  #: the time limit was reached
    OUT_OF_BOUNDS = 2  #: the vehicle was too far from the reference, or its state was not finite
    TIPPED_OVER = 3  #: the vehicle was tilted too far
    BELOW_MIN_HEIGHT = 4  #: the vehicle was too low, or crashed into ground that supports vehicles
    LAST_GATE = 5  #: the last gate was passed
    FILTER_FAILED = 6  #: the filter failed numerically, see `FilterStatus`
    FILTER_DIVERGED = 7  #: the filter's consistency monitor flagged divergence
    TASK = 8  #: a user-defined task ended the episode, see `quad_gym.Task`
    COLLISION = 9  #: the vehicle touched an obstacle
    LEFT_GEOFENCE = 10  #: the vehicle left the geofence

    def __str__(self) -> str:
        return self.name.lower()


class Shape(IntEnum):
    """Shape of an obstacle."""

    WALL = 0
    CYLINDER = 1


class Command(IntEnum):
    """Operation of a call of the batch kernel."""

    STEP = 0  #: fly a control period
    RESET = 1  #: begin episodes
    FINISH = 2
    """end a control period flown by TICK: observe the user's estimate, set results, observe"""
    LOOK = 3  #: observe again, after a user's estimator has begun episodes
    TICK = 4  #: fly one tick up to its measurements; TICK + k: k more follow in the control period


class Supply(IntEnum):
    """Limit of the motor voltages in addition to the controller's."""

    NOMINAL = 0  #: none: the controller assumes the true largest voltage
    LIMIT = 1  #: a largest voltage that is unknown to the controller
    BATTERY = 2  #: a battery, see `quad_gym.BatteryParams`


class FaultKind(IntEnum):
    """Kinds of faults; a flight has at most one fault of each kind, which may recur.

    Recorded flights contain the numbers, and a fault's draws follow its number: every member keeps
    its number, and new ones come last, also the loss of a new sensor.
    """

    GNSS_OUTAGE = 0
    GNSS_OUTLIERS = 1
    GNSS_RAMP = 2
    GNSS_JUMP = 3
    BASELINE_LOSS = 4
    POSITION_JUMP = 5
    CAMERA_OCCLUSION = 6
    WRONG_ASSOCIATIONS = 7
    ACCEL_BIAS_STEP = 8
    GYRO_BIAS_STEP = 9
    IMU_SATURATION = 10
    ROTOR_LOSS = 11
    BAROMETER_LOSS = 12
    MAGNETOMETER_LOSS = 13
    OPTICAL_FLOW_LOSS = 14
    RANGE_FINDER_LOSS = 15
    UWB_RANGE_LOSS = 16
    MAGNETOMETER_DISTURBANCE = 17


def _losses() -> tuple[FaultKind, ...]:
    names = [f"{aid.name}_LOSS" for aid in Aid]
    for name in names:
        if name not in FaultKind.__members__:
            last = max(FaultKind)
            raise ValueError(
                f"FaultKind must have {name} = {last + 1} behind {last.name}, got none"
            )
    return tuple(FaultKind[name] for name in names)


LOSSES = _losses()  #: faults that silence aiding sensors, in the order of `Aid`


class FieldFault(IntEnum):
    """Disturbances of a magnetometer."""

    TURNED = 0  #: about body z
    IRON = 1  #: a constant field in B is added
    FROZEN = 2  #: the last field before the onset is repeated


class RewardTerm(IntEnum):
    """Terms of the built-in rewards; each has a weight with its name in `RewardParams`."""

    NEAR = 0
    FINE = 1
    PROGRESS = 2
    GATE_PASSED = 3
    HEADING = 4
    ACTION_RATE = 5
    BODY_RATES = 6

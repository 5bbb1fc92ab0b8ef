"""Beginnings of episodes: seeds, references, initial states, cold and warm filters."""

import functools
import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_gym.configuration import FlightConfiguration
from quad_gym.kernels import entries
from quad_gym.packing import pack_obstacles, slow_states
from quad_gym.params import checks as check
from quad_gym.params import portable
from quad_gym.params.aids import MIN_DRIFT
from quad_gym.params.randomization import DrawingTable
from quad_gym.params.suites import SensorSuite
from quad_gym.params.task import TaskParams
from quad_gym.params.trajectories import Trajectory
from quad_gym.params.vehicle import ActionParams, VehicleParams
from quad_gym.params.world import Obstacle, WorldParams
from quad_gym.records import (
    COLUMNS,
    MAX_STATES,
    SETTINGS,
    WARM_DRAWS,
    Autoreset,
    Control,
    Source,
    joint_covariance,
    shown_rows,
)
from quad_gym.records.streams import GATE_SPREAD, LOWEST_GATE, RANDOM_RISE
from quad_gym.rotations import dcm_to_euler, quaternion_to_dcm

# --------------------------------------------------------------------------------------------------
# Keys of random streams from seeds, for all flights at once.
#
# A key is the first two words of `numpy.random.Generator(PCG64(seed))`, as Gymnasium makes it. The
# constants and steps are those of NumPy's `SeedSequence` and `PCG64`, on arrays.
# --------------------------------------------------------------------------------------------------

Words = NDArray[np.uint64]
Halves = NDArray[np.uint32]

_POOL = 4  #: words of 32 bits that hold a seed's entropy
_CHUNK = 1 << 13  #: seeds whose words stay in the cache
_WORD, _HALF = np.uint64(2**32 - 1), np.uint64(32)
_MULTIPLIER = 2549297995355413924 << 64 | 4865540595714422341  #: of PCG64
_BY_HAND = 1 << 32 * _POOL  #: seeds from here on have more words


def stream_key(rng: np.random.Generator) -> Words:
    """Draw the key of a flight's random stream, (2,) words."""
    return rng.integers(0, 2**64, size=2, dtype=np.uint64, endpoint=False)


def stream_keys(seeds: Sequence[int | None]) -> Words:
    """Return keys (n, 2) for flights seeded one by one; None uses fresh entropy."""
    checked = [check.seed("seeds", seed) for seed in seeds]
    small = [0 if seed is None or seed >= _BY_HAND else seed for seed in checked]
    if max(small, default=0) < 1 << 63:
        keys = keys_of(np.array(small, np.uint64))
    else:
        keys = keys_of(*(np.array([s >> k & 2**64 - 1 for s in small], np.uint64) for k in (0, 64)))
    for flight, seed in enumerate(checked):
        if seed is None or seed >= _BY_HAND:
            keys[flight] = stream_key(np.random.Generator(np.random.PCG64(seed)))
    return keys


def keys_of(low: Words, high: Words | int = 0) -> Words:
    """Return keys (n, 2) of the seeds `low + 2**64 high`, (n,) each."""
    high = np.broadcast_to(np.asarray(high, np.uint64), low.shape)
    keys, one = np.empty((len(low), 2), np.uint64), np.uint64(1)
    for first in range(0, len(low), _CHUNK):
        chunk = slice(first, first + _CHUNK)
        state_high, state_low, sequence_high, sequence_low = _state_words(low[chunk], high[chunk])
        increment = sequence_high << one | sequence_low >> np.uint64(63), sequence_low << one | one
        state = _stepped(_added(increment, (state_high, state_low)), increment)
        for k in range(2):
            state = _stepped(state, increment)
            mixed, turn = state[0] ^ state[1], state[0] >> np.uint64(58)
            keys[chunk, k] = mixed >> turn | mixed << (-turn & np.uint64(63))
    return keys


def _state_words(low: Words, high: Words) -> list[Words]:
    """Return the four words (n,) that `SeedSequence` generates for a seed of four half words."""
    constant = 0x43B0D7E5

    def hashed(value: Halves, factor: int) -> Halves:
        nonlocal constant
        value = value ^ np.uint32(constant)
        constant = constant * factor & 2**32 - 1
        value *= np.uint32(constant)
        value ^= value >> np.uint32(16)
        return value

    entropy = [half.astype(np.uint32) for word in (low, high) for half in (word, word >> _HALF)]
    pool = [hashed(half, 0x931E8875) for half in entropy]
    for source in range(_POOL):
        for target in range(_POOL):
            if source != target:
                right = hashed(pool[source], 0x931E8875) * np.uint32(0x4973F715)
                mixed = pool[target] * np.uint32(0xCA01F9DD) - right
                pool[target] = mixed ^ mixed >> np.uint32(16)
    constant = 0x8B51F9DD
    halves = [hashed(pool[k % _POOL], 0x58F38DED).astype(np.uint64) for k in range(8)]
    return [halves[k] | halves[k + 1] << _HALF for k in range(0, 8, 2)]


def _stepped(state: tuple[Words, Words], increment: tuple[Words, Words]) -> tuple[Words, Words]:
    """Return the next state of PCG64, as its high and low words."""
    a, b = np.uint64(_MULTIPLIER >> 64), np.uint64(_MULTIPLIER & 2**64 - 1)
    high, low = state
    b0, b1, l0, l1 = b & _WORD, b >> _HALF, low & _WORD, low >> _HALF
    middle = l0 * b1 + (l0 * b0 >> _HALF)
    carry = l1 * b0 + (middle & _WORD)
    product = high * b + low * a + l1 * b1 + (middle >> _HALF) + (carry >> _HALF)
    return _added((product, low * b), increment)


def _added(x: tuple[Words, Words], y: tuple[Words, Words]) -> tuple[Words, Words]:
    """Return the sum of numbers of 128 bits, as its high and low words."""
    low = x[1] + y[1]
    return x[0] + y[0] + (low < y[1]), low


# --------------------------------------------------------------------------------------------------
# Distances from obstacles and lines of sight: for starts, and for the views of tasks.
# --------------------------------------------------------------------------------------------------

Floats = NDArray[np.float64]


def nearest_obstacle(
    obstacles: Sequence[Obstacle], centers: Floats, points: Floats
) -> tuple[Floats, Floats]:
    """Return distances (n,) of points (n, 3) in I from the nearest obstacle's surface [m].

    They are negative inside, and infinite without obstacles. The second array (n, 3) holds vectors
    to the nearest points, in I [m]; `centers` (n, obstacles, 3) belong to the obstacles.
    """
    distances, vectors = np.full(len(points), np.inf), np.zeros((len(points), 3))
    given = (np.ascontiguousarray(array, np.float64) for array in (points, centers))
    entries.nearest_obstacles(*given, _settings(tuple(obstacles)), distances, vectors)
    return distances, vectors


def hidden_points(
    obstacles: Sequence[Obstacle], centers: Floats, eyes: Floats, points: Floats
) -> NDArray[np.bool_]:
    """Return a mask (n, m) of points (m, 3) or (n, m, 3) behind an obstacle, seen from eyes (n, 3).

    All are in I [m], as are the centers (n, obstacles, 3) of the obstacles.
    """
    each = np.broadcast_to(points, (len(eyes), *points.shape[-2:]))
    hidden = np.zeros(each.shape[:2], bool)
    given = (np.ascontiguousarray(array, np.float64) for array in (eyes, each, centers))
    entries.hide_points(*given, _settings(tuple(obstacles)), hidden)
    return hidden


@functools.lru_cache(maxsize=64)
def _settings(obstacles: tuple[Obstacle, ...]) -> NDArray[Any]:
    """Return settings with the shapes of obstacles, shape (1,)."""
    settings = np.zeros(1, SETTINGS)
    pack_obstacles(settings[0], obstacles)
    return settings


def require_room(name: str, points: Floats, world: WorldParams) -> None:
    """Refuse places (n, 3) that an obstacle may reach by its shift, or beyond the geofence."""
    reach: list[Floats] = []
    for k, obstacle in enumerate(world.obstacles):
        shared = 0.0 if obstacle.follows is None else reach[obstacle.follows]
        reach.append(np.array(obstacle.shift_I) + shared)
        gap = points - np.array(obstacle.center_I)
        aslant = min(abs(part) for part in obstacle.axis) > 1e-9
        if not aslant:  # the shift that comes nearest is the one that does along each axis
            gap = np.sign(gap) * np.maximum(np.abs(gap) - reach[k], 0.0)
        distance, _ = nearest_obstacle([obstacle], np.zeros((len(points), 1, 3)), gap)
        if aslant:  # at most so much nearer
            distance = distance - float(np.linalg.norm(reach[k]))
        close = np.flatnonzero(distance <= world.vehicle_radius)
        if close.size:
            shifted = ", shifted as it may be," if reach[k].any() else ""
            raise ValueError(
                f"{name} must be farther than vehicle_radius={world.vehicle_radius:g} m from all "
                f"obstacles, got {points[close[0]]}, which obstacle {k}{shifted} comes as near as "
                f"{max(float(distance[close[0]]), 0.0):.3g} m to"
            )
    if world.geofence is not None:
        low, high = world.geofence
        beyond = np.flatnonzero(((points < low) | (points > high)).any(axis=1))
        if beyond.size:
            raise ValueError(
                f"{name} must be within the geofence {world.geofence}, got {points[beyond[0]]}"
            )


# --------------------------------------------------------------------------------------------------
# Checks of references: a vehicle can follow them, and begin episodes at them.
# --------------------------------------------------------------------------------------------------

MAX_THRUST = 2.0
"""Largest thrust-to-weight ratio that an action commands; motor voltages have no such limit."""

SHARPNESS = {"circle": 1.0, "lemniscate": 17.0 / 8.0}
"""Largest acceleration of a reference over its radius times its squared frequency, by task."""

LARGER, FASTER = 1.25, 0.8
"""Factors on radius and period of the sharpest draw, with `randomize_reference`."""


def check_reference(
    task: TaskParams, vehicle: VehicleParams, actions: ActionParams, control: Control
) -> None:
    """Refuse references that need more than the assumed vehicle or the scales of actions allow."""
    limits: dict[str, Any] = {"max_tilt": task.max_tilt}
    if control in (Control.WRENCH, Control.CTBR, Control.ATTITUDE):
        limits["max_thrust"] = min(
            MAX_THRUST * vehicle.mass * vehicle.gravity, 4.0 * vehicle.max_rotor_force
        )
    if control is Control.CTBR:
        limits["max_body_rates"] = actions.rate_scale
    elif control is Control.ATTITUDE:  # roll and pitch at full action, together
        cosine = math.cos(actions.tilt_scale)
        limits["max_tilt"] = min(task.max_tilt, math.acos(cosine * cosine))
    elif control is Control.VELOCITY:
        limits["max_speed"] = math.sqrt(3.0) * actions.velocity_scale
    for k, trajectory in enumerate(task.trajectories):
        name = "trajectory" if len(task.trajectories) == 1 else f"trajectory[{k}]"
        trajectory.check(vehicle, name=name, **limits)
    if task.kind in SHARPNESS:
        _check_period(task, vehicle, limits.get("max_thrust", 4.0 * vehicle.max_rotor_force))


def _check_period(task: TaskParams, vehicle: VehicleParams, limit: float) -> None:
    """Refuse a period whose centripetal acceleration needs more thrust than the limit [N]."""
    larger, faster = (LARGER, FASTER) if task.randomize_reference else (1.0, 1.0)
    omega = 2.0 * math.pi / (faster * task.period)
    acceleration = SHARPNESS[task.kind] * larger * task.radius * omega**2
    thrust = vehicle.mass * math.hypot(acceleration, vehicle.gravity)
    if thrust > limit:
        raise ValueError(
            f"period is infeasible for this vehicle: with radius={task.radius:g} m, "
            f"{task.period:g} s need an acceleration of {acceleration:.4g} m/s^2 and a thrust of "
            f"{thrust:.4g} N, above the limit of {limit:.4g} N"
        )


# ---- the ground ------------------------------------------------------------------------------


def check_standing(
    task: TaskParams, vehicle: VehicleParams, world: WorldParams, draws: DrawingTable
) -> None:
    """Refuse ground on which the vehicle cannot stand, or where no episode of a task can begin.

    A foot has to be below all rotor hubs, as standing on these is a crash; a start on the ground
    has to be within `TaskParams.out_of_bounds` of the reference.
    """
    if world.ground is None:
        return
    feet, hubs = (np.array(p)[:, 2] for p in (world.ground.feet_B, vehicle.rotor_positions_B))
    if feet.max() >= hubs.min():
        raise ValueError(
            "GroundParams.feet_B must be below the vehicle's lowest rotor hub, at "
            f"{hubs.min():g} m, got {feet.max():g} m"
        )
    standing = world.ground_height - world.ground.feet_B[0][2]
    column = COLUMNS["start_position_I"].stop - 1
    lower, upper = (max(float(ends[column]), 0.0) for ends in (draws.low, draws.high))
    for low, high in _reference_heights(task):
        above, below = standing + lower - high, low - (standing + upper)
        # a start in the air is near the reference, unless the ground lifts it
        distance = max(above, below) if task.may_start_on_ground else above
        if distance > task.out_of_bounds:
            begins = f"{low:g}" if low == high else f"{low:g} to {high:g}"
            raise ValueError(
                "WorldParams.ground_height must let a vehicle stand within "
                f"out_of_bounds={task.out_of_bounds:g} m of the reference, which begins at a "
                f"height of {begins} m, got {world.ground_height:g}, where it stands at "
                f"{standing:g} m"
            )


def check_pad(c: FlightConfiguration) -> None:
    """Refuse a launch pad, at height 0, that is out of bounds wherever a reference begins."""
    task, elsewhere = c.task, "start_position_I" in c.randomization.names
    if c.world.ground is not None or elsewhere or not task.may_start_on_ground:
        return
    distance = max(max(low, -high, 0.0) for low, high in _reference_heights(task))
    if distance > task.out_of_bounds:
        raise ValueError(
            f"out_of_bounds must be at least {distance:g} m, or start 'hover' or 'moving': with "
            f"start={task.start!r} episodes begin on the launch pad, {distance:g} m from the "
            f"reference, got out_of_bounds={task.out_of_bounds:g} m"
        )


def _reference_heights(task: TaskParams) -> list[tuple[float, float]]:
    """Return the lowest and highest start of each reference of a task [m]."""
    if task.kind == "waypoints":
        return [(LOWEST_GATE * task.height, (LOWEST_GATE + GATE_SPREAD) * task.height)]
    if task.kind == "random_trajectory":
        rise = RANDOM_RISE * task.radius
        return [(task.height - rise, task.height + rise)]
    if task.kind != "trajectory":
        return [(task.height, task.height)]
    heights = []
    for path in task.trajectories:
        anywhere = task.randomize_reference and path.closed
        z = path(path.instants(200))[:, 2] if anywhere else path(0.0)[2:3]
        heights.append((float(z.min()), float(z.max())))
    return heights


# ---- given starts ----------------------------------------------------------------------------


def check_in_bounds(task: TaskParams, places: Floats) -> None:
    """Refuse starts (n, 3) in I [m] with which an episode would end in its first step."""
    distance = distance_from_reference(task, places)
    worst = int(distance.argmax())
    if distance[worst] > task.out_of_bounds:
        raise ValueError(
            f"position must be within out_of_bounds={task.out_of_bounds:g} m of the reference, got "
            f"{places[worst]}, {distance[worst]:g} m from where that begins"
        )


def distance_from_reference(task: TaskParams, places: Floats) -> Floats:
    """Return distances (n,) of positions (n, 3) in I from the nearest beginning of a reference."""
    radius, height = task.radius, task.height
    if task.kind == "trajectory":
        return np.min([_from_path(path, task, places) for path in task.trajectories], axis=0)
    if task.kind == "random_trajectory":
        return np.maximum(np.linalg.norm(places - (0.0, 0.0, height), axis=1) - radius, 0.0)
    if task.kind == "waypoints":
        gates = LOWEST_GATE * height, (LOWEST_GATE + GATE_SPREAD) * height
        return _from_ring(places, (0.4 * radius, radius), gates)
    if task.kind == "lemniscate":
        return np.linalg.norm(places - (0.0, 0.0, height), axis=1)
    if task.randomize_reference:
        return _from_ring(places, (0.5 * radius, 1.25 * radius), (height, height))
    return np.linalg.norm(places - (radius, 0.0, height), axis=1)


def _from_ring(places: Floats, radii: tuple[float, float], heights: tuple[float, float]) -> Floats:
    """Return distances (n,) from the region between two radii and two heights."""
    level, z = np.hypot(places[:, 0], places[:, 1]), places[:, 2]
    aside = np.maximum(np.maximum(radii[0] - level, level - radii[1]), 0.0)
    return np.hypot(aside, np.maximum(np.maximum(heights[0] - z, z - heights[1]), 0.0))


def _from_path(path: Trajectory, task: TaskParams, places: Floats) -> Floats:
    """Return distances (n,) from the beginnings of a trajectory, at any drawn heading."""
    if not task.randomize_reference:
        return np.linalg.norm(places - path(0.0), axis=1)
    points = path(path.instants(200)) if path.closed else path(0.0)[np.newaxis]
    level = np.hypot(points[:, 0], points[:, 1])
    rings = [_from_ring(places, (r, r), (z, z)) for r, z in zip(level, points[:, 2], strict=True)]
    return np.min(rings, axis=0)


# --------------------------------------------------------------------------------------------------
# Arguments of a reset: random streams, flights, and their initial states.
# --------------------------------------------------------------------------------------------------

MAX_SPEED = 1e4
"""Largest initial speed [m/s]: several times faster than any bullet, with drag still integrable."""


def checked_keys(
    count: int, seeds: Sequence[int | None] | None, keys: ArrayLike | None
) -> NDArray[np.uint64] | None:
    """Return keys (count, 2): of the seeds if given, else `keys`; None without either."""
    if seeds is not None:
        if isinstance(seeds, str) or not hasattr(seeds, "__len__"):  # type: ignore[unreachable]
            raise ValueError(f"seeds must contain {count} seeds, got {seeds!r}")
        if len(seeds) != count:
            raise ValueError(f"seeds must contain {count} seeds, got {len(seeds)}")
        return stream_keys(seeds)
    if keys is None:
        return None
    words = np.asarray(keys)
    if words.shape != (count, 2) or words.dtype != np.uint64:
        raise ValueError(
            f"keys must be uint64 of shape ({count}, 2), got {words.dtype} of {words.shape}"
        )
    return words


def checked_start(
    count: int,
    position: ArrayLike | None,
    velocity: ArrayLike | None,
    yaw: ArrayLike | None,
    task: TaskParams,
    world: WorldParams | None = None,
    chosen: NDArray[np.bool_] | None = None,
) -> NDArray[np.float64] | None:
    """Return initial values (count, 7), NaN where they are to be drawn; None if all are.

    Positions of `chosen` flights (count,) have to be free of the world's obstacles. Starts from
    which no flight can begin are refused, as are speeds above MAX_SPEED and yaws beyond a turn.
    """
    if position is None and velocity is None and yaw is None:
        return None
    given = np.full((count, 7), np.nan)
    for name, value, columns in (
        ("position", position, slice(0, 3)),
        ("velocity", velocity, slice(3, 6)),
        ("yaw", yaw, slice(6, 7)),
    ):
        if value is None:
            continue
        width = columns.stop - columns.start
        try:
            if check.holds_no_numbers(value):
                raise TypeError
            numbers = np.asarray(value, np.float64)
        except (TypeError, ValueError, OverflowError):
            raise ValueError(f"{name} must be numbers, got {value!r}") from None
        if name == "yaw":
            numbers = numbers[..., np.newaxis]
        if numbers.shape not in ((width,), (count, width)):
            shapes = "a number or (n,)" if name == "yaw" else "(3,) or (n, 3)"
            raise ValueError(f"{name} must have shape {shapes}, got {np.shape(value)}")
        if not np.isfinite(numbers).all():
            raise ValueError(f"{name} must be finite, got {value!r}")
        given[:, columns] = numbers
    reach = 1.5 * task.radius + 1.3 * task.height  # of any reference from the origin
    reach = max((path.reach for path in task.trajectories), default=reach)
    farthest = task.out_of_bounds + reach
    with np.errstate(over="ignore"):  # infinite lengths are refused like others; NaN never is
        distance, speed = (np.linalg.norm(given[:, k : k + 3], axis=1).max() for k in (0, 3))
    if distance > farthest:
        raise ValueError(
            f"position must be within {farthest:g} m of the origin: farther, a start is beyond "
            f"out_of_bounds={task.out_of_bounds:g} m of the reference, got {distance:g} m"
        )
    if world is not None and position is not None:
        require_room("position", given[:, :3] if chosen is None else given[chosen, :3], world)
    if speed > MAX_SPEED:
        raise ValueError(f"velocity must be at most {MAX_SPEED:g} m/s, got {speed:g} m/s")
    if yaw is not None:
        check.angle("yaw", float(given[np.abs(given[:, 6]).argmax(), 6]))
    return given


def checked_mask(count: int, mask: ArrayLike | None) -> NDArray[np.bool_]:
    """Return the mask (count,) of flights; all of them without a mask."""
    if mask is None:
        return np.ones(count, bool)
    chosen = np.asarray(mask)
    if chosen.shape != (count,) or chosen.dtype != bool:
        raise ValueError(
            f"mask must be {count} booleans, got shape {chosen.shape} of {chosen.dtype}"
        )
    return chosen


# --------------------------------------------------------------------------------------------------
# Cold starts: limits of the uncertainty of a filter's first estimate.
#
# A filter starts level, with a linearized model, whose error is half the square of the attitude
# error. This error enters velocity and position before the first fix, where the covariance lacks
# it; updates in steps, as of images, do not remove it. Up to the bounds below, the mean NEES of 15
# states stays under 17, see `tests/statistical/test_vague_starts.py`.
# --------------------------------------------------------------------------------------------------

MAX_START_TILT = 0.15
"""Root mean square of a drawn roll or pitch, and of the error of the magnetic heading by it [rad].

No sensor measures the tilt of a start: the accelerometer of a vehicle that hovers measures its
thrust, which is along the body z axis at any tilt."""

MAX_BASELINE_SIGMA = 0.15
"""Standard deviation of the heading from the first baseline, whose noise averages out [rad]."""
MAX_HEADING_SIGMA = 0.1
"""Standard deviation of the heading of a mark, or due to hard iron, which lasts [rad]."""
MAX_HEADING_SIGMA_INDOORS = 1.0
"""The same with a camera and without GNSS: images correct it in steps [rad]."""
MAX_POSITION_SIGMA = 1.0
"""Standard deviation of the position of a mark without GNSS, with features 8 m away [m]."""


def check_cold_start(sensors: SensorSuite, draws: DrawingTable) -> None:
    """Refuse tilts from which a filter cannot start, and warn of too uncertain starts."""
    source = sensors.heading_source
    heading = None if source is None else source.first_heading
    slope = 0.0 if heading is None else heading.slope
    most = MAX_START_TILT / max(slope, 1.0)
    for name in ("start_roll", "start_pitch"):
        if name not in draws.names:
            continue
        tilt = math.sqrt(draws.mean_square(name)[0])
        if tilt > most:
            by = "" if slope <= 1.0 else ", as it turns the magnetic heading"
            uniform = math.floor(1000.0 * math.sqrt(3.0) * most) / 1000.0
            raise ValueError(
                f"{name} must have a root mean square of at most {most:.3g} rad (uniform within "
                f"+-{uniform:g} rad) with filter_start='cold'{by}, got {tilt:.3g} rad: a cold "
                "filter assumes a level vehicle; filter_start='warm' takes any tilt"
            )
    for field, value, bound, unit in _vague(sensors):
        warnings.warn(
            f"{field} is {value:.3g} {unit}, more than {bound:.3g} {unit}: after a cold start the "
            "filter is overconfident, as its linearized model does not hold for errors so large; "
            "filter_start='warm' (of quad-gym train: --env filter_start=warm) begins with a "
            "converged filter, if these sensors let it converge in 10 s of hovering",
            UserWarning,
            stacklevel=4,
        )


def _vague(sensors: SensorSuite) -> Iterator[tuple[str, float, float, str]]:
    """Fields that exceed their bounds: name, value, bound and unit."""
    pose, source, bounds = sensors.initial_pose, sensors.heading_source, []
    heading = None if source is None else source.first_heading
    if heading is not None:
        most = MAX_HEADING_SIGMA if heading.lasting else MAX_BASELINE_SIGMA
        name = f"{type(source).__name__}.{heading.field}"
        bounds.append((name, heading.sigma, most * heading.per_radian, heading.unit))
    else:
        images = not sensors.has_fixes and sensors.blocks_of("pixels") > 0
        most = MAX_HEADING_SIGMA_INDOORS if images else MAX_HEADING_SIGMA
        bounds.append(("InitialPoseParams.heading_sigma", pose.heading_sigma, most, "rad"))
    if not sensors.has_fixes:
        sigma = pose.position_sigma
        bounds.append(("InitialPoseParams.position_sigma", sigma, MAX_POSITION_SIGMA, "m"))
    return ((name, value, most, unit) for name, value, most, unit in bounds if value > most)


# --------------------------------------------------------------------------------------------------
# Warm starts: the covariance that a filter has reached before a flight begins.
#
# Before any real take-off the filter has been running for a while. Its covariance then depends on
# the sensors and hardly on the flight, so it is computed once per configuration: flights hover
# where the task begins, each with its own noise, and every episode begins with the mean of their
# covariances, rotated to a common heading.
# --------------------------------------------------------------------------------------------------

WARM_UP = 10.0
"""Time for which a filter has been running at a warm start [s]: several correlation times of its
velocity and attitude, as between switching a vehicle on and its take-off."""

FLIGHTS = 8  #: flights whose covariances are averaged

LOST = 0.35
"""Attitude error above which a filter has diverged, whatever its covariance [rad]: the linear model
is wrong by half its square. Overconfidence alone is no reason to refuse a warm start."""

MAX_HEIGHT_SIGMA, MAX_HEIGHT_SHARE = 1.0, 0.5
"""Standard deviation of the height [m], and its share of the height, that a warm start with optical
flow may have. Flow is velocity over height: at 2 m, the mean NEES of 15 states is 15.4 up to 0.8 m,
17.5 at 1.4 m, and 100 without a sensor of the height."""


def pack_warm_start(settings: Any, make: Callable[..., Any], c: FlightConfiguration) -> None:
    """Fill the fields of a warm start in a SETTINGS record; `make` makes a `FlightBatch`."""
    height, ground = c.world.ground_height, c.world.ground
    P = converged_covariance(
        make,
        vehicle=c.vehicle,
        sensors=c.sensors,
        task=c.task,
        world=WorldParams(ground_height=height),
        standing=0.0 if ground is None else height - ground.feet_B[0][2],
        substeps=c.substeps,
    )
    W = root_with_truth(P, c.sensors)
    settings["warm"] = True
    states, draws = W.shape
    order = np.argsort(shown_rows(states))
    settings["warm_root"][:states, :draws] = W[order]
    settings["warm_covariance"][:states, :states] = portable.product(W[order], W[order].T)
    drift = c.flown_sensors.drift_after(WARM_UP)
    settings["warm_drift_sigma"][: len(drift)] = drift


@functools.lru_cache(maxsize=64)
def converged_covariance(
    make: Callable[..., Any],
    *,
    vehicle: VehicleParams,
    sensors: SensorSuite,
    task: TaskParams,
    world: WorldParams,
    standing: float,
    substeps: int,
) -> Floats:
    """Return the mean covariance that filters reach from a cold start in `WARM_UP` of hovering.

    It is that of a vehicle that looks east, in the order r, v, e, b_a, b_g and then the slow errors
    of sensors. Filters that fail or diverge on the way are refused, as without a known heading.
    """
    with warnings.catch_warnings():  # that the start is vague, as errors are drawn from P itself
        warnings.simplefilter("ignore", UserWarning)
        batch = make(
            FLIGHTS,
            vehicle=vehicle,
            sensors=sensors,
            task=task.replace(start="hover"),
            world=world,
            source=Source.TRUTH,
            control=Control.VELOCITY,
            control_rate=sensors.imu.rate / round(WARM_UP * sensors.imu.rate),
            substeps=substeps,
            run_filter=True,
            autoreset=Autoreset.DISABLED,
            threads=1,
        )
    batch.reset(seeds=range(FLIGHTS))
    if task.start == "ground":
        r = batch.record("r")
        r[:, 2] = standing
        batch.reset(seeds=range(FLIGHTS), position=r, velocity=np.zeros((FLIGHTS, 3)))
    batch.step(np.zeros((FLIGHTS, 4)))  # one step, as long as the whole
    if batch.record("filter_status").any():
        raise ValueError(
            f"filter_start must be 'cold' for these sensors: the filter fails within {WARM_UP:g} s "
            "of hovering"
        )
    R_error = quaternion_to_dcm(batch.record("q")) @ batch.record("R_hat").transpose(0, 2, 1)
    angle = float(np.abs(dcm_to_euler(R_error)).max())
    if angle > LOST:
        raise ValueError(
            f"filter_start must be 'cold' for these sensors: after {WARM_UP:g} s of hovering the "
            f"attitude is wrong by {math.degrees(angle):.0f} degrees. Does anything observe the "
            "heading, such as a level baseline or the heading of `initial_pose`?"
        )
    states = 15 + len(slow_states(sensors).errors)
    joint = joint_covariance(batch.record("P"), batch.record("P_slow"))[:, :states, :states]
    mean = np.zeros((states, states))
    for q, P in zip(batch.record("q"), joint, strict=True):
        turn = _turned_east(q, sensors).T[:states, :states]
        mean += portable.product(portable.product(turn, P), turn.T) / FLIGHTS
    _require_height(batch, sensors, math.sqrt(mean[2, 2]))
    return 0.5 * (mean + mean.T)


def _require_height(batch: Any, sensors: SensorSuite, sigma: float) -> None:
    """Refuse a warm start with optical flow where the height is too uncertain."""
    height = float(batch.record("r")[:, 2].mean()) - batch.world.ground_height
    most = max(MAX_HEIGHT_SIGMA, MAX_HEIGHT_SHARE * height)
    if sensors.optical_flow is not None and sigma > most:
        raise ValueError(
            f"filter_start must be 'cold' for these sensors: after {WARM_UP:g} s of hovering at "
            f"{height:.2g} m the standard deviation of the height is {sigma:.2g} m, at most "
            f"{most:.2g} m expected with optical flow. Add a sensor of the height, such as "
            "`range_finder`"
        )


def _turned_east(q: Floats, sensors: SensorSuite) -> Floats:
    """Return the rotation (24, 24) of quantities in I from a vehicle that looks east to this one.

    Three time-correlated errors of an aiding sensor are in B, such as hard iron. Their correlation
    with the heading error depends on the direction of the field, so they are kept as seen from I.
    """
    w, x, y, z = map(float, q)
    forward = (w * w + x * x - y * y - z * z, 2.0 * (x * y + w * z))
    c, s = (component / portable.norm(forward) for component in forward)
    turn, level, states = np.eye(MAX_STATES), np.eye(3), slow_states(sensors)
    level[:2, :2] = [[c, -s], [s, c]]
    for first in (0, 3, *([15] if states.drifts else [])):
        turn[first : first + 3, first : first + 3] = level
    for first in states.vectors:
        if first >= 0:
            turn[15 + first : 18 + first, 15 + first : 18 + first] = level.T
    return turn


def root_with_truth(P: Floats, sensors: SensorSuite) -> Floats:
    """Return W with W W^T = P, some of whose columns belong to the true biases and drifts.

    A filter that started from the distribution of the biases, of covariance S, has an estimate that
    is independent of its error, so that cov(error, bias) = P_b, the columns of P for the biases.
    Errors W u have it with u = (n, S^-1/2 bias), where n are standard normals. Time-correlated
    errors of sensors are treated in the same way.

    W is (n, WARM_DRAWS + 2 (n - 15)): the columns of the biases follow the first fifteen, and then,
    in threes, the columns of the time-correlated errors alone and of their true values.
    """
    imu = sensors.imu
    sigma = np.repeat([imu.accel_bias_sigma, imu.gyro_bias_sigma], 3)
    slow = np.array([error.sigma for error in slow_states(sensors).errors])
    drift = sensors.drift_after(WARM_UP)
    slow[: len(drift)] = np.maximum(drift, MIN_DRIFT)
    sigma = np.concatenate([sigma, slow])
    W = np.zeros((len(P), WARM_DRAWS + 2 * len(slow)))
    with_truth = P[:, 9:] / sigma
    # the part that the truth does not explain; where it explains all, rounding leaves a rest
    rest = portable.lower_root(P - portable.product(with_truth, with_truth.T), np.diag(P))
    W[:, :15], W[:, 15:21] = rest[:, :15], with_truth[:, :6]
    for k in range(0, len(slow), 3):
        own = WARM_DRAWS + 2 * k
        W[:, own : own + 3] = rest[:, 15 + k : 18 + k]
        W[:, own + 3 : own + 6] = with_truth[:, 6 + k : 9 + k]
    return W

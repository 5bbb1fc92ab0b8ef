"""User-defined trajectories in all interfaces: kernels against `Trajectory`, and options."""

import gymnasium
import numpy as np
import pytest

import quad_gym
from baselines import PDPolicy
from quad_gym import FlightBatch, FlightRecorder, TaskParams, Trajectory, Wall, WorldParams
from quad_gym.batch.starts import nearest_obstacle
from quad_gym.envs.single import QuadEnv
from quad_gym.envs.vector import QuadVectorEnv
from quad_gym.records import Source
from quad_gym.rotations import quaternion_to_dcm
from tests.builders import batch, part

FIVE = [(0, 0, 1.5), (1, 0.5, 2), (1, -0.5, 1), (-1, 0.5, 2), (-1, -0.5, 1)]
WHEN = [0.0, 1.0, 2.2, 3.2, 4.8]
RADIUS = {"out_of_bounds": 50.0, "max_tilt": np.pi, "min_height": -50.0}
TRUTH = {"source": Source.TRUTH, "run_filter": False, "threads": 1}
OPEN = Trajectory.through(FIVE, WHEN, yaw=[0.0, 0.5, 1.0, 1.5, 2.0])
CLOSED = Trajectory.through(FIVE, [*WHEN, 6.2], closed=True, look_at=(0.2, 5.0))
BEND = [(0, 0, 1), (1, 0.2, 1.5), (2, 1, 1.5), (2.4, 2.5, 1)]
ALONG = Trajectory.through(BEND, [0, 1, 2.2, 4.2], yaw="along", minimize="jerk")
SEVERAL = (OPEN, CLOSED, ALONG)


def batch_of(trajectory, count=9, **options):
    task = TaskParams(
        kind="trajectory", start="hover", trajectory=trajectory, **{**RADIUS, **options}
    )
    return FlightBatch(count, task=task, control_rate=50.0, **TRUTH)


def direction(angle):
    return np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=-1)


def assert_on_reference(batch, time):
    """Check the kernels' reference against the trajectories of the flights."""
    for i in range(batch.count):
        path, phase = batch.trajectory(i)
        t = time + phase
        for k, name in enumerate(("path_r", "path_v", "path_a")):
            np.testing.assert_allclose(
                batch.record(name)[i], path(t, k), rtol=0.0, atol=1e-12 * (1 + 100 * k)
            )
        heading, speed = direction(path.yaw(t)), np.linalg.norm(path(t, 1))
        miss = 1e-12 * max(1.0, 1.0 / (speed + 1e-6))  # for the direction of a small velocity
        np.testing.assert_allclose(batch.record("path_x")[i], heading, rtol=0.0, atol=miss)
        ahead = path(t + np.array(batch.task.preview))
        np.testing.assert_allclose(batch.record("path_ahead")[i], ahead, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("randomize", [False, True])
@pytest.mark.parametrize("preview", [(0.2, 0.4), (0.0, 1.0)])
def test_kernel_reference_equals_python_trajectory(randomize, preview):
    batch = batch_of(SEVERAL, count=9, randomize_reference=randomize, preview=preview)
    batch.reset(seeds=range(9))
    assert len(set(batch.record("path"))) == 3
    for step in range(350):  # at knots, and past the ends
        if step % 10 == 0:
            assert_on_reference(batch, step / 50.0)
        error = np.linalg.norm(batch.record("r") - batch.record("path_r"), axis=1)
        np.testing.assert_allclose(batch.record("position_error"), error, rtol=1e-12)
        batch.step()


def test_kernel_reference_is_accurate_with_many_segments_and_long_flights():
    rng = np.random.default_rng(0)
    places = np.cumsum(rng.normal(size=(300, 3)) * 0.3, axis=0)
    path = Trajectory.through(places, np.arange(300.0), yaw=np.cumsum(rng.normal(size=300)))
    batch = batch_of(path, count=3)
    batch.reset(seeds=range(3))
    for tick in (0.0, 12_345.0, 44_444.0, 59_799.0, 59_800.0, 80_000.0):
        batch._blocks["tick"] = tick - 4.0
        batch.step()
        t = batch.record("tick")[0] / 200.0
        assert t == tick / 200.0
        for k, name in enumerate(("path_r", "path_v", "path_a")):
            np.testing.assert_allclose(batch.record(name)[0], path(t, k), rtol=0, atol=1e-10)


def test_an_episode_draws_its_trajectory_phase_and_turn():
    n = 3000
    plain = batch_of(SEVERAL, count=n)
    plain.reset(seeds=range(n))
    counts = np.bincount(plain.record("path").astype(int), minlength=3)
    assert abs(counts - n / 3).max() < 5.0 * np.sqrt(n * 2 / 9)
    assert (plain.record("path_turn") == [1.0, 0.0]).all()
    assert (plain.record("path_share") == 0.0).all()
    drawn = batch_of(SEVERAL, count=n, randomize_reference=True)
    drawn.reset(seeds=range(n))
    np.testing.assert_array_equal(drawn.record("path"), plain.record("path"))
    share = drawn.record("path_share")
    turn = np.arctan2(*drawn.record("path_turn").T[::-1]) / (2.0 * np.pi) % 1.0
    for values in (share, turn):
        deciles = np.histogram(values, 10, (0.0, 1.0))[0]
        assert abs(deciles - n / 10).max() < 5.0 * np.sqrt(n * 0.09)
    assert abs(np.corrcoef(share, turn)[0, 1]) < 5.0 / np.sqrt(n)
    again = drawn.record("path")
    drawn.reset()
    assert (drawn.record("path") != again).any()


def test_a_users_task_sees_the_reference():
    seen = {}

    class Watch(quad_gym.Task):
        def reward(self, view):
            seen.update(r=view.reference_position.copy(), v=view.reference_velocity.copy())
            return super().reward(view)

    keywords = {"trajectory": SEVERAL, "randomize_reference": True, "observation": "truth"}
    envs = QuadVectorEnv(4, base="trajectory", task=Watch(), **keywords)
    plain = QuadVectorEnv(4, "trajectory", **keywords)
    envs.reset(seed=3), plain.reset(seed=3)
    for k in range(1, 20):
        action = np.zeros((4, 4))
        rewards = [env.step(action)[1] for env in (envs, plain)]
        np.testing.assert_array_equal(*rewards)
        for i in range(4):
            path, phase = envs.flights.batch.trajectory(i)
            np.testing.assert_allclose(seen["r"][i], path(phase + k / 50), rtol=0.0, atol=1e-12)
            np.testing.assert_allclose(seen["v"][i], path(phase + k / 50, 1), rtol=0.0, atol=1e-10)


def test_recorded_flight_contains_its_trajectory(tmp_path):
    env = QuadEnv(
        "trajectory", trajectory=[CLOSED, OPEN], randomize_reference=True, observation="truth"
    )
    recorder = FlightRecorder(env.flights.batch)
    policy, times = PDPolicy(env), np.linspace(0.0, 7.0, 50)
    for seed in (0, 1, 5):
        observation, _ = env.reset(seed=seed)
        recorder.keep()
        for _ in range(30):
            observation, *_ = env.step(policy.predict(observation)[0])
            recorder.keep()
        path, phase = env.flights.batch.trajectory(0)
        flight = recorder.flight
        expected = path(flight["time"] + phase)
        np.testing.assert_allclose(flight["reference_position"], expected, rtol=0.0, atol=1e-12)
        loaded = quad_gym.Flight.load(flight.save(tmp_path / f"{seed}.npz"))
        for scene in (flight.scene, loaded.scene):
            np.testing.assert_allclose(
                scene.reference(times), path(times + phase), rtol=0.0, atol=1e-12
            )
            assert scene.reference_period == path.duration


@pytest.mark.parametrize("action", ["ctbr", "attitude", "velocity"])
def test_pd_control_follows_default_trajectory(action):
    layout = "absolute" if action == "velocity" else "relative"
    env = gymnasium.make_vec(
        "QuadGym/Trajectory-v0", num_envs=20, action=action, layout=layout, randomize_reference=True
    )
    policy, errors = PDPolicy(env), []
    observation, _ = env.reset(seed=0)
    for _ in range(400):
        observation, _, terminated, _, info = env.step(policy.predict(observation)[0])
        assert not terminated.any()
        errors.append(info["position_error"])
    assert np.mean(errors[150:]) < 0.15


def test_time_limit_defaults_to_duration_of_trajectory():
    for given, seconds in ((OPEN, 4.8), (CLOSED, 6.2), (SEVERAL, 6.2), (None, 10.0)):
        env = QuadEnv("trajectory", trajectory=given, observation="truth")
        assert env.flights.batch.max_steps == round(50 * seconds)
    assert QuadEnv("trajectory", trajectory=OPEN, duration=7.0).flights.batch.max_steps == 350
    env = QuadEnv("trajectory", trajectory=OPEN, max_episode_steps=40)
    assert env.flights.batch.max_steps == 40


def test_trajectory_is_read_from_path_of_table(tmp_path):
    file = tmp_path / "path.csv"
    rows = [f"{t},{x},{y},{z}" for t, (x, y, z) in zip(WHEN, FIVE, strict=True)]
    file.write_text("\n".join(["time,x,y,z", *rows]))
    for given in (file, str(file), [file, CLOSED]):
        env = QuadEnv("trajectory", trajectory=given, observation="truth")
        assert env.flights.task.trajectories[0] == Trajectory.through(FIVE, WHEN)


def test_infeasible_or_invalid_trajectory_is_refused():
    fast = Trajectory.through(FIVE, max_speed=8.0, max_acceleration=30.0)
    with pytest.raises(
        ValueError, match=r"trajectory is infeasible .*: it needs .* at .* s .segment . of 4"
    ):
        gymnasium.make("QuadGym/Trajectory-v0", trajectory=fast)
    with pytest.raises(ValueError, match=r"trajectory\[1\] is infeasible for this vehicle"):
        gymnasium.make_vec("QuadGym/Trajectory-v0", num_envs=2, trajectory=[OPEN, fast])
    far = Trajectory.through([(0, 0, 1), (2000, 0, 1)])
    for keywords, message in (
        (
            {"task": "circle", "trajectory": OPEN},
            r"trajectory has no effect on the task circle \(only on trajectory\)",
        ),
        ({"trajectory": 3}, "must be a Trajectory or a sequence of them"),
        ({"trajectory": "nowhere.csv"}, "trajectory must be a file that can be read"),
        ({"trajectory": []}, "must be a Trajectory or a sequence of them"),
        ({"trajectory": [OPEN, 3]}, "trajectory must be a Trajectory"),
        ({"trajectory": far}, "must stay within 1000 m"),
        ({"radius": 3.0}, "radius has no effect on the task trajectory"),
        ({"period": 3.0}, "period has no effect on the task trajectory"),
        ({"max_speed": 3.0}, r"max_speed has no effect .* \(only on random_trajectory\)"),
    ):
        with pytest.raises(ValueError, match=message):
            QuadEnv(**{"task": "trajectory", **keywords})
    with pytest.raises(ValueError, match="trajectory has no effect on the task hover"):
        TaskParams(kind="hover", trajectory=OPEN)
    env = QuadEnv("trajectory", trajectory=OPEN, observation="truth")
    env.reset(options={"position": (2.0, 0.0, 1.0)})
    with pytest.raises(ValueError, match="position must be within"):
        env.reset(options={"position": (9.0, 0.0, 1.0)})


GAP = (
    Wall(center_I=(0.0, 5.5, 2.0), size=(0.2, 8.0, 4.0), shift_I=(0.0, 0.2, 0.0)),
    Wall(center_I=(0.0, -5.5, 2.0), size=(0.2, 8.0, 4.0), follows=0),
)
THROUGH = Trajectory.through([(-3, 0, 1.5), (0, 0, 1.5), (3, 1, 1.5)], max_speed=1.5)
INTO_A_WALL = Trajectory.through([(-3, 0, 1.5), (0, 3, 1.5), (3, 1, 1.5)], max_speed=1.5)


def fly(trajectory, world, count=4, **options):
    """Return positions, collisions, distances and obstacle centers of all ticks."""
    task = TaskParams(kind="trajectory", start="hover", trajectory=trajectory, duration=0.0)
    flights = batch(count, task=task, sensors="indoor", gains="tuned", world=world, **options)
    seconds = max(path.duration for path in task.trajectories)
    found = []
    for _ in range(round(seconds * flights.clocks.imu_rate)):
        flights.step()
        names = ("r", "collided", "obstacle_distance", "obstacle_center")
        found.append([flights.record(name) for name in names])
    return [np.array(part) for part in zip(*found, strict=True)]


def test_trajectory_through_a_gap_does_not_collide():
    world = WorldParams(obstacles=GAP)
    seeing = {"source": Source.TRUTH}  # walls hide markers, which makes the estimate worse
    r, collided, distance, centers = fly(THROUGH, world, **seeing)
    assert not collided.any()
    for k in range(0, len(r), 50):
        expected, _ = nearest_obstacle(GAP, centers[k][:, :2], r[k])
        np.testing.assert_allclose(distance[k], expected, atol=1e-12)
    assert (fly(THROUGH, WorldParams(), **seeing)[0] == r).all()


def test_trajectory_into_a_wall_collides():
    r, collided, distance, _ = fly(INTO_A_WALL, WorldParams(obstacles=GAP))
    assert collided[-1].all()
    first = collided.argmax(axis=0)
    radius = WorldParams().vehicle_radius
    for flight, k in enumerate(first):
        assert distance[k, flight] <= radius < distance[k - 1, flight]
        assert abs(r[k, flight, 0]) < 0.1 + radius + 1e-9


def test_own_task_observes_wall_and_reference_ahead_in_body_frame():
    class Sees(quad_gym.Task):
        def observe(self, view):
            return {
                "wall": view.observed.obstacle_vector,
                "ahead": view.observed.preview.reshape(-1, 6),
            }

    world = WorldParams(obstacles=GAP)
    made = {"trajectory": THROUGH, "world": world, "task": Sees(), "observation": "truth"}
    env = gymnasium.make_vec("QuadGym/Trajectory-v0", num_envs=3, **made)
    observations, _ = env.reset(seed=0)
    flights = env.unwrapped.flights
    lengths = np.linalg.norm(part(env, observations, "wall"), axis=1)
    np.testing.assert_allclose(lengths, flights.batch.record("obstacle_distance"), rtol=1e-5)
    q, path_r, ahead = map(flights.batch.record, ("q", "path_r", "path_ahead"))
    offsets = np.einsum("nij,nkj->nki", quaternion_to_dcm(q), ahead - path_r[:, np.newaxis])
    np.testing.assert_allclose(
        part(env, observations, "ahead").reshape(3, 2, 3), offsets, rtol=1e-5, atol=1e-6
    )

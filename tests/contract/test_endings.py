"""Endings are equal in every interface, and requested starts must be within bounds."""

import gymnasium
import numpy as np
import pytest

import quad_gym
from quad_gym import Cylinder, GroundParams, WorldParams
from quad_gym.envs.vector import QuadVectorEnv
from quad_gym.records import WIDTH, Ending
from tests.builders import batch as flights_of

CRASHES = {
    "out of bounds": ("Hover", {"action": "velocity"}, (1.0, 0.0, 0.0, 0.0)),
    "tipped over": ("Hover", {"action": "motor", "max_tilt": 0.5}, (0.3, 0.0, 0.0, 0.3)),
    "ground": (
        "Hover",
        {"action": "motor", "world": WorldParams(ground=GroundParams()), "out_of_bounds": 9.0},
        (-1.0, -1.0, -1.0, -1.0),
    ),
    "obstacle": (
        "Hover",
        {
            "action": "velocity",
            "out_of_bounds": 9.0,
            "world": WorldParams(obstacles=(Cylinder(center_I=(0.0, 0.0, 1.0), radius=2.0),)),
        },
        (1.0, 0.0, 0.0, 0.0),
    ),
}


class Late(quad_gym.Task):
    """Task whose methods return the endings of the built-in task."""

    def terminated(self, view):
        return view.builtin.terminated.copy()

    def truncated(self, view):
        return view.builtin.truncated.copy()


def ended_after(name, keywords, action):
    """Fly the episode of seed 3 in each interface; return its steps and its ending."""
    single = gymnasium.make(name, **keywords)
    together = gymnasium.make_vec(name, num_envs=2, **keywords)
    sb3 = quad_gym.make_sb3_vec_env(name, 2, seed=2, **keywords)
    single.reset(seed=3)
    together.reset(seed=[2, 3])
    sb3.reset()
    for k in range(1, 400):
        *_, terminated, truncated, info = single.step(np.array(action))
        *_, ends, cuts, infos = together.step(np.tile(action, (2, 1)))
        *_, done, sb3_infos = sb3.step(np.tile(action, (2, 1)))
        assert (terminated, truncated) == (ends[1], cuts[1])
        assert info["ending"] == infos["ending"][1]
        assert done[1] == (terminated or truncated)
        if done[1]:
            assert sb3_infos[1]["ending"] == info["ending"]
            assert sb3_infos[1]["TimeLimit.truncated"] == (truncated and not terminated)
            return k, terminated, truncated, info["ending"]
    raise AssertionError("the episode does not end")


@pytest.mark.parametrize(
    "own_task", [None, quad_gym.Task(), Late()], ids=["built-in", "own", "late"]
)
@pytest.mark.parametrize("crash", CRASHES)
def test_crash_at_time_limit_is_terminated_and_truncated(crash, own_task):
    task, keywords, action = CRASHES[crash]
    name = f"QuadGym/{task}-v0"
    if own_task is not None:
        name = f"Test/{task}{type(own_task).__name__}-v0"
        if name not in gymnasium.registry:
            quad_gym.register_task(name, own_task, f"QuadGym/{task}-v0")
    steps, terminated, truncated, ending = ended_after(name, keywords, action)
    assert (terminated, truncated) == (True, False)
    rate = gymnasium.make(name, **keywords).unwrapped.flights.control_rate
    limited = ended_after(name, {**keywords, "duration": steps / rate}, action)
    assert limited == (steps, True, True, ending)
    cut = ended_after(name, {**keywords, "duration": (steps - 1) / rate}, action)
    assert cut == (steps - 1, False, True, quad_gym.Ending.TIME_LIMIT)


DRAWN = {"randomize_reference": True}
REFERENCES = [
    *((name, {}) for name in ("Hover", "Circle", "RandomTrajectory", "Waypoints", "Trajectory")),
    *((name, DRAWN) for name in ("Hover", "Circle", "Lemniscate", "Trajectory")),
]


def is_refused(env, place):
    try:
        env.reset(options={"position": place})
    except ValueError as error:
        return "position must be within" in str(error)
    return False


@pytest.mark.parametrize(("task", "keywords"), REFERENCES, ids=str)
def test_a_start_out_of_bounds_of_the_reference_is_refused(task, keywords):
    """A refused position is out of bounds of the references of 512 random episodes."""
    env = gymnasium.make_vec(f"QuadGym/{task}-v0", num_envs=512, observation="truth", **keywords)
    env.reset(seed=1)
    begins = env.unwrapped.flights.batch.read("reference_position")
    bound, refused, rng = env.unwrapped.flights.task.out_of_bounds, 0, np.random.default_rng(2)
    reach = np.linalg.norm(begins, axis=1).max() + bound
    for place in rng.uniform(-reach, reach, (100, 3)):
        nearest = np.linalg.norm(begins - place, axis=1).min()
        if is_refused(env, place):
            refused += 1
            assert nearest > bound
        else:  # an episode may begin there, and one of 512 references is nearly as near as possible
            assert nearest < bound + (2.0 if task == "RandomTrajectory" else 0.6)
    assert refused > 20
    assert not is_refused(env, begins[0] + [0.0, 0.0, 0.9 * bound])


def test_task_with_own_endings_accepts_start_out_of_bounds():
    class Patient(quad_gym.Task):
        """Task that ends no episode."""

        def terminated(self, view):
            return np.zeros(view.count, bool)

    env = QuadVectorEnv(2, base="hover", task=Patient)
    env.reset(seed=1, options={"position": (-2.0, 0.0, 1.0)})
    assert not env.step(np.zeros((2, 4)))[2].any()


def fallen(k, flights, **values):
    """Set fields of flight k of a snapshot."""
    for name, value in values.items():
        flights[name][k // WIDTH, ..., k % WIDTH] = value


@pytest.mark.parametrize("truncates", [False, True])
def test_each_ending_has_its_cause_and_the_worst_one_is_named(truncates):
    """A filter that is flagged as diverged ends an episode only if the task says so."""
    task = quad_gym.TaskParams(
        start="hover", max_tilt=1.0, out_of_bounds=3.0, min_height=0.5,
        truncate_when_diverged=truncates,
    )  # fmt: skip
    batch = flights_of(8, task=task, sensors="rtk")
    batch.step()
    flights, x = batch.snapshot(), batch.record("r")
    far, low = np.array([8.0, 0.0, 0.0]), np.array([0.0, 0.0, 0.45])
    diverged = {"alarm_tick": 1e9, "diverged": 1.0}
    tipped = {"q": np.array([np.cos(0.55), np.sin(0.55), 0.0, 0.0])}
    fallen(1, flights, **diverged)
    fallen(2, flights, **diverged, filter_status=1)
    fallen(3, flights, r=np.append(x[3, :2], low[2]), **diverged, filter_status=1)
    fallen(4, flights, r=np.append(x[4, :2], low[2]), **tipped, **diverged)
    fallen(5, flights, r=x[5] + far, **tipped, filter_status=1)
    fallen(6, flights, q=np.array([np.cos(0.45), np.sin(0.45), 0.0, 0.0]))
    fallen(7, flights, r=np.append(x[7, :2], 0.55))
    batch.restore(flights)
    batch.step()
    expected = ["NONE", "FILTER_DIVERGED", "FILTER_FAILED", "BELOW_MIN_HEIGHT", "TIPPED_OVER",
                "OUT_OF_BOUNDS", "NONE", "NONE"]  # fmt: skip
    if not truncates:
        expected[1] = "NONE"
    assert [Ending(int(k)).name for k in batch.result("ending")] == expected
    np.testing.assert_array_equal(batch.result("terminated"), [0, 0, 0, 1, 1, 1, 0, 0])
    truncated = np.array([0, truncates, 1, 1, truncates, 1, 0, 0])
    np.testing.assert_array_equal(batch.result("truncated"), truncated)

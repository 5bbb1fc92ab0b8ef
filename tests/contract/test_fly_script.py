"""Tests of the command `fly`."""

import re
from dataclasses import replace

import numpy as np
import pytest

from baselines.policies import load_policy
from quad_gym import IDS, Flight
from quad_gym.commands import fly as script
from tests import console_commands
from tests.builders import run_python

pytest.importorskip("pygame")


def fly(*options, cwd, **environment):
    if not environment:
        return console_commands.run("fly", *options, where=cwd)
    return run_python("-m", "quad_gym", "fly", *options, where=cwd, **environment)


def test_fly_writes_video_and_flight_that_replays_to_same_video(tmp_path):
    size = ("--size", 320, 240, "--fps", 5)
    done = fly(
        "hover", "--duration", 1, "--seed", 4, *size, "--output", "new/hover.gif", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert "time limit after 1.00 s" in done.stdout
    assert "Wrote new/hover.gif" in done.stdout
    assert done.stderr.index("rendering: 100%") < done.stderr.index("encoding new/hover.gif ...")
    flight = Flight.load(tmp_path / "new" / "hover.npz")
    assert (len(flight), flight.about["seed"], flight.about["task"]) == (51, 4, "hover")
    assert flight.about["policy"] == "pd"
    done = fly("--replay", "new/hover.npz", *size, "--output", "again.gif", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "again.gif").read_bytes() == (tmp_path / "new/hover.gif").read_bytes()


@pytest.mark.parametrize("env_id", IDS)
def test_every_task_is_made_with_the_default_options(env_id):
    env = script.make_env(script.FlyArgs(env_id=env_id))
    assert env.unwrapped.flights.batch.sensors.camera is not None or "outage" in IDS[env_id]


@pytest.mark.parametrize(
    ("task", "said"),
    [("waypoints", r"\d of 5 gates passed"), ("hover", r"mean tracking error \d+\.\d mm")],
)
def test_a_flight_is_summed_up_by_gates_on_a_course_and_by_errors_elsewhere(task, said, capsys):
    env = script.make_env(script.FlyArgs(env_id=task, duration=1.0))
    list(script.fly(env, load_policy("pd", env), 0, {}))
    printed = capsys.readouterr().out
    assert re.search(said, printed)
    assert ("gates" in printed) != ("tracking" in printed)


def test_fly_uses_default_action_and_faults_of_task():
    flights = script.make_env(script.FlyArgs(env_id="outage_dash")).unwrapped.flights
    assert flights.action == "velocity"
    assert [type(fault).__name__ for fault in flights.batch.faults] == ["GnssOutage"]
    given = script.FlyArgs(env_id="outage_dash", env={"action": "ctbr"}, faults=("rotor_loss",))
    flights = script.make_env(given).unwrapped.flights
    assert flights.action == "ctbr"
    assert [type(fault).__name__ for fault in flights.batch.faults] == ["RotorLoss"]
    assert script.make_env(script.FlyArgs()).unwrapped.flights.action == "ctbr"


@pytest.mark.parametrize("suite", ["standard", "consumer"])
@pytest.mark.parametrize("camera", [True, False])
def test_any_suite_is_made_with_and_without_a_camera(suite, camera):
    env = script.make_env(script.FlyArgs(sensors=suite, camera=camera))
    wanted = camera and suite == "standard"
    assert (env.unwrapped.flights.batch.sensors.camera is not None) == wanted


def test_faults_begin_and_end_at_given_times(tmp_path):
    options = ("hover", "--duration", 3, "--faults", "gnss_outage", "--fault-time", 1, 2)
    done = fly(*options, "--no-camera", "--output", "flight.npz", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    flight = Flight.load(tmp_path / "flight.npz")
    fixed = np.isfinite(flight["gnss_position"][:, 0])
    away = (flight["time"] >= 1.0) & (flight["time"] < 2.0)
    # a row holds the fixes since the previous row, so the row of 1.0 s has some
    np.testing.assert_array_equal(fixed, ~away | (flight["time"] == 1.0))
    np.testing.assert_array_equal(flight["faults"] == 1.0, away)
    sigma = np.sqrt(flight["covariance"][:, 0, 0])
    assert sigma[99] > 10.0 * sigma[50]  # the uncertainty grows in the outage
    assert sigma[110] < 0.1 * sigma[99]
    assert not flight.scene.has_camera


@pytest.mark.parametrize("existing", ["film.gif", "film.npz"])
def test_existing_file_is_replaced_only_with_overwrite(existing, tmp_path):
    (tmp_path / existing).write_bytes(b"results of an earlier day")
    args = script.FlyArgs(env_id="QuadGym/Hover-v0", output=tmp_path / "film.gif")
    with pytest.raises(ValueError, match=f"{existing} exists: use --overwrite to replace it"):
        script.check_options(args)
    script.check_options(replace(args, overwrite=True))


def test_video_of_a_saved_flight_leaves_the_flight_as_it_is(tmp_path):
    args = script.FlyArgs(output=tmp_path / "film.gif", replay=tmp_path / "film.npz")
    args.replay.write_bytes(b"the saved flight")
    script.check_options(args)
    assert script.files_of(args.output, args) == (args.output,)


def test_window_without_display_ends_with_hint_to_write_video(tmp_path):
    done = fly("hover", cwd=tmp_path, SDL_VIDEODRIVER="x11")
    assert done.returncode == 2
    assert "without a display, --output writes a video instead" in done.stderr


def test_window_shows_every_picture_until_it_is_closed():
    class Screen:
        """Window that is closed after some pictures."""

        def __init__(self, most):
            self.shown, self.most = 0, most

        closed = property(lambda self: self.shown == self.most)

        def show(self, frame, seconds):
            self.shown += 1

    args = script.FlyArgs(env_id="QuadGym/Hover-v0", duration=0.4, size=(320, 240))
    flights = script.flights_of(args)
    for most, shown in ((100, 21), (10, 10)):
        script.watch(flights(0), args, screen := Screen(most))
        assert screen.shown == shown

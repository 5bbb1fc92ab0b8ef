"""Studies: arms, trainings, resumption, tables, conclusions."""

import json

import numpy as np
import pytest

from quad_gym.evaluation import Episodes
from quad_gym.experiments import Flown
from scripts.studies import __main__ as command
from scripts.studies.arms import Arm
from scripts.studies.plots import outages
from scripts.studies.tasks import stays
from tests.console_commands import plain, without_figures
from tests.scripts.running import run

QUICK = ["look_around", "--quick", "--steps", "4096", "--env", "duration=0.6"]
MINE = """
from scripts.studies.arms import Arm
ARMS = (
    Arm(name="facing", label="PD, facing the features", policy="pd:features"),
    Arm(name="truth", label="truth", training={"observation": "truth"}),
    Arm(name="mine", label="mine", environment={"include_std": True}),
)
"""


def test_study_continues_and_repeats_a_missing_training(tmp_path, capsys):
    (tmp_path / "mine.py").write_text(MINE)
    folder = tmp_path / "out"
    words = [*QUICK, "--arms-file", str(tmp_path / "mine.py"), "--output", str(folder)]
    run(words)
    text = capsys.readouterr().out
    assert "PD, facing the features" in text
    assert "so few that the intervals are wide" in text
    summary = json.loads((folder / "summary.json").read_text())
    assert set(summary["rows"]) == {"facing", "truth", "mine"}
    assert len(summary["return_of_each_seed"]["mine"]) == 2
    for name in ("learning.png", "glance.png", "report.html", "episodes.csv", "table.md"):
        assert (folder / name).stat().st_size > 100
    kept = folder / "runs/truth/seed_1/best.npz"
    gone = folder / "runs/mine/seed_0"
    before = kept.stat().st_mtime_ns, (gone / "best.npz").read_bytes()
    for file in gone.iterdir():
        file.unlink()
    with without_figures():
        run(words)
    assert kept.stat().st_mtime_ns == before[0]
    again = json.loads((folder / "summary.json").read_text())
    assert again["rows"] == summary["rows"]  # the repeated training is bitwise equal


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "arms"),
    [
        ("stale_race", ["pd", "truth", "std", "truth_on_truth", "std_delay_compensated"]),
        ("outage_dash", ["pd_waiting", "truth", "std", "truth_on_truth"]),
    ],
)
def test_study_of_each_task_flies_all_arms(task, arms, tmp_path, capsys):
    folder = tmp_path / "out"
    short = ["--quick", "--steps", "4096", "--env", "duration=0.6", "--arms", *arms]
    run([task, *short, "--output", str(folder)])
    summary = json.loads((folder / "summary.json").read_text())
    assert set(summary["rows"]) == set(arms)
    assert set(summary["rows"]["truth"]) >= {"success", "crashed", "gates", "speed"}
    assert not (folder / "runs/truth_on_truth").exists()
    text = (folder / "table.md").read_text()
    assert "passed" in text.partition("Success: ")[2].partition(".")[0]
    assert (folder / "pace.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"name": "a b"}, r"Arm.name must be a word"),
        ({"flies": "truth", "parameters": {"gamma": 0.9}}, "its policy is taken from"),
        ({"flies": "truth", "policy": "pd"}, "either a policy or the name of another arm"),
        ({"policy": "pd", "algorithm": "sac"}, "must not be trained, because its policy is pd"),
        ({"algorithm": "a2c"}, r"algorithm must be one of ppo, .*, got 'a2c'"),
        ({"environment": 3}, r"Arm.environment must be a"),
    ],
    ids=str,
)
def test_invalid_arms_are_rejected(given, message):
    with pytest.raises(ValueError, match=message):
        Arm(**{"name": "a", "label": "x", **given})


def test_reward_of_an_arm_applies_in_training_only():
    args = command.StudyArgs(arms=("std_certainty",))
    setting = command.configure(args)
    plan = setting.trainings[0].plan
    learned = plan.make_vector_flights().unwrapped.flights.batch
    judged = plan.make_judge().unwrapped.flights.batch
    assert type(learned.own_task).__name__ == "WithStdCertaintyReward"
    assert type(judged.own_task).__name__ == "WithStd"
    assert judged.task.out_of_bounds == 8.0


def flown(returns, crashed, error):
    count = len(returns)
    episodes = Episodes(
        returns=np.array(returns, float),
        lengths=np.full(count, 100),
        mean_error=np.full(count, error),
        late_error=np.where(crashed, np.nan, error),
        estimation_error=np.zeros(count),
        crashed=np.array(crashed, bool),
        gates_passed=np.zeros(count, int),
        ending=np.full(count, "none"),
    )
    return Flown(episodes, {"in_view": np.full(count, 0.5), "mean_speed": np.ones(count)})


def test_success_needs_a_complete_episode_and_a_small_late_error():
    some = flown([1.0, 1.0, 1.0], [False, True, False], 0.3)
    np.testing.assert_array_equal(stays(some, 0.5), [True, False, True])
    np.testing.assert_array_equal(stays(some, 0.3), [False, False, False])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("look_around --arms", "--arms must have at least one value, got none"),
        ("look_around --arms nobody", "--arms must be one of"),
        ("look_around --arms-file text.toml", "--arms-file must be a Python file, got text.toml"),
        ("stale_race --arms truth_delay_compensated", "--arms must name truth, whose policies"),
        ("QuadGym/Hover-v0", "ENV_ID must be one of QuadGym/Circle-v0"),
        ("look_around --env observation=truth", "must not contain observation: use --arms instead"),
        ("look_around --arms certainty --set clip=1", "clip is not a keyword of the compiled PPO"),
        (
            "look_around --arms truth --set critic_only=3",
            "critic_only must be the number of values",
        ),
        (
            "look_around --video webp --arms std estimate",
            "needs the arm truth and another",
        ),
        ("look_around --seeds 0", "--seeds must be at least 1"),
        ("look_around --video avi", "invalid choice 'avi'"),
    ],
)
def test_wrong_options_end_with_exit_code_2(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "text.toml").write_text("steps 3 [")
    with pytest.raises(SystemExit) as end:
        run(words.split())
    assert end.value.code == 2
    assert message in plain(capsys.readouterr().err)


@pytest.mark.parametrize(
    ("failed", "runs"),
    [("0110010", [(1, 2), (5, 5)]), ("111", [(0, 2)]), ("000", []), ("", [])],
)
def test_outages_are_runs_of_instants_without_gnss(failed, runs):
    assert outages(np.array([letter == "1" for letter in failed], bool)) == runs

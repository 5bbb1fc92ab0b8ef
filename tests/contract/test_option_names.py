"""Short names of tasks in every command."""

from quad_gym.commands import consistency, evaluate, fly, study, train
from quad_gym.commands.options import parse


def test_ids_may_be_short_without_the_command_line(tmp_path):
    few = {"env_id": "circle", "output": tmp_path / "out"}
    cases, _ = evaluate.configure(evaluate.EvaluateArgs(**few, policy=("pd",), episodes=2))
    assert {env.unwrapped.flights.name for _, env in cases.values()} == {"circle"}
    plan, _ = train.configure(train.TrainArgs(**few, engine="compiled"))
    assert plan.env_id == "QuadGym/Circle-v0"
    assert fly.make_env(fly.FlyArgs(env_id="circle")).unwrapped.flights.name == "circle"
    race = study.StudyArgs(env_id="stale_race", arms=("pd",), output=tmp_path / "out")
    assert study.configure(race).env_id == "QuadGym/StaleRace-v0"
    assert consistency.ConsistencyArgs(env_id="circle").env_id == "QuadGym/Circle-v0"
    assert parse(train.TrainArgs, ["Mine/Task-v0"]).env_id == "Mine/Task-v0"

"""The same option has the same name and kind in every command."""

import re
from collections import defaultdict

import pytest

from quad_gym.commands import compare, consistency, evaluate, fly, study, train
from quad_gym.commands.main import COMMANDS, main, module_of
from quad_gym.commands.options import parse


def args_of(command):
    return module_of(command).Args


def options_of(command, capsys):
    """Kinds of the options of a command, such as INT or {} for choices, by their names."""
    with pytest.raises(SystemExit):
        main([*command.split(), "--help"])
    found = {}
    for line in capsys.readouterr().out.splitlines():
        option = re.match(r"(?:│|  ?)(?: )?(--[a-z-]+)(?:, --no-[a-z-]+| (\S+))?", line)
        if option:
            kind = re.sub(r"\{None\}\||[\[\]]", "", option[2] or "FLAG")
            found[option[1]] = "{}" if kind.startswith("{") else kind
    return found


def test_options_of_one_name_are_of_one_kind(capsys):
    kinds = defaultdict(dict)
    for command in COMMANDS:
        for option, kind in options_of(command, capsys).items():
            kinds[option][command] = kind
    for option, found in kinds.items():
        if option == "--observation":  # one, or several for a comparison
            continue
        values = list(found.values())
        assert all(value == values[0] for value in values), (option, found)
    assert len(kinds["--seed"]) >= 7
    assert len(kinds["--episodes"]) >= 6


def test_ids_may_be_short_without_the_command_line(tmp_path):
    few = {"env_id": "circle", "output": tmp_path / "out"}
    cases, _ = evaluate.configure(evaluate.Args(**few, policy=("pd",), episodes=2))
    assert {env.unwrapped.flights.name for _, env in cases.values()} == {"circle"}
    plan, _ = train.configure(train.Args(**few, engine="compiled"))
    assert plan.env_id == "QuadGym/Circle-v0"
    assert fly.make_env(fly.Args(env_id="circle")).unwrapped.flights.name == "circle"
    race = study.Args(env_id="stale_race", arms=("pd",), output=tmp_path / "out")
    assert study.configure(race).env_id == "QuadGym/StaleRace-v0"
    assert consistency.Args(env_id="circle").env_id == "QuadGym/Circle-v0"


def test_a_comparison_may_be_of_a_short_id(tmp_path):
    pytest.importorskip("stable_baselines3")
    args = compare.Args(env_id="hover", seeds=1, train_on=("truth",), output=tmp_path / "out")
    assert compare.configure(args).env_id == "QuadGym/Hover-v0"


def test_ids_may_be_short():
    for command in ("train", "evaluate", "compare"):
        assert parse(args_of(command), ["hover"]).env_id == "QuadGym/Hover-v0"
        assert parse(args_of(command), ["QuadGym/Hover-v0"]).env_id == "QuadGym/Hover-v0"
        assert parse(args_of(command), ["Mine/Task-v0"]).env_id == "Mine/Task-v0"


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_examples_as_they_are_written(command, capsys):
    examples = [
        line.strip()
        for line in (module_of(command).__doc__ or "").splitlines()
        if line.strip().startswith(("quad-gym ", "source "))
    ]
    with pytest.raises(SystemExit):
        main([*command.split(), "--help"])
    shown = [line.strip() for line in capsys.readouterr().out.splitlines()]
    assert [line for line in examples if line not in shown] == []

"""Command-line options parsed into dataclasses."""

import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest

from quad_gym.commands import consistency, evaluate, fly, train
from quad_gym.commands.compile import CompileArgs
from quad_gym.commands.options import (
    EnvId,
    Keywords,
    SuiteNames,
    environment_of,
    flying_options,
    known_id,
    leave,
    parse,
    usage_errors,
)
from quad_gym.envs import IDS
from quad_gym.envs.config import env_option
from tests.console_commands import plain


@dataclass(frozen=True)
class Args:
    env_id: EnvId = "QuadGym/Circle-v0"
    seeds: int = 10
    """flights"""
    rate: float | None = None
    """rate [Hz]; 50 % of the other if not given"""
    gains: tuple[float, float] = (1.0, 2.0)
    """gains"""
    camera: bool = True
    """see"""
    kind: Literal["a", "b"] = "a"
    """kind"""
    output: Path | None = None
    """folder"""
    sensors: SuiteNames = ("standard",)
    env: Keywords = field(default_factory=dict)
    """keywords"""

    def __post_init__(self):
        if self.seeds < 1:
            raise ValueError("seeds must be at least 1")


def test_options_of_all_types_are_parsed():
    line = (
        "QuadGym/Hover-v0 --seeds 3 --rate 2.5 --gains 3 4 --no-camera --kind b "
        "--output some/where --sensors rtk lab --env a=1 b=(2,3) c=true d=none e=x=y f=1e-3"
    )
    keywords = {"a": 1, "b": (2, 3), "c": True, "d": None, "e": "x=y", "f": 1e-3}
    want = ("QuadGym/Hover-v0", 3, 2.5, (3.0, 4.0), False, "b", Path("some/where"), ("rtk", "lab"))
    assert parse(Args, line.split()) == Args(*want, keywords)
    assert parse(Args, []) == Args()


def test_help_has_defaults_and_texts(capsys):
    with pytest.raises(SystemExit) as end:
        parse(Args, ["--help"], description="Do it.", prog="it")
    assert end.value.code == 0
    text = plain(capsys.readouterr().out)
    for part in ("Do it.", "(default: 10)", "(default: 1.0 2.0)", "--no-camera", "consumer"):
        assert part in text
    assert "or an id such as QuadGym/Hover-v0 (default: circle)" in text


def test_integers_may_be_written_as_floats(capsys):
    for word, seeds in (("1e3", 1000), ("2.0", 2), ("1_000", 1000)):
        given = parse(Args, ["--seeds", word]).seeds
        assert (type(given), given) == (int, seeds)
    for word in ("1.5", "inf", "1e999", "", "one"):
        with pytest.raises(SystemExit):
            parse(Args, ["--seeds", word])
        assert "--seeds" in plain(capsys.readouterr().err)


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        ("Circle", "circle"),
        ("QuadGym/Cirle-v0", "QuadGym/Circle-v0"),
        ("lookaround", "look_around"),
    ],
)
def test_misspelt_id_is_refused_with_a_suggestion(given, meant):
    with pytest.raises(ValueError, match=rf"ENV_ID must be one of .*; did you mean {meant}\?$"):
        known_id("ENV_ID", given)
    assert known_id("ENV_ID", meant) in IDS
    with pytest.raises(ValueError, match=r"got 'waypoints'$"):
        known_id("ENV_ID", "waypoints", ["QuadGym/Circle-v0"])


@pytest.mark.parametrize("error", [ValueError("why"), OSError("why"), ImportError("why")])
def test_usage_errors_end_with_one_line(error, capsys):
    with pytest.raises(SystemExit) as end, usage_errors():
        raise error
    assert end.value.code == 2
    assert capsys.readouterr().err == "error: why\n"


def test_checks_of_options_are_reported_without_the_name_of_their_class(capsys):
    with pytest.raises(SystemExit) as end:
        parse(CompileArgs, ["--jobs", "0"])
    assert end.value.code == 2
    assert capsys.readouterr().err == "error: --jobs must be at least 1, got 0\n"
    with pytest.raises(ValueError, match="--jobs must be at least 1"):
        CompileArgs(jobs=0)


def test_env_keywords_with_a_dedicated_option_are_refused():
    keywords = {"radius": 2.0, "sensors": "rtk"}
    assert leave(keywords, faults="--fault") == keywords
    with pytest.raises(ValueError, match=r"^--env must not contain sensors: use --sensors"):
        leave(keywords, "sensors", faults="--fault")


def test_options_with_names_of_keywords_are_keywords_of_environment():
    given = {"action": "motor"}
    assert environment_of(train.TrainArgs(env=given)) == given
    args = fly.FlyArgs(env=given, sensors="rtk", camera=False, observation="truth", seed=3)
    of_options = {"sensors": "rtk", "camera": False, "observation": "truth"}
    assert environment_of(args) == given | of_options
    assert environment_of(args, sensors="lab") == given | of_options | {"sensors": "lab"}
    with pytest.raises(ValueError, match=r"^--env must not contain duration: use --duration"):
        environment_of(fly.FlyArgs(env={"duration": 3.0}))
    with pytest.raises(ValueError, match=r"^--env must not contain threads: use --threads"):
        environment_of(train.TrainArgs(env={"threads": 2}))


def test_keywords_are_formatted_as_command_line_options():
    assert flying_options({}) == ""
    assert flying_options({"sensors": "rtk"}) == " --sensors rtk"
    keywords = {"camera": False, "faults": "gnss_jump+rotor_loss", "observation": "noisy"}
    words = shlex.split(flying_options({**keywords, "world": "a b"}))
    assert words[:3] == ["--observation", "noisy", "--env"]
    assert words[3:] == ["camera=False", "faults=gnss_jump+rotor_loss", "world=a b"]
    assert env_option({}) == ""
    assert env_option({"sensors": "rtk", "task": "m:T"}) == " --env sensors=rtk task=m:T"


def test_ids_may_be_short_without_the_command_line(tmp_path):
    few = {"env_id": "circle", "output": tmp_path / "out"}
    cases, _ = evaluate.configure(evaluate.EvaluateArgs(**few, policy=("pd",), episodes=2))
    assert {env.unwrapped.flights.name for _, env in cases.values()} == {"circle"}
    plan, _ = train.configure(train.TrainArgs(**few, engine="compiled"))
    assert plan.env_id == "QuadGym/Circle-v0"
    assert fly.make_env(fly.FlyArgs(env_id="circle")).unwrapped.flights.name == "circle"
    assert consistency.ConsistencyArgs(env_id="circle").env_id == "QuadGym/Circle-v0"
    assert parse(train.TrainArgs, ["Mine/Task-v0"]).env_id == "Mine/Task-v0"

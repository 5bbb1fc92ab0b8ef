"""From dataclasses to command lines."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pytest

from quad_gym.cli import flying_options, leave, option, parse, parser_of, usage_errors


@dataclass(frozen=True)
class Args:
    seeds: int = option(10, "flights", group="numbers")
    rate: float | None = option(None, "rate [Hz]; 50 % of the other if not given")
    gains: tuple[float, float] = option((1.0, 2.0), "gains")
    camera: bool = option(True, "see", group="things")
    kind: Literal["a", "b"] = option("a", "kind")
    output: Path | None = option(None, "folder")

    def __post_init__(self):
        if self.seeds < 1:
            raise ValueError("seeds must be at least 1")


def test_defaults():
    args = parse(Args, [])
    assert (args.seeds, args.rate, args.gains, args.camera) == (10, None, (1.0, 2.0), True)


def test_all_types():
    line = "--seeds 3 --rate 2.5 --gains 3 4 --no-camera --kind b --output some/where"
    want = Args(3, 2.5, (3.0, 4.0), False, "b", Path("some/where"))
    assert parse(Args, line.split()) == want


def test_help_names_groups_defaults_and_texts():
    text = parser_of(Args, description="What it does.").format_help()
    for part in ("What it does.", "numbers:", "things:", "(default: 10)", "(default: 1.0 2.0)"):
        assert part in text
    assert "50 % of the other if not given\n" in text
    assert "(default: --camera)" in text


@pytest.mark.parametrize(
    "line",
    ["--seeds x", "--seeds 0", "--kind c", "--gains 1", "--see 3", "stray"],
)
def test_wrong_options_end_with_one_line(line, capsys):
    with pytest.raises(SystemExit) as end:
        parse(Args, line.split(), program="it")
    assert end.value.code == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert message.startswith("it: error: ")


@pytest.mark.parametrize("error", [ValueError("why"), OSError("why"), ImportError("why")])
def test_usage_errors_end_with_one_line(error, capsys):
    with pytest.raises(SystemExit) as end, usage_errors():
        raise error
    assert end.value.code == 2
    assert capsys.readouterr().err == "error: why\n"


def test_bugs_are_not_taken_for_usage_errors():
    with pytest.raises(KeyError), usage_errors():
        raise KeyError("bug")


def test_keywords_with_an_option_of_their_own_are_refused():
    keywords = {"radius": 2.0, "sensors": "rtk"}
    assert leave(keywords, {"faults": "--fault"}) == keywords
    with pytest.raises(ValueError, match=r"^--env must leave sensors to --sensors$"):
        leave(keywords, {"faults": "--fault", "sensors": "--sensors"})


def test_keywords_become_options_that_are_parsed_as_they_were():
    assert flying_options({}) == ""
    assert flying_options({"sensors": "rtk"}) == " --sensors rtk"
    keywords = {"camera": False, "faults": "gnss_jump+rotor_loss", "observation": "noisy"}
    words = shlex.split(flying_options({**keywords, "world": "a b"}))
    assert words[:3] == ["--observation", "noisy", "--env"]
    assert words[3:] == ["camera=False", "faults=gnss_jump+rotor_loss", "world=a b"]

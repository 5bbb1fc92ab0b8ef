"""The public interface: names, signatures and types."""

import ast
import dataclasses
import inspect
import re
import subprocess
import sys
from pathlib import Path

import gymnasium
import pytest

import baselines
import quad_gym
from quad_gym.batch.flight_batch import FlightBatch
from quad_gym.commands import evaluate
from quad_gym.envs.config import (
    DEFAULTS,
    TASK_KEYWORDS,
    EnvConfig,
    EnvKeywords,
    RenderingConfig,
    TaskKeywords,
    VectorKeywords,
    with_effect,
)
from quad_gym.envs.flights import Flights
from quad_gym.records import Autoreset

ROOT = Path(__file__).parents[2]


def test_dir_shows_every_public_name_and_no_internal_one():
    assert set(dir(quad_gym)) >= set(quad_gym.__all__)
    assert not {"register_all", "envs", "params", "records", "Any"} & set(dir(quad_gym))
    for name in quad_gym.__all__:
        assert getattr(quad_gym, name) is not None, name


def test_every_name_of_the_api_pages_is_public():
    pages = "".join(page.read_text() for page in (ROOT / "docs" / "api").glob("*.md"))
    found = re.findall(r"auto(?:class|function):: quad_gym\.(\w+)$", pages, flags=re.MULTILINE)
    assert len(found) > 30
    assert set(found) <= set(quad_gym.__all__)


@pytest.mark.parametrize(
    "shown",
    [
        quad_gym.QuadEnv,
        quad_gym.QuadVectorEnv,
        quad_gym.register_task,
        quad_gym.make_sb3_vec_env,
        type(gymnasium.make("QuadGym/Hover-v0").unwrapped),
    ],
    ids=lambda shown: shown.__name__,
)
def test_signatures_show_every_keyword_with_its_type_and_default(shown):
    parameters = inspect.signature(shown).parameters
    types = inspect.get_annotations(EnvKeywords)
    assert set(types) <= set(parameters)
    for name, kind in types.items():
        found = parameters[name]
        assert found.kind is found.KEYWORD_ONLY
        assert found.annotation == kind
        assert found.default == DEFAULTS.get(name)
    assert not any(p.kind is p.VAR_KEYWORD for p in parameters.values())
    assert "self" not in parameters


def test_signature_of_make_sb3_vec_env_has_vector_keywords():
    more = set(inspect.get_annotations(VectorKeywords)) - set(inspect.get_annotations(EnvKeywords))
    assert more == {"task", "threads", "render_mode", "render_flights"}
    assert more <= set(inspect.signature(quad_gym.make_sb3_vec_env).parameters)


def test_declared_keywords_match_task_params_and_flight_batch():
    fields = {field.name for field in dataclasses.fields(quad_gym.TaskParams)} - {"kind"}
    assert set(inspect.get_annotations(TaskKeywords)) == fields == set(TASK_KEYWORDS)
    of_flights = set(inspect.signature(FlightBatch).parameters)
    pictures = {field.name for field in dataclasses.fields(RenderingConfig)}
    own = {"observation", "action", "camera", "reward_terms"}
    assert set(DEFAULTS) - of_flights == own | pictures
    others = {"max_episode_steps", *TASK_KEYWORDS}
    assert set(inspect.get_annotations(EnvKeywords)) == set(DEFAULTS) | others


def test_declared_defaults_equal_defaults_of_flights():
    given = Flights(EnvConfig.of(DEFAULTS, "hover"), 1, Autoreset.DISABLED).batch
    plain = Flights(EnvConfig.of({}, "hover"), 1, Autoreset.DISABLED).batch
    assert given._settings.tobytes() == plain._settings.tobytes()


def test_signatures_of_parameters_show_their_fields():
    for kind in (quad_gym.WorldParams, quad_gym.Uniform, quad_gym.faults.GnssOutage):
        fields = [field.name for field in dataclasses.fields(kind)]
        assert sorted(inspect.signature(kind).parameters) == sorted(fields)


WRONG = """\
import quad_gym

quad_gym.QuadEnv(task="circle", obsevation="truth")
quad_gym.QuadVectorEnv(4, observation="truthful")
quad_gym.make_sb3_vec_env("QuadGym/Hover-v0", control_rate="fast")
quad_gym.WorldParams(wnd=(1.0, 0.0, 0.0))
"""


@pytest.mark.slow
def test_a_type_checker_refuses_wrong_keywords(tmp_path):
    pytest.importorskip("mypy")
    file = tmp_path / "wrong.py"
    file.write_text(WRONG + 'quad_gym.QuadEnv(task="circle", observation="truth", radius=2.0)\n')
    words = [sys.executable, "-m", "mypy", "--config-file=", "--follow-imports=silent", str(file)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    lines = [int(number) for number in re.findall(r"wrong\.py:(\d+): error", done.stdout)]
    assert sorted(set(lines)) == [3, 4, 5, 6], done.stdout
    assert 'Unexpected keyword argument "obsevation"' in done.stdout


def test_evaluate_passes_filter_keywords_only_to_flights_with_filter(tmp_path):
    env = {"filter_start": "warm"}
    args = evaluate.EvaluateArgs(env=env, estimator="ekf", output=tmp_path)
    for observation in ("truth", "noisy", "estimate"):
        evaluate.make_flights(args, observation, 1, "pd").close()
    given = {**env, "estimator": "ekf", "sensors": "rtk"}
    truth, estimate = ({"observation": name} for name in ("truth", "estimate"))
    assert with_effect(given | truth) == truth | {"sensors": "rtk"}
    assert with_effect(given | estimate) == estimate | given
    for sensors in ("rtk", quad_gym.sensor_suite("rtk")):  # by name, and as an object
        faulty = {"sensors": sensors, "faults": "gnss_outage+rotor_loss", "observation": "truth"}
        assert [fault.name for fault in with_effect(faulty)["faults"]] == ["rotor_loss"]


def test_task_is_named_by_its_first_argument_or_base():
    for env in (quad_gym.QuadEnv("hover"), quad_gym.QuadEnv(base="hover")):
        assert env.flights.name == "hover"
    for env in (quad_gym.QuadEnv(), quad_gym.QuadEnv(quad_gym.Task())):
        assert env.flights.name == "circle"


def test_packages_and_names_imported_on_first_use_have_types():
    """A type checker does not run `__getattr__`; it reads the imports under `TYPE_CHECKING`."""
    for package in (quad_gym, baselines):
        assert (Path(package.__file__).parent / "py.typed").exists()
    tree = ast.parse(Path(quad_gym.__file__).read_text(encoding="utf-8"))
    (block,) = [node for node in tree.body if isinstance(node, ast.If)]
    assert ast.unparse(block.test) == "TYPE_CHECKING"
    told = {name.name: statement.module for statement in block.body for name in statement.names}
    assert told == quad_gym._LAZY
    assert set(told) <= set(quad_gym.__all__)  # exported, so that type checkers accept them

"""The public interface: names, signatures and types; inputs without effect are refused."""

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
from quad_gym.envs.effects import with_effect
from quad_gym.envs.flights import Flights
from quad_gym.envs.keywords import (
    DEFAULTS,
    RENDERING_KEYWORDS,
    TASK_KEYWORDS,
    EnvKeywords,
    TaskKeywords,
    VectorKeywords,
)
from quad_gym.records import Autoreset, Control, Source

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
    assert set(DEFAULTS) - of_flights == {*("observation", "action", "camera", "reward_terms")}
    others = {"max_episode_steps", *RENDERING_KEYWORDS, *TASK_KEYWORDS}
    assert set(inspect.get_annotations(EnvKeywords)) == set(DEFAULTS) | others


def test_declared_defaults_equal_defaults_of_flights():
    given = Flights("hover", 1, Autoreset.DISABLED, **DEFAULTS).batch
    plain = Flights("hover", 1, Autoreset.DISABLED).batch
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


@pytest.mark.parametrize(
    ("make", "meant"),
    [
        (lambda: quad_gym.WorldParams(wnd=1.0), "wnd is not a keyword of WorldParams.*wind_I"),
        (lambda: quad_gym.SensorSuite().replace(gns=None), "gns is not a keyword.*gnss"),
        (lambda: quad_gym.Uniform(0.0, heigh=1.0), "heigh is not a keyword of Uniform.*high"),
        (lambda: quad_gym.faults.GnssOutage(begin=1.0), "begin is not a keyword of GnssOutage"),
        (lambda: quad_gym.QuadEnv(threads=2), "threads is not a keyword of a single environment"),
        (lambda: quad_gym.register_task("A/B-v0", "a:B", obsevation=1), "mean observation"),
    ],
)
@pytest.mark.parametrize("kind", [TypeError, ValueError])
def test_unknown_keywords_are_refused_with_suggestion(make, meant, kind):
    with pytest.raises(kind, match=meant):
        make()


SCALES = quad_gym.ActionParams()


@pytest.mark.parametrize(
    ("keywords", "name"),
    [
        ({"observation": "measurements", "layout": "relative"}, "layout"),
        ({"observation": "measurements", "layout": "absolute"}, "layout"),
        ({"observation": "truth", "estimator": "ekf"}, "estimator"),
        ({"observation": "truth", "filter_start": "cold"}, "filter_start"),
        ({"observation": "noisy", "filter_start": "warm"}, "filter_start"),
        ({"observation": "truth", "truncate_when_diverged": True}, "truncate_when_diverged"),
        ({"observation": "truth", "faults": "gnss_outage"}, "faults"),
        ({"action": "motor", "action_params": SCALES}, "action_params"),
        ({"action": "wrench", "action_params": SCALES}, "action_params"),
        ({"render_size": (64, 64)}, "render_size"),
        ({"gate_count": 3}, "gate_count"),
    ],
    ids=str,
)
def test_inputs_without_effect_are_refused(keywords, name):
    with pytest.raises(ValueError, match=rf"^{name} (must not|must concern|needs|belongs)"):
        quad_gym.QuadEnv("hover", **keywords)


@pytest.mark.parametrize(
    "keywords",
    [
        {"observation": "truth", "include_std": True, "estimator": "ekf", "filter_start": "warm"},
        {"observation": "noisy", "innovations": True, "filter_start": "warm"},
        {"observation": "truth", "estimator": None},
        {"action": "ctbr", "action_params": SCALES},
    ],
    ids=str,
)
def test_inputs_with_effect_are_accepted(keywords):
    quad_gym.QuadEnv("hover", **keywords)


def test_evaluate_passes_filter_keywords_only_to_flights_with_filter(tmp_path):
    args = evaluate.EvaluateArgs(env={"filter_start": "warm", "estimator": "ekf"}, output=tmp_path)
    for observation in ("truth", "noisy", "estimate"):
        evaluate.make_flights(args, observation, 1, "pd").close()
    given = {**args.env, "sensors": "rtk"}
    truth, estimate = ({"observation": name} for name in ("truth", "estimate"))
    assert with_effect(given | truth) == truth | {"sensors": "rtk"}
    assert with_effect(given | estimate) == estimate | given


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"gains": "tuned", "control": Control.CTBR}, "gains must not be given with Control.CTBR"),
        ({"action_params": SCALES}, "action_params must not be given with Control.PD"),
        ({"source": Source.TRUTH, "filter_start": "warm"}, "filter_start needs a filter"),
        ({"run_filter": False, "innovations": True}, "innovations needs a filter"),
        ({"run_filter": False, "include_std": True}, "include_std needs a filter"),
    ],
    ids=str,
)
def test_arguments_of_a_batch_without_effect_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        FlightBatch(1, **arguments)


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ({"observation": "measurements", "layout": "relative"}, "layout"),
        ({"drawn": ("mass",)}, "drawn"),
    ],
    ids=str,
)
def test_arguments_of_a_layout_without_effect_are_refused(arguments, name):
    with pytest.raises(ValueError, match=f"^{name} must not be given"):
        quad_gym.observation_layout(**arguments)


def test_task_name_next_to_id_or_base_is_refused():
    with pytest.raises(ValueError, match=r"task must be a quad_gym.Task.* choose the id of hover"):
        gymnasium.make("QuadGym/Circle-v0", task="hover")
    with pytest.raises(ValueError, match="choose the id of hover"):
        quad_gym.QuadEnv("hover", base="hover")
    with pytest.raises(ValueError, match=r"task must be one of .*did you mean hover"):
        quad_gym.QuadEnv("hovr")
    with pytest.raises(ValueError, match=r"base must be one of .*did you mean hover"):
        quad_gym.QuadEnv(base="hovr")
    assert quad_gym.QuadEnv("hover").flights.name == "hover"
    assert quad_gym.QuadEnv(base="hover").flights.name == "hover"
    assert quad_gym.QuadEnv().flights.name == "circle"
    assert quad_gym.QuadEnv(quad_gym.Task()).flights.name == "circle"


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

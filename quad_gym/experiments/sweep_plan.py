"""Trainings of a sweep: a file or options, expanded to all combinations of values."""

import itertools
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from baselines.plans import Plan
from baselines.recipes import Recipe, recipe
from quad_gym import IDS
from quad_gym.experiments.experiment import Training, make_trainings
from quad_gym.params import checks as check

DEFAULTS: Mapping[str, Any] = {
    "env_ids": ["QuadGym/Circle-v0"],
    "algorithm": "ppo",
    "steps": None,
    "n_envs": None,
    "engine": "sb3",
    "seeds": 1,
    "evaluations": 20,
    "episodes": 100,
    "env": {},
    "set": {},
    "recipe": {},
}
"""Keys of a sweep, see `docs/sweeps.md`; None: as in the recipe."""

TABLES = ("env", "set", "recipe")
_SINGLE = ("algorithm", "steps", "n_envs")  #: fields of a recipe that are separate keys
_ELSEWHERE = {**{name: name for name in _SINGLE}, "parameters": "set"}
"""Keys to use instead of fields of the recipe."""
_RECIPE = tuple(f.name for f in fields(Recipe) if f.name not in (*_ELSEWHERE, "flights", "policy"))

Axis = tuple[str, str]  #: table (empty for a separate key) and key of a value


def read(file: Path) -> dict[str, Any]:
    """Read a sweep file."""
    try:
        found = tomllib.loads(file.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{file} is not valid TOML: {error}") from None
    for name, value in found.items():
        check.choice(f"a key of {file}", name, tuple(DEFAULTS))
        if name in TABLES and not isinstance(value, dict):
            raise ValueError(f"{name} in {file} must be a table, got {value!r}")
        names = isinstance(value, list) and all(isinstance(each, str) for each in value)
        if name == "env_ids" and not names:
            raise ValueError(f"{name} must be a list of names, got {value!r}")
    return found


def expand(given: Mapping[str, Any], folder: Path, *, threads: int = 1) -> list[Training]:
    """All trainings of a sweep, with keys of `DEFAULTS`; the first seed of each is first."""
    spec = {**DEFAULTS, **given}
    axes: dict[Axis, Any] = {(table, k): v for table in TABLES for k, v in spec[table].items()}
    axes |= {("", key): spec[key] for key in _SINGLE if spec[key] is not None}
    tried = [value if isinstance(value, list) else [value] for value in axes.values()]
    if [] in tried:
        empty = ".".join(filter(None, list(axes)[tried.index([])]))
        raise ValueError(f"{empty} must have at least one value")
    cases: dict[str, Plan] = {}
    for env_id, values in itertools.product(spec["env_ids"], itertools.product(*tried)):
        chosen = dict(zip(axes, values, strict=True))
        engine = "compiled_" if spec["engine"] == "compiled" else ""
        words = [IDS[env_id], f"{engine}{chosen['', 'algorithm']}"]
        words += [  # values from lists, so that further values do not change it
            f"{axis[1]}={_word(value)}"
            for axis, value in chosen.items()
            if isinstance(axes[axis], list) and axis[1] != "algorithm"
        ]
        name = ",".join(words)
        if name in cases:
            raise ValueError(f"every value of a sweep must be given once, got {name} twice")
        cases[name] = _plan(spec, env_id, chosen, threads)
    return make_trainings(cases, _seeds(spec["seeds"]), folder)


def _seeds(given: Any) -> Sequence[int]:
    if not isinstance(given, list):
        return range(check.whole("seeds", given))
    if not given or len(set(given)) < len(given):
        raise ValueError(f"seeds must be different numbers, at least one, got {given}")
    return [check.whole("seeds", seed, least=0) for seed in given]


def _plan(spec: Mapping[str, Any], env_id: str, chosen: Mapping[Axis, Any], threads: int) -> Plan:
    tables = {t: {k: _frozen(v) for (u, k), v in chosen.items() if u == t} for t in (*TABLES, "")}
    for name in tables["recipe"]:
        if name in _ELSEWHERE:
            raise ValueError(f"recipe must not hold {name}: use {_ELSEWHERE[name]} instead")
        check.choice("recipe", name, _RECIPE)
    base = recipe(env_id, tables[""].pop("algorithm"))
    return Plan(
        env_id=env_id,
        environment=tables["env"],
        recipe=base.replace(
            **tables[""],
            **tables["recipe"],
            parameters={**base.parameters, **tables["set"]},
        ),
        threads=threads,
        **{name: spec[name] for name in ("engine", "evaluations", "episodes")},
    )


def _frozen(value: Any) -> Any:
    """Convert lists to tuples, as keywords and recipes require."""
    return tuple(map(_frozen, value)) if isinstance(value, list) else value


def _word(value: Any) -> str:
    """Value in the name of a folder."""
    if isinstance(value, list | tuple):
        return "x".join(map(_word, value))
    text = str(value).lower() if isinstance(value, bool) else str(value)
    return "".join(c if c.isalnum() or c in "._-+" else "-" for c in text)

"""What a sweep trains: a file, or options, expanded to a list of folders."""

import itertools
import json
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from baselines.keeping import has_checkpoint
from baselines.plans import Plan, description
from baselines.recipes import Recipe, recipe
from quad_gym import IDS
from quad_gym.experiments.arms import Arm
from quad_gym.params import checks as check

RECORD = "training.json"
_SINGLE = ("algorithm", "steps", "n_envs")
"""Fields of a recipe that are keys by themselves."""
_ELSEWHERE = {**{name: name for name in _SINGLE}, "parameters": "set"}
"""Fields of a recipe that `recipe` does not take, with the keys to use instead."""


@dataclass(frozen=True, kw_only=True)
class Spec:
    """A sweep as a file has it; where a list is given, its values are tried one by one."""

    env_ids: list[str] = field(default_factory=lambda: ["QuadGym/Circle-v0"])
    """ids of environments"""
    arms: list[str] = field(default_factory=list)
    """names of arms of a study; none: environments as `env` has them"""
    algorithm: Any = "ppo"
    steps: Any = None
    """environment steps; None: the recipe's"""
    n_envs: Any = None
    """flights at a time; None: the recipe's"""
    engine: str = "sb3"
    seeds: Any = 1
    """a number of them from 0 on, or a list"""
    evaluations: int = 20
    episodes: int = 100
    env: Mapping[str, Any] = field(default_factory=dict)
    """keywords of the environments"""
    set: Mapping[str, Any] = field(default_factory=dict)
    """parameters of the algorithm"""
    recipe: Mapping[str, Any] = field(default_factory=dict)
    """other fields of the recipe"""


NAMES = tuple(f.name for f in fields(Spec))
TABLES = ("env", "set", "recipe")


@dataclass(frozen=True)
class Training:
    """One training of a sweep."""

    group: str
    """what it has in common with those of other seeds; a name of a folder"""
    plan: Plan
    folder: Path

    @property
    def name(self) -> str:
        """For people."""
        return f"{self.group}/seed_{self.plan.seed}"

    def record(self) -> dict[str, Any]:
        """What the folder says of it; empty where it was not begun.

        Raises:
            ValueError: If the folder holds another training.
        """
        if not has_checkpoint(self.folder):
            return {}
        found: dict[str, Any] = json.loads((self.folder / RECORD).read_text(encoding="utf-8"))
        described = description(self.plan)
        if found["plan"] != described:
            differing = [k for k in described if found["plan"].get(k) != described[k]]
            raise ValueError(
                f"folder {self.folder} holds another training (different: "
                f"{', '.join(differing)}): choose another --output"
            )
        return found

    @property
    def finished(self) -> bool:
        """Whether nothing is left to be done."""
        return bool(self.record().get("finished"))


def read(file: Path) -> dict[str, Any]:
    """What a file of a sweep gives.

    Raises:
        ValueError: If it is invalid.
        OSError: If it cannot be read.
    """
    try:
        found = tomllib.loads(file.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{file} is no valid TOML: {error}") from None
    for name, value in found.items():
        check.choice(f"a key of {file}", name, NAMES)
        if name in TABLES and not isinstance(value, dict):
            raise ValueError(f"{name} in {file} must be a table, got {value!r}")
        if name in ("env_ids", "arms"):
            _listed(name, value)
    return found


def expand(
    given: Mapping[str, Any], arms: Mapping[str, Arm], folder: Path, *, threads: int = 1
) -> list[Training]:
    """All trainings of a sweep, the first seed of every group first.

    Args:
        given: Fields of Spec; others keep their defaults.
        arms: Those that `given` names.
        folder: Of the sweep.
        threads: Of each training.

    Raises:
        ValueError: If a value is invalid.
    """
    spec = Spec(**given)
    groups = [
        (env_id, arm, dict(axes))
        for env_id in spec.env_ids
        for arm in tuple[str | None, ...](spec.arms) or (None,)
        for axes in _products(spec)
    ]
    found = []
    for seed in _seeds(spec.seeds):
        for env_id, arm, axes in groups:
            plan = _plan(spec, env_id, None if arm is None else arms[arm], axes, seed, threads)
            name = _name(spec, env_id, arm, axes)
            found.append(Training(name, plan, folder / "runs" / name / f"seed_{seed}"))
    for name, count in Counter(training.name for training in found).items():
        if count > 1:
            raise ValueError(f"every value of a sweep must be given once, got {name} twice")
    return found


def _listed(name: str, values: Any) -> None:
    if not (isinstance(values, list) and all(isinstance(value, str) for value in values)):
        raise ValueError(f"{name} must be a list of names, got {values!r}")


def _seeds(given: Any) -> Sequence[int]:
    if isinstance(given, list):
        if not given:
            raise ValueError("seeds must not be empty")
        return [check.whole("seeds", seed, least=0) for seed in given]
    return range(check.whole("seeds", given))


def _products(spec: Spec) -> Iterator[dict[tuple[str, str], Any]]:
    """Every combination of values, by table and key."""
    axes: dict[tuple[str, str], list[Any]] = {}
    for table in TABLES:
        for key, value in getattr(spec, table).items():
            axes[table, key] = value if isinstance(value, list) else [value]
    for key in _SINGLE:
        if (value := getattr(spec, key)) is not None:
            axes["", key] = value if isinstance(value, list) else [value]
    for (table, key), values in axes.items():
        if not values:
            raise ValueError(f"{f'{table}.{key}' if table else key} must have at least one value")
    for combination in itertools.product(*axes.values()):
        yield dict(zip(axes, combination, strict=True))


def _plan(
    spec: Spec,
    env_id: str,
    arm: Arm | None,
    axes: Mapping[tuple[str, str], Any],
    seed: int,
    threads: int,
) -> Plan:
    tables = {t: {k: _frozen(v) for (u, k), v in axes.items() if u == t} for t in (*TABLES, "")}
    arm = arm or Arm(name="none", label="none")
    if arm.policy is not None:
        raise ValueError(f"arms must be trained, got {arm.name}, whose policy is {arm.policy}")
    chosen: Recipe = recipe(env_id, tables[""].pop("algorithm"))
    others = [f.name for f in fields(Recipe) if f.name not in (*_ELSEWHERE, "flights", "policy")]
    for name in tables["recipe"]:
        if name in _ELSEWHERE:
            raise ValueError(f"recipe must not hold {name}: use {_ELSEWHERE[name]} instead")
        check.choice("recipe", name, others)
    chosen = chosen.replace(
        **tables[""],
        **tables["recipe"],
        parameters={**chosen.parameters, **arm.parameters, **tables["set"]},
    )
    return Plan(
        env_id=env_id,
        environment={**tables["env"], **arm.environment, **arm.training},
        learning=arm.learning,
        recipe=chosen,
        seed=seed,
        threads=threads,
        engine=spec.engine,
        evaluations=spec.evaluations,
        episodes=spec.episodes,
    )


def _frozen(value: Any) -> Any:
    """Lists as the tuples that keywords and recipes take."""
    return tuple(map(_frozen, value)) if isinstance(value, list) else value


def _name(spec: Spec, env_id: str, arm: str | None, axes: Mapping[tuple[str, str], Any]) -> str:
    """Task, algorithm, arm, and every value of a list: no value that is added changes it."""
    algorithm = axes["", "algorithm"]
    words = [IDS[env_id], "compiled_ppo" if spec.engine == "compiled" else algorithm]
    words += [] if arm is None else [arm]
    words += [
        f"{key}={_word(value)}"
        for (table, key), value in axes.items()
        if key != "algorithm"
        and isinstance(getattr(spec, table)[key] if table else getattr(spec, key), list)
    ]
    return ",".join(words)


def _word(value: Any) -> str:
    """A value in the name of a folder."""
    if isinstance(value, list | tuple):
        return "x".join(map(_word, value))
    text = str(value).lower() if isinstance(value, bool) else str(value)
    return "".join(c if c.isalnum() or c in "._-+" else "-" for c in text)

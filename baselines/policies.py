"""Policies by name or file, checked against the environment in which they will fly."""

import json
import pickle
import warnings
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium

from baselines.crazyflie_pid import SLOW, CrazyfliePID
from baselines.mlp import MlpPolicy, checked_record
from baselines.normalization import normalized, require_statistics
from baselines.pd import REACH_OF_GAPS, PDPolicy, require_plain_observations
from quad_gym import IDS, PDGains
from quad_gym.evaluation import Policy
from quad_gym.params import checks as check

PRETRAINED = Path(__file__).resolve().parent / "pretrained"  #: folder of the included policies

_PD: dict[str, dict[str, Any]] = {
    "pd": {},
    "pd:tuned": {},
    "pd:lab": {"gains": "lab"},
    "pd:features": {"faces": "features"},
    "pd:features_when_uncertain": {"faces": "features_when_uncertain"},
    "pd:slow": {"max_position_error": 0.5 * REACH_OF_GAPS},
    "pd:waiting": {"pace": "waiting"},
}
"""Arguments of `PDPolicy` by name, see `load_policy`."""

_INCLUDED, _CRAZYFLIE = "pretrained", "crazyflie_pid"

NAMES = (*_PD, _CRAZYFLIE, _INCLUDED, f"{_INCLUDED}:truth")  #: names of policies, see `load_policy`

_ALGORITHM_OF_MODULE = {
    "stable_baselines3.common.policies": "ppo",
    "stable_baselines3.sac.policies": "sac",
    "stable_baselines3.td3.policies": "td3",
    "sb3_contrib.tqc.policies": "tqc",
    "sb3_contrib.common.recurrent.policies": "recurrent_ppo",
}


def interface_of(env: Any) -> dict[str, Any]:
    """Describe the observations and actions of an environment for a policy.

    The source of the observation is left out: a policy trained on the truth may fly on the
    estimate.
    """
    flights = _flights_of(env)
    return {
        "observation": [field.name for field in flights.table],
        "action": flights.action,
        "control_rate": flights.control_rate,
    }


def load_policy(name: str | Path, env: Any, normalization: Any = None) -> Policy:
    """Load a policy for an environment.

    Args:
        name: "pd" (tuned gains), "pd:lab" (gains of the report), "pd:features" and
            "pd:features_when_uncertain" (tuned gains, facing the features), "pd:slow" and
            "pd:waiting" (for courses with gaps: half the speed, or waiting when uncertain),
            "pd:FILE.json" (gains found by `quad-gym tune`), "crazyflie_pid" (the Crazyflie's
            cascade of PID loops), "pretrained" (the included policy for the task of the
            environment), "pretrained:truth" (the included one that was trained on the true state,
            for Circle and LookAround), or a file: `.npz` with plain arrays, or `.zip` written by
            Stable-Baselines3. Loading a `.zip` can run code: open only trusted files.
        env: Environment of this package: single, vector or Stable-Baselines3, without wrappers
            that change observations.
        normalization: Statistics with which observations were normalized while a policy in a file
            was trained: a file or a wrapper, see `baselines.normalization.Normalization.of`;
            "none": it was trained without.

    Raises:
        ValueError: If the policy does not exist, does not fit the environment, or lies next to
            statistics of `VecNormalize` that are not given; or if a wrapper changes observations,
            which included policies and those with statistics need as they are.
        ImportError: If the file is a `.zip` and Stable-Baselines3 is not installed.

    Warns:
        UserWarning: If a `.npz` was trained on another task.
    """
    name = str(name)
    of_file = not (name in _PD or name == _CRAZYFLIE or name.startswith("pd:") or is_included(name))
    if normalization is not None and not of_file:
        raise ValueError(
            f"normalization must not be given for {name}, which does not observe normalized values"
        )
    if name in _PD:
        return PDPolicy(env, **_PD[name])
    if name == _CRAZYFLIE:
        return CrazyfliePID(env)
    if name.startswith("pd:"):
        return PDPolicy(env, gains=_gains_of(Path(name.removeprefix("pd:"))))
    file = pretrained_file(task_of(env), name) if is_included(name) else Path(name)
    if file.suffix == ".npz":
        policy: Any = MlpPolicy.load(file)
        if is_included(name):
            require_plain_observations(env)
        _require_agreement(file, policy.record, env)
        _require_size(file, policy.inputs, env)
        trained_on = policy.record.get("plan", {}).get("env_id", task_of(env))
        if trained_on != task_of(env):
            warnings.warn(
                f"{file} was trained on {trained_on}, but flies {task_of(env)}", stacklevel=2
            )
        return _normalized(file, policy, normalization, env)
    if file.suffix != ".zip":
        raise ValueError(
            "policy must be pd, pd:lab, pd:FILE.json, pretrained, or a .npz or .zip file, "
            f"got {name!r}{check.did_you_mean(name, NAMES)}"
        )
    return _stable_baselines_policy(file, env, normalization)


def keywords_of_policy(name: str, env_id: str) -> dict[str, Any]:
    """Keywords that an environment needs for a policy, in addition to the defaults of its id.

    Raises a ValueError if no policy of this name is included for the task.
    """
    if name in ("pd:features_when_uncertain", "pd:waiting"):
        return {"include_std": True}
    if name == _CRAZYFLIE:
        return {"action": "motor", "layout": "absolute", "control_rate": SLOW}
    if not is_included(name):
        return {}
    trained = MlpPolicy.load(pretrained_file(env_id, name)).record["plan"]["environment"]
    return {key: trained[key] for key in ("task", "include_std") if key in trained}


def _gains_of(file: Path) -> PDGains:
    """Read PD gains written by `quad-gym tune`."""
    if not file.is_file():
        name = f"pd:{file}"
        raise ValueError(f"there are no gains {file}{check.did_you_mean(name, NAMES)}")
    try:
        return PDGains(**json.loads(file.read_text(encoding="utf-8"))["gains"])
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError) as error:
        raise ValueError(f'{file} has no valid table "gains": {error!r}') from None


def is_included(name: str) -> bool:
    """True for names of included policies: "pretrained", or one such as "pretrained:truth"."""
    return name.partition(":")[0] == _INCLUDED


def pretrained_file(env_id: str, name: str = _INCLUDED) -> Path:
    """File of the included policy of a name for a task; a ValueError if there is none."""
    ending = name.removeprefix(_INCLUDED).replace(":", "_")
    file = PRETRAINED / f"{IDS[env_id]}{ending}.npz"
    if not file.exists():
        known = [task for task in IDS.values() if (PRETRAINED / f"{task}{ending}.npz").exists()]
        what = "no policy" if name == _INCLUDED else f"no policy {name}"
        others = f", only for {', '.join(sorted(known))}" if known else ""
        meant = others or check.did_you_mean(name, NAMES)
        raise ValueError(f"{what} is included for {env_id}{meant}")
    return file


def task_of(env: Any) -> str:
    """Id of an environment."""
    name = _flights_of(env).name
    return next(env_id for env_id, task in IDS.items() if task == name)


def _flights_of(env: Any) -> Any:
    flights = getattr(getattr(env, "unwrapped", env), "flights", None)
    if flights is None:
        raise ValueError(f"env must be a QuadGym environment, got {type(env).__name__}")
    return flights


def _stable_baselines_policy(file: Path, env: Any, normalization: Any) -> Policy:
    if not file.exists():
        raise ValueError(f"policy file not found: {file}")
    try:
        with zipfile.ZipFile(file) as archive:
            module = json.loads(archive.read("data"))["policy_class"]["__module__"]
    except (zipfile.BadZipFile, KeyError, json.JSONDecodeError):
        raise ValueError(f"{file} is not a policy of Stable-Baselines3, or is damaged") from None
    if module not in _ALGORITHM_OF_MODULE:
        raise ValueError(f"{file} contains a policy of an unknown algorithm ({module})")
    require_statistics(file, normalization)
    record = file.parent / "training.json"
    if record.exists():
        _require_agreement(file, record_of(record), env)
    try:
        from baselines.models import algorithm_class
    except ImportError as error:
        raise ImportError(
            f'{file} needs Stable-Baselines3: pip install "quad-gym[train]"'
        ) from error
    try:
        model = algorithm_class(_ALGORITHM_OF_MODULE[module]).load(file, device="cpu")
    except (pickle.UnpicklingError, RuntimeError, EOFError, KeyError) as error:
        raise ValueError(f"{file} cannot be loaded: {error}") from None
    policy: Any = _normalized(file, model, normalization, env)
    space = getattr(env, "single_observation_space", env.observation_space)
    free = policy is not model and model.observation_space.shape == space.shape
    if model.observation_space != space and not free:
        if _is_unbounded(model.observation_space, space):
            raise ValueError(
                f"{file} expects observations without bounds, as a wrapper of the environment "
                "makes them: give the statistics of NormalizeObservation as normalization"
            )
        _require_size(file, gymnasium.spaces.flatdim(model.observation_space), env)
        raise ValueError(f"{file} expects observations {model.observation_space}, not {space}")
    return policy  # type: ignore[no-any-return]


def record_of(file: Path) -> dict[str, Any]:
    """Training record in a file, a ValueError if it is none."""
    try:
        return checked_record(json.loads(file.read_text(encoding="utf-8")))
    except (UnicodeDecodeError, ValueError) as error:
        raise ValueError(f"{file} is not a valid training record: {error}") from None


def _is_unbounded(space: Any, bounded: Any) -> bool:
    """Return True for a box of the shape of another one, but without its bounds."""
    return (
        isinstance(space, gymnasium.spaces.Box)
        and space.shape == bounded.shape
        and not space.is_bounded("both")
    )


def _normalized(file: Path, policy: Any, normalization: Any, env: Any) -> Policy:
    """Policy with its statistics; a ValueError if they are of observations of another size."""
    found = normalized(str(file), policy, normalization)
    if getattr(found, "normalization", None) is not None:
        require_plain_observations(env)
    if found is not policy and (size := len(found.normalization.mean)) != _size_of(env):
        source = f" in {normalization}" if isinstance(normalization, str | Path) else ""
        raise ValueError(
            f"normalization must be of the {_size_of(env)} numbers that the environment returns, "
            f"got {size}{source}: make it with the keywords with which {file} was trained, and "
            "give the statistics of this training"
        )
    return found  # type: ignore[no-any-return]


def _size_of(env: Any) -> int:
    """Numbers in an observation of one environment."""
    space = getattr(env, "single_observation_space", env.observation_space)
    return gymnasium.spaces.flatdim(space)


def _require_size(file: Path, size: int, env: Any) -> None:
    here = _size_of(env)
    if size != here:
        raise ValueError(
            f"{file} expects observations of {size} numbers, but the environment returns {here}: "
            "make it with the keywords with which the policy was trained"
        )


def _require_agreement(file: Path, record: Mapping[str, Any], env: Any) -> None:
    """Reject a policy that was trained with other actions or observations."""
    trained, here = record.get("interface", {}), interface_of(env)
    for name in trained:
        if name not in here or trained[name] == here[name]:
            continue
        if name == "observation":
            keywords = record.get("plan", {}).get("environment", {})
            had = "".join(f" {key}={value}" for key, value in keywords.items())
            raise ValueError(
                f"{file} was trained with observations of "
                f"{_difference(trained[name], here[name])}: make it with the keywords with which "
                f"the policy was trained{had and ','}{had}"
            )
        raise ValueError(
            f"{file} was trained with {name} {trained[name]}, but the environment has {here[name]}"
        )


def _difference(trained: Sequence[str], here: Sequence[str]) -> str:
    """Describe the difference of two lists of names: sizes, missing and additional names."""
    differing = {
        "lacks": ", ".join(name for name in trained if name not in here),
        "adds": ", ".join(name for name in here if name not in trained),
    }
    words = [f"{verb} {names}" for verb, names in differing.items() if names]
    found = f"it {' and '.join(words)}" if words else "in another order"
    return f"{len(trained)} fields, but the environment returns {len(here)} ({found})"

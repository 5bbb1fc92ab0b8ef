"""Entries of EstimateBench: a folder with policies and `entry.json`, flown and compared.

`entry.json` has the fields of `Entry`. Policies are rules of this repository, `.npz` files of
`baselines.mlp.MlpPolicy`, or ONNX models: input "observation" (n, k), output "action" (n, 4), and
for a policy with memory also inputs "state" (n, m) and "start" (n,), and output "next_state". None
of these formats runs code of its author.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from baselines.policies import NAMES
from quad_gym.analysis.reports import write_json
from quad_gym.evaluation import Policy
from quad_gym.params import checks as check
from scripts.estimate_bench.tasks import PROTOCOL, TASK, BenchTask
from scripts.studies.campaign import EPISODES, FIRST_EPISODE, flights_digest
from scripts.studies.rules import RULES
from scripts.studies.study import StudyTrial

FILE = "entry.json"
TRACKS = ("memoryless", "memory")
KEYWORDS = ("observation", "include_std", "layout", "task")
"""Keywords of the environment that an entry may set; `task` only to a class of this repository."""
OBSERVATIONS = ("estimate", "measurements")  #: sources that a controller of an entry may observe
DIGITS = 10  #: significant digits that are stored and compared
RESULTS = ("success", "crashed", "return")  #: numbers that are compared


class EntryError(ValueError):
    """Error raised for an entry that does not follow the protocol."""


@dataclass(frozen=True)
class Entry:
    """Entry of the benchmark."""

    folder: Path
    name: str
    """Name of the row"""
    track: str
    """One of `TRACKS`"""
    training: str
    """Description of the training, with a link to the code"""
    policies: tuple[Mapping[str, Any], ...]
    """Each with "task", "policy" (a file, or the name of a rule), "seed" (None: a rule), and, if
    needed, "environment", "steps" and "seconds" of its training"""
    results: Mapping[str, Any] | None
    """Flown results: "flights" by task, "episodes", "first_episode" and "rows"; None: not flown"""

    @classmethod
    def read(cls, folder: Path) -> "Entry":
        """Read and check an entry.

        Raises:
            EntryError: If it does not follow the protocol.
        """
        file = folder / FILE
        if not file.is_file():
            raise EntryError(f"{folder} must have a file {FILE}")
        try:
            given = json.loads(file.read_text(encoding="utf-8"))
        except json.JSONDecodeError as error:
            raise EntryError(f"{file} must be JSON: {error}") from None
        names = ("protocol", "name", "track", "training", "policies")
        missing = [name for name in names if name not in given]
        unknown = sorted(set(given) - {*names, "results"})
        if missing or unknown:
            what = f"lacks {missing[0]}" if missing else f"has an unknown field {unknown[0]}"
            raise EntryError(f"{file} {what}: it must have {', '.join(names)}")
        if given["protocol"] != PROTOCOL:
            raise EntryError(f"protocol must be {PROTOCOL}, got {given['protocol']!r}")
        try:
            check.choice("track", given["track"], TRACKS)
        except ValueError as error:
            raise EntryError(str(error)) from None
        for policy in given["policies"]:
            _check_policy(folder, policy)
        return cls(
            folder,
            given["name"],
            given["track"],
            given["training"],
            tuple(given["policies"]),
            given.get("results"),
        )

    def fly(self, episodes: int, first_episode: int) -> dict[str, Any]:
        """Fly all policies; returns the results as `entry.json` stores them."""
        rows = []
        for policy in self.policies:
            task = TASK[policy["task"]]
            flown = _trial(task, policy, self.folder, episodes, first_episode).flown(
                policy["policy"]
            )
            values = {
                "success": float(task.defined.success(flown).mean()),
                "crashed": float(flown.episodes.crashed.mean()),
                "return": float(flown.episodes.returns.mean()),
                "return_sd": float(flown.episodes.returns.std(ddof=1)),
            }
            shown = {name: float(f"{value:.{DIGITS}g}") for name, value in values.items()}
            rows.append({"task": task.name, "seed": policy.get("seed"), **shown})
        tasks = {policy["task"] for policy in self.policies}
        return {
            "flights": {name: flights_digest(TASK[name].flights) for name in sorted(tasks)},
            "episodes": episodes,
            "first_episode": first_episode,
            "rows": rows,
        }

    def write(self, results: Mapping[str, Any]) -> None:
        """Write results into `entry.json`."""
        given = json.loads((self.folder / FILE).read_text(encoding="utf-8"))
        write_json(self.folder / FILE, given | {"results": results})

    def differences(self) -> list[str]:
        """Fly again; return a line for each number that differs in a digit.

        Raises:
            EntryError: If it was not flown, or the flights of a task have changed since.
        """
        stored = self.results
        if stored is None:
            raise EntryError(f"{self.folder} has no results: run `fly` on it first")
        for name, digest in stored["flights"].items():
            if digest != flights_digest(TASK[name].flights):
                raise EntryError(
                    f"{self.folder}: the flights of {name} have changed since it was flown: "
                    "run `fly` on it again"
                )
        again = self.fly(stored["episodes"], stored["first_episode"])
        return [
            f"{old['task']}, seed {old['seed']}: {name} is {new[name]!r}, "
            f"the entry has {old[name]!r}"
            for old, new in zip(stored["rows"], again["rows"], strict=True)
            for name in RESULTS
            if old[name] != new[name]
        ]


def _check_policy(folder: Path, policy: Mapping[str, Any]) -> None:
    """Refuse a policy that does not follow the protocol."""
    for name in ("task", "policy"):
        if name not in policy:
            raise EntryError(f"each of the policies must have {name}, got {dict(policy)}")
    if policy["task"] not in TASK:
        raise EntryError(f"task must be one of {', '.join(TASK)}, got {policy['task']!r}")
    given = policy.get("environment", {})
    for name in given:
        if name not in KEYWORDS:
            raise EntryError(f"environment may set {', '.join(KEYWORDS)}, got {name}")
    if given.get("observation", "estimate") not in OBSERVATIONS:
        raise EntryError(
            f"observation must be one of {', '.join(OBSERVATIONS)}, got {given['observation']!r}"
        )
    own = str(given.get("task", "baselines."))
    if not own.startswith(("baselines.", "scripts.", "quad_gym.")):
        raise EntryError(f"task of an environment must be a class of this repository, got {own}")
    name = policy["policy"]
    if name in RULES or name in NAMES:
        return
    file = (folder / name).resolve()
    if file.suffix not in (".npz", ".onnx") or folder.resolve() not in file.parents:
        raise EntryError(
            f"policy must be a rule, or a .npz or .onnx file in the folder of the entry, got {name}"
        )
    if not file.is_file():
        raise EntryError(f"{folder} has no file {name}")


def _trial(
    task: BenchTask, policy: Mapping[str, Any], folder: Path, episodes: int, first_episode: int
) -> "EntryTrial":
    return EntryTrial(
        env_id=task.env_id,
        keywords={"observation": "estimate", **task.environment, **policy.get("environment", {})},
        policy=policy["policy"],
        episodes=episodes,
        first_episode=first_episode,
        threads=1,
        traced=(),
        folder=folder,
    )


@dataclass(frozen=True, kw_only=True)
class EntryTrial(StudyTrial):
    """Test episodes of a policy of an entry."""

    folder: Path

    def load(self, policy: str) -> Policy:
        """Load a rule, or a file of the entry's folder."""
        if policy.endswith(".onnx"):
            return OnnxPolicy(self.folder / policy)
        return super().load(str(self.folder / policy) if policy.endswith(".npz") else policy)


class OnnxPolicy:
    """Policy in an ONNX model, with or without memory."""

    def __init__(self, file: Path) -> None:
        runtime = check.package("onnxruntime", "an ONNX policy", "export")
        options = runtime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self._session = runtime.InferenceSession(
            str(file), options, providers=["CPUExecutionProvider"]
        )
        inputs = {each.name: each.shape for each in self._session.get_inputs()}
        outputs = {each.name for each in self._session.get_outputs()}
        self._memory = int(inputs["state"][1]) if "state" in inputs else 0
        needed = {"observation", "state", "start"} if self._memory else {"observation"}
        given = {"action", "next_state"} if self._memory else {"action"}
        if set(inputs) != needed or not given <= outputs:
            raise EntryError(
                f"{file} must have inputs {sorted(needed)} and outputs {sorted(given)}, got "
                f"{sorted(inputs)} and {sorted(outputs)}"
            )

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Any, Any]:
        """Return actions (n, 4) for observations (n, k), and the state of the memory."""
        fed = {"observation": np.asarray(observation, np.float32)}
        if not self._memory:
            return self._session.run(["action"], fed)[0], None
        n = len(fed["observation"])
        before = np.zeros((n, self._memory), np.float32) if state is None else state
        starts = np.zeros(n) if episode_start is None else episode_start
        fed |= {"state": before, "start": np.asarray(starts, np.float32)}
        action, after = self._session.run(["action", "next_state"], fed)
        return action, after


def fly(folder: Path, episodes: int = EPISODES, first_episode: int = FIRST_EPISODE) -> Entry:
    """Fly the entry in a folder, and write its results."""
    entry = Entry.read(folder)
    entry.write(entry.fly(episodes, first_episode))
    return Entry.read(folder)

"""Ledger of results: commands, digest of golden flights and texts of each result.

A result is stale if its commands, the golden flights of its tasks and suites, or the included
policies that it flies have changed. It stays valid after a change of the code that keeps these
flights bitwise equal.
"""

import fnmatch
import hashlib
import json
from pathlib import Path
from typing import Any

from baselines.policies import PRETRAINED
from docs.renewal import release
from docs.renewal.catalog import Result
from scripts.estimate_bench import table as estimate_bench
from scripts.studies import again, conclusions
from tests.soak import log as soak

FILE = Path(__file__).with_name("ledger.json")
GOLDEN = Path(__file__).parents[2] / "tests/golden/flights.json"


def read() -> dict[str, Any]:
    """Entries by the names of their results."""
    return json.loads(FILE.read_text(encoding="utf-8")) if FILE.exists() else {}


def write(entries: dict[str, Any]) -> None:
    """Write the entries."""
    text = json.dumps(entries, indent=1, sort_keys=True, ensure_ascii=False)
    FILE.write_text(text + "\n", encoding="utf-8")


def digest(result: Result) -> str:
    """Digest of the golden flights of the tasks and suites of a result, and of its policies.

    Raises:
        ValueError: If a pattern matches no golden flight.
    """
    golden = json.loads(GOLDEN.read_text(encoding="utf-8"))
    chosen: dict[str, str] = {}
    for pattern in result.flights:
        names = fnmatch.filter(golden, pattern)
        if not names:
            raise ValueError(f"{result.name}: no golden flight is named {pattern}")
        chosen |= {name: golden[name] for name in names}
    for name in result.policies:
        weights = (PRETRAINED / f"{name}.npz").read_bytes()
        chosen[f"policy {name}"] = hashlib.sha256(weights).hexdigest()
    return hashlib.sha256(json.dumps(chosen, sort_keys=True).encode()).hexdigest()[:16]


def stale(result: Result, entries: dict[str, Any]) -> bool:
    """True if a result has to be measured."""
    entry = entries.get(result.name, {})
    return entry.get("commands") != result.commands or entry.get("flights") != digest(result)


def texts(entries: dict[str, Any]) -> dict[str, str]:
    """All texts of all results, by the names of their marks."""
    minutes = [entry["minutes"] for entry in entries.values()]
    hours = "several" if None in minutes else f"{sum(minutes) / 60.0:.0f}"
    found = {name: text for entry in entries.values() for name, text in entry["texts"].items()}
    facts = release.texts(release.facts())
    return found | measured_per_seed() | facts | {"total.hours": hours}


def measured_per_seed() -> dict[str, str]:
    """Texts of studies, of the benchmark and of the soak, computed from the rows in docs/data."""
    return conclusions.texts() | estimate_bench.texts() | again.texts() | soak.texts()

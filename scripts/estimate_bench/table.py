"""Table of EstimateBench, computed from rows per seed."""

from collections.abc import Mapping
from pathlib import Path

from quad_gym.analysis.metrics import Estimated
from quad_gym.analysis.reports import markdown_table
from scripts.estimate_bench.entries import FILE, Entry
from scripts.estimate_bench.rows import MEMORY, arms_of
from scripts.estimate_bench.tasks import TASKS, BenchTask
from scripts.studies.campaign import DATA, flights_digest
from scripts.studies.report import number, share
from scripts.studies.rows import Rows

ENTRIES = Path(__file__).with_name("entries")  #: folder of the entries of others
HEADS = ("row", "track", "seeds", "success", "crashed", "return", "score", "processor seconds")
NOT_MEASURED = "not yet measured"


def score(returned: Estimated, rule: float, ideal: float) -> Estimated:
    """Normalized score: 0 is the best rule on the estimate, 1 a policy of the truth on the truth.

    Both ends of the scale are taken as exact, so that the interval follows from the return's.
    """
    width = ideal - rule
    if not width > 0.0:
        raise ValueError(f"the return on the truth ({ideal}) must exceed the rule's ({rule})")
    return Estimated(*((value - rule) / width for value in returned))


def entry_rows(folder: Path = ENTRIES) -> dict[str, Rows]:
    """Rows of the entries of others, by name of the task."""
    found: dict[str, list[Mapping[str, object]]] = {}
    for file in sorted(folder.glob(f"*/{FILE}")):
        entry = Entry.read(file.parent)
        if entry.results is None:
            continue
        of_policy = {(p["task"], p.get("seed")): p for p in entry.policies}
        for row in entry.results["rows"]:
            policy = of_policy[row["task"], row["seed"]]
            found.setdefault(row["task"], []).append(
                {
                    **row,
                    "arm": file.parent.name,
                    "label": entry.name,
                    "track": entry.track,
                    "steps": policy.get("steps"),
                    "seconds": policy.get("seconds", 0.0),
                    "episodes": entry.results["episodes"],
                    "flights": entry.results["flights"][row["task"]],
                }
            )
    return {task: Rows(rows) for task, rows in found.items()}


def lines(task: BenchTask, measured: Rows, entered: Rows) -> list[list[str]]:
    """Lines of a task; a row that was not measured on the present flights says so."""
    now = flights_digest(task.flights)
    own = measured.where(task=task.name, flights=now)
    rule, ideal = own.of("rule"), own.of("truth_on_truth")
    ends = (
        (rule.estimated("return").value, ideal.estimated("return").value)
        if rule.rows and ideal.rows
        else None
    )
    found = []
    for arm in arms_of(task):
        track = "memory" if arm.name in MEMORY else "memoryless"
        found.append(_line(arm.label, track, own.of(arm.name), ends))
    fresh = entered.where(flights=now)
    for name in dict.fromkeys(row["arm"] for row in entered.rows):
        rows = fresh.of(name)
        first = entered.of(name).rows[0]
        found.append(_line(str(first["label"]), str(first["track"]), rows, ends))
    return found


def _line(label: str, track: str, rows: Rows, ends: tuple[float, float] | None) -> list[str]:
    if not rows.rows:
        return [label, track, NOT_MEASURED, *[""] * (len(HEADS) - 3)]
    trained = rows.rows[0]["seed"] is not None
    returned = rows.estimated("return")
    scored = "" if ends is None or ends[1] <= ends[0] else number(score(returned, *ends), 2)
    return [
        label,
        track,
        str(rows.seeds) if trained else "",
        share(rows.estimated("success")),
        share(rows.estimated("crashed")),
        number(returned, 1),
        scored,
        f"{rows.estimated('seconds').value:.0f}" if trained else "",
    ]


def table(file: Path = DATA / "estimate_bench.csv", entries: Path = ENTRIES) -> str:
    """All tasks, as Markdown."""
    measured, entered = Rows.read(file), entry_rows(entries)
    blocks = []
    for task in TASKS:
        body = lines(task, measured, entered.get(task.name, Rows(())))
        blocks.append(f"\n### {task.name}\n\n{task.asks}.\n\n{markdown_table(HEADS, body)}")
    return "\n".join(blocks).replace("?.", "?")

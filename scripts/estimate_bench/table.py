"""Table of EstimateBench, computed from rows per seed."""

from collections.abc import Mapping
from pathlib import Path

from quad_gym.analysis.metrics import Estimated
from quad_gym.analysis.reports import markdown_table
from scripts.estimate_bench.entries import FILE, Entry
from scripts.estimate_bench.rows import MEMORY, SEEDS, arms_of
from scripts.estimate_bench.tasks import TASKS, BenchTask
from scripts.studies.campaign import DATA, flights_digest
from scripts.studies.conclusions import LINE, NOT_MEASURED, p_value
from scripts.studies.report import number, share
from scripts.studies.rows import Effect, Rows, effect

ENTRIES = Path(__file__).with_name("entries")  #: folder of the entries of others
HEADS = ("row", "seeds", "success", "crashed", "return", "score", "CPU s")
MISSING = "-"  #: cell of a number that is not measured with the present flights

ON_ESTIMATE = "training on the estimate, not the truth"
COMPARED: Mapping[str, tuple[str, str]] = {
    ON_ESTIMATE: ("estimate", "truth"),
    "observing standard deviations, trained on the estimate": ("estimate_std", "estimate"),
    "observing standard deviations, trained on the truth": ("truth_std", "truth"),
    "privileged critic": ("privileged", "estimate_std"),
    "independent noise on the truth": ("noisy", "truth"),
    "randomized dynamics": ("randomized", "noisy"),
}
"""Changes of the training whose effects the page compares: the rows with and without each."""


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


def lines(task: BenchTask, measured: Rows, entered: Rows) -> tuple[list[list[str]], list[str]]:
    """Lines of the rows of a task that were measured on the present flights, and other labels."""
    now = flights_digest(task.flights)
    own, fresh = measured.where(task=task.name, flights=now), entered.where(flights=now)
    rule, ideal = own.of("rule"), own.of("truth_on_truth")
    ends = (
        (rule.estimated("return").value, ideal.estimated("return").value)
        if rule.rows and ideal.rows
        else None
    )
    # a row that flies the policies of another one shares their training
    every = [
        (
            _label(arm.label, memory=arm.name in MEMORY),
            own.of(arm.name),
            own.of(arm.flies or arm.name),
        )
        for arm in arms_of(task)
    ]
    for row in {row["arm"]: row for row in entered.rows}.values():
        label = _label(str(row["label"]), memory=row["track"] == "memory")
        entry = fresh.of(row["arm"])
        every.append((label, entry, entry))
    found = [_line(label, rows, trained, ends) for label, rows, trained in every if rows.rows]
    return found, [label for label, rows, _ in every if not rows.rows]


def _label(label: str, *, memory: bool) -> str:
    """Label of a row, with its track unless this is "memoryless"."""
    return f"{label} (memory)" if memory else label


def _line(label: str, rows: Rows, trained: Rows, ends: tuple[float, float] | None) -> list[str]:
    """Cells of a row, which has the processor time of the rows that `trained` its policies."""
    returned = rows.estimated("return")
    scored = MISSING if ends is None or ends[1] <= ends[0] else number(score(returned, *ends), 2)
    return [
        label,
        str(rows.seeds) if rows.trained else "rule",
        share(rows.estimated("success")),
        share(rows.estimated("crashed")),
        number(returned, 1),
        scored,
        _seconds(trained) if rows.trained else "",
    ]


def _seconds(trained: Rows) -> str:
    """Mean processor time of trainings [s]."""
    return f"{trained.estimated('seconds').value:.0f}" if trained.rows else MISSING


def block(task: BenchTask, measured: Rows, entered: Rows) -> str:
    """Heading, question and table of a task; rows that are not measured have no seeds."""
    question = task.asks if task.asks.endswith("?") else f"{task.asks}."
    body, missing = lines(task, measured, entered)
    parts = [f"### {task.name}", question]
    if body:
        body += [[label, "none", *[MISSING] * (len(HEADS) - 2)] for label in missing]
        parts.append(markdown_table(HEADS, body))
    else:
        parts.append("No row is measured with the present flights yet.")
    return "\n\n".join(parts)


def effect_of(change: str, task: BenchTask, measured: Rows) -> Effect | None:
    """Effect of one of `COMPARED` on the return; None unless both rows have all seeds."""
    own = measured.where(task=task.name, flights=flights_digest(task.flights))
    first, second = (own.of(arm) for arm in COMPARED[change])
    return effect(first, second, "return") if min(first.seeds, second.seeds) >= SEEDS else None


def effects(measured: Rows) -> str:
    """Differences of returns between pairs of rows, by task, as Markdown.

    A task without all seeds of both rows has a dash.
    """
    body = []
    for change in COMPARED:
        found = [effect_of(change, task, measured) for task in TASKS]
        body.append([change, *(MISSING if e is None else _cell(e) for e in found)])
    return f"\n{markdown_table(('change', *(task.name for task in TASKS)), body)}\n"


def _cell(found: Effect) -> str:
    """Effect and p, in bold if it is significant."""
    size = number(found.size, 0)
    return LINE.join(filter(None, (f"**{size}**" if found.significant else size, p_value(found))))


def summary(measured: Rows) -> str:
    """Sentence about the tasks in which a training on the estimate is better or worse."""
    found = {task.name: effect_of(ON_ESTIMATE, task, measured) for task in TASKS}
    known = {name: e for name, e in found.items() if e is not None}
    if not known:
        return NOT_MEASURED
    better = [name for name, e in known.items() if e.significant and e.size.value > 0.0]
    worse = [name for name, e in known.items() if e.significant and e.size.value < 0.0]
    equal = [name for name, e in known.items() if not e.significant]
    says = (("more", better), ("less", worse))
    parts = [f"significantly {words} in {' and '.join(names)}" for words, names in says if names]
    if equal:
        parts.append(f"not significantly more or less in {' and '.join(equal)}")
    return (
        "Tested on the estimate, PPO that was trained on the estimate, compared with PPO that was "
        f"trained on the truth, returns {', '.join(parts)} ({SEEDS} seeds of each)."
    )


def table(measured: Rows, entries: Path = ENTRIES) -> str:
    """All tasks, as Markdown."""
    entered = entry_rows(entries)
    blocks = [block(task, measured, entered.get(task.name, Rows(()))) for task in TASKS]
    return "\n\n" + "\n\n".join(blocks) + "\n"


def texts(file: Path = DATA / "estimate_bench.csv") -> dict[str, str]:
    """Texts of the page, by the names of their marks."""
    measured = Rows.read(file)
    return {
        "benchmark.summary": summary(measured),
        "benchmark.effects": effects(measured),
        "benchmark.table": table(measured),
    }

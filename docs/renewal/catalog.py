"""The catalog of results: commands, what they fly, and the texts and figures made of them.

To add a result, add an entry, and its marks to a page (`docs.renewal.pages`).
"""

import csv
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from docs.renewal.extracts import compile_seconds, interface_speeds, study_rows
from docs.renewal.pages import console, table

Texts = Callable[[Path, Sequence[str]], dict[str, str]]
TRACKING = ("Hover", "Circle", "Lemniscate", "RandomTrajectory")
TESTS = 100_000  # first of the test episodes of studies: nobody looked at them while choosing


@dataclass(frozen=True, kw_only=True)
class Result:
    """One result of the pages."""

    name: str
    """also of its folder below results/renewal"""
    commands: list[str]
    """of `quad-gym`, or a script; OUT stands for a folder of their own"""
    flights: tuple[str, ...]
    """golden flights of its tasks and suites, as patterns; none: a measurement of time"""
    texts: Texts
    """texts by the names of their marks, from the folder and what the commands printed"""
    figures: Mapping[str, str] = field(default_factory=dict)
    """from files below its folder to files of the repository"""


def _read(file: Path) -> Any:
    return json.loads(file.read_text(encoding="utf-8"))


def _rows(file: Path) -> list[dict[str, str]]:
    with file.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def _body(printed: str) -> str:
    """What a command printed, less the lines about the files that it wrote."""
    return printed.partition("\nWrote ")[0]


def _after_trainings(printed: str) -> str:
    """The tables and conclusions of a comparison, without its progress."""
    return _body(printed[printed.index("\nSensors ") :])


def _console(name: str) -> Texts:
    return lambda _, printed: {name: console(_body(printed[0]))}


# ---- controllers --------------------------------------------------------------------------------


def _policies(folder: Path, _: Sequence[str]) -> dict[str, str]:
    rows, ids = [], (*TRACKING, "Waypoints")
    for number, task in enumerate(ids):
        row = [f"`QuadGym/{task}-v0`"]
        for case in _read(folder / f"{number}/summary.json")["cases"]:
            if task == "Waypoints":
                row += [f"{case['gates_passed']:.2f} of 5 gates", f"{case['crash_rate']:.1%}"]
            else:
                row += [f"{1e3 * case['mean_error']:.1f} mm", f"{case['crash_rate']:.1%}"]
        rows.append(row)
    heads = ["id", "tuned PD", "crashed", "the report's PD", "crashed", "included", "crashed"]
    return {"policies": table(heads, rows)}


def _recipes(folder: Path, _: Sequence[str]) -> dict[str, str]:
    rows = []
    for group in _rows(folder / "0/groups.csv"):
        each = [f"{1e3 * float(group[k]):.1f}" for k in ("mean_error", *_ENDS)]
        crashed = [f"{100 * float(group[k]):.1f}" for k in ("crash_rate", *_CRASH_ENDS)]
        rows.append(
            [
                f"`{group['group']}`",
                "{} [{}, {}] mm".format(*each),
                "{} [{}, {}] %".format(*crashed),
            ]
        )
    return {"recipes": table(("trainings", "mean error", "crashed"), rows)}


_ENDS = ("mean_error_low", "mean_error_high")
_CRASH_ENDS = ("crash_rate_low", "crash_rate_high")

# ---- the filter ---------------------------------------------------------------------------------

CONSISTENCY = {
    "`standard`": "--sensors standard --episodes 4000",
    "`rtk`": "--sensors rtk --episodes 4000",
    "`indoor`": "--sensors indoor --episodes 4000",
    "`consumer`": "--sensors consumer --episodes 4000",
    "`lab`, all corrections": "--sensors lab --form corrected --episodes 1000",
    "`lab`, no camera": "--sensors lab --no-camera --episodes 1000",
    "`lab`": "--sensors lab --episodes 1000",
}
PARTS = ("state", "position", "velocity", "attitude", "accel_bias", "gyro_bias")


def _nees(value: float) -> str:
    return f"{value:.2f}" if value < 100.0 else f"{value:,.0f}"


def _ablation(which: str) -> Texts:
    """NEES by part, and root mean square errors, of each case."""

    def texts(folder: Path, _: Sequence[str]) -> dict[str, str]:
        rows = []
        for case, row in _read(folder / f"0/{which}.json")["rows"].items():
            cells = [_nees(row[f"nees_{part}"]) for part in PARTS]
            cells.append(f"{1e3 * row['rms_position']:.1f} mm")
            cells.append(f"{1e3 * row['rms_attitude']:.1f} mrad")
            cells.append(f"{1e3 * row['tracking_mean']:.0f} mm")
            rows.append([case, *cells])
        parts = (part.replace("_", " ") for part in PARTS)
        errors = ("position error", "attitude error", "tracking error")
        return {f"ablation_{which}": table(("case; NEES of", *parts, *errors), rows)}

    return texts


def _consistency(folder: Path, _: Sequence[str]) -> dict[str, str]:
    rows = []
    for number, label in enumerate(CONSISTENCY):
        overall = _read(folder / f"{number}/consistency.json")["overall"]
        rows.append([label, *(_nees(overall[part]) for part in PARTS)])
    heads = ["suite", *(part.replace("_", " ") for part in PARTS)]
    return {"consistency": table(heads, [["(consistent)", "15", *["3"] * 5], *rows])}


def _matrix(folder: Path, _: Sequence[str]) -> dict[str, str]:
    """All cells as CSV, and those that deviate, with the reason where it is known."""
    cells = _read(folder / "0/matrix.json")["cells"]
    names = list(dict.fromkeys(name for cell in cells.values() for name in cell["values"]))
    with (folder / "0/matrix.csv").open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["cell", *names, "misses", "expected"])
        for label, cell in cells.items():
            values = [f"{cell['values'][n]:.4g}" if n in cell["values"] else "" for n in names]
            reasons = "; ".join(cell["expected"].values())
            writer.writerow([label, *values, " ".join(cell["misses"]), reasons])
    rows = []
    for label, cell in cells.items():
        for name in cell["misses"]:
            if "" not in cell["expected"] and name not in cell["expected"]:
                rows.append([label, name, f"{cell['values'][name]:.2f}"])
    inside = sum(not cell["misses"] for cell in cells.values())
    return {
        "matrix": table(("configuration", "quantity", "mean"), rows),
        "matrix.count": f"{len(cells)}",
        "matrix.inside": f"{inside}",
    }


def _recovery(folder: Path, _: Sequence[str]) -> dict[str, str]:
    """All trials as CSV, and those with more than 1 % undetected failures."""
    cells = _read(folder / "0/recovery.json")["cells"]
    faulty = {label: cell for label, cell in cells.items() if "undetected" in cell["values"]}
    calm = {label: cell for label, cell in cells.items() if "undetected" not in cell["values"]}
    for name, chosen in (("faults", faulty), ("calm", calm)):
        columns = list(next(iter(chosen.values()))["values"])
        with (folder / f"0/{name}.csv").open("w", encoding="utf-8", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow(["trial", *columns, "expected"])
            for label, cell in chosen.items():
                values = [cell["values"][column] for column in columns]
                shown = ["" if value is None else f"{value:.4g}" for value in values]
                writer.writerow([label, *shown, cell["expected"]])
    rows = [
        [
            label,
            *(f"{cell['values'][n]:.1f}" for n in ("consistent", "flagged", "undetected")),
            cell["expected"],
        ]
        for label, cell in faulty.items()
        if cell["miss"]
    ]
    alarms = max(cell["values"]["alarms_per_hour"] for cell in calm.values())
    return {
        "recovery": table(
            ("suite, fault", "consistent [%]", "flagged [%]", "undetected [%]", "reason"), rows
        ),
        "recovery.count": f"{len(faulty)}",
        "recovery.alarms": f"{alarms:.1f}",
    }


# ---- studies ------------------------------------------------------------------------------------


def _study(name: str, *arms: str) -> Texts:
    """The whole table, success and crashes of some arms, and single crash rates."""

    def texts(folder: Path, _: Sequence[str]) -> dict[str, str]:
        summary = _read(folder / "0/summary.json")
        found = {
            name: "\n" + (folder / "0/table.md").read_text(encoding="utf-8").strip() + "\n",
            f"{name}.short": study_rows(summary, "trained on", arms, ("success", "crashed")),
        }
        for arm, row in summary["rows"].items():
            percent = 100.0 * row["crashed"]["value"]
            found[f"{name}.{arm}.crashed"] = (
                f"{percent:.1f} %" if percent < 10 else f"{percent:.0f} %"
            )
        return found

    return texts


def _variants(name: str, head: str, *columns: str) -> Texts:
    """Some columns of a study's table."""

    def texts(folder: Path, _: Sequence[str]) -> dict[str, str]:
        return {f"{name}.short": study_rows(_read(folder / "0/summary.json"), head, (), columns)}

    return texts


def _compiling(folder: Path, printed: Sequence[str]) -> dict[str, str]:
    seconds = compile_seconds(_read(folder / "0/benchmark.json"))
    return {"speed.compile": seconds, **_console("speed_compile")(folder, printed)}


def _film_and_figures(study: str, figure: str) -> dict[str, str]:
    names = ("film.webp", "learning.png", f"{figure}.png")
    return {f"0/{name}": f"docs/images/{study}_{name}" for name in names}


_EVALUATE = (
    "evaluate QuadGym/{}-v0 --policy pd pd:lab pretrained --observation estimate --output OUT"
)
_DEFAULTS = "docs/examples/sb3_defaults.py --algorithm ppo --env-id QuadGym/{}-v0 --seed {}"


def _defaults(_: Path, printed: Sequence[str]) -> dict[str, str]:
    errors = [text.strip().splitlines()[-1].split()[4] for text in printed]
    each = [f"{1e3 * float(error):.0f}" for error in errors]
    return {
        "sb3_defaults.hover": ", ".join(each[:3]) + " mm",
        "sb3_defaults.circle": ", ".join(each[3:]) + " mm",
    }


CATALOG = {
    result.name: result
    for result in (
        Result(
            name="circle",
            commands=["circle --output OUT"],
            flights=("Circle, lab",),
            texts=_console("circle"),
            figures={"0/overview.png": ".github/images/circle.png"},
        ),
        Result(
            name="circle_predicted",
            commands=["circle --bearing-noise-at predicted --output OUT"],
            flights=("Circle, lab",),
            texts=_console("circle_predicted"),
        ),
        Result(
            name="evaluate",
            commands=["evaluate QuadGym/Circle-v0 --policy pd pretrained --output OUT"],
            flights=("Circle, standard", "observation truth, standard"),
            texts=_console("evaluate"),
        ),
        Result(
            name="policies",
            commands=[_EVALUATE.format(task) for task in (*TRACKING, "Waypoints")],
            flights=("*, standard",),
            texts=_policies,
        ),
        Result(
            name="recipes",
            commands=[
                "sweep --engine compiled --seeds 5 --output OUT --env-ids "
                + " ".join(f"QuadGym/{task}-v0" for task in TRACKING)
            ],
            flights=("*, standard",),
            texts=_recipes,
        ),
        Result(
            name="compare",
            commands=["compare --engine compiled --sensors standard rtk --output OUT"],
            flights=("Circle, standard", "Circle, rtk", "observation truth", "observation noisy"),
            texts=lambda _, printed: {"compare": console(_after_trainings(printed[0]))},
            figures={"0/learning_standard.png": ".github/images/learning.png"},
        ),
        Result(
            name="consistency",
            commands=[f"consistency {options} --output OUT" for options in CONSISTENCY.values()],
            flights=("RandomTrajectory, *",),
            texts=_consistency,
            figures={"0/nees.png": ".github/images/nees.png"},
        ),
        Result(
            name="matrix",
            commands=["consistency --matrix --episodes 256 --output OUT"],
            flights=("*",),
            texts=_matrix,
            figures={"0/matrix.csv": "docs/data/consistency_matrix.csv"},
        ),
        Result(
            name="recovery",
            commands=["consistency --recovery --episodes 400 --output OUT"],
            flights=("fault *", "RandomTrajectory, *"),
            texts=_recovery,
            figures={
                "0/faults.csv": "docs/data/recovery.csv",
                "0/calm.csv": "docs/data/false_alarms.csv",
            },
        ),
        Result(
            name="ablation_filters",
            commands=["ablation filters --output OUT"],
            flights=("RandomTrajectory, rtk",),
            texts=_ablation("filters"),
        ),
        Result(
            name="ablation_models",
            commands=["ablation models --output OUT"],
            flights=("RandomTrajectory, rtk", "breeze"),
            texts=_ablation("models"),
        ),
        Result(
            name="look_around",
            commands=[
                "study look_around --video webp --output OUT --first-episode 100000 --arms "
                "pd_reference pd_features pd_features_when_uncertain truth noisy noisier certainty "
                "std std_certainty std_certainty_privileged"
            ],
            flights=("LookAround", "LookAround, truth"),
            texts=_study(
                "look_around",
                *("pd_features_when_uncertain", "truth", "noisy", "std", "std_certainty"),
            ),
            figures=_film_and_figures("look_around", "glance"),
        ),
        Result(
            name="miscalibrated",
            commands=[
                "study look_around --arms-file baselines/arms_miscalibrated.py --output OUT "
                "--first-episode 100000 --episodes 1000"
            ],
            flights=("LookAround",),
            texts=_variants("miscalibrated", "condition", "success", "crashed", "error"),
        ),
        Result(
            name="stale_race",
            commands=[
                "study stale_race --video webp --output OUT --first-episode 100000 --arms pd truth "
                "residual std std_history truth_on_truth truth_delay_compensated "
                "std_delay_compensated"
            ],
            flights=("StaleRace", "StaleRace, truth"),
            texts=_study("stale_race", "pd", "truth", "residual", "std", "truth_delay_compensated"),
            figures=_film_and_figures("stale_race", "pace"),
        ),
        Result(
            name="masked",
            commands=[
                "study stale_race --arms-file baselines/arms_masked.py --output OUT "
                "--first-episode 100000"
            ],
            flights=("StaleRace",),
            texts=_variants("masked", "observed", "success", "crashed"),
        ),
        Result(
            name="outage_dash",
            commands=[
                "study outage_dash --video webp --output OUT --first-episode 100000 --arms pd "
                "pd_slow pd_waiting truth std std_privileged truth_on_truth"
            ],
            flights=("OutageDash", "OutageDash, truth"),
            texts=_study("outage_dash", "pd", "pd_waiting", "truth", "std", "std_privileged"),
            figures=_film_and_figures("outage_dash", "pace"),
        ),
        Result(
            name="sb3_defaults",
            commands=[_DEFAULTS.format(t, s) for t in ("Hover", "Circle") for s in range(3)],
            flights=("Hover, standard", "Circle, standard", "Circle, mixed"),
            texts=_defaults,
        ),
        Result(
            name="learning",
            commands=["benchmark --only learning --output OUT"],
            flights=("Circle, standard", "Circle, mixed"),
            texts=_console("learning"),
        ),
        Result(
            name="outage",
            commands=[
                "fly circle --no-camera --seed 1 --faults gnss_outage --fault-time 4 7 --fps 20 "
                "--output OUT/outage.webp"
            ],
            flights=("Circle, standard", "fault gnss_outage"),
            texts=lambda _, __: {},
            figures={"0/outage.webp": ".github/images/outage.webp"},
        ),
        *(
            Result(
                name=f"speed_{section}",
                commands=[f"benchmark --only {section} --output OUT"],
                flights=(),
                texts=texts,
            )
            for section, texts in {
                "filter": _console("speed_filter"),
                "tick": _console("speed_tick"),
                "interfaces": lambda folder, _: interface_speeds(
                    _read(folder / "0/benchmark.json")
                ),
                "options": _console("speed_options"),
                "compile": _compiling,
            }.items()
        ),
    )
}
"""By name, in the order in which they are renewed."""

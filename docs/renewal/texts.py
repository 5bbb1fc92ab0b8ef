"""Texts of the pages, made from the files and the output of the commands of a result."""

import csv
import json
import re
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

from docs.renewal.pages import console as block
from docs.renewal.pages import table
from quad_gym.analysis.metrics import Estimated, rate_interval
from scripts.studies.report import number, share

Texts = Callable[[Path, Sequence[str]], dict[str, str]]
TRACKING = ("Hover", "Circle", "Lemniscate", "RandomTrajectory")
SUITES = {
    "`standard`": "--sensors standard --episodes 4000",
    "`rtk`": "--sensors rtk --episodes 4000",
    "`indoor`": "--sensors indoor --episodes 4000",
    "`consumer`": "--sensors consumer --episodes 4000",
    "`lab`, all corrections": "--sensors lab --form corrected --episodes 1000",
    "`lab`, no camera": "--sensors lab --no-camera --episodes 1000",
    "`lab`": "--sensors lab --episodes 1000",
}
"""Options of the rows of the table of consistency, by label."""

HEADINGS = {
    "return": "return",
    "success": "success",
    "crashed": "crashed",
    "error": "position error [m]",
}
SPEEDS = {
    "estimate": "vector, estimate, 50 Hz, standard",
    "truth": "vector, truth, 50 Hz, standard",
}
"""Names of the benchmark's rows by mark."""


def _read(file: Path) -> Any:
    return json.loads(file.read_text(encoding="utf-8"))


def _body(printed: str) -> str:
    """The output of a command, without the lines about written files."""
    return printed.partition("\nWrote ")[0]


_TRAINED = "training on the estimate"
COMPARED = {
    ("flying on the estimate", "on the truth"): "trained on the truth: error on the estimate minus "
    "error on the truth",
    (
        _TRAINED,
        "training on the truth",
    ): "on the estimate: trained on it minus trained on the truth",
    (_TRAINED, "training on the noisy truth"): "on the estimate: trained on it minus trained on "
    "noisy truth",
    (_TRAINED, "tuned PD control"): "on the estimate: trained on it minus tuned PD control",
}
"""Rows of the short table of a comparison, by the two sides of the sentence with the interval."""


def compare(_: Path, printed: Sequence[str]) -> dict[str, str]:
    """The tables and conclusions of a comparison, without its progress, and a short table."""
    body = _body(printed[0][printed[0].index("\nSensors ") :])
    return {"compare": block(body), "compare.short": compared(body)}


def compared(body: str) -> str:
    """Table of the 95 % intervals of a comparison's sentences, with a column for each suite."""
    suites, rows = dict.fromkeys(re.findall(r"^Sensors (\w+):", body, re.MULTILINE)), []
    for (first, second), row in COMPARED.items():
        sentence = (
            rf"^Sensors (\w+): {first} (?:and|gives .+? than) {second}"
            r"(?: are statistically indistinguishable)? \(\d+ seeds, 95 % interval (.+?)\)"
        )
        intervals = dict(re.findall(sentence, body, re.MULTILINE))
        rows.append([row, *(intervals[suite] for suite in suites)])
    return table(["95 % interval of the mean difference", *(f"`{s}`" for s in suites)], rows)


def console(name: str) -> Texts:
    return lambda _, printed: {name: block(_body(printed[0]))}


def tutorial(_: Path, printed: Sequence[str]) -> dict[str, str]:
    """The output of two blocks of the tutorial."""
    lines = [line for line in printed[0].splitlines() if "crashed" in line or "minus" in line]
    problem, result = "\n".join(lines[:2]), "\n".join(lines[2:])
    return {"tutorial.problem": block(problem), "tutorial.result": block(result)}


def policies(folder: Path, _: Sequence[str]) -> dict[str, str]:
    rows, ids = [], (*TRACKING, "Waypoints")
    for k, task in enumerate(ids):
        row = [f"`QuadGym/{task}-v0`"]
        for case in _read(folder / f"{k}/summary.json")["cases"]:
            if task == "Waypoints":
                row += [f"{case['gates_passed']:.2f} of 5 gates", f"{case['crash_rate']:.1%}"]
            else:
                row += [f"{1e3 * case['mean_error']:.1f} mm", f"{case['crash_rate']:.1%}"]
        rows.append(row)
    heads = ["id", "tuned PD", "crashed", "the report's PD", "crashed", "included", "crashed"]
    return {"policies": table(heads, rows)}


def recipes(folder: Path, _: Sequence[str]) -> dict[str, str]:
    rows = []
    with (folder / "0/groups.csv").open(encoding="utf-8", newline="") as stream:
        for group in csv.DictReader(stream):
            cells = []
            for name, scale, unit in (("mean_error", 1e3, "mm"), ("crash_rate", 1e2, "%")):
                ends = (scale * float(group[f"{name}{end}"]) for end in ("", "_low", "_high"))
                cells.append("{:.1f} [{:.1f}, {:.1f}] {}".format(*ends, unit))
            rows.append([f"`{group['group'].partition(',')[0]}`", *cells])
    return {"recipes": table(("trainings", "mean error", "crashed"), rows)}


PARTS = ("state", "position", "velocity", "attitude", "accel_bias", "gyro_bias")


def _nees(value: float) -> str:
    return f"{value:.2f}" if value < 100.0 else f"{value:,.0f}"


def ablation(which: str) -> Texts:
    """NEES, root mean square errors and tracking errors of each case."""

    def texts(folder: Path, _: Sequence[str]) -> dict[str, str]:
        rows = []
        for case, row in _read(folder / f"0/{which}.json")["rows"].items():
            cells = [
                _nees(row["nees_state"]),
                f"{1e3 * row['rms_position']:.1f} mm",
                f"{1e3 * row['rms_attitude']:.1f} mrad",
                f"{1e3 * row['tracking_mean']:.0f} mm",
            ]
            rows.append([case, *cells])
        heads = ("case", "NEES", "position error", "attitude error", "tracking error")
        return {f"ablation_{which}": table(heads, rows)}

    return texts


def filters(folder: Path, _: Sequence[str]) -> dict[str, str]:
    """Errors and consistency of filters, and tracking errors and losses under control on them."""
    parts = {"position": (1e3, ".1f"), "velocity": (1e3, ".1f"), "attitude": (1e3, ".2f")}
    faults = ("none", "gnss_outage", "gnss_outliers", "wrong_associations")
    accuracy, control = [], []
    for suite in range(4):
        found = _read(folder / f"{suite}/benchmark.json")["sections"]["filters"]
        for row in found:
            first = [f"`{row['suite']}`", row["name"]]
            if row["failed"]:
                accuracy.append([*first, row["failed"], *[""] * 5])
                continue
            errors = [_bracketed(row[f"{part}_rmse"], *form) for part, form in parts.items()]
            nees, nis, us = row["nees"], row["nis"], row["seconds"]
            accuracy.append(
                [
                    *first,
                    *errors,
                    "" if nees is None else f"{nees[0]:,.2f}",
                    "" if nis is None else f"{nis:.2f}",
                    "" if us is None else f"{1e6 * us:,.1f}",
                ]
            )
            if row["tracking"] is not None:
                lost = [
                    f"{row['lost'][fault][0]:.0%}" if fault in row["lost"] else ""
                    for fault in faults
                ]
                control.append([*first, _bracketed(row["tracking"], 1e3, ".0f"), *lost])
    heads = ("suite", "filter", "position [mm]", "velocity [mm/s]", "attitude [mrad]")
    more = ("NEES", "NIS", "us a tick")
    lost_heads = ("lost", "GNSS outage", "GNSS outliers", "wrong features")
    return {
        "filters": table((*heads, *more), accuracy),
        "filters.control": table(("suite", "filter", "error [mm]", *lost_heads), control),
    }


def _bracketed(found: Sequence[float], scale: float, form: str) -> str:
    """A mean, with its interval if there is one."""
    value, *ends = (format(scale * number, form) for number in found)
    return f"{value} [{', '.join(ends)}]" if ends else value


def consistency(folder: Path, _: Sequence[str]) -> dict[str, str]:
    rows = []
    for k, label in enumerate(SUITES):
        overall = _read(folder / f"{k}/consistency.json")["overall"]
        rows.append([label, *(_nees(overall[part]) for part in PARTS)])
    heads = ["suite", *(part.replace("_", " ") for part in PARTS)]
    return {"consistency": table(heads, [["(consistent)", "15", *["3"] * 5], *rows])}


def _write_cells(file: Path, first: str, cells: dict[str, Any], *, misses: bool = False) -> None:
    """Write the values of cells as CSV, with the reasons for misses."""
    names = list(dict.fromkeys(name for cell in cells.values() for name in cell["values"]))
    with file.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([first, *names, *["misses"] * misses, "expected"])
        for label, cell in cells.items():
            values = (cell["values"].get(name) for name in names)
            shown = ["" if value is None else f"{value:.4g}" for value in values]
            missed = [" ".join(cell["misses"])] * misses
            writer.writerow([label, *shown, *missed, "; ".join(cell["expected"].values())])


def matrix(folder: Path, _: Sequence[str]) -> dict[str, str]:
    """Write all cells as CSV; the table has unexpected misses."""
    cells = _read(folder / "0/matrix.json")["cells"]
    _write_cells(folder / "0/matrix.csv", "cell", cells, misses=True)
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


def recovery(folder: Path, _: Sequence[str]) -> dict[str, str]:
    """Write all trials as CSV; the table has trials with more than 1 % undetected failures."""
    cells = _read(folder / "0/recovery.json")["cells"]
    faulty = {label: cell for label, cell in cells.items() if "undetected" in cell["values"]}
    calm = {label: cell for label, cell in cells.items() if "undetected" not in cell["values"]}
    for name, chosen in (("faults", faulty), ("calm", calm)):
        _write_cells(folder / f"0/{name}.csv", "trial", chosen)
    rows = [
        [
            label,
            *(f"{cell['values'][n]:.1f}" for n in ("consistent", "flagged", "undetected")),
            "; ".join(cell["expected"].values()),
        ]
        for label, cell in faulty.items()
        if cell["misses"]
    ]
    alarms = max(cell["values"]["alarms_per_hour"] for cell in calm.values())
    missed = {label: cell["values"]["undetected"] for label, cell in faulty.items()}
    most = sorted(missed, key=lambda label: -missed[label])[:4]
    return {
        "recovery.few": f"{sum(share <= 2.5 for share in missed.values())}",
        "recovery.most": "; ".join(f"{label} ({missed[label]:.0f} %)" for label in most),
        "recovery": table(
            ("suite, fault", "consistent [%]", "flagged [%]", "undetected [%]", "reason"), rows
        ),
        "recovery.count": f"{len(faulty)}",
        "recovery.alarms": f"{alarms:.1f}",
    }


def causes(folder: Path, _: Sequence[str]) -> dict[str, str]:
    """Write the causes of undetected failures as CSV and as a table; shares of sentences."""
    cells = _read(folder / "0/causes.json")["cells"]
    _write_cells(folder / "0/causes.csv", "trial", cells)
    names = ("undetected", "in_measured", "faint", "flagged_before")
    rows = [
        [
            label,
            *(f"{cell['values'][name]:.1f}" for name in names),
            cell["expected"][""],
            f"{cell['values']['remedied']:.1f}",
        ]
        for label, cell in cells.items()
    ]
    heads = (
        "suite, fault",
        "undetected [%]",
        "in a measured quantity [% of these]",
        "too faint [% of these]",
        "flagged before [% of these]",
        "remedy",
        "undetected with it [%]",
    )
    values = {label: cell["values"] for label, cell in cells.items()}
    shares = {
        f"causes.{suite}.{name}": _limits(
            [found[name] for label, found in values.items() if label.startswith(f"{suite}, ")]
        )
        for suite in ("crazyflie", "uwb", "field")
        for name in (*names, "remedied")
    }
    jump = values["crazyflie, position_jump"]
    shares |= {f"causes.jump.{name}": f"{value:.0f} %" for name, value in jump.items()}
    return shares | {"causes": table(heads, rows)}


_OF_COMPASSES = (("in_use", 1), ("without", 2))  #: columns of flights with a compass, and digits


def compass(folder: Path, _: Sequence[str]) -> dict[str, str]:
    """Flights with a wrong compass, as a table."""
    cells = _read(folder / "0/compass.json")["cells"]
    rows = []
    for label, cell in cells.items():
        values, (suite, task, what) = cell["values"], label.split(", ", 2)
        used = [f"{values[n]:.{k}f}" if n in values else "" for n, k in _OF_COMPASSES]
        nees = f"{values['nees']:.2f} ± {values['standard_error']:.2f}"
        tilt = f"{values['tilted']:.1f}", f"{values['worst_tilt']:.1f}"
        rows.append([f"`{suite}`, {task}", what, nees, *used, *tilt])
    heads = (
        "suite, task",
        "compass",
        "NEES per state",
        "compass in use after 10 s [%]",
        "NEES where it is not",
        "tilt off by more than 10 degrees [%]",
        "largest tilt error [deg]",
    )
    return {"compass": table(heads, rows)}


def _limits(shares: Sequence[float]) -> str:
    """The smallest and the largest of some shares [%]."""
    low, high = min(shares), max(shares)
    return f"{low:.0f} %" if round(low) == round(high) else f"{low:.0f} to {high:.0f} %"


def study_rows(
    summary: Mapping[str, Any], head: str, arms: Sequence[str], columns: Sequence[str]
) -> str:
    """A table of some arms of a study, or of all if empty, with columns of `HEADINGS`."""
    labels = {arm["name"]: arm["label"] for arm in summary["study"]["arms"]}
    rows = [
        [labels[name], *(cell(summary["rows"][name][column], column) for column in columns)]
        for name in arms or labels
    ]
    return table((head, *(HEADINGS[column] for column in columns)), rows)


def cell(found: Mapping[str, float], column: str) -> str:
    """A value with its 95 % interval in brackets."""
    estimated = Estimated(*(found[name] for name in ("value", "low", "high")))
    digits = {"error": 3, "return": 1}.get(column)
    return share(estimated) if digits is None else number(estimated, digits)


FLOWN = {
    "LookAround": "look_around --env task=baselines.arm_tasks:WithStd "
    "--policy pd:features_when_uncertain pretrained",
    "OutageDash": "outage_dash --policy pd pretrained",
}
"""Options of the flights on each filter, by task."""


def flown(estimators: Sequence[str]) -> Texts:
    """Crashes of PD control and of the included policy on each filter, by task."""

    def texts(folder: Path, _: Sequence[str]) -> dict[str, str]:
        cells: dict[str, list[str]] = {name: [] for name in estimators}
        for k, (_, name) in enumerate(product(FLOWN, estimators)):
            for case in _read(folder / f"{k}/summary.json")["cases"]:
                crashed = round(case["crash_rate"] * case["episodes"])
                cells[name].append(f"{crashed} of {case['episodes']:.0f}")
        heads = ["filter", *(f"{task}, {who}" for task in FLOWN for who in ("PD", "included"))]
        return {"filters_flown": table(heads, [[name, *row] for name, row in cells.items()])}

    return texts


def included(name: str) -> Texts:
    """Crashes of each controller of an evaluation, with intervals."""

    def texts(folder: Path, _: Sequence[str]) -> dict[str, str]:
        found = {}
        for case in _read(folder / "0/summary.json")["cases"]:
            policy = case["policy"].replace(":", "_")
            rate, n = case["crash_rate"], case["episodes"]
            interval = rate_interval(round(rate * n), n)
            found[f"{name}.{policy}"] = share(Estimated(rate, *interval))
        return found

    return texts


def variants(name: str, head: str, *columns: str) -> Texts:
    """Some columns of a study's table."""

    def texts(folder: Path, _: Sequence[str]) -> dict[str, str]:
        return {f"{name}.short": study_rows(_read(folder / "0/summary.json"), head, (), columns)}

    return texts


def compiling(folder: Path, printed: Sequence[str]) -> dict[str, str]:
    """Seconds of the first reset with the default suite, from an empty cache, and the table."""
    rows = _read(folder / "0/benchmark.json")["sections"]["compile"]
    row = next(r for r in rows if r["name"] == "default" and r["cache"] == "empty")
    return {"speed.compile": f"{row['seconds']:.0f} s", **console("speed_compile")(folder, printed)}


def defaults(_: Path, printed: Sequence[str]) -> dict[str, str]:
    errors = [text.strip().splitlines()[-1].split()[4] for text in printed]
    each = [f"{1e3 * float(error):.0f}" for error in errors]
    return {
        "sb3_defaults.hover": ", ".join(each[:3]) + " mm",
        "sb3_defaults.circle": ", ".join(each[3:]) + " mm",
    }


_SHORT = {
    ("vector, truth", "1,024", "2"): "1,024 environments, on the truth",
    ("vector, estimate", "1,024", "2"): "1,024 environments, on the estimate",
    ("single, estimate", "1", "1"): "one environment, on the estimate, one core",
    ("Pendulum-v1", "1", "1"): "Pendulum-v1 of Gymnasium, one core",
}
"""Rows of README's table of speed, by those of the page."""


def short_speeds(cells: Mapping[tuple[str, ...], str]) -> str:
    rows = [[words, cells[key]] for key, words in _SHORT.items()]
    return table(("", "steps per second"), rows)


def peers(_: Path, printed: Sequence[str]) -> dict[str, str]:
    """Table of simulators and filters, and the number of our filter cycles in one of filterpy."""
    found, rates = console("speed_peers")(_, printed), {}
    for line in printed[0].splitlines():
        if line.startswith("filter cycle, "):
            name, _count, rate, *_rest = line.removeprefix("filter cycle, ").rsplit(maxsplit=6)
            rates[name.strip()] = float(rate.replace(",", ""))
    ratio = rates["UnscentedKalmanFilter"] / rates["filterpy"]
    return {**found, "speed.filterpy": f"{ratio:.0f}"}


def speeds(folder: Path, _: Sequence[str]) -> dict[str, str]:
    """Steps per second of the interfaces with the default suite at 50 Hz."""
    rows = _read(folder / "0/benchmark.json")["sections"]["interfaces"]
    chosen = [
        row
        for row in rows
        if row["name"].startswith("Pendulum")
        or (row["name"].endswith(", 50 Hz, standard") and row["envs"] in (1, 1024))
    ]
    cells = {
        (row["name"].replace(", 50 Hz, standard", ""), f"{row['envs']:,}", str(row["threads"])): (
            f"{1.0 / row['seconds']:,.0f}"
        )
        for row in chosen
    }
    heads = ("interface, observation", "environments", "threads", "steps per second")
    found = {"speed_interfaces": table(heads, [[*key, value] for key, value in cells.items()])}
    found["speed.short"] = short_speeds(cells)
    for mark, name in SPEEDS.items():
        best = max(1.0 / r["seconds"] for r in rows if r["name"] == name and r["envs"] == 1024)
        thousands = f"{best / 1e3:,.0f},000"
        found[f"speed.{mark}"] = thousands if best < 1e6 else f"{best / 1e6:.1f} million"
    return found

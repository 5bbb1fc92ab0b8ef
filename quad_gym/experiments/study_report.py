"""Output of a study: tables, figures, numbers, and a page."""

import base64
import html
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from quad_gym.analysis import plots
from quad_gym.analysis.reports import text_table, versions, write_csv, write_json
from quad_gym.analysis.study_plots import (
    Glance,
    Pace,
    glance_figure,
    pace_figure,
    returns_figure,
)
from quad_gym.experiments.study_flights import Flown
from quad_gym.experiments.study_pair import CHOICES, label_of, pair_of
from quad_gym.experiments.study_results import Results
from quad_gym.experiments.study_tasks import ALWAYS, Column
from quad_gym.experiments.study_words import conclusions, number, share

CAPTIONS = {
    "learning": "Return of the evaluations while training, each arm on what it is trained on; "
    "thin lines are single seeds, bold ones their median.",
    "glance": "The same episode, flown on the estimate. Above, where the vehicle looks; below, "
    f"what the filter states and what is so. {CHOICES['glance']}",
    "pace": "The same episode, flown on the estimate. Above, how fast the vehicle flies; below, "
    f"what the filter states and what is so. {CHOICES['pace']}",
    "film": "The policies and the episode of the figure: the truth, and the estimate on which both "
    "fly.",
}
_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #222; max-width: 64rem; margin: 2rem auto;
  padding: 0 1rem; }
table { border-collapse: collapse; margin: 1rem 0; font-size: 14px; }
th, td { padding: .3rem .7rem; text-align: right; border-bottom: 1px solid #ddd; }
th:first-child, td:first-child { text-align: left; }
figure { margin: 1.5rem 0; } img, video { max-width: 100%; } figcaption { color: #666; }
"""


def columns_of(results: Results) -> dict[str, Column]:
    """The columns of the table, in their order."""
    about = results.study.about
    always = dict(ALWAYS)
    success = Column(heading="success", of=about.success)
    return {
        **{name: always[name] for name in ("return", "worst")},
        "success": success,
        "crashed": always["crashed"],
        **about.columns,
    }


def headings(results: Results) -> tuple[str, ...]:
    """Those of the table, for people."""
    return ("arm", *(column.heading for column in columns_of(results).values()))


def cells(results: Results) -> list[list[str]]:
    """The table's rows, for people."""
    columns = columns_of(results)

    def cell(row: Any, name: str) -> str:
        digits = columns[name].digits
        return share(row[name]) if digits is None else number(row[name], digits)

    return [
        [arm.label, *(cell(results.rows[arm.name], name) for name in columns)]
        for arm in results.study.arms
    ]


def table_text(results: Results) -> str:
    """The table for the screen."""
    heads = headings(results)
    flown = "flown on the estimate unless the arm says otherwise"
    return text_table({"": heads[:1], flown: heads[1:]}, cells(results))


def table_markdown(results: Results) -> str:
    """The table for a page."""
    heads = headings(results)
    lines = [heads, ("---", *["---:"] * (len(heads) - 1)), *cells(results)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def write_report(results: Results, film: Path | None = None) -> list[Path]:
    """Write figures, numbers and pages; the last file is the page to open.

    Args:
        results: Of the study.
        film: A film that is written already, for the page to show.
    """
    folder, arms = results.study.folder, results.study.arms
    columns: dict[str, list[Any]] = {}
    for arm in arms:
        for seed in results.study.seeds_of(arm):
            flown = results.flown[arm.name, seed]
            block: dict[str, Any] = {
                "arm": [arm.name] * len(flown.returns),
                "training_seed": [seed] * len(flown.returns),
                "episode": results.study.first_episode + np.arange(len(flown.returns)),
                "return": flown.returns,
                "crashed": flown.crashed,
                "position_error": flown.error,
                "late_error": flown.late_error,
                "features_in_view": flown.in_view,
                "gates_passed": flown.gates,
                "speed": flown.speed,
                "success": results.study.about.success(flown),
            }
            for name, values in block.items():
                columns.setdefault(name, []).extend(values)
    written = [
        write_csv(folder / "episodes.csv", columns),
        write_json(
            folder / "summary.json",
            {
                **results.description(),
                "conclusions": conclusions(results),
                "versions": versions("numpy", "numba", "scipy"),
            },
        ),
    ]
    (folder / "table.md").write_text(page_text(results), encoding="utf-8")
    written.append(folder / "table.md")
    figures = {name: plots.save_figure(f, folder / name) for name, f in _figures(results).items()}
    for files in figures.values():
        written += files
    shown = {CAPTIONS[name]: files[0] for name, files in figures.items()}
    if film is not None:
        speed = results.study.about.film_speed
        shown[CAPTIONS["film"] + ("" if speed == 1.0 else f" At {speed:g} times the speed.")] = film
        written.append(film)
    return [*written, _page(results, shown)]


def page_text(results: Results) -> str:
    """The setting, the table and the conclusions, in Markdown."""
    study = results.study
    return "\n".join(
        [
            f"{_trainings(results)}{study.episodes:,} test episodes with each policy. Success: "
            f"{study.about.meaning}.",
            "",
            table_markdown(results),
            "",
            *(f"- {sentence}" for sentence in conclusions(results)),
            "",
        ]
    )


def _trainings(results: Results) -> str:
    """How many there were, if there were any."""
    study = results.study
    if not results.trained():
        return ""
    return f"Training seeds: {len(study.seeds)}, of {study.steps()} each; "


def _figures(results: Results) -> dict[str, Any]:
    study, found = results.study, {}
    curves = {
        results.arm(name).label: [results.curves[name, seed] for seed in study.seeds]
        for name in results.trained()
    }
    levels = {results.arm(n).label: results.rows[n]["return"].value for n in results.fixed()}
    if curves:
        found["learning"] = returns_figure(curves, levels)
    pair = pair_of(results)
    if pair is not None:
        episodes = {
            label_of(results, name).replace(", ", ",\n"): (
                results.flown[name, seed].time,
                _traces(results.flown[name, seed], pair.episode),
            )
            for name, seed in pair.trainings.items()
        }
        found[study.about.figure] = _FIGURES[study.about.figure](study.env_id, episodes)
    return found


def half_view_of(env_id: str) -> float:
    """Half of the horizontal angle of view of a task's own camera [rad]."""
    from quad_gym import IDS, sensor_suite
    from quad_gym.envs.benchmarks import BENCHMARKS

    camera = sensor_suite(BENCHMARKS[IDS[env_id]].keywords["sensors"]).camera
    assert camera is not None
    return math.atan(0.5 * camera.image_size[0] / camera.focal_length)


def _glances(env_id: str, episodes: Mapping[str, tuple[Any, dict[str, Any]]]) -> Any:
    glances = {label: Glance(time, **traces) for label, (time, traces) in episodes.items()}
    return glance_figure(glances, half_view_of(env_id))


def _paces(env_id: str, episodes: Mapping[str, tuple[Any, dict[str, Any]]]) -> Any:
    return pace_figure({label: Pace(time, **traces) for label, (time, traces) in episodes.items()})


_FIGURES = {"glance": _glances, "pace": _paces}


def _traces(flown: Flown, k: int) -> dict[str, Any]:
    return {name: values[:, k] for name, values in flown.traces.items()}


def _page(results: Results, shown: Mapping[str, Path]) -> Path:
    """A page with table, conclusions, and pictures and films by their captions."""
    study = results.study
    rows = [f"<tr>{''.join(f'<th>{html.escape(h)}</th>' for h in headings(results))}</tr>"]
    rows += [
        f"<tr>{''.join(f'<td>{html.escape(c)}</td>' for c in line)}</tr>" for line in cells(results)
    ]
    parts = [
        f"<h1>{html.escape(study.env_id)}</h1>",
        f"<p>{_trainings(results)}{study.episodes:,} episodes with each policy, flown on the "
        "estimate unless the arm says otherwise. Means over seeds; in brackets 95 % "
        "intervals over seeds and episodes (quad_gym.analysis.intervals). Success: "
        f"{study.about.meaning}.</p>",
        f"<table>{''.join(rows)}</table><ul>",
        *[f"<li>{html.escape(sentence)}</li>" for sentence in conclusions(results)],
        "</ul>",
    ]
    for caption, picture in shown.items():
        words, kind = html.escape(caption), picture.suffix[1:]
        data = base64.b64encode(picture.read_bytes()).decode()
        tag = f'<img alt="{words}" src="data:image/{kind};base64,{data}">'
        if kind == "mp4":
            tag = f'<video controls loop src="data:video/mp4;base64,{data}"></video>'
        parts.append(f"<figure>{tag}<figcaption>{words}</figcaption></figure>")
    file = study.folder / "report.html"
    file.write_text(
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f"<title>{html.escape(study.env_id)}</title><style>{_STYLE}</style></head><body>"
        + "\n".join(parts)
        + "</body></html>\n",
        encoding="utf-8",
    )
    return file

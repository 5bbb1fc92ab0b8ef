"""Report of a study: tables, figures, numbers, and a page."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from quad_gym import IDS, sensor_suite
from quad_gym.analysis.comparison_plots import learning_figure
from quad_gym.analysis.reports import stacked, text_table, versions, write_csv, write_json
from quad_gym.analysis.study_plots import glance_figure, pace_figure
from quad_gym.envs.benchmarks import BENCHMARKS
from quad_gym.experiments.pages import Report
from quad_gym.experiments.study import StudyResults
from quad_gym.experiments.study_films import CHOICES, label_of, pair_of
from quad_gym.experiments.study_words import conclusions, number, share


def _table(results: StudyResults) -> tuple[tuple[str, ...], list[list[str]]]:
    """Headings and rows of the table."""
    columns = results.study.about.table()

    def cell(row: Any, name: str) -> str:
        digits = columns[name].digits
        return share(row[name]) if digits is None else number(row[name], digits)

    rows = [
        [arm.label, *(cell(results.rows[arm.name], name) for name in columns)]
        for arm in results.study.arms
    ]
    return ("arm", *(column.heading for column in columns.values())), rows


def table_text(results: StudyResults) -> str:
    """Table for the screen."""
    heads, rows = _table(results)
    flown = "flown on the estimate unless the arm says otherwise"
    return text_table({"": heads[:1], flown: heads[1:]}, rows)


def page_text(results: StudyResults) -> str:
    """Setting, table and conclusions, in Markdown."""
    study, (heads, rows) = results.study, _table(results)
    lines = [heads, ("---", *["---:"] * (len(heads) - 1)), *rows]
    return "\n".join(
        [
            f"{_trainings(results)}{study.episodes:,} test episodes with each policy. Success: "
            f"{study.about.meaning}.",
            "",
            *("| " + " | ".join(line) + " |" for line in lines),
            "",
            *(f"- {sentence}" for sentence in conclusions(results)),
            "",
        ]
    )


def _trainings(results: StudyResults) -> str:
    """Number of trainings, if there are any."""
    study = results.study
    if not results.trained():
        return ""
    return f"Training seeds: {len(study.seeds)}, of {study.steps()} each; "


def write_report(results: StudyResults, film: Path | None = None) -> list[Path]:
    """Write figures, numbers and pages; the last file is the page, which also shows the film."""
    study, folder = results.study, results.study.folder
    table = folder / "table.md"
    table.write_text(page_text(results), encoding="utf-8")
    summary = {
        **results.description(),
        "conclusions": conclusions(results),
        "versions": versions("numpy", "numba", "scipy"),
    }
    report = Report(folder, study.env_id)
    report.files += [
        write_csv(folder / "episodes.csv", stacked(_episodes(results))),
        write_json(folder / "summary.json", summary),
        table,
    ]
    report.add(
        "p",
        f"{_trainings(results)}{study.episodes:,} episodes with each policy, flown on the "
        "estimate unless the arm says otherwise. Means over seeds; in brackets 95 % "
        "intervals over seeds and episodes (quad_gym.analysis.intervals). Success: "
        f"{study.about.meaning}.",
    )
    report.add_table(*_table(results))
    report.add_bullets(conclusions(results))
    _add_figures(report, results)
    if film is not None:
        speed = study.about.film_speed
        report.add_picture(
            film,
            "The policies and the episode of the figure: the truth, and the estimate on which both "
            f"fly.{'' if speed == 1.0 else f' At {speed:g} times the speed.'}",
        )
    return report.write()


def _episodes(results: StudyResults) -> Iterator[dict[str, Any]]:
    """Numbers of all episodes, policy by policy."""
    study = results.study
    for arm in study.arms:
        seeds = (None,) if arm.policy is not None else study.seeds
        for seed, flown in zip(seeds, results.flown[arm.name], strict=True):
            episodes = flown.episodes
            yield {
                "arm": [arm.name] * study.episodes,
                "training_seed": [seed] * study.episodes,
                "episode": study.first_episode + np.arange(study.episodes),
                "return": episodes.returns,
                "crashed": episodes.crashed,
                "position_error": episodes.mean_error,
                "late_error": episodes.late_error,
                "features_in_view": flown.recorded["in_view"],
                "gates_passed": episodes.gates_passed,
                "speed": flown.recorded["mean_speed"],
                "success": study.about.success(flown),
            }


def _add_figures(report: Report, results: StudyResults) -> None:
    """Draw the learning curves, and one episode of two policies."""
    study = results.study
    curves = {results.arm(name).label: results.curves[name] for name in results.trained()}
    levels = {results.arm(n).label: results.rows[n]["return"].value for n in results.fixed()}
    if curves:
        report.add_figure(
            "learning",
            learning_figure(curves, levels, score="return of an episode", linear=True),
            "Return of the evaluations during training, each arm on its own observations; "
            "thin lines are single seeds, bold ones their median.",
        )
    pair, kind = pair_of(results), study.about.figure
    if pair is None:
        return
    episodes = {}
    for name, k in pair.trainings.items():
        recorded = results.flown[name][k].recorded
        traces = {trace: recorded[trace][:, pair.episode] for trace in study.about.traced}
        label = label_of(results, name).replace(", ", ",\n")
        episodes[label] = {"time": recorded["time"], **traces}
    if kind == "glance":
        figure, above = glance_figure(episodes, _half_view(study.env_id)), "where the vehicle looks"
    else:
        figure, above = pace_figure(episodes), "the speed of the vehicle"
    report.add_figure(
        kind,
        figure,
        f"The same episode, flown on the estimate. Above, {above}; below, "
        f"standard deviation of the filter, and errors. {CHOICES[kind]}",
    )


def _half_view(env_id: str) -> float:
    """Half of the horizontal field of view of a task's camera [rad]."""
    camera = sensor_suite(BENCHMARKS[IDS[env_id]].keywords["sensors"]).camera
    assert camera is not None
    return math.atan(0.5 * camera.image_size[0] / camera.focal_length)

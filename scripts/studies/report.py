"""Report of a study: tables, conclusions, figures, numbers, and a page."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from quad_gym import IDS, sensor_suite
from quad_gym.analysis.metrics import Estimated, in_brackets
from quad_gym.analysis.plots import learning_figure
from quad_gym.analysis.reports import (
    Report,
    markdown_table,
    stacked,
    text_table,
    versions,
    write_csv,
    write_json,
)
from quad_gym.envs.config import BENCHMARKS
from quad_gym.rendering.video import ending_for_readers
from scripts.studies.films import CHOICES, label_of, pair_of
from scripts.studies.plots import glance_figure, pace_figure
from scripts.studies.rows import Effect
from scripts.studies.scores import difference, permutation_p
from scripts.studies.study import StudyResults

FEW = 5  #: number of seeds below which intervals over trainings are wide


def number(found: Estimated, digits: int) -> str:
    """Number with its interval."""
    return in_brackets(found.value, (found.low, found.high), f"z.{digits}f")


def share(found: Estimated) -> str:
    """Share with its interval, in percent."""
    scaled = Estimated(*(100.0 * value for value in found))
    return number(scaled, 1 if scaled.value < 10.0 else 0) + " %"


def conclusions(results: StudyResults) -> list[str]:
    """Conclusions that intervals and permutation tests allow.

    Two trained arms differ significantly if the p value of a permutation test over their trainings
    is below `SIGNIFICANT`, which needs five trainings each. A trained arm and a fixed rule differ
    significantly if the 95 % interval of their difference excludes zero. For equal arms both are
    rarer than said here; they are less rare for an arm that was selected as the best of several.
    """
    found, seeds, trained = [], len(results.study.seeds), results.trained()
    learned = [name for name in trained if name != "truth"]
    if "truth" in trained and learned:
        found += _against_truth(results, results.best(learned))
    if results.fixed() and trained:
        found.append(_against_rules(results, results.best(trained)))
    for first, second in (("std", "estimate"), ("std_history", "std")):
        if seeds > 1 and {first, second} <= set(trained):
            found.append(_of_pair(results, first, second))
    if trained and seeds < FEW:
        wide = "so few that the intervals are wide"
        if seeds == 1:
            wide = (
                "so that the intervals cover the episodes alone and say nothing of other trainings"
            )
        found.append(f"Training seeds: {seeds}, {wide}: run with {FEW} or more.")
    return found


def _label(results: StudyResults, name: str) -> str:
    arm = results.arm(name)
    return f'the arm "{arm.label}"' if arm.trained else arm.label


def _against_truth(results: StudyResults, best: str) -> list[str]:
    label = _label(results, best)
    ours, truth = results.rows[best], results.rows["truth"]
    p = permutation_p([(results.mean_success(best), results.mean_success("truth"))])
    change = Effect(difference(ours["success"], truth["success"]), p)
    word = "a significant" if change.significant else "no significant"
    points = number(change.scaled(100.0).size, 0)
    verdict = f"{word} difference ({points} percentage points, p = {p:.2g})"
    success = [
        f"On the estimate, {label} succeeds in {share(ours['success'])} of the episodes, and "
        f"{_label(results, 'truth')} in {share(truth['success'])}: {verdict}."
    ]
    crashes = f"It crashes in {share(ours['crashed'])}, compared with {share(truth['crashed'])}"
    telling = results.study.about.telling
    if telling != "error":
        column = results.study.about.columns[telling]
        a, b = (number(row[telling], column.digits or 0) for row in (ours, truth))
        return [*success, f"{crashes}; {column.heading}: {a}, compared with {b}."]
    error, other = ours["error"].value, truth["error"].value
    if other > error:
        smaller = f"{error:.3f} m, compared with {other:.3f} m ({other / error:.1f} times smaller)."
        return [*success, f"{crashes}, and its mean position error is {smaller}"]
    return [*success, f"Its mean position error is {error:.3f} m, not smaller than {other:.3f} m."]


def _against_rules(results: StudyResults, best: str) -> str:
    rule = results.best(results.fixed())
    a, b = results.rows[best]["return"], results.rows[rule]["return"]
    change, label = Effect(difference(a, b), None), _label(results, best)
    verdict = "significantly above" if change.size.value > 0.0 else "significantly below"
    if not change.significant:
        verdict = "not significantly different from"
    return (
        f"{label[0].upper()}{label[1:]} returns {number(a, 1)}, {verdict} the best fixed rule "
        f"({_label(results, rule)}, {number(b, 1)}): a difference of {number(change.size, 1)}."
    )


def _of_pair(results: StudyResults, first: str, second: str) -> str:
    chance = results.improvement(first, second)
    a, b = _label(results, first), _label(results, second)
    return f"Probability of improvement of {a} over {b}: {number(chance, 2)}" + (
        ", which is not significant." if chance.low <= 0.5 <= chance.high else "."
    )


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
    flown = "evaluated on the estimate unless the arm says otherwise"
    return text_table({"": heads[:1], flown: heads[1:]}, rows)


def write_report(results: StudyResults, film: Path | None = None) -> list[Path]:
    """Write figures, numbers and pages; the last file is the page, which also shows the film."""
    study, folder, (heads, rows) = results.study, results.study.folder, _table(results)
    trainings = f"Training seeds: {len(study.seeds)}, of {study.steps()} each; "
    flown = f"{trainings if results.trained() else ''}{study.episodes:,}"
    text = [
        f"{flown} test episodes with each policy. Success: {study.about.meaning}.",
        "",
        markdown_table(heads, rows),
        "",
        *(f"- {sentence}" for sentence in conclusions(results)),
    ]
    table = folder / "table.md"
    table.write_text("\n".join([*text, ""]), encoding="utf-8")
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
        f"{flown} episodes with each policy, evaluated on the "
        "estimate unless the arm says otherwise. A crashed episode counts with the position error "
        "out_of_bounds of the task from its crash on. Means over seeds; in brackets 95 % "
        "intervals over seeds and episodes (quad_gym.analysis.metrics). Success: "
        f"{study.about.meaning}.",
    )
    report.add_table(heads, rows)
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
    tests = {results.arm(n).label: results.rows[n]["return"].value for n in results.trained()}
    if curves:
        report.add_figure(
            "learning",
            learning_figure(curves, levels, score="return of an episode", linear=True, tests=tests),
            "Return of the validation during training, each arm on its own observations. "
            "Thin lines are single seeds, bold ones their median. Dots: return in the test on the "
            "estimate, which compares the arms.",
        )
    pair, kind = pair_of(results), study.about.figure
    if pair is None or kind == "none":
        return
    episodes = {}
    for name, k in pair.trainings.items():
        recorded = results.flown[name][k].recorded
        traces = {trace: recorded[trace][:, pair.episode] for trace in study.about.traced}
        label = label_of(results, name).replace(", ", ",\n")
        flown = results.flown[name][k].episodes
        ending = ending_for_readers(str(flown.ending[pair.episode]))
        ending = f"crash: {ending}" if flown.crashed[pair.episode] else "finish"
        episodes[label] = {"time": recorded["time"], "ending": ending, **traces}
    if kind == "glance":
        camera = sensor_suite(BENCHMARKS[IDS[study.env_id]].keywords["sensors"]).camera
        assert camera is not None
        half_view = math.atan(0.5 * camera.image_size[0] / camera.focal_length)
        figure, above = glance_figure(episodes, half_view), "where the vehicle looks"
    else:
        figure, above = pace_figure(episodes), "the speed of the vehicle"
    report.add_figure(
        kind,
        figure,
        f"The same episode, evaluated on the estimate. Above, {above}; below, "
        f"standard deviation of the filter, and errors. {CHOICES[kind]}",
    )

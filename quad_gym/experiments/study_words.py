"""Conclusions of a study, computed from its numbers.

Two arms differ significantly if the 95 % interval of their difference excludes zero. For equal arms
the probability of this is 1 % with three trainings each, 2 % with five, and at most 5 % with many;
it is larger for an arm that was selected as the best of several by the same numbers.
"""

from collections.abc import Mapping

from quad_gym.analysis.intervals import Estimated, difference, in_brackets
from quad_gym.experiments.study import StudyResults

FEW = 5
"""Number of seeds below which intervals over trainings are wide."""


def number(found: Estimated, digits: int) -> str:
    """Number with its interval."""
    return in_brackets(found.value, (found.low, found.high), f".{digits}f")


def share(found: Estimated) -> str:
    """Share with its interval, in percent."""
    scaled = Estimated(*(100.0 * value for value in found))
    return number(scaled, 1 if scaled.value < 10.0 else 0) + " %"


def conclusions(results: StudyResults) -> list[str]:
    """Conclusions that the intervals allow."""
    found = []
    learned = [name for name in results.trained() if name != "truth"]
    if "truth" in results.trained() and learned:
        found += _against_truth(results, results.best(learned))
    if results.fixed() and results.trained():
        found.append(_against_rules(results, results.best(results.trained())))
    several = len(results.study.seeds) > 1
    if several and {"estimate", "std"} <= set(results.trained()):
        found.append(_of_pair(results, "std", "estimate"))
    if several and {"std_history", "std"} <= set(results.trained()):
        found.append(_of_pair(results, "std_history", "std"))
    if results.trained() and len(results.study.seeds) < FEW:
        wide = "so few that the intervals are wide"
        alone = "so that the intervals cover the episodes alone and say nothing of other trainings"
        found.append(
            f"Training seeds: {len(results.study.seeds)}, {wide if several else alone}: run with "
            f"{FEW} or more."
        )
    return found


def _label(results: StudyResults, name: str) -> str:
    arm = results.arm(name)
    return f'the arm "{arm.label}"' if arm.trained else arm.label


def _against_truth(results: StudyResults, best: str) -> list[str]:
    label = _label(results, best)
    ours, truth = results.rows[best], results.rows["truth"]
    change = difference(ours["success"], truth["success"])
    points = number(Estimated(*(100.0 * value for value in change)), 0)
    verdict = f"a difference of {points} percentage points"
    if change.holds(0.0):
        verdict = f"no significant difference ({points} percentage points)"
    return [
        f"On the estimate, {label} succeeds in {share(ours['success'])} of the episodes, and "
        f"{_label(results, 'truth')} in {share(truth['success'])}: {verdict}.",
        _how(results, ours, truth),
    ]


def _how(
    results: StudyResults, ours: Mapping[str, Estimated], truth: Mapping[str, Estimated]
) -> str:
    """Difference in crashes and in the column of the task that conclusions quote."""
    telling = results.study.about.telling
    crashes = f"It crashes in {share(ours['crashed'])}, compared with {share(truth['crashed'])}"
    if telling != "error":
        column = results.study.about.columns[telling]
        a, b = (number(row[telling], column.digits or 0) for row in (ours, truth))
        return f"{crashes}; {column.heading}: {a}, compared with {b}."
    ratio = truth["error"].value / ours["error"].value
    if ratio > 1.0:
        return (
            f"{crashes}, and its mean position error is {ours['error'].value:.3f} m, compared with "
            f"{truth['error'].value:.3f} m ({ratio:.1f} times smaller)."
        )
    return (
        f"Its mean position error is {ours['error'].value:.3f} m, not smaller than "
        f"{truth['error'].value:.3f} m."
    )


def _against_rules(results: StudyResults, best: str) -> str:
    rule = results.best(results.fixed())
    a, b = results.rows[best]["return"], results.rows[rule]["return"]
    change = difference(a, b)
    verdict = "significantly above" if change.value > 0.0 else "significantly below"
    if change.holds(0.0):
        verdict = "not significantly different from"
    return (
        f"{_label(results, best)[0].upper()}{_label(results, best)[1:]} returns {number(a, 1)}, "
        f"{verdict} the best fixed rule ({_label(results, rule)}, {number(b, 1)}): a difference of "
        f"{number(change, 1)}."
    )


def _of_pair(results: StudyResults, first: str, second: str) -> str:
    chance = results.improvement(first, second)
    a, b = _label(results, first), _label(results, second)
    return (
        f"A training of {a} returns more than one of {b} with probability {number(chance, 2)}"
        + (", which is not significant." if chance.low <= 0.5 <= chance.high else ".")
    )

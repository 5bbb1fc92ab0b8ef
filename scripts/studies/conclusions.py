"""Conclusions of the studies, each computed from rows per seed.

A conclusion is a function of the rows of a table. It names arms, seeds, budget and intervals, and
its verdict follows from a permutation test over the trainings (`Effect.significant`). Where a row
is missing, or of other flights, it is `NOT_MEASURED`. `docs.renewal` writes the texts into the
pages, and a test compares these with the rows.
"""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from itertools import product
from pathlib import Path
from typing import NamedTuple

from quad_gym.analysis.metrics import Estimated
from quad_gym.analysis.reports import markdown_table
from scripts.studies.arms import SLOWED
from scripts.studies.campaign import DATA, Part, flights_digest, is_complete
from scripts.studies.parts import (
    BUDGETS,
    CURVE_ARMS,
    IMITATION_STEPS,
    PARTS,
    RACE_CURVE,
    SUITES,
    TRACKING_STEPS,
)
from scripts.studies.report import number, share
from scripts.studies.rows import RATES, Effect, Rows, effect, mean_effect

NOT_MEASURED = (
    "This is not yet measured with the present flights (`python -m scripts.studies run --all`)."
)
"""Text of a conclusion or table whose rows are missing or of other flights."""

Conclusion = Callable[[Rows], str]


class MissingRowsError(ValueError):
    """Error raised if an arm has not been measured."""


def points(found: Effect, separator: str = " ") -> str:
    """Difference of rates in percentage points, with its interval and verdict."""
    return f"{number(found.scaled(100.0).size, 0)} points{separator}({verdict(found)})"


LINE = "<br>"  #: separator in cells of tables, so that these are narrow


def p_value(found: Effect) -> str:
    """P value of a difference; empty where an arm is a fixed rule."""
    if found.p is None:
        return ""
    return "p < 0.001" if found.p < 0.001 else f"p = {found.p:.2g}"


def findings(found: Effect) -> tuple[str, ...]:
    """P value of a difference, and whether it is significant where the p value does not say it."""
    p, word = p_value(found), "significant" if found.significant else "not significant"
    if not p:
        return (word,)
    return (p,) if found.significant else (p, word)


def verdict(found: Effect) -> str:
    """The same as words in a sentence."""
    return ", ".join(findings(found))


def table(heads: Sequence[str], body: Sequence[Sequence[str]], texts: int = 1) -> str:
    """Table of a page, between its marks."""
    return f"\n{markdown_table(heads, body, texts)}\n"


class Arms:
    """Rows of arms, and words about them.

    Each arm has one number of steps: the first of the given ones with which it was trained.
    """

    def __init__(self, rows: Rows, *steps: int) -> None:
        self._rows, self._steps = rows, steps

    def __getitem__(self, name: str) -> Rows:
        for steps in self._steps:
            found = self._rows.of(name, steps)
            if found.rows:
                return found
        raise MissingRowsError(name)

    def success(self, name: str) -> str:
        """Success of an arm, in percent."""
        return share(self[name].estimated("success"))

    def budget(self, *names: str) -> str:
        """Number of seeds, and of steps."""
        counts = sorted({self[name].seeds for name in names})
        seeds = str(counts[0]) if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
        steps = sorted({self[name].steps for name in names})
        return f"{seeds} seeds, {' or '.join(f'{count:,}' for count in steps)} steps"

    def against(
        self, first: str, second: str, column: str = "success", separator: str = " "
    ) -> str:
        """Difference of two arms."""
        return points(effect(self[first], self[second], column), separator)


def compared(arms: Arms, names: Sequence[str], against: Mapping[str, str]) -> str:
    """Table of arms and their differences from others, given by the words for these."""
    body = []
    for name in names:
        others = [
            arms.against(name, other, separator=LINE) if name != other else ""
            for other in against.values()
        ]
        body.append([arms[name].label, str(arms[name].seeds), arms.success(name), *others])
    heads = ["trained on", "seeds", "success", *(f"difference from {words}" for words in against)]
    return table(heads, body)


def look_around_headline(rows: Rows) -> str:
    """Training on the estimate with the task's own reward, for readers of one sentence."""
    arms, (ours, other) = Arms(rows, BUDGETS["LookAround"]), ("std", "truth_std")
    success, crashes = (effect(arms[ours], arms[other], column) for column in RATES)
    shown = [share(arms[name].estimated(column)) for column in RATES for name in (ours, other)]
    return (
        f"Policies that observe the filter's standard deviation succeed in {shown[0]} of the "
        f"episodes on the estimate if they were trained on the estimate, and in {shown[1]} if they "
        f"were trained on the truth ({verdict(success)}). Their crash rates are {shown[2]} and "
        f"{shown[3]} ({verdict(crashes)}; {arms.budget(ours, other)})."
    )


_OBSERVATION = "training on the estimate"
_FACTORS = {
    _OBSERVATION: (
        ("estimate", "truth"),
        ("std", "truth_std"),
        ("certainty", "truth_certainty"),
        ("std_certainty", "truth_std_certainty"),
    ),
    "observing the standard deviation": (
        ("truth_std", "truth"),
        ("std", "estimate"),
        ("truth_std_certainty", "truth_certainty"),
        ("std_certainty", "certainty"),
    ),
    "the reward for certainty": (
        ("truth_certainty", "truth"),
        ("certainty", "estimate"),
        ("truth_std_certainty", "truth_std"),
        ("std_certainty", "std"),
    ),
}
"""Pairs of arms of LookAround that differ in one factor only."""


def look_around_observation(rows: Rows) -> str:
    """Effect of the training observation in each combination of the other two factors."""
    arms, body = Arms(rows, BUDGETS["LookAround"]), []
    for ours, other in _FACTORS[_OBSERVATION]:
        condition = arms[other].label.removeprefix("truth").lstrip("+, ") or "neither"
        shown = [share(arms[name].estimated("success")) for name in (other, ours)]
        changes = [points(effect(arms[ours], arms[other], column), LINE) for column in RATES]
        body.append([condition, *shown, *changes])
    heads = ["in both arms", "trained on the truth", "trained on the estimate"]
    return table([*heads, "difference", "difference in crashes"], body)


def look_around_factors(rows: Rows) -> str:
    """Effect of each of the three factors, averaged over the others."""
    arms, body = Arms(rows, BUDGETS["LookAround"]), []
    for factor, pairs in _FACTORS.items():
        compared = [(arms[first], arms[second]) for first, second in pairs]
        body.append([factor, *(points(mean_effect(compared, column)) for column in RATES)])
    return table(["factor", "difference in success", "difference in crashes"], body)


def look_around_noise(rows: Rows) -> str:
    """Noise on the truth instead of the filter, all else equal."""
    names = ("noisy_std_certainty", "matched_std_certainty")
    against = {"the truth": "truth_std_certainty", "the estimate": "std_certainty"}
    return compared(Arms(rows, BUDGETS["LookAround"]), names, against)


def look_around_single(rows: Rows) -> str:
    """Flights of the training in single precision, all else equal."""
    arms = Arms(rows, BUDGETS["LookAround"])
    names = single, double = ("std_certainty_single", "std_certainty")
    success, crashed = ([share(arms[name].estimated(column)) for name in names] for column in RATES)
    return (
        f"In LookAround, policies whose training flew in single precision succeed in {success[0]} "
        f"of the episodes in double precision and crash in {crashed[0]} "
        f"({arms.budget(single)}). Those whose training flew in double precision succeed in "
        f"{success[1]} and crash in {crashed[1]} ({arms[double].seeds} seeds), a difference in "
        f"success of {arms.against(single, double)} and in crashes of "
        f"{arms.against(single, double, 'crashed')}."
    )


def stale_race_headline(rows: Rows) -> str:
    """Late measurements, for readers of one sentence."""
    arms = Arms(rows, BUDGETS["StaleRace"])
    found = effect(arms["estimate"], arms["truth"])
    return (
        f"Policies that were trained on the estimate pass all gates in {arms.success('estimate')} "
        f"of the episodes on the estimate, and policies that were trained on the truth in "
        f"{arms.success('truth')} ({verdict(found)}; {arms.budget('estimate', 'truth')}). With a "
        f"filter that compensates the delay, the latter succeed in "
        f"{arms.success('truth_delay_compensated')}. PD control succeeds in {arms.success('pd')} "
        f"without compensation."
    )


def stale_race_training(rows: Rows) -> str:
    """Training on the estimate in the race with late measurements."""
    arms = Arms(rows, BUDGETS["StaleRace"])
    return (
        f"On the estimate, policies that were trained on the truth pass all gates in "
        f"{arms.success('truth')} of the episodes, and policies that were trained on the estimate "
        f"in {arms.success('estimate')}, a difference of {arms.against('estimate', 'truth')}. "
        f"Policies that also observe the 15 standard deviations succeed in {arms.success('std')}, "
        f"which differs from those without by {arms.against('std', 'estimate')}. Each arm has "
        f"{arms.budget('truth', 'estimate', 'std')}. On the truth, the policies that were trained "
        f"on it pass all gates in "
        f"{arms.success('truth_on_truth')}. PD control passes them on the estimate in "
        f"{arms.success('pd')}."
    )


def stale_race_compensation(rows: Rows) -> str:
    """Compensating the delay in the filter instead of training on its errors."""
    arms = Arms(rows, BUDGETS["StaleRace"])
    pair = ("truth_delay_compensated", "std_delay_compensated")
    return (
        f"If the filter compensates the delay in the test, the same policies pass all gates in "
        f"{arms.success(pair[0])} (trained on the truth) and {arms.success(pair[1])} (trained on "
        f"the estimate and 15 standard deviations, without compensation). The success of policies "
        f"that were trained on the truth changes by {arms.against(pair[0], 'truth')}, and then "
        f"differs from that of policies that were trained and tested on the uncompensated estimate "
        f"and its deviations by {arms.against(pair[0], 'std')}."
    )


def stale_race_substitutes(rows: Rows) -> str:
    """Noise, a residual model and a compensating filter in training, without deviations."""
    names = ("noisy", "residual", "compensated")
    against = {"the truth": "truth", "the estimate": "estimate"}
    return compared(Arms(rows, BUDGETS["StaleRace"]), names, against)


def stale_race_curve(rows: Rows) -> str:
    """Success by budget, as a table, which names the budgets that are not complete."""
    body, (truth, ours) = [], CURVE_ARMS
    measured = {int(row["steps"]) for row in rows.of(ours).rows}
    for steps in sorted((*RACE_CURVE, BUDGETS["StaleRace"])):
        if steps not in measured:
            body.append([f"{steps:,}", "not yet measured", "not yet measured", ""])
            continue
        arms = Arms(rows, steps)
        changed = arms.against(ours, truth, separator=LINE)
        body.append([f"{steps:,}", arms.success(truth), arms.success(ours), changed])
    seeds = Arms(rows, BUDGETS["StaleRace"])[CURVE_ARMS[0]].seeds
    heads = [
        "steps",
        f"truth ({seeds} seeds)",
        f"estimate + 15 standard deviations ({seeds} seeds)",
    ]
    return table([*heads, "difference"], body, texts=0)


def outage_dash_rules(rows: Rows) -> str:
    """Rules: waiting once does not pay."""
    arms = Arms(rows, BUDGETS["OutageDash"])
    return (
        f"PD control that does not wait succeeds in {arms.success('pd')} of "
        f"{arms['pd'].episodes:,} episodes. To wait at the start for the end of an outage gives "
        f"{arms.success('pd_waits_at_start')}, to wait wherever the filter is uncertain "
        f"{arms.success('pd_waiting')}, and to back off from walls as well "
        f"{arms.success('pd_backs_off')}. Waiting once differs from waiting when uncertain by "
        f"{arms.against('pd_waits_at_start', 'pd_waiting')}."
    )


def outage_dash_learned(rows: Rows) -> str:
    """Learned policies without memory, against each other and the best rule."""
    names, best = ("truth", "std", "since_fix", "imitation"), "pd_backs_off"
    against = {"the truth": "truth", "the rule that backs off": best}
    return compared(Arms(rows, BUDGETS["OutageDash"], IMITATION_STEPS), names, against)


def outage_dash_speed(rows: Rows) -> str:
    """Success and return by the speed of PD control while the filter is uncertain, as a table."""
    arms = Arms(rows, IMITATION_STEPS)
    kinds = {"100 %": "pd", **{f"{share} %": f"pd_slows_to_{share}" for share in SLOWED}}
    kinds["waits halfway between walls"] = "pd_waiting"
    body = [
        [words, arms.success(name), number(arms[name].estimated("return"), 1)]
        for words, name in kinds.items()
    ]
    return table(["speed while uncertain", "success", "return"], body)


def outage_dash_imitation(rows: Rows) -> str:
    """Imitation of the best rule, against the rule and PPO with the same observation."""
    arms = Arms(rows, BUDGETS["OutageDash"], IMITATION_STEPS)
    speeds = {name: arms[name].estimated("speed") for name in ("std", "pd_backs_off", "pd")}
    return (
        f"A network that imitates the rule that backs off from the observation *estimate + "
        f"normalized uncertainty* succeeds in {arms.success('imitation')} of the episodes "
        f"({arms.budget('imitation')}). It differs from the rule by "
        f"{arms.against('imitation', 'pd_backs_off')}, and from the policies that PPO finds with "
        f"the same observation and network by {arms.against('imitation', 'std')}. These fly at "
        f"{number(speeds['std'], 1)} m/s on average, the rule at "
        f"{speeds['pd_backs_off'].value:.1f} m/s, and PD control that does not wait at "
        f"{speeds['pd'].value:.1f} m/s."
    )


def outage_dash_memory(rows: Rows) -> str:
    """A recurrent policy against the best rule and the policy without memory."""
    arms = Arms(rows, BUDGETS["OutageDash"])
    return (
        f"A recurrent policy on the estimate and its normalized uncertainty succeeds in "
        f"{arms.success('recurrent')} of the episodes ({arms.budget('recurrent')}). This differs "
        f"from the policy without memory by {arms.against('recurrent', 'std')}, and from the rule "
        f"that backs off by {arms.against('recurrent', 'pd_backs_off')}."
    )


class Case(NamedTuple):
    """Arms of a task that follows a reference, with one suite."""

    task: str
    suite: str
    ideal: Rows  #: trained and tested on the truth
    truth: Rows  #: trained on the truth, as all that follow tested on the estimate
    estimate: Rows  #: trained on the estimate
    rule: Rows  #: PD control

    @property
    def name(self) -> str:
        """Name in a sentence."""
        return f"{self.task} with `{self.suite}`"

    @property
    def seeds(self) -> int:
        """Number of trainings of each arm."""
        return min(self.truth.seeds, self.estimate.seeds)

    @property
    def column(self) -> str:
        """Column that measures success in the task."""
        return "success" if self.task == "Waypoints" else "error"

    @property
    def sign(self) -> float:
        """Sign with which a larger number is worse."""
        return -1.0 if self.column == "success" else 1.0

    @property
    def cost(self) -> Effect:
        """Change of policies trained on the truth when they fly on the estimate."""
        return effect(self.truth, self.ideal, self.column).scaled(self.sign)

    @property
    def gain(self) -> Effect:
        """Part of the cost that training on the estimate takes away."""
        return effect(self.truth, self.estimate, self.column).scaled(self.sign)


def cases(rows: Rows) -> list[Case]:
    """Cases that have been measured, in their order."""
    found = []
    for (task, steps), suite in product(TRACKING_STEPS.items(), SUITES):
        arms = Arms(rows.where(task=task, suite=suite), steps)
        names = ("truth_on_truth", "truth", "estimate", "pd")
        with suppress(MissingRowsError):  # of a part that is not complete
            found.append(Case(task, suite, *(arms[name] for name in names)))
    if not found:
        raise MissingRowsError("truth")
    return found


def when_to_train(rows: Rows) -> str:
    """Cost of flying on the estimate and gain of training on it, by task and suite, as a table."""
    body = [
        [
            case.task,
            f"`{case.suite}`",
            _shown(case.rule.estimated(case.column), case.column, rule=True),
            _shown(case.ideal.estimated(case.column), case.column),
            _shown(case.cost.size, case.column),
            LINE.join([_shown(case.gain.size, case.column), *findings(case.gain)]),
            f"{case.seeds}",
        ]
        for case in cases(rows)
    ]
    heads = [
        "task",
        "sensors",
        "PD on the estimate",
        "trained and tested on the truth",
        "cost of flying on the estimate",
        "gain of training on it",
        "seeds",
    ]
    return table(heads, body, texts=2)


def when_to_train_summary(rows: Rows) -> str:
    """In how many of the cases training on the estimate wins or loses significantly."""
    measured, planned = cases(rows), len(TRACKING_STEPS) * len(SUITES)
    changed = [case for case in measured if case.gain.significant]
    wins = [case.name for case in changed if case.gain.size.value > 0.0]
    losses = [case.name for case in changed if case.gain.size.value < 0.0]
    counts = sorted({case.seeds for case in measured})
    seeds = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    rest = planned - len(measured)
    text = (
        f"Training on the estimate is significantly better in {len(wins)} of {len(measured)} cases"
        f"{_listed(wins)}, and significantly worse in {len(losses)}{_listed(losses)} "
        f"({seeds} seeds of each arm)."
    )
    return text + (f" The other {rest} cases are not yet measured." if rest else "")


def _listed(names: list[str]) -> str:
    return f" ({', '.join(names)})" if names else ""


def _shown(found: Estimated, column: str, rule: bool = False) -> str:
    """Errors in millimeters, rates in percent; the mean error of a rule has no interval."""
    scale, unit = (100.0, "%") if column == "success" else (1e3, "mm")
    scaled = Estimated(*(scale * value for value in found))
    text = f"{scaled.value:.0f}" if rule and column == "error" else number(scaled, 0)
    return f"{text} {unit}"


def arms_table(name: str, steps: int) -> Conclusion:
    """Make the table of the arms of a study with one budget, as Markdown."""

    def text(rows: Rows) -> str:
        own = [part for part in PARTS if part.table == name and part.steps == steps]
        names = dict.fromkeys(arm for part in own for arm in part.arms)
        arms, body = Arms(rows, steps), []
        for arm in names:
            try:
                found = arms[arm]
            except MissingRowsError:
                continue  # of a part that is not complete
            body.append(
                [
                    found.label,
                    str(found.seeds) if found.trained else "rule",
                    share(found.estimated("success")),
                    share(found.estimated("crashed")),
                    number(found.estimated("return"), 1),
                ]
            )
        if not body:
            raise MissingRowsError(name)
        return table(["trained on", "seeds", "success", "crashed", "return"], body)

    return text


CONCLUSIONS: Mapping[str, tuple[str, Conclusion]] = {
    "look_around.table": ("look_around", arms_table("look_around", BUDGETS["LookAround"])),
    "look_around.headline": ("look_around", look_around_headline),
    "look_around.observation.table": ("look_around", look_around_observation),
    "look_around.factors.table": ("look_around", look_around_factors),
    "look_around.noise.table": ("look_around", look_around_noise),
    "look_around.single": ("look_around", look_around_single),
    "stale_race.table": ("stale_race", arms_table("stale_race", BUDGETS["StaleRace"])),
    "stale_race.headline": ("stale_race", stale_race_headline),
    "stale_race.training": ("stale_race", stale_race_training),
    "stale_race.compensation": ("stale_race", stale_race_compensation),
    "stale_race.substitutes.table": ("stale_race", stale_race_substitutes),
    "stale_race.curve.table": ("stale_race", stale_race_curve),
    "outage_dash.table": ("outage_dash", arms_table("outage_dash", BUDGETS["OutageDash"])),
    "outage_dash.rules": ("outage_dash", outage_dash_rules),
    "outage_dash.learned.table": ("outage_dash", outage_dash_learned),
    "outage_dash.speed.table": ("outage_dash", outage_dash_speed),
    "outage_dash.imitation": ("outage_dash", outage_dash_imitation),
    "outage_dash.memory": ("outage_dash", outage_dash_memory),
    "when_to_train.table": ("when_to_train", when_to_train),
    "when_to_train.summary": ("when_to_train", when_to_train_summary),
}
"""Table and function of each conclusion, by the name of its mark on pages."""


def present_rows(table: str, folder: Path = DATA) -> Rows:
    """Rows of a table that were measured on the present flights."""
    digests = {flights_digest(part.flights) for part in PARTS if part.table == table}
    rows = Rows.read(folder / f"{table}.csv")
    return Rows([row for row in rows.rows if row["flights"] in digests])


def texts(folder: Path = DATA) -> dict[str, str]:
    """Texts of all conclusions by mark; `NOT_MEASURED` where rows are missing."""
    found, rows = {}, {}
    for mark, (table, conclude) in CONCLUSIONS.items():
        if table not in rows:
            rows[table] = present_rows(table, folder)
        try:
            found[mark] = conclude(rows[table])
        except MissingRowsError:
            # a mark of a table is on a line of its own
            found[mark] = f"\n{NOT_MEASURED}\n" if mark.endswith(".table") else NOT_MEASURED
    return found


def incomplete(parts: tuple[Part, ...] = PARTS, folder: Path = DATA) -> list[Part]:
    """Parts whose rows are missing, or of other flights."""
    return [
        part for part in parts if not is_complete(part, Rows.read(folder / f"{part.table}.csv"))
    ]

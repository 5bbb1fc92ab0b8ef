"""The campaign of studies: cells, their rows, resumption, and remaining work."""

import dataclasses
from itertools import combinations

import numpy as np
import pytest
from scipy.stats import fisher_exact

from quad_gym.analysis.metrics import mean_interval, rate_over_trainings
from scripts.studies import again, campaign, conclusions, run
from scripts.studies.campaign import Part, is_complete
from scripts.studies.parts import PARTS
from scripts.studies.rows import Rows, effect, mean_effect
from scripts.studies.scores import permutation_p

SMALL = Part(
    table="small",
    decides="whether it works",
    env_id="QuadGym/LookAround-v0",
    arms=("pd_features", "truth_std_certainty", "std_certainty"),
    steps=16_384,
    seeds=2,
    flights=("LookAround",),
    environment={"duration": 0.4},
)


@pytest.fixture
def small(monkeypatch, tmp_path):
    monkeypatch.setattr(campaign, "EPISODES", 6)
    monkeypatch.setattr(run, "PARTS", (SMALL,))
    monkeypatch.setattr(run, "TABLES", ("small",))
    monkeypatch.setattr(run, "DATA", tmp_path / "data")
    monkeypatch.setattr(run.os, "nice", lambda _: 0)
    return run.RunArgs(all=True, output=tmp_path / "out")


def test_campaign_continues_where_it_stopped_and_repeats_lost_rows(small, capsys):
    assert run.main(dataclasses.replace(small, cells=2)) == 0
    text = capsys.readouterr().out
    assert "0 of 5 rows" in text
    assert "2 of 5 rows" in text
    assert not (run.DATA / "small.csv").exists()  # incomplete
    assert run.main(small) == 0
    assert "5 of 5 rows, complete" in capsys.readouterr().out
    found = Rows.read(run.DATA / "small.csv")
    assert [(row["arm"], row["seed"]) for row in found.rows] == [
        ("pd_features", None),
        *[("truth_std_certainty", seed) for seed in (0, 1)],
        *[("std_certainty", seed) for seed in (0, 1)],
    ]
    assert is_complete(SMALL, found)
    assert not is_complete(dataclasses.replace(SMALL, seeds=3), found)
    assert not is_complete(dataclasses.replace(SMALL, flights=("StaleRace",)), found)
    lost = next(cell for cell in SMALL.cells(small.output) if cell.seed == 1)
    before = lost.row
    lost.file.unlink()
    (run.DATA / "small.csv").unlink()
    assert run.main(small) == 0
    assert lost.row["return"] == before["return"]
    assert lost.row["seconds"] == before["seconds"] > 0.0  # it was not trained again
    elsewhere = dataclasses.replace(small, output=small.output / "elsewhere")
    capsys.readouterr()
    assert run.main(elsewhere) == 0  # continues from the table
    assert capsys.readouterr().out.startswith("whether it works: 5 of 5 rows, complete")
    assert list(elsewhere.output.rglob("*.npz")) == []
    again = Rows.read(run.DATA / "small.csv")
    assert again.rows == found.rows
    stale = [{**row, "flights": "others"} for row in found.rows]
    Rows(stale).write(run.DATA / "small.csv")
    other = dataclasses.replace(small, output=small.output / "other", list=True)
    assert run.main(other) == 0
    assert "0 of 5 rows" in capsys.readouterr().out


def test_every_arm_is_validated_on_the_estimate_and_control_differs_in_one_factor():
    for part in PARTS:
        study = part.study(campaign.OUTPUT)
        for arm in study.arms:
            if arm.trained:
                assert study.cases()[arm.name].environment.get("observation") in (None, "estimate")
                assert not arm.training, arm.name
    arms = {arm.name: arm for arm in PARTS[0].study(campaign.OUTPUT).arms}
    truth, estimate = arms["truth_std_certainty"], arms["std_certainty"]
    assert truth.environment == estimate.environment
    assert set(truth.learning.items()) - set(estimate.learning.items()) == {
        ("observation", "truth"),
        ("run_filter", True),
    }
    plans = PARTS[0].study(campaign.OUTPUT).cases()
    assert plans["truth_std_certainty"].recipe == plans["std_certainty"].recipe


def test_intervals_and_effects_follow_from_rows():
    rates = [0.5, 0.75, 1.0]
    rows = Rows(
        [
            {"arm": arm, "label": arm, "seed": k, "steps": 9, "episodes": 100, "success": rate - d}
            | {"crashed": 0.0, "return": 10.0 * rate, "return_sd": 0.0, "error": rate}
            for arm, d in (("a", 0.0), ("b", 0.5))
            for k, rate in enumerate(rates)
        ]
    )
    a, b = rows.of("a"), rows.of("b")
    assert a.estimated("success") == rate_over_trainings(rates, 100)
    np.testing.assert_allclose(a.estimated("error")[1:], mean_interval(rates), rtol=1e-12)
    np.testing.assert_allclose(a.estimated("return")[1:], 10.0 * np.array(mean_interval(rates)))
    one, same = effect(a, b), mean_effect([(a, b), (a, b)])
    assert one.size.value == same.size.value == pytest.approx(0.5)
    narrower = (same.size.high - same.size.low) / (one.size.high - one.size.low)
    assert narrower == pytest.approx(np.sqrt(0.5))
    # the share of the 20 ways to divide six trainings whose difference is at least as large
    values = np.array([0.0, 0.25, 0.5, 0.5, 0.75, 1.0])
    sums = [values[list(own)].sum() for own in combinations(range(6), 3)]
    p = np.mean(np.abs(np.array(sums) - 1.5) >= 0.75)
    assert one.p == pytest.approx(p, abs=0.015)
    rule = Rows([dict(b.rows[0], seed=None)])
    assert effect(a, rule).p is None
    assert effect(rule, a).scaled(-1.0).size == pytest.approx(effect(a, rule).size)


@pytest.mark.parametrize(("first", "second"), [(20, 13), (20, 16), (3, 3)])
def test_permutation_test_of_successes_and_failures_equals_fishers_exact_test(first, second):
    a, b = (np.arange(20) < count for count in (first, second))
    exact = fisher_exact([[first, 20 - first], [second, 20 - second]]).pvalue
    assert permutation_p([(a, b)]) == pytest.approx(exact, abs=0.015)
    with pytest.raises(ValueError, match="pairs must have finite numbers, got 20 and 0"):
        permutation_p([(a, [])])


def test_files_without_seeds_are_refused(tmp_path):
    file = tmp_path / "old.csv"
    file.write_text("arm,return\nPD,3 [2; 4]\n")
    with pytest.raises(ValueError, match="must have a column crashed, and one row per seed"):
        Rows.read(file)
    assert Rows.read(tmp_path / "none.csv").rows == ()


@pytest.mark.parametrize(
    ("given", "message"),
    [({}, "must have --all or --tables"), ({"tables": ("nothing",)}, "must be of look_around")],
)
def test_wrong_tables_are_refused(given, message, capsys):
    with pytest.raises(SystemExit):
        run.main(run.RunArgs(**given))
    assert message in capsys.readouterr().err


@pytest.mark.slow  # makes all environments once
def test_all_parts_can_be_made():
    for part in run.PARTS:
        part.study(campaign.OUTPUT).check()


def complete_rows(part, success):
    """Rows of all arms of a part, with a success rate by arm."""
    found = []
    for cell in part.cells(campaign.OUTPUT):
        rate = success(cell.arm.name)
        trained = cell.training and cell.training.plan.recipe.steps
        row = {"arm": cell.arm.name, "label": cell.arm.label, "seed": cell.seed, "steps": trained}
        row |= {"episodes": 1000, "success": rate, "crashed": 1.0 - rate, "return": 100.0 * rate}
        row |= {"return_sd": 1.0, "seconds": 9.0, "flights": part.digest, "error": 1.0 - rate}
        row["speed"] = 4.0 * rate
        found.append(row | dict(part.columns))
    return found


def test_conclusions_follow_from_rows_and_name_arms_seeds_budget_and_interval(tmp_path):
    def success(arm):
        estimate = not arm.startswith("truth")
        return 0.2 + 0.3 * estimate + 0.2 * ("std" in arm) + 0.1 * ("certainty" in arm)

    own = [part for part in PARTS if part.table == "look_around"]
    rows = Rows([row for part in own[:2] for row in complete_rows(part, success)])
    rows.write(tmp_path / "look_around.csv")
    found = conclusions.texts(tmp_path)
    pairs = found["look_around.observation.table"].splitlines()
    both = next(line for line in pairs if line.startswith("| standard deviation, reward"))
    assert "| 50 [" in both
    assert "| 80 [" in both
    assert "| 30 [" in both
    assert "points<br>(p < 0.001) | -30 [" in both
    factors = found["look_around.factors.table"]
    for factor, points in (("estimate", 30), ("standard deviation", 20), ("certainty", 10)):
        row = next(line for line in factors.splitlines() if f"{factor} |" in line)
        assert f"| {points} [" in row
        assert f"| {-points} [" in row
    headline = found["look_around.headline"]
    assert "succeed in 70 [" in headline
    assert "and in 40 [" in headline
    assert "20 seeds, 2,000,000 steps" in headline
    assert found["look_around.noise.table"].strip() == conclusions.NOT_MEASURED
    assert found["stale_race.table"].strip() == conclusions.NOT_MEASURED
    assert own[0] not in conclusions.incomplete(folder=tmp_path)
    assert own[2] in conclusions.incomplete(folder=tmp_path)
    Rows([row | {"flights": "others"} for row in rows.rows]).write(tmp_path / "look_around.csv")
    assert conclusions.texts(tmp_path)["look_around.headline"] == conclusions.NOT_MEASURED


def test_imitation_is_compared_with_its_rule_and_with_ppo(tmp_path):
    rates = {"imitation": 0.85, "std": 0.6, "pd_backs_off": 0.86, "pd_slows_to_25": 0.7}
    parts = [part for part in PARTS if part.table == "outage_dash"][:2]
    rows = [row for part in parts for row in complete_rows(part, lambda a: rates.get(a, 0.5))]
    Rows(rows).write(tmp_path / "outage_dash.csv")
    found = conclusions.texts(tmp_path)
    sentence = found["outage_dash.imitation"]
    assert "succeeds in 85 [" in sentence
    assert "(10 seeds, 300,000 steps)" in sentence
    assert "from the rule by -1 [" in sentence
    assert "network by 25 [" in sentence
    table = found["outage_dash.speed.table"].strip().splitlines()
    assert [line.split(" | ")[0] for line in table[2:]] == [
        *(f"| {share} %" for share in (100, 50, 25, 0)),
        "| waits halfway between walls",
    ]
    assert "| 70 [" in table[4]
    learned = found["outage_dash.learned.table"]
    assert "imitation of the rule that backs off | 10 | 85 [" in learned
    plan = parts[1].study(campaign.OUTPUT).cases()["imitation"]
    other = parts[0].study(campaign.OUTPUT).cases()["std"]
    assert plan.environment == other.environment
    assert plan.recipe.layers == other.recipe.layers
    assert plan.recipe.activation == other.recipe.activation


def test_every_conclusion_can_be_computed_once_all_parts_are_measured(tmp_path):
    for table in {part.table for part in PARTS}:
        rows = [
            row
            for part in PARTS
            if part.table == table
            for row in complete_rows(part, lambda arm: 0.5 + 0.01 * len(arm) % 0.5)
        ]
        Rows(rows).write(tmp_path / f"{table}.csv")
    assert conclusions.NOT_MEASURED not in "".join(conclusions.texts(tmp_path).values())
    assert conclusions.incomplete(folder=tmp_path) == []


def test_cost_and_gain_have_signs_of_loss_and_recovery_and_list_measured_cases_only(tmp_path):
    def success(arm):
        return {"truth": 0.5, "estimate": 0.8, "truth_on_truth": 0.9}.get(arm, 0.7)

    parts = {part.decides.removeprefix("Truth or estimate in training: "): part for part in PARTS}
    chosen = [parts["Circle, standard"], parts["Waypoints, rtk"]]
    rows = [row for part in chosen for row in complete_rows(part, success)]
    Rows(rows).write(tmp_path / "when_to_train.csv")
    found = conclusions.texts(tmp_path)
    circle, waypoints = found["when_to_train.table"].strip().splitlines()[2:]
    # the errors are 0.1, 0.5 and 0.2 m; of 0.4 m that the estimate costs, training regains 0.3 m
    assert circle.startswith("| Circle | `standard` | 300 mm |")
    assert "| 100 [100, 100] mm | 400 [400, 400] mm | 300 [300, 300] mm<br>p < 0.001" in circle
    assert "| 90 [" in waypoints
    assert "| 40 [" in waypoints
    assert "| 30 [" in waypoints
    summary = found["when_to_train.summary"]
    assert "better in 2 of 2 cases (Circle with `standard`, Waypoints with `rtk`)" in summary
    assert "significantly worse in 0 (10 seeds" in summary
    assert "The other 13 cases are not yet measured." in summary


def test_row_of_an_equal_cell_of_another_table_is_taken_over(small, monkeypatch, tmp_path):
    twin = dataclasses.replace(SMALL, table="twin", columns={"task": "Twin"})
    other = dataclasses.replace(SMALL, table="other", parameters={"gamma": 0.5})
    assert run.main(small) == 0
    monkeypatch.setattr(run, "PARTS", (SMALL, twin, other))
    monkeypatch.setattr(run, "TABLES", ("small", "twin", "other"))
    cells = {
        part.table: run.cells_of([part], tmp_path / "elsewhere") for part in (SMALL, twin, other)
    }
    assert run.take_over([*cells["twin"], *cells["other"]]) == 6
    for own, mine in zip(cells["small"], cells["twin"], strict=True):
        same = own.part.cells(small.output)
        (measured,) = [cell.row for cell in same if cell.key == own.key]
        assert mine.row["task"] == "Twin"
        assert mine.row["return"] == pytest.approx(measured["return"], rel=1e-9)
        assert mine.row["seconds"] == measured["seconds"]
    # with another discount only the fixed rule flies the same
    assert [cell.row is not None for cell in cells["other"]] == [True, *[False] * 4]


def test_parts_are_chosen_by_words_of_their_names(small, capsys, monkeypatch):
    second = dataclasses.replace(SMALL, table="second", decides="something else")
    monkeypatch.setattr(run, "PARTS", (SMALL, second))
    monkeypatch.setattr(run, "TABLES", ("small", "second"))
    assert run.main(dataclasses.replace(small, list=True, parts=("else",))) == 0
    assert capsys.readouterr().out.startswith("something else: 0 of 5 rows")
    with pytest.raises(SystemExit):
        run.main(dataclasses.replace(small, list=True, parts=("unknown",)))
    assert "--parts must have words of a part" in capsys.readouterr().err


def test_rows_of_other_parts_of_a_table_stay_when_chosen_parts_are_complete(small, monkeypatch):
    second = dataclasses.replace(
        SMALL, decides="something else", arms=("std_certainty",), steps=32_768
    )
    monkeypatch.setattr(run, "PARTS", (SMALL, second))
    assert run.main(dataclasses.replace(small, cells=2, parts=("it works",))) == 0
    assert run.main(dataclasses.replace(small, write=True)) == 0  # the rows so far
    known = Rows.read(run.DATA / "small.csv").rows
    assert len(known) == 2
    elsewhere = small.output / "elsewhere"  # as on another machine
    assert run.main(dataclasses.replace(small, output=elsewhere, parts=("else",))) == 0
    rows = Rows.read(run.DATA / "small.csv").rows
    assert [row for row in rows if row in known] == known
    assert len(rows) == 2 + 2


def test_policies_fly_other_episodes_and_are_compared_with_their_rows(small, capsys):
    words = again.AgainArgs(output=small.output, episodes=5)
    assert again.main(words) == 0
    assert "No policy is here" in capsys.readouterr().out
    assert run.main(dataclasses.replace(small, cells=4)) == 0
    assert run.main(dataclasses.replace(small, write=True)) == 0
    trained = next(cell for cell in SMALL.cells(small.output) if cell.seed == 0)
    flown = again.fly(trained, 5)
    assert flown == again.fly(trained, 5)
    assert (flown["arm"], flown["steps"], flown["episodes"]) == (trained.arm.name, 16_384, 5)
    assert again.fly(trained, 5) != again.fly(trained, 4)

    rows = [again.fly(cell, 5) for cell in again.cells((SMALL,), small.output)]
    assert len(rows) == 4
    again.write(rows[:3], run.DATA)
    again.write(rows[1:], run.DATA)  # in place of the same ones
    assert sorted(map(str, again.read(run.DATA))) == sorted(
        str({**dict.fromkeys(again.COLUMNS), **row}) for row in rows
    )
    policies = sum(row["seed"] is not None for row in rows)
    said = again.texts(run.DATA)["studies.again"]
    assert said.startswith(f"{policies} policies flew 5 other episodes ")
    assert ("fixed rules" in said) == (policies < len(rows))
    wrong = {**rows[0], "crashed": 1.0 - rows[0]["crashed"]}
    (found,) = (c for c in again.compared([wrong], run.DATA) if c.column == "crashed")
    assert not found.within
    assert abs(found.rate - found.value) > 1.9 * found.sigma


def test_committed_rates_in_other_episodes_agree_with_the_rows():
    for one in again.compared(again.read()):
        # 10^-5 to each side; errors of a difference of rates are nearly normal
        assert abs(one.rate - one.value) < 4.5 * one.sigma, one

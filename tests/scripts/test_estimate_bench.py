"""EstimateBench: entries are flown, compared and refused; the table follows from rows."""

import dataclasses
import json
import re

import numpy as np
import pytest

from quad_gym.analysis.metrics import Estimated
from scripts.estimate_bench import __main__ as command
from scripts.estimate_bench import entries, table
from scripts.estimate_bench.rows import PARTS, SEEDS, arms_of
from scripts.estimate_bench.tasks import TASK, TASKS
from scripts.studies.rows import Rows


def write_entry(folder, **changed):
    given = {
        "protocol": 1,
        "name": "linear",
        "track": "memoryless",
        "training": "none",
        "policies": [
            {"task": "Circle", "policy": "pd", "environment": {"include_std": True}},
            {"task": "Circle", "policy": "linear.onnx", "seed": 3},
        ],
    }
    folder.mkdir(exist_ok=True)
    write_linear(folder / "linear.onnx")
    (folder / entries.FILE).write_text(json.dumps(given | changed))
    return folder


def write_linear(file, memory=False):
    onnx = pytest.importorskip("onnx")
    from onnx import TensorProto, helper, numpy_helper

    gain = 0.05 * np.random.default_rng(0).standard_normal((28, 4))
    value, size = helper.make_tensor_value_info, TensorProto.FLOAT
    inputs = [value("observation", size, ["n", 28])]
    outputs = [value("action", size, ["n", 4])]
    nodes = [helper.make_node("MatMul", ["observation", "gain"], ["linear"])]
    if memory:
        inputs += [value("state", size, ["n", 4]), value("start", size, ["n"])]
        outputs += [value("next_state", size, ["n", 4])]
        nodes += [helper.make_node("Add", ["linear", "state"], ["next_state"])]
        nodes += [helper.make_node("Tanh", ["next_state"], ["action"])]
        nodes += [helper.make_node("Identity", ["start"], ["unused"])]
    else:
        nodes += [helper.make_node("Tanh", ["linear"], ["action"])]
    stored = [numpy_helper.from_array(gain.astype(np.float32), "gain")]
    graph = helper.make_graph(nodes, "linear", inputs, outputs, stored)
    opset = [helper.make_opsetid("", 17)]
    onnx.save(helper.make_model(graph, opset_imports=opset, ir_version=8), str(file))


def test_command_prints_the_table_of_the_page(capsys):
    assert command.main(["table"]) == 0
    printed = capsys.readouterr().out
    assert all(task.name in printed for task in TASKS)
    assert printed.strip() == table.texts()["benchmark.table"].strip()


def test_entry_is_flown_and_equal_in_every_digit_until_one_is_changed(tmp_path, capsys):
    folder = write_entry(tmp_path / "linear")
    assert command.main(["check", str(folder)]) == 1
    assert "has no results: run `fly` on it first" in capsys.readouterr().out
    assert command.main(["fly", str(folder), "--episodes", "3"]) == 0
    assert "linear: equal in every digit, 2 policies" in capsys.readouterr().out
    found = json.loads((folder / entries.FILE).read_text())
    rule, linear = found["results"]["rows"]
    assert rule["success"] == 1.0
    assert linear["seed"] == 3
    assert linear["return"] < rule["return"]
    found["results"]["rows"][1]["return"] += 1e-6
    (folder / entries.FILE).write_text(json.dumps(found))
    assert command.main(["check", str(folder)]) == 1
    assert "Circle, seed 3: return is" in capsys.readouterr().out
    found["results"]["flights"]["Circle"] = "0" * 16
    (folder / entries.FILE).write_text(json.dumps(found))
    assert command.main(["check", str(folder)]) == 1
    assert "the flights of Circle have changed" in capsys.readouterr().out


def test_policy_with_memory_adds_up_its_observations(tmp_path):
    write_linear(tmp_path / "memory.onnx", memory=True)
    policy = entries.OnnxPolicy(tmp_path / "memory.onnx")
    seen = np.random.default_rng(1).standard_normal((5, 28)).astype(np.float32)
    _, state = policy.predict(seen)
    action, state = policy.predict(seen, state=state, episode_start=np.zeros(5, bool))
    gain = (0.05 * np.random.default_rng(0).standard_normal((28, 4))).astype(np.float32)
    np.testing.assert_allclose(action, np.tanh(2.0 * seen @ gain), rtol=1e-5)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"protocol": 0}, "protocol must be 1, got 0"),
        ({"track": "fast"}, "track must be one of memoryless, memory"),
        ({"extra": 1}, "has an unknown field extra"),
        ({"policies": [{"task": "Circle"}]}, "must have policy"),
        ({"policies": [{"task": "Square", "policy": "pd"}]}, "task must be one of LookAround"),
        ({"policies": [{"task": "Circle", "policy": "../x.npz"}]}, "in the folder of the entry"),
        ({"policies": [{"task": "Circle", "policy": "a.zip"}]}, "a .npz or .onnx file"),
        ({"policies": [{"task": "Circle", "policy": "a.npz"}]}, "has no file a.npz"),
        (
            {"policies": [{"task": "Circle", "policy": "pd", "environment": {"radius": 1}}]},
            "environment may set observation, include_std, layout, task, got radius",
        ),
        (
            {
                "policies": [
                    {"task": "Circle", "policy": "pd", "environment": {"observation": "truth"}}
                ]
            },
            "observation must be one of estimate, measurements",
        ),
        (
            {
                "policies": [
                    {"task": "Circle", "policy": "pd", "environment": {"task": "os:system"}}
                ]
            },
            "must be a class of this repository",
        ),
    ],
    ids=str,
)
def test_entries_against_the_protocol_are_refused(changed, message, tmp_path):
    folder = write_entry(tmp_path / "entry", **changed)
    with pytest.raises(entries.EntryError, match=message):
        entries.Entry.read(folder)


def test_every_task_has_all_rows_in_some_part():
    for task in TASKS:
        measured = {
            name for part in PARTS if part.columns["task"] == task.name for name in part.arms
        }
        assert measured == {arm.name for arm in arms_of(task)}


def measured(arm, seed, value, flights=None):
    """Return a row of Circle, of its present flights unless others are given."""
    numbers = {"success": 1.0, "crashed": 0.0, "return": value, "return_sd": 1.0, "seconds": 9.0}
    shown = {"arm": arm, "label": arm, "seed": seed, "steps": 1, "episodes": 100}
    flights = flights or table.flights_digest(TASK["Circle"].flights)
    return {**shown, **numbers, "flights": flights, "task": "Circle"}


def test_effects_of_training_are_differences_of_complete_rows():
    estimate = 15.0 + np.linspace(0.0, 1.0, SEEDS)
    truth = estimate - 2.0 + np.tile([0.3, -0.3], SEEDS // 2)
    rows = [measured("estimate", seed, value) for seed, value in enumerate(estimate)]
    rows += [measured("truth", seed, value) for seed, value in enumerate(truth)]
    rows += [measured("estimate_std", seed, 99.0) for seed in range(SEEDS - 1)]
    lines = table.effects(Rows(rows)).strip().split("\n")
    cells = {line.split("|")[1].strip(): line.split("|")[2:-1] for line in lines}
    of_circle = [task.name for task in TASKS].index("Circle")
    trained = cells["training on the estimate, not the truth"]
    assert [cell.strip() for k, cell in enumerate(trained) if k != of_circle] == ["-"] * 4
    assert re.fullmatch(r" \*\*2 \[[12], [23]\]\*\*<br>p < 0.001 ", trained[of_circle])
    assert "returns significantly more in Circle (10 seeds of each)" in table.summary(Rows(rows))
    # the row with a standard deviation lacks a seed
    incomplete = cells["observing standard deviations, trained on the estimate"]
    assert incomplete[of_circle].strip() == "-"


def test_table_shows_rows_of_the_present_flights_only():
    task = TASK["Circle"]
    rows = [measured("rule", None, 10.0)]
    rows += [measured("truth_on_truth", seed, 20.0) for seed in range(3)]
    rows += [measured("estimate", seed, 15.0) for seed in range(3)]
    rows += [measured("noisy", seed, 15.0, "of other flights") for seed in range(3)]
    found, missing = table.lines(task, Rows(rows), Rows(()))
    lines = {line[0]: line for line in found}
    assert lines.keys().isdisjoint(missing)
    assert lines["PPO, estimate"][1] == "3"
    assert lines["PPO, estimate"][5].startswith("0.50 [")
    assert (lines["best rule"][-1], lines["PPO, estimate"][-1]) == ("", "9")
    # its policies are those of a row without flights, which has the time of their training
    assert lines["PPO, truth, tested on the truth"][-1] == "-"
    rows += [{**measured("truth", seed, 12.0), "seconds": 7.0} for seed in range(3)]
    found, _ = table.lines(task, Rows(rows), Rows(()))
    assert {line[0]: line[-1] for line in found}["PPO, truth, tested on the truth"] == "7"
    assert "| recurrent PPO, estimate (memory) | none | - | - | - | - | - |" in table.block(
        task, Rows(rows), Rows(())
    )
    assert {"PPO, truth + independent noise", "SAC, estimate + standard deviations"} < set(missing)
    assert table.score(Estimated(15.0, 12.0, 18.0), 10.0, 20.0) == (0.5, 0.2, 0.8)
    with pytest.raises(ValueError, match="must exceed the rule's"):
        table.score(Estimated(1.0, 1.0, 1.0), 2.0, 2.0)


def test_plans_have_the_recipe_of_circle_but_for_horizon_and_scale():
    part = next(part for part in PARTS if part.columns["task"] == "LookAround")
    plan = part.study(folder()).cases()["estimate"]
    circle = dataclasses.replace(part, env_id="QuadGym/Circle-v0").recipe_of("ppo")
    assert plan.recipe.parameters["gamma"] == TASK["LookAround"].gamma
    assert plan.recipe.learning_rate == circle.learning_rate
    assert plan.recipe.parameters["n_epochs"] == 5


def folder():
    from scripts.studies.campaign import OUTPUT

    return OUTPUT

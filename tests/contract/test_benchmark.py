"""The command `benchmark`: sections and files; no test depends on measured times."""

import json

from quad_gym.commands import benchmark as script
from quad_gym.commands.benchmark import Timing, by_turns
from quad_gym.commands.options import parse


def run(folder, *options):
    script.main(parse(script.BenchmarkArgs, ["--quick", "--output", str(folder), *options]))
    return json.loads((folder / "benchmark.json").read_text())


def test_suites_section_gives_ratios_to_standard_suite_and_to_few_flights(tmp_path):
    options = ("--only", "suites", "--n-envs", "8", "--threads", "2")
    rows = run(tmp_path, *options)["sections"]["suites"]
    of = {(row["suite"], row["flights"], row["threads"]): row["seconds"] for row in rows}
    names = {"standard", "rtk", "consumer", "indoor", "field", "crazyflie", "truth"}
    assert of.keys() == {
        (name, n, threads) for name in names for n in (8, 512) for threads in (1, 2)
    }
    for row in rows:
        suite, flights, threads = row["suite"], row["flights"], row["threads"]
        assert row["speed"] == of["standard", flights, threads] / row["seconds"]
        assert row["times_few"] == row["seconds"] / of[suite, 8, threads]


def test_jobs_are_timed_in_alternation_with_minimum_and_spread():
    order, slow, fast = [], iter([4.0, 2.0, 3.0]), iter([1.0, 1.0, 1.5])
    jobs = [lambda: order.append("slow") or next(slow), lambda: order.append("fast") or next(fast)]
    timings = by_turns(jobs, 3)
    assert order == ["slow", "fast"] * 3
    assert timings == [Timing(2.0, 0.5), Timing(1.0, 0.0)]

"""EstimateBench: tasks in which controllers fly on a state estimate, with baselines and entries.

`tasks` has the five tasks, `rows` the baselines, `entries` the policies that others submit, `table`
the page's table; `docs/benchmark.md` is the protocol.
"""

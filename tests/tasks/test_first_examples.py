"""The first three examples of the page on tasks do what they say."""

import re
from pathlib import Path

import numpy as np

from tests.builders import part

PAGE = Path(__file__).resolve().parents[2] / "docs" / "tasks.md"
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)[:3]


def test_examples_do_what_the_page_says():
    names, envs = {}, []
    for block in BLOCKS:
        exec(block, names)
        envs.append(names["env"])
    reward, path, wall = envs
    reward.reset(seed=0)
    first = reward.step(np.full(4, 0.5, np.float32))[1]
    again = reward.step(np.full(4, 0.5, np.float32))[1]
    assert again > first + 0.05, "a change of the action costs 0.1 of its square more"
    flown = names["path"]
    times = np.linspace(0.0, flown.duration, 20_001)
    for point in names["points"]:
        assert np.linalg.norm(flown(times) - point, axis=1).min() < 1e-3
    path.reset(seed=0)

    observation, _ = wall.reset(seed=0)
    batch = wall.unwrapped.flights.batch
    seen = batch.record("r_seen")[0]
    level = np.maximum(np.abs(seen[:2] - [6.0, 0.0]) - [2.0, 0.1], 0.0)
    above = max(abs(seen[2] - 1.5) - 1.5, 0.0)
    expected = np.linalg.norm([*level, above])
    np.testing.assert_allclose(part(wall, observation, "wall"), expected, rtol=1e-5)

"""Coverage of the intervals of rates over trainings, by simulation.

python -m tests.statistical.interval_coverage    # prints the table behind docs/where-it-matters.md
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from quad_gym.analysis.metrics import rate_over_trainings

EPISODES, SEEDS = 100, (3, 5, 10)


Design = tuple[Callable[..., Any], float]
"""Function that draws rates of trainings, and their mean."""


def either(share, high, low):
    """A share of the trainings has a high rate, the others a low one."""
    return (
        lambda rng, shape: np.where(rng.random(shape) < share, high, low),
        share * high + (1.0 - share) * low,
    )


def _beta(a, b):
    return lambda rng, shape: rng.beta(a, b, shape), a / (a + b)


DESIGNS = {
    "all 5 %": either(1.0, 0.05, 0.0),
    "all 50 %": either(1.0, 0.5, 0.0),
    "beta, mean 5 %, sigma 5 %": _beta(0.9, 17.1),
    "beta, mean 50 %, sigma 22 %": _beta(2.0, 2.0),
    "beta, mean 90 %, sigma 9 %": _beta(9.0, 1.0),
    "one in ten 90 %, else 2 %": either(0.1, 0.9, 0.02),
    "one in five 90 %, else 1 %": either(0.2, 0.9, 0.01),
    "half 95 %, else 2 %": either(0.5, 0.95, 0.02),
}
"""Distribution of the rates of trainings, and its mean, by words."""


def coverage(
    design: str | Design, seeds: int, draws: int = 1000, episodes: int = EPISODES
) -> tuple[float, float]:
    """Return the share of intervals that hold the mean rate, and their mean width."""
    draw, mean = DESIGNS[design] if isinstance(design, str) else design
    rng = np.random.default_rng(seeds)
    rates = rng.binomial(episodes, draw(rng, (draws, seeds))) / episodes
    found = [rate_over_trainings(of_seeds, episodes) for of_seeds in rates]
    held = np.mean([each.holds(mean) for each in found])
    return float(held), float(np.mean([each.high - each.low for each in found]))


def main() -> None:
    """Print the table."""
    print("| crash rates of trainings | " + " | ".join(f"{s} trainings" for s in SEEDS) + " |")
    print("|---|" + "---|" * len(SEEDS))
    for design in DESIGNS:
        cells = [coverage(design, seeds, 4000) for seeds in SEEDS]
        row = " | ".join(f"{100 * held:.0f} % ({100 * width:.0f})" for held, width in cells)
        print(f"| {design} | {row} |")


if __name__ == "__main__":
    main()

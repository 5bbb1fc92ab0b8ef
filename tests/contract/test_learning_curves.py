"""Learning curves of the two engines over training seeds: PPO is the same, whatever trains."""

import csv

import numpy as np
import pytest
from scipy.stats import mannwhitneyu

from baselines.plans import Plan
from baselines.recipes import recipe
from baselines.training import train

HOVER = "QuadGym/Hover-v0"
SHORT = recipe(HOVER).replace(steps=96 * 64 * 32, n_envs=64)
"""Long enough that policies fly, too short for all to fly as well as they can."""
SEEDS = 8
ALARM = 1e-3
"""Of each of the four evaluations; 16 policies in any order have p >= 1.6e-4."""


def curves(folder, engine, first_seed, recipe=SHORT):
    """Mean returns (seeds, evaluations after the first) of policies trained by one engine."""
    found = []
    for seed in range(first_seed, first_seed + SEEDS):
        plan = Plan(
            env_id=HOVER, recipe=recipe, seed=seed, engine=engine, evaluations=4, episodes=50
        )
        train(plan, folder / str(seed), quiet=True, tensorboard=False)
        with (folder / str(seed) / "evaluations.csv").open() as file:
            found.append([float(row["return"]) for row in csv.DictReader(file)])
    return np.array(found)[:, 1:]


def p_values(first, second):
    """Probability, at each evaluation, that equal engines differ by as much in either direction."""
    return mannwhitneyu(first, second, axis=0, method="exact").pvalue


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    return curves(tmp_path_factory.mktemp("compiled"), "compiled", 0)


@pytest.mark.slow  # eight trainings with each engine, about two minutes
def test_learning_curves_of_the_engines_do_not_differ(compiled, tmp_path):
    pytest.importorskip("stable_baselines3")
    reference = curves(tmp_path, "sb3", SEEDS)
    assert compiled.shape == (SEEDS, 4)
    p = p_values(compiled, reference)
    assert np.all(p > ALARM), f"{p}\n{compiled}\n{reference}"

"""Files of included policies have the plans that train them again."""

import pytest

from baselines.mlp import MlpPolicy
from baselines.policies import PRETRAINED
from baselines.recipes import description
from scripts import included


@pytest.mark.parametrize("file", sorted(PRETRAINED.glob("*.npz")), ids=lambda file: file.stem)
def test_record_of_an_included_policy_is_its_plan(file):
    plan, seeds = included.PLANS[file.stem]
    record = MlpPolicy.load(file).record
    assert record["plan"]["seed"] < seeds
    assert record["plan"] == description(plan.replace(seed=record["plan"]["seed"]))


def test_every_plan_has_a_file():
    assert set(included.PLANS) == {file.stem for file in PRETRAINED.glob("*.npz")}


def test_unknown_name_is_refused_before_a_training(tmp_path):
    args = included.IncludedArgs(names=("circle", "square"), output=tmp_path / "runs")
    with pytest.raises(ValueError, match="square"):
        included.main(args)
    assert not (tmp_path / "runs").exists()

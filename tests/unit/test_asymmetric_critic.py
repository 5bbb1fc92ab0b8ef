"""The compiled PPO with a critic that sees more than the actor; gradients: test_compiled_ppo.py."""

import numpy as np
import pytest

from baselines.compiled_ppo import CompiledPPO
from tests.unit.sliders import sliders, small_recipe


def test_input_of_the_critic_alone_changes_no_action():
    model = CompiledPPO(sliders(), small_recipe(parameters={"critic_only": 1}), seed=0)
    model.learn(1000)
    draw = np.random.default_rng(0)
    x = draw.normal(size=(150, 3)).astype(np.float32)  # more than two tiles
    other = x.copy()
    other[:, 2] += 1.0
    means, values = model._evaluate(x)
    moved = model._evaluate(other)
    np.testing.assert_array_equal(moved[0], means)
    assert abs(moved[1] - values).min() > 1e-4

    policy = model.policy()
    assert policy.inputs == 2
    want = policy.predict(x[:, :2])[0]
    np.testing.assert_allclose(want, means.clip(-1.0, 1.0), atol=1e-6)
    for seen in (x, x[:, :2]):
        np.testing.assert_array_equal(model.predict(seen)[0], want)
    with pytest.raises(ValueError, match=r"must be \(..., 2\), got shape \(150, 1\)"):
        model.predict(x[:, :1])

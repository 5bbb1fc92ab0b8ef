"""The compiled PPO with a critic that sees more than the actor; gradients: test_compiled_ppo.py."""

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

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


class Signs(gymnasium.Env):
    """One step, rewarded by a hidden sign: nothing that is seen or done predicts the reward."""

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.sign = self.np_random.choice([-1.0, 1.0])
        return np.array([1.0, self.sign], np.float32), {}

    def step(self, action):
        return np.array([1.0, self.sign], np.float32), self.sign, True, False, {}


@pytest.mark.parametrize("critic_only", [0, 1])
def test_a_critic_learns_from_what_the_actor_does_not_see(critic_only):
    env = SyncVectorEnv([Signs] * 8, autoreset_mode=AutoresetMode.SAME_STEP)
    recipe = small_recipe(
        reward_scale=1.0,
        learning_rate=(1e-2, 1e-2),
        parameters={"n_steps": 32, "critic_only": critic_only},
    )
    model = CompiledPPO(env, recipe, seed=0)
    model.learn(8000)
    _, values = model._evaluate(np.array([[1.0, -1.0], [1.0, 1.0]], np.float32))
    np.testing.assert_allclose(values, [-1.0, 1.0], atol=0.1)
    assert model.policy().inputs == 2 - critic_only

"""The script in the style of CleanRL trains and computes correct advantages."""

import numpy as np
import pytest

from tests.examples import example

torch = pytest.importorskip("torch")


@pytest.fixture(scope="module")
def cleanrl():
    """Return the script as a module."""
    return example("cleanrl_ppo")


def test_the_script_of_cleanrl_trains_evaluates_and_saves(cleanrl, tmp_path, capsys):
    file = tmp_path / "weights.pt"
    args = cleanrl.Args(total_timesteps=256, num_steps=64, num_envs=2, num_minibatches=4)
    args.evaluate, args.save = 3, file
    cleanrl.main(args)
    assert "mean_error" in capsys.readouterr().out
    weights = torch.load(file)
    agent = cleanrl.Agent(28, 4)
    agent.load_state_dict(weights)
    assert (weights["variance"] != 1.0).any()  # from the observations in training
    actions, _ = agent.predict(np.zeros((5, 28), np.float32))
    assert actions.shape == (5, 4)
    assert np.abs(actions).max() <= 1.0


def test_advantages_of_script_equal_returns_minus_values(cleanrl):
    rng = np.random.default_rng(0)
    rewards, values = rng.normal(size=(2, 6, 3))
    dones = np.zeros((6, 3))
    dones[3, 1] = 1.0  # before step 3, an episode of flight 1 ended
    last = rng.normal(size=3)
    args = cleanrl.Args(num_steps=6, gamma=0.9, gae_lambda=1.0)
    given = [torch.as_tensor(x) for x in (rewards, dones, values, np.zeros(3), last)]
    found = cleanrl.advantages_of(*given, args).numpy()
    for i in range(3):
        total = last[i]
        for t in reversed(range(6)):
            ends = t == 2 and i == 1
            total = rewards[t, i] + 0.9 * (0.0 if ends else total)
            assert found[t, i] == pytest.approx(total - values[t, i])

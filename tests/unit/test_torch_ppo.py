"""The PPO of the examples trains with and without memory, and computes correct advantages."""

import dataclasses
import itertools

import numpy as np
import pytest

from tests.examples import example

torch = pytest.importorskip("torch")

UNITS, FLIGHTS, STEPS = 5, 3, 6


@pytest.fixture(scope="module")
def script():
    """Return the script as a module."""
    return example("torch_ppo")


@pytest.fixture
def args(script):
    sizes = {"num_envs": 4, "num_steps": 8, "num_minibatches": 2, "units": UNITS}
    return script.Args(total_timesteps=64, evaluate=3, **sizes)


@pytest.mark.parametrize("memory", [False, True])
def test_agent_trains_is_evaluated_and_saved(script, args, memory, tmp_path, capsys):
    file = tmp_path / "weights.pt"
    script.main(dataclasses.replace(args, memory=memory, save=file))
    assert "'mean_error'" in capsys.readouterr().out
    before = script.Agent(28, 4, UNITS, memory)
    before.load_state_dict(torch.load(file))
    assert (before.log_std != -1.0).all()  # has learned


def test_advantages_equal_returns_minus_values(script):
    rng = np.random.default_rng(0)
    rewards, values = rng.normal(size=(2, STEPS, FLIGHTS))
    over = np.zeros((STEPS, FLIGHTS), bool)
    over[2, 1] = True
    last = rng.normal(size=FLIGHTS)
    args = script.Args(gamma=0.9, gae_lambda=1.0)
    given = [torch.as_tensor(x) for x in (rewards, over, values, last)]
    found = script.advantages_of(*given, args).numpy()
    for i in range(FLIGHTS):
        total = last[i]
        for t in reversed(range(STEPS)):
            total = rewards[t, i] + 0.9 * total * (not over[t, i])
            assert found[t, i] == pytest.approx(total - values[t, i], abs=1e-6)


def test_memory_is_that_of_a_gru_over_each_episode(script):
    torch.manual_seed(0)
    agent = script.Agent(2, 4, UNITS, memory=True)
    whole = torch.nn.GRU(2, UNITS)
    for name, values in agent.cell.named_parameters():
        getattr(whole, f"{name}_l0").data = values.data
    seen = torch.randn(STEPS, FLIGHTS, 2)
    begins = torch.zeros(STEPS, FLIGHTS, dtype=torch.bool)
    begins[0], begins[4, 1] = True, True
    found, state = agent.features(seen, begins, torch.full((FLIGHTS, UNITS), 9.0))
    for i, cuts in enumerate([(0, 6), (0, 4, 6), (0, 6)]):
        for first, after in itertools.pairwise(cuts):
            expected, _ = whole(seen[first:after, i])
            assert torch.allclose(found[first:after, i], expected, atol=1e-6)
    assert torch.equal(state, found[-1])


def test_truncated_episodes_count_what_would_have_followed(script, args):
    """With reward 0 and value v everywhere, a truncated step counts gamma v, a terminated one 0."""
    agent = script.Agent(2, 4, UNITS, memory=False)
    for parameter in agent.critic.parameters():
        torch.nn.init.zeros_(parameter)
    agent.critic[-1].bias.data.fill_(2.0)

    class Ending:
        """Two flights, of which the first is truncated and the second terminated at once."""

        def step(self, action):
            truncated = torch.tensor([True, False])
            seen = torch.zeros(2, 2)
            return seen, torch.zeros(2), ~truncated, truncated, {"final_obs": seen}

    begun = (torch.zeros(2, 2), torch.ones(2, dtype=torch.bool), agent.begin(2))
    parts, _, _ = script.rollout(Ending(), agent, *begun, args)
    assert torch.allclose(parts[4], torch.tensor([2.0 * args.gamma, 0.0]))

"""Tests of recurrent PPO: sequences at once have the values and gradients of step by step."""

import zipfile

import gymnasium
import numpy as np
import pytest

torch = pytest.importorskip("torch")
contrib = pytest.importorskip("sb3_contrib")

from baselines.memory import SequencePPO, at_once  # noqa: E402

LENGTH, N, INPUTS, UNITS = 7, 5, 3, 4


def lstm_step_by_step(features, states, starts, lstm):
    """The equations of an LSTM, with states that are zero where an episode starts; float64."""
    w_x, w_h, bias = lstm.weight_ih_l0, lstm.weight_hh_l0, lstm.bias_ih_l0 + lstm.bias_hh_l0
    hidden, cell = (state[0] for state in states)
    outputs = []
    for x, start in zip(
        features.reshape(N, LENGTH, INPUTS).unbind(1),
        starts.reshape(N, LENGTH).unbind(1),
        strict=True,
    ):
        hidden, cell = (state * (1.0 - start)[:, None] for state in (hidden, cell))
        i, f, g, o = (x @ w_x.T + hidden @ w_h.T + bias).chunk(4, dim=1)
        cell = torch.sigmoid(f) * cell + torch.sigmoid(i) * torch.tanh(g)
        hidden = torch.sigmoid(o) * torch.tanh(cell)
        outputs.append(hidden)
    return torch.stack(outputs, 1).reshape(N * LENGTH, UNITS), (hidden[None], cell[None])


@pytest.mark.parametrize("where", ["nowhere", "first step", "any step"])
def test_sequences_at_once_have_values_and_gradients_of_equations(where):
    generator = torch.Generator().manual_seed(1)
    lstm = torch.nn.LSTM(INPUTS, UNITS).double()
    policy = contrib.common.recurrent.policies.RecurrentActorCriticPolicy
    starts = torch.zeros(N, LENGTH, dtype=torch.float64)
    if where == "first step":
        starts[::2, 0] = 1.0
    elif where == "any step":
        starts[::2, 0], starts[1, 3] = 1.0, 1.0

    def random(*shape):
        return torch.randn(shape, generator=generator, dtype=torch.float64, requires_grad=True)

    features, hidden, cell = random(N * LENGTH, INPUTS), random(1, N, UNITS), random(1, N, UNITS)
    weights = random(N * LENGTH, UNITS).detach()
    found = []
    for process in (lstm_step_by_step, at_once(policy._process_sequence)):
        output, (last_hidden, last_cell) = process(features, (hidden, cell), starts.flatten(), lstm)
        loss = (weights * output).sum() + (last_hidden * last_cell).sum()
        inputs = (features, hidden, cell, *lstm.parameters())
        found.append([output, last_hidden, last_cell, *torch.autograd.grad(loss, inputs)])
    for expected, value in zip(*found, strict=True):
        torch.testing.assert_close(value, expected, rtol=1e-10, atol=1e-12)


def test_training_passes_whole_sequences_and_writes_file_of_sb3_contrib(tmp_path):
    env = gymnasium.make("CartPole-v1", max_episode_steps=5)
    lengths = []
    model = SequencePPO("MlpLstmPolicy", env, n_steps=32, batch_size=32, n_epochs=1, seed=0)
    model.policy.lstm_actor.register_forward_pre_hook(
        lambda _, given: lengths.append((model.policy.training, given[0].shape[0]))
    )
    model.learn(32)
    assert [length for training, length in lengths if training] == [5]  # an update in one pass
    model.save(tmp_path / "model.zip")
    with zipfile.ZipFile(tmp_path / "model.zip") as file:
        assert b"baselines.memory" not in file.read("data")
    again = contrib.RecurrentPPO.load(tmp_path / "model.zip")
    observation = np.zeros(4, dtype=np.float32)
    actions = [m.predict(observation, deterministic=True)[0] for m in (model, again)]
    assert actions[0] == actions[1]

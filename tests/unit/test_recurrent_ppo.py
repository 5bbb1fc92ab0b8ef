"""The compiled recurrent PPO, compared with torch and trained on a task that needs memory."""

import math

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from baselines.compiled_ppo import CompiledPPO
from baselines.compiled_ppo.kernels.common import SUMS, flip
from baselines.compiled_ppo.learner import PARTS
from baselines.gru import GruPolicy, load_network
from baselines.mlp import MlpPolicy
from quad_gym.batch.threads import board_of
from tests.unit.sliders import sliders, small_recipe

MEMORY = {"n_steps": 16, "sequence_length": 8, "batch_size": 64, "n_epochs": 2}
LOSS = {"clip_range": 0.25, "ent_coef": 0.125, "vf_coef": 0.75}


def recurrent(parameters=None, **changes):
    """A small recipe with memory."""
    options = {"memory_units": 7, "layers": (9,), "critic_layers": (6, 5), **changes}
    return small_recipe(
        algorithm="recurrent_ppo", parameters={**MEMORY, **(parameters or {})}, **options
    )


def in_double(model, samples):
    """Gradient and `SUMS` of the loss of all sequences, in double precision."""
    learner, networks = model.learner, model.networks
    double = lambda x: x.astype(float) if x.dtype == np.float32 else x  # noqa: E731
    params, flipped, activation = networks.net
    net = (double(params), double(flipped), activation)
    for table in networks._tables:
        flip(net, table)
    learner.span[:] = 0, len(learner.order)
    written = np.zeros((PARTS, params.size)), np.zeros((PARTS, len(SUMS)))
    networks.differentiate(
        *(board_of(PARTS, 1), 0, 0, False),
        (learner.span, learner.order, double(learner.normalized)),
        (net, *networks.model[1:]),
        tuple(map(double, samples)),
        np.array(list(LOSS.values())),
        tuple(map(double, networks.rooms(PARTS))),
        written,
    )
    return written[0].sum(axis=0), written[1].sum(axis=0)


def torch_loss(torch, model, samples, params, advantages):
    """The loss of PPO over all sequences, written with the GRU of torch."""
    observations, actions, log_probs, returns, ended, begun = map(torch.as_tensor, samples)
    networks, (steps, flights) = model.networks, model._ended.shape
    length = networks.sequence_length
    network = {}
    for which, gru, table in (
        (0, networks.gru, networks.actor),
        (1, networks.critic_gru, networks.critic),
    ):
        cell = torch.nn.GRUCell(int(gru[0, 0]), int(gru[0, 1]), dtype=torch.float64)
        maps = [pieces(params, row) for row in gru.tolist()]
        arguments = dict(
            zip(
                ("weight_ih", "bias_ih", "weight_hh", "bias_hh"),
                (torch.cat([m[k] for m in part]) for part in (maps[:3], maps[3:]) for k in (0, 1)),
                strict=True,
            )
        )
        outputs, seen = [], observations.reshape(steps, flights, -1)[..., : gru[0, 0]]
        for t in range(steps):
            if t % length == 0:
                h = begun[t // length, which]
            else:
                h = h * ~ended.reshape(steps, flights)[t - 1, :, None]
            h = torch.func.functional_call(cell, arguments, (seen[t], h))
            y = torch.cat([seen[t], h], dim=1)
            for k, row in enumerate(table.tolist()):
                W, b = pieces(params, row)
                y = y @ W.T + b
                y = torch.tanh(y) if k < len(table) - 1 else y
            outputs.append(y)
        network[which] = torch.cat(outputs)
    first = int(networks.actor[-1, 3] + networks.actor[-1, 1])
    log_std = params[first : first + 2]
    z = (actions - network[0]) * torch.exp(-log_std)
    log_prob = -(0.5 * (z**2 + float(np.float32(math.log(2.0 * math.pi)))) + log_std).sum(dim=1)
    ratio = torch.exp(log_prob - log_probs)
    gain = torch.minimum(ratio * advantages, ratio.clip(0.75, 1.25) * advantages)
    value = (network[1][:, 0] - returns) ** 2
    return (-gain + 0.75 * value).mean() - 0.125 * log_std.sum()


def pieces(params, row):
    inputs, outputs, w, b, _ = row
    return params[w : w + inputs * outputs].reshape(outputs, inputs), params[b : b + outputs]


@pytest.mark.parametrize("critic_only", [0, 1])
def test_gradient_through_time_agrees_with_torch_to_1e_12(critic_only):
    """One tile is full, one is not. Episodes end within and at the end of sequences, and twice."""
    torch = pytest.importorskip("torch")
    draw, flights = np.random.default_rng(0), 64
    recipe = recurrent(parameters={**LOSS, "critic_only": critic_only})
    model = CompiledPPO(sliders(flights), recipe, seed=3)
    count = 16 * flights
    model.networks.params[:] += 0.3 * draw.normal(size=model.networks.params.size).astype("f4")
    samples = (
        draw.normal(size=(count, 3)),
        draw.normal(size=(count, 2)),
        draw.normal(size=count) - 3.0,
        draw.normal(size=count),
        draw.random(count) < 0.15,
        draw.normal(size=model._begun.shape),
    )
    advantages = draw.normal(size=count).astype("f4")
    order = model.learner.order
    model.learner.normalized[:] = advantages[order[:, None] + model.learner._later]
    found, sums = in_double(model, samples)
    params = torch.tensor(model.networks.params.astype(float), requires_grad=True)
    loss = torch_loss(torch, model, samples, params, torch.as_tensor(advantages.astype(float)))
    loss.backward()
    want = params.grad.numpy()
    np.testing.assert_allclose(found, want, rtol=0.0, atol=1e-12 * abs(want).max() + 1e-15)
    entropy = 0.125 * model.networks.log_std.astype(float).sum()
    assert (sums[0] + 0.75 * sums[1]) / count - entropy == pytest.approx(loss.item(), rel=1e-12)
    fields = (model._observations, model._actions, model._log_probs, model._targets, model._ended)
    for kept, given in zip((*fields, model._begun), samples, strict=True):
        kept[:] = given.reshape(kept.shape)
    model.networks.flip()
    model.learner.differentiate(0, len(order))
    single = model.learner.gradients.sum(axis=0)
    np.testing.assert_allclose(single, want, rtol=0.0, atol=1e-5 * abs(want).max())


def test_memory_is_empty_at_the_start_of_each_episode():
    """Rollout and policy agree over episodes of 20 steps in sequences of 8."""
    model = CompiledPPO(sliders(), recurrent(parameters={"n_steps": 48}), seed=0)
    model.prepare()
    model._roll_out()
    policy = model.policy()
    state = kept = None
    starts = np.concatenate([np.ones((1, 8), bool), model._ended[:-1]])
    assert 16 <= starts[1:].sum() < 48
    for t in range(48):
        if t % 8 == 0:
            before = np.zeros((8, 7)) if t == 0 else state * ~starts[t, :, None]
            np.testing.assert_allclose(model._begun[t // 8, 0], before, atol=2e-6)
        action, state = policy.predict(model._observations[t], state, starts[t])
        alone, _ = policy.predict(model._observations[t, 0], kept, starts[t, 0])
        np.testing.assert_allclose(alone, action[0], atol=2e-6)
        kept = state[0]
    noise = (model._actions - _means(model)) / np.exp(model.networks.log_std)
    want = -0.5 * (noise**2 + np.log(2.0 * np.pi)).sum(axis=2) - model.networks.log_std.sum()
    np.testing.assert_allclose(model._log_probs, want, atol=1e-4)


def _means(model):
    """Mean actions of the policy in a rollout that began with empty memory."""
    memory, means = np.zeros_like(model._memory), []
    for x, ended in zip(model._observations, model._ended, strict=True):
        mean, _, memory = model.networks.evaluate(x, memory)
        memory[:, ended] = 0.0
        means.append(mean)
    return np.array(means)


def test_same_seed_same_bits_with_any_number_of_threads_and_after_a_pause():
    found, states = [], []
    for seed, threads in ((0, 1), (0, 2), (1, 1)):
        model = CompiledPPO(sliders(), recurrent(), seed=seed, threads=threads)
        model.learn(1000, lambda model: states.append(model.state()) or True)
        found.append(model.networks.params)
    np.testing.assert_array_equal(found[0], found[1])
    assert not np.array_equal(found[0], found[2])
    resumed = CompiledPPO(sliders(), recurrent(), seed=9)
    resumed.restore(states[3])
    resumed.learn(1000)
    np.testing.assert_array_equal(resumed.networks.params, found[0])


def test_a_saved_policy_acts_as_before(tmp_path):
    model = CompiledPPO(sliders(), recurrent(), seed=0)
    model.learn(1000)
    policy = model.policy({"plan": {"seed": 4}})
    policy.save(tmp_path / "it.npz")
    loaded, state, again = load_network(tmp_path / "it.npz"), None, None
    assert isinstance(loaded, GruPolicy)
    assert loaded.record == {"plan": {"seed": 4}}
    for x in np.random.default_rng(0).normal(size=(5, 4, 3)).astype("f4"):
        action, state = policy.predict(x, state)
        same, again = loaded.predict(x, again)
        np.testing.assert_array_equal(same, action)
    with pytest.raises(ValueError, match="must be a 'quad_gym policy 1'"):
        MlpPolicy.load(tmp_path / "it.npz")
    with pytest.raises(ValueError, match=r"state must have shape \(4, 7\), got \(5, 7\)"):
        loaded.predict(x, np.zeros((5, 7)))
    with pytest.raises(ValueError, match="W, b, U, c and layers must fit"):
        GruPolicy(policy.W, policy.b, policy.U[:, 1:], policy.c, policy.layers)


class Cue(gymnasium.Env):
    """A cue of +1 or -1 in the first step only; the reward is the action times the cue."""

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.cue, self.steps = self.np_random.choice([-1.0, 1.0]), 0
        return np.array([self.cue, 1.0], np.float32), {}

    def step(self, action):
        self.steps += 1
        reward = float(action[0]) * self.cue if self.steps > 1 else 0.0
        return np.array([0.0, 0.0], np.float32), reward, False, self.steps >= 10, {}


@pytest.mark.parametrize(
    ("algorithm", "least", "most"), [("recurrent_ppo", 7.0, 9.1), ("ppo", -1.5, 1.5)]
)
def test_only_a_policy_with_memory_learns_a_delayed_cue(algorithm, least, most):
    parameters = {"n_steps": 16, "batch_size": 128, "n_epochs": 5, "gamma": 0.9}
    rates = {"learning_rate": (5e-3, 1e-3), "n_envs": 32}
    recipe = small_recipe(algorithm=algorithm, parameters=parameters, **rates)
    env = SyncVectorEnv([Cue] * 32, autoreset_mode=AutoresetMode.SAME_STEP)
    model = CompiledPPO(env, recipe, seed=0)
    model.learn(12_000)
    assert least < model.training_return < most


@pytest.mark.parametrize(
    ("recipe", "message"),
    [
        (recurrent(parameters={"sequence_length": 5}), "must divide n_steps = 16, got 5"),
        (recurrent(parameters={"sequence_length": 0}), "sequence_length must be at least 1"),
        (small_recipe(parameters={"sequence_length": 8}), "sequence_length is not a keyword"),
    ],
)
def test_sequences_that_do_not_fit_are_refused(recipe, message):
    with pytest.raises(ValueError, match=message):
        CompiledPPO(sliders(), recipe)

"""The compiled PPO against torch, Stable-Baselines3, and plain sums."""

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from baselines.compiled_ppo import CompiledPPO
from baselines.compiled_ppo.ppo import advantages
from tests.unit.sliders import Slider, sliders, small_recipe


def rng():
    return np.random.default_rng(0)


# ---- against torch and Stable-Baselines3 ---------------------------------------------------------


def models(activation, parameters, count=300, critic_only=0):
    """A model of each kind with the same weights, and the same samples to learn from."""
    torch = pytest.importorskip("torch")
    from stable_baselines3 import PPO

    recipe = small_recipe(
        activation=activation,
        policy={"log_std_init": -0.4},
        parameters={"n_steps": count, "batch_size": 128, **parameters},
        learning_rate=(3e-3, 3e-3),
    )
    asymmetric = {**recipe.parameters, "critic_only": critic_only}
    ours = CompiledPPO(sliders(1), recipe.replace(parameters=asymmetric), seed=1)
    kinds = {"relu": torch.nn.ReLU, "tanh": torch.nn.Tanh, "elu": torch.nn.ELU}
    theirs = PPO(
        "MlpPolicy",
        Slider(),
        device="cpu",
        learning_rate=3e-3,
        policy_kwargs={
            "net_arch": {"pi": list(recipe.layers), "vf": list(recipe.critic_layers)},
            "activation_fn": kinds[activation],
            "log_std_init": -0.4,
        },
        **recipe.parameters,
    )
    draw = rng()
    if critic_only:
        actor = theirs.policy.mlp_extractor.policy_net
        actor[0] = torch.nn.Linear(3 - critic_only, recipe.layers[0])
    layers = pairs_of(theirs, ours.networks.params, ours)
    for tensor, view in layers:  # biases too are to be something else than zero
        view[:] = draw.normal(0.0, 0.3, view.shape)
        tensor.data[:] = torch.as_tensor(view)
    samples = {
        "observations": draw.normal(size=(count, 3)),
        "actions": draw.normal(size=(count, 2)),
        "rewards": draw.normal(size=count),
        "values": draw.normal(size=count),
        "ended": draw.random(count) < 0.1,
    }
    samples = {k: v if v.dtype == bool else v.astype(np.float32) for k, v in samples.items()}
    with torch.no_grad():
        normal, _ = outputs_of(theirs, torch.as_tensor(samples["observations"]))
        found = normal.log_prob(torch.as_tensor(samples["actions"])).sum(dim=1).numpy()
    # some ratios beyond the clipping on either side
    samples["log_probs"] = found + draw.normal(0.0, 0.3, count).astype(np.float32)
    samples["advantages"] = draw.normal(2.0, 3.0, count).astype(np.float32)
    samples["returns"] = draw.normal(1.0, 2.0, count).astype(np.float32)
    ours._observations[:, 0], ours._actions[:, 0] = samples["observations"], samples["actions"]
    ours._log_probs[:, 0], ours._targets[:, 0] = samples["log_probs"], samples["returns"]
    ours._advantages[:, 0] = samples["advantages"]
    ours.prepare()
    return ours, theirs, samples


def outputs_of(theirs, x):
    """Distribution and values of a model of Stable-Baselines3, whose actor sees what it takes."""
    import torch

    policy, nets = theirs.policy, theirs.policy.mlp_extractor
    means = policy.action_net(nets.policy_net(x[:, : nets.policy_net[0].in_features]))
    values = policy.value_net(nets.value_net(x))
    return torch.distributions.Normal(means, policy.log_std.exp()), values


def pairs_of(theirs, vector, ours):
    """Each tensor of a model of Stable-Baselines3, with the part of a vector that is like it."""
    policy, networks = theirs.policy, ours.networks
    pairs = []
    for table, hidden, last in (
        (networks.actor, policy.mlp_extractor.policy_net, policy.action_net),
        (networks.critic, policy.mlp_extractor.value_net, policy.value_net),
    ):
        modules = [m for m in (*hidden, last) if hasattr(m, "weight")]
        for module, (i, o, w, b, _) in zip(modules, table.tolist(), strict=True):
            pairs.append((module.weight, vector[w : w + i * o].reshape(o, i)))
            pairs.append((module.bias, vector[b : b + o]))
    first = networks.actor[-1, 3] + 2
    return [*pairs, (policy.log_std, vector[first : first + 2])]


@pytest.mark.parametrize("activation", ["relu", "tanh", "elu"])
@pytest.mark.parametrize(
    ("normalize", "size", "critic_only"), [(True, 173, 0), (False, 751, 0), (True, 751, 2)]
)
def test_gradients_are_those_of_torch(activation, normalize, size, critic_only):
    """Of parts smaller than a tile, and of such as take two; of an actor that sees less, too."""
    parameters = {"ent_coef": 0.02, "vf_coef": 0.7, "normalize_advantage": normalize}
    ours, theirs, samples = models(activation, parameters, count=800, critic_only=critic_only)
    import torch

    chosen = rng().permutation(800)[:size]
    ours.learner.order[:size] = chosen
    advantage = samples["advantages"][chosen].astype(np.float64)
    if normalize:
        advantage = (advantage - advantage.mean()) / (advantage.std(ddof=1) + 1e-8)
    ours.learner.normalized[:size] = advantage
    sums = ours.learner.differentiate(0, size)
    found = ours.learner.gradients.sum(axis=0)

    theirs.policy.double()
    tensors = {k: torch.as_tensor(v[chosen]).double() for k, v in samples.items() if k != "ended"}
    normal, values = outputs_of(theirs, tensors["observations"])  # its policy rounds to float32
    log_prob = normal.log_prob(tensors["actions"]).sum(dim=1)
    entropy = normal.entropy().sum(dim=1)
    A = torch.as_tensor(advantage)
    ratio = torch.exp(log_prob - tensors["log_probs"])
    assert 0.1 < float((abs(ratio - 1.0) > 0.2).double().mean()) < 0.9  # both kinds are there
    policy_loss = -torch.min(A * ratio, A * torch.clamp(ratio, 0.8, 1.2)).mean()
    value_loss = torch.nn.functional.mse_loss(tensors["returns"], values.flatten())
    (policy_loss - 0.02 * entropy.mean() + 0.7 * value_loss).backward()
    for tensor, part in pairs_of(theirs, found, ours):
        want = tensor.grad.numpy()
        assert np.linalg.norm(part - want) < 1e-5 * np.linalg.norm(want)
    np.testing.assert_allclose(sums[0] / size, policy_loss.item(), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(sums[1] / size, value_loss.item(), rtol=1e-5)
    np.testing.assert_allclose(sums[3], int((abs(ratio - 1.0) > 0.2).sum()))


def test_first_weights_are_orthogonal_as_those_of_stable_baselines():
    networks = CompiledPPO(sliders(), small_recipe(layers=(64, 32))).networks
    (W1, b1), (W2, _), (W3, _) = networks.layers(networks.actor)
    np.testing.assert_allclose(W1.T @ W1, 2.0 * np.eye(3), atol=1e-5)
    np.testing.assert_allclose(W2 @ W2.T, 2.0 * np.eye(32), atol=1e-5)
    np.testing.assert_allclose(W3 @ W3.T, 1e-4 * np.eye(2), atol=1e-9)
    value = networks.layers(networks.critic)[-1][0]
    np.testing.assert_allclose(value @ value.T, [[1.0]], atol=1e-5)
    assert not b1.any()


# ---- rollouts ------------------------------------------------------------------------------------


def test_advantages_are_the_sums_that_define_them():
    """A_t = sum_k (gamma lambda)^k d_{t+k}, up to the end of the episode."""
    draw, gamma, decay = rng(), 0.9, 0.8
    rewards, values = draw.normal(size=(2, 12, 5)).astype(np.float32)
    after = draw.normal(size=5).astype(np.float32)
    ended = draw.random((12, 5)) < 0.25
    found = advantages(rewards, values, ended, after, gamma, decay)
    ahead = np.vstack([values[1:], after])
    for flight in range(5):
        for t in range(12):
            want, weight = 0.0, 1.0
            for k in range(t, 12):
                goes_on = not ended[k, flight]
                step = rewards[k, flight] + gamma * goes_on * ahead[k, flight]
                want += weight * (step - values[k, flight])
                weight *= gamma * decay
                if not goes_on:
                    break
            assert found[t, flight] == pytest.approx(want, rel=1e-4, abs=1e-5)


def test_truncated_episodes_alone_earn_what_the_critic_expects():
    env = sliders(4)
    model = CompiledPPO(env, small_recipe(parameters={"n_steps": 50}), seed=2)
    seen = []
    step = env.step

    def watched(actions):
        seen.append(step(actions))
        return seen[-1]

    env.step = watched
    model.prepare()
    model._roll_out()
    kinds = set()
    for t, (_, reward, terminated, truncated, info) in enumerate(seen):
        for i in range(4):
            want = 0.5 * reward[i]
            if truncated[i] and not terminated[i]:
                want += 0.99 * model._evaluate(info["final_obs"][i][None])[1][0]
            assert model._rewards[t, i] == pytest.approx(want, abs=1e-5)
            assert model._ended[t, i] == (terminated[i] or truncated[i])
            kinds.add((bool(terminated[i]), bool(truncated[i])))
    assert {(True, False), (False, True)} <= kinds


def test_actions_have_the_probability_that_is_kept_with_them():
    model = CompiledPPO(sliders(), small_recipe(policy={"log_std_init": -0.7}), seed=3)
    model.prepare()
    model._roll_out()
    x = model._observations.reshape(-1, 3)
    mean = model.policy().predict(x)[0]  # small enough not to be clipped
    z = (model._actions.reshape(-1, 2) - mean) / np.exp(-0.7)
    want = (-0.5 * z**2 + 0.7 - 0.5 * np.log(2.0 * np.pi)).sum(axis=1)
    np.testing.assert_allclose(model._log_probs.reshape(-1), want, atol=1e-4)
    assert abs(z.mean()) < 0.3
    assert 0.7 < z.std() < 1.3


# ---- the whole -----------------------------------------------------------------------------------


@pytest.mark.parametrize("critic_only", [0, 1])
def test_same_seed_same_bits_with_any_number_of_threads(critic_only):
    found, recipe = [], small_recipe(parameters={"critic_only": critic_only})
    for seed, threads in ((0, 1), (0, 2), (0, 4), (1, 1)):
        model = CompiledPPO(sliders(), recipe, seed=seed, threads=threads)
        model.learn(1000)
        found.append(model.networks.params)
    assert model.num_timesteps == 1024  # whole rollouts of 128
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])
    assert not np.array_equal(found[0], found[3])


@pytest.mark.parametrize("critic_only", [0, 1])
def test_a_kept_state_goes_on_bit_for_bit(critic_only):
    states, recipe = [], small_recipe(parameters={"critic_only": critic_only})

    def watch(model):
        states.append(model.state())
        return True

    model = CompiledPPO(sliders(), recipe, seed=0)
    model.learn(1000, watch)
    for state in states[1::3]:
        other = CompiledPPO(sliders(), recipe, seed=9)
        other.restore(state)
        other.learn(1000)
        np.testing.assert_array_equal(other.networks.params, model.networks.params)
        assert other.training_return == model.training_return


def test_it_learns_an_environment_that_is_not_ours():
    recipe = small_recipe(
        learning_rate=(3e-3, 3e-3), parameters={"n_steps": 32, "batch_size": 64, "n_epochs": 5}
    )
    model = CompiledPPO(sliders(), recipe, seed=0)
    returns = []

    def watch(model):
        returns.append(model.training_return)
        return True

    model.learn(20_000, watch)
    assert np.nanmean(returns[:5]) < 8.0
    assert model.training_return > 14.0  # 20 without the way from the start
    x = np.array([[1.0, 1.0, 0.5], [-1.0, 1.0, 0.5]], np.float32)
    action, state = model.predict(x)
    assert state is None
    assert action[0, 0] < -0.3
    assert action[1, 0] > 0.3


def test_a_diverged_training_says_so():
    model = CompiledPPO(sliders(), small_recipe(), seed=0)
    model.prepare()
    model.networks.params[0] = np.nan
    with pytest.raises(FloatingPointError, match="diverged"):
        model.learn(1000)


@pytest.mark.parametrize(
    ("env", "recipe", "message"),
    [
        (sliders(mode=AutoresetMode.NEXT_STEP), small_recipe(), "SameStep"),
        (gymnasium.make_vec("Pendulum-v1", 2), small_recipe(), r"\[-1, 1\]"),
        (gymnasium.make_vec("CartPole-v1", 2), small_recipe(), "vectors as actions"),
        (sliders(), small_recipe(algorithm="sac"), "must be one of ppo"),
        (sliders(), small_recipe(parameters={"target_kl": 0.1}), "target_kl is not a keyword"),
        (sliders(), small_recipe(parameters={"batch_size": 0}), "batch_size must be at least 1"),
        (sliders(), small_recipe(parameters={"gamma": 1.5}), "gamma must be at most 1"),
        (sliders(), small_recipe(policy={"ortho_init": False}), "ortho_init is not a keyword"),
        (sliders(), small_recipe(parameters={"critic_only": -1}), "critic_only must be at least 0"),
        (sliders(), small_recipe(parameters={"critic_only": 0.5}), "critic_only must be a whole"),
        (sliders(), small_recipe(parameters={"critic_only": 3}), "at least one of 3 obs.*, got 3"),
    ],
)
def test_what_does_not_fit_is_refused(env, recipe, message):
    with pytest.raises(ValueError, match=message):
        CompiledPPO(env, recipe)


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

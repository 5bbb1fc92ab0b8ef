"""The compiled PPO: gradients, first weights, repeatability, saved states and learning."""

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from baselines.compiled_ppo import CompiledPPO
from baselines.policies import load_policy
from tests.unit.sliders import sliders, small_recipe


@pytest.mark.parametrize("activation", ["relu", "tanh", "elu"])
def test_critic_only_input_gives_gradients_of_actor_with_zero_weights(activation):
    """The reference actor has zero weights for the hidden input; 751 samples take two tiles."""
    draw, count, size, found = np.random.default_rng(0), 800, 751, []
    samples = {name: draw.normal(size=(count, 1)).astype("f4") for name in ("_targets", "_lp")}
    seen, acted = (draw.normal(size=(count, n)).astype(np.float32) for n in (3, 2))
    advantages = draw.normal(size=size)
    for critic_only in (1, 0):
        parameters = {"n_steps": count, "batch_size": 128, "critic_only": critic_only}
        recipe = small_recipe(activation=activation, parameters=parameters)
        model = CompiledPPO(sliders(1), recipe, seed=1)
        networks = model.networks
        actor, critic = networks.layers(networks.actor), networks.layers(networks.critic)
        if critic_only:
            kept = [[w.copy() for w in layer] for layer in (*actor, *critic)]
        else:
            for own, given in zip((*actor, *critic), kept, strict=True):
                for view, values in zip(own, given, strict=True):
                    view[:] = 0.0
                    view[..., : values.shape[-1]] = values
        model._observations[:, 0], model._actions[:, 0] = seen, acted
        model._log_probs[:], model._targets[:] = samples["_lp"] - 2.0, samples["_targets"]
        model.prepare()
        model.learner.order[:size] = np.arange(size)
        model.learner.normalized[:size] = advantages
        model.learner.differentiate(0, size)
        gradients = model.learner.gradients.sum(axis=0)
        parts = []
        for inputs, outputs, w, b, _ in (*networks.actor.tolist(), *networks.critic.tolist()):
            parts.append(gradients[w : w + inputs * outputs].reshape(outputs, inputs))
            parts.append(gradients[b : b + outputs])
        found.append(parts)
    assert found[0][0].shape[1] == 2
    found[1][0] = found[1][0][:, :2]
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-6 * abs(other).max())
    assert max(abs(part).max() for part in found[0]) > 1e-3


def test_initial_weights_are_orthogonal_as_in_stable_baselines():
    networks = CompiledPPO(sliders(), small_recipe(layers=(64, 32))).networks
    (W1, b1), (W2, _), (W3, _) = networks.layers(networks.actor)
    np.testing.assert_allclose(W1.T @ W1, 2.0 * np.eye(3), atol=1e-5)
    np.testing.assert_allclose(W2 @ W2.T, 2.0 * np.eye(32), atol=1e-5)
    np.testing.assert_allclose(W3 @ W3.T, 1e-4 * np.eye(2), atol=1e-9)
    value = networks.layers(networks.critic)[-1][0]
    np.testing.assert_allclose(value @ value.T, [[1.0]], atol=1e-5)
    assert not b1.any()


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
def test_training_continues_bit_for_bit_from_restored_state(critic_only):
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


def test_training_improves_return_in_foreign_environment():
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
    assert model.training_return > 14.0  # 20 if x were 0 from the start
    x = np.array([[1.0, 1.0, 0.5], [-1.0, 1.0, 0.5]], np.float32)
    action, state = model.predict(x)
    assert state is None
    assert action[0, 0] < -0.3
    assert action[1, 0] > 0.3


def test_diverged_training_raises_floating_point_error():
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
def test_unsupported_environment_or_recipe_raises_value_error(env, recipe, message):
    with pytest.raises(ValueError, match=message):
        CompiledPPO(env, recipe)


def test_policy_is_refused_where_actions_or_observations_differ(tmp_path):
    def hover(count=1, **keywords):
        return gymnasium.make_vec("QuadGym/Hover-v0", num_envs=count, **keywords)

    trained = hover(8, autoreset_mode="SameStep", start="hover", action="velocity")
    model = CompiledPPO(trained, small_recipe(), seed=np.int64(0), env_seed=np.int64(10**9))
    model.policy().save(tmp_path / "mine.npz")
    name = str(tmp_path / "mine.npz")
    assert load_policy(name, hover(action="velocity", observation="truth")) is not None
    with pytest.raises(ValueError, match=r"trained with action velocity, but .* has ctbr"):
        load_policy(name, hover())
    with pytest.raises(ValueError, match=r"trained with control_rate 50.0, but .* has 100.0"):
        load_policy(name, hover(action="velocity", control_rate=100))
    with pytest.raises(ValueError, match=r"trained with observations of .* fields"):
        load_policy(name, hover(action="velocity", include_std=True))


def test_input_of_the_critic_alone_changes_no_action():
    model = CompiledPPO(sliders(), small_recipe(parameters={"critic_only": 1}), seed=0)
    model.learn(1000)
    draw = np.random.default_rng(0)
    x = draw.normal(size=(150, 3)).astype(np.float32)  # more than two tiles
    other = x.copy()
    other[:, 2] += 1.0
    means, values = model.networks.evaluate(x)
    moved = model.networks.evaluate(other)
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

"""Imitation of a controller: gradients, repeatability, saved states, and learned actions."""

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from baselines.compiled_ppo.imitation import Imitation, columns_of, teacher_of
from baselines.pd import PDPolicy
from baselines.recipes import IMITATION, Plan, Recipe, recipe
from baselines.training import train
from tests.unit.sliders import sliders

HOVER = "QuadGym/Hover-v0"


class Linear:
    """Controller whose action is a linear function of the three observed values of `Slider`."""

    matrix = np.array([[-0.3, 0.1, 0.2], [0.1, -0.2, 0.4]])

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return observation @ self.matrix.T, None


class Alternating:
    """Controller with a memory: the sign of its action changes in every step of an episode."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        before = np.zeros(len(observation)) if state is None else state
        steps = np.where(episode_start, 0, before + 1)
        return np.where(steps % 2 == 0, 0.5, -0.5)[:, np.newaxis] * np.ones(2), steps


def small(parameters=None, **changes):
    options = {
        "algorithm": IMITATION,
        "n_envs": 8,
        "steps": 4000,
        "learning_rate": (3e-3, 1e-4),
        "action_noise": 0.25,
        "parameters": {"n_steps": 50, "batch_size": 256, "n_batches": 100, **(parameters or {})},
    }
    return Recipe(**{**options, **changes})


def drawn(seed, *shape):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def test_linear_controller_is_imitated():
    model = Imitation(sliders(), small(), teacher=Linear())
    model.learn(4000, quiet=True)
    assert model.num_timesteps == 4000
    x = np.random.default_rng(1).uniform([-1.0, 1.0, 0.0], [1.0, 1.0, 1.0], (500, 3))
    found, memory = model.policy().predict(x)
    assert memory is None
    np.testing.assert_allclose(found, x @ Linear.matrix.T, atol=0.05)
    assert np.abs(found - x @ Linear.matrix.T).mean() < 0.01
    assert model.losses["squared_error"] < 1e-3
    assert np.isfinite(model.training_return)


def test_same_seed_same_policy():
    found = []
    for seed in (0, 0, 1):
        model = Imitation(sliders(), small(), teacher=Linear(), seed=seed, env_seed=5)
        model.learn(800)
        found.append(model.networks.params)
    np.testing.assert_array_equal(found[0], found[1])
    assert not np.array_equal(found[0], found[2])


def test_network_observes_its_columns_only_and_the_teacher_everything():
    model = Imitation(sliders(), small(), teacher=Linear(), columns=[2, 1])
    model.learn(4000)
    x = drawn(0, 5, 3)
    np.testing.assert_array_equal(model.predict(x)[0], model.policy().predict(x[:, [2, 1]])[0])
    np.testing.assert_array_equal(model.predict(x[:, [2, 1]])[0], model.predict(x)[0])
    assert model.losses["squared_error"] > 1e-2  # the position, which it does not observe
    with pytest.raises(ValueError, match=r"must be \(\.\.\., 2\), got shape \(5, 4\)"):
        model.predict(drawn(0, 5, 4))


def test_memory_of_the_teacher_lasts_until_the_end_of_its_episode():
    model = Imitation(sliders(2), small({"n_steps": 65}, n_envs=2), teacher=Alternating())
    model.prepare()
    model._roll_out(1.0)
    shown = model._observations.reshape(65, 2, 3)
    steps = np.round(20.0 * shown[:, :, 2])  # since the start of the episode
    answers = model._answers.reshape(65, 2, 2)
    np.testing.assert_array_equal(answers[:, :, 0], np.where(steps % 2 == 0, 0.5, -0.5))
    assert (steps == 0.0).sum() >= 8


def test_noise_is_added_to_every_second_flight_and_teacher_flies_its_share():
    acted = []

    class Kept(gymnasium.vector.VectorWrapper):
        def step(self, actions):
            acted.append(actions)
            return self.env.step(actions)

    env = Kept(sliders(200))
    env.metadata = env.env.metadata
    model = Imitation(env, small({"n_steps": 1}, n_envs=200), teacher=Linear(), seed=3)
    model.prepare()
    for share in (1.0, 0.5, 0.0):
        before = model._seen
        model._roll_out(share)
        own = model.networks.evaluate(before)[0]
        by_teacher = np.abs(acted[-1] - before @ Linear.matrix.T).max(axis=1) < 1e-6
        by_network = np.abs(acted[-1] - own).max(axis=1) < 1e-6
        assert not (by_teacher | by_network)[1::2].any()  # with noise
        assert (by_teacher | by_network)[::2].all()
        assert by_teacher[::2].mean() == pytest.approx(share, abs=0.12)


@pytest.mark.parametrize("activation", ["relu", "tanh", "elu"])
def test_gradient_and_steps_equal_torch(activation):
    torch = pytest.importorskip("torch")
    model = Imitation(sliders(), small(activation=activation, layers=(16, 9)), teacher=Linear())
    layers = model.networks.layers(model.networks.actor)
    for k, (W, b) in enumerate(layers):
        W[:], b[:] = 0.5 * drawn(k, *W.shape), 0.1 * drawn(k, *b.shape)
    theirs = [torch.tensor(p.copy(), requires_grad=True) for layer in layers for p in layer]
    optimizer = torch.optim.Adam(theirs, lr=1e-2)
    act = {"relu": torch.relu, "tanh": torch.tanh, "elu": torch.nn.functional.elu}[activation]
    for k in range(4):
        x, wanted = drawn(10 + k, 40, 3), drawn(20 + k, 40, 2)
        y = torch.tensor(x)
        for W, b in zip(theirs[::2], theirs[1::2], strict=True):
            y = y @ W.T + b
            y = y if W is theirs[-2] else act(y)
        loss = ((y - torch.tensor(wanted)) ** 2).mean()
        optimizer.zero_grad()
        loss.backward()
        assert model._differentiate(x, wanted) == pytest.approx(loss.item(), rel=1e-5)
        own = model.networks.layers(model.networks.actor, model._gradient)
        for found, parameter in zip([p for layer in own for p in layer], theirs, strict=True):
            np.testing.assert_allclose(found, parameter.grad.numpy(), rtol=1e-3, atol=1e-6)
        optimizer.step()
        model._descend(1e-2)
        for found, parameter in zip([p for layer in layers for p in layer], theirs, strict=True):
            np.testing.assert_allclose(found, parameter.detach().numpy(), atol=2e-4)


def plan(**changes):
    parameters = {"teacher": "pd", "n_steps": 10, "batch_size": 64, "n_batches": 20}
    chosen = recipe(HOVER, IMITATION).replace(steps=800, n_envs=8, parameters=parameters)
    options = {"env_id": HOVER, "recipe": chosen, "engine": "compiled", "episodes": 4}
    return Plan(**{**options, "environment": {"duration": 1.0}, "evaluations": 2, **changes})


def test_training_is_a_run_that_continues_bit_for_bit(tmp_path):
    done = train(plan(), tmp_path / "a", tensorboard=False, quiet=True)
    assert done.finished
    assert done.steps == 800
    env = gymnasium.make_vec(HOVER, num_envs=8, autoreset_mode="SameStep", duration=1.0)
    states = []

    def watch(model):
        states.append(model.state())
        return True

    model = Imitation(env, plan().recipe, columns=None)
    model.learn(800, watch)
    again = gymnasium.make_vec(HOVER, num_envs=8, autoreset_mode="SameStep", duration=1.0)
    other = Imitation(again, plan().recipe, seed=9)
    other.restore(states[4])
    other.learn(800)
    np.testing.assert_array_equal(other.networks.params, model.networks.params)
    assert other.training_return == model.training_return


def test_imitation_of_pd_control_hovers():
    env = gymnasium.make_vec(HOVER, num_envs=50, autoreset_mode="SameStep", duration=4.0)
    model = Imitation(env, small({"n_batches": 200}, n_envs=50), teacher=PDPolicy(env))
    model.learn(20_000)
    seen, _ = env.reset(seed=1)
    for _ in range(100):
        seen, _, terminated, _, _ = env.step(model.predict(seen)[0])
        assert not terminated.any()


def test_columns_follow_named_parts():
    env = gymnasium.make_vec("QuadGym/OutageDash-v0", num_envs=2)
    where = {field.name: field.slice for field in env.unwrapped.flights.table}
    found = columns_of(["gap_width", "up"], env)
    assert found == [where["gap_width"].start, *range(where["up"].start, where["up"].stop)]
    with pytest.raises(ValueError, match="must observe position_sigma, as the policy does"):
        columns_of(["up", "position_sigma"], env)


def test_teachers_are_policies_or_classes():
    env = gymnasium.make_vec("QuadGym/OutageDash-v0", num_envs=2, include_std=True)
    assert isinstance(teacher_of("pd:waiting", env), PDPolicy)
    assert type(teacher_of("scripts.studies.rules:BacksOff", env)).__name__ == "BacksOff"
    for name in ("nothing", "nothing:Rule", "scripts.studies.rules:Nobody"):
        with pytest.raises(ValueError, match="must be"):
            teacher_of(name, env)


@pytest.mark.parametrize(
    ("env", "changes", "message"),
    [
        (sliders(mode=AutoresetMode.NEXT_STEP), {}, "SameStep"),
        (gymnasium.make_vec("CartPole-v1", 2), {}, "vectors as actions"),
        (sliders(), {"recipe": small(algorithm="sac")}, "algorithm of imitation must be one of"),
        (sliders(), {"recipe": small({"gamma": 0.9})}, "gamma is not a keyword of imitation"),
        (sliders(), {"recipe": small({"n_batches": 0})}, "n_batches must be at least 1"),
        (sliders(), {"recipe": small({"teacher": 3})}, "teacher must be a str, got 3"),
        (sliders(), {"recipe": small(policy={"log_std_init": 0.0})}, "log_std_init is not a key"),
        (sliders(), {"columns": [3]}, "indices of 3 observed values"),
        (sliders(), {"columns": [0.5]}, "indices of 3 observed values"),
        (sliders(), {"columns": []}, "indices of 3 observed values"),
    ],
)
def test_unsupported_environment_or_recipe_raises_value_error(env, changes, message):
    with pytest.raises(ValueError, match=message):
        Imitation(env, **{"recipe": small(), "teacher": Linear(), **changes})


def test_imitation_needs_the_compiled_engine(tmp_path):
    pytest.importorskip("stable_baselines3")
    with pytest.raises(ValueError, match="algorithm of Stable-Baselines3 must be one of ppo"):
        train(plan(engine="sb3"), tmp_path, tensorboard=False, quiet=True)

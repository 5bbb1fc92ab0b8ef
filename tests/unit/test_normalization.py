"""Policies that were trained on normalized observations: evaluated, converted and exported.

The right actions are those of Stable-Baselines3 with its own `VecNormalize`, or of the network
behind Gymnasium's own wrapper.
"""

import re

import gymnasium
import numpy as np
import pytest

import quad_gym
from baselines.exporting import controller_of, save_onnx
from baselines.mlp import MlpPolicy
from baselines.normalization import Normalization, NormalizedPolicy
from baselines.policies import load_policy
from quad_gym.commands.main import main
from tests.unit.test_exporting import COMPILER, compiled, needs_compiler

sb3 = pytest.importorskip("stable_baselines3")
from stable_baselines3.common.vec_env import VecNormalize  # noqa: E402

HOVER = "QuadGym/Hover-v0"
KEYWORDS = {"observation": "truth", "start": "hover"}


def plain(count=50):
    return gymnasium.make_vec(HOVER, num_envs=count, **KEYWORDS)


def observations(count=2000):
    """Observations, typical ones and far ones, within the bounds of the space."""
    space = plain(1).single_observation_space
    drawn = (
        np.random.default_rng(1).normal(0.0, 1.0, (count, 28)) * np.logspace(-1, 2, count)[:, None]
    )
    return drawn.clip(space.low, space.high).astype(np.float32)


def act_much(model):
    """Give an untrained policy weights that produce actions that differ."""
    import torch

    with torch.no_grad():
        model.policy.action_net.weight *= 50.0


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Folder with a policy, and the environment with its statistics, of which some clip."""
    folder = tmp_path_factory.mktemp("normalized")
    env = VecNormalize(
        quad_gym.make_sb3_vec_env(HOVER, n_envs=8, seed=10**9, **KEYWORDS), clip_obs=2.5
    )
    model = sb3.PPO("MlpPolicy", env, n_steps=16, batch_size=32, seed=0, device="cpu")
    model.learn(256)
    act_much(model)
    model.save(folder / "policy.zip")
    (folder / "apart").mkdir()
    env.save(folder / "apart" / "vn.pkl")
    env.training = False
    return folder, model, env


def test_evaluated_policy_acts_as_behind_vec_normalize(trained):
    folder, model, env = trained
    seen = observations()
    expected = model.predict(env.normalize_obs(seen), deterministic=True)[0]
    assert (np.abs(env.normalize_obs(seen)) == 2.5).mean() > 0.05  # clipping matters
    for given in (str(folder / "apart" / "vn.pkl"), env, Normalization.of(env)):
        policy = load_policy(str(folder / "policy.zip"), plain(1), normalization=given)
        np.testing.assert_array_equal(policy.predict(seen, deterministic=True)[0], expected)
    without = load_policy(str(folder / "policy.zip"), plain(1)).predict(seen, deterministic=True)[0]
    assert np.abs(without - expected).max() > 0.5


@pytest.mark.parametrize("kind", ["c", "onnx"])
def test_exported_policy_contains_the_normalization(kind, trained, tmp_path):
    folder, model, env = trained
    controller = controller_of(
        str(folder / "policy.zip"), HOVER, KEYWORDS, folder / "apart" / "vn.pkl"
    )
    seen = observations()
    expected = model.predict(env.normalize_obs(seen), deterministic=True)[0]
    np.testing.assert_allclose(controller.act(seen), expected, atol=1e-5)
    if kind == "c":
        if COMPILER is None:
            pytest.skip("there is no C compiler here")
        actions = compiled(controller, tmp_path)(seen)[0]
    else:
        pytest.importorskip("onnx")
        onnxruntime = pytest.importorskip("onnxruntime")
        save_onnx(controller, tmp_path / "it.onnx")
        session = onnxruntime.InferenceSession(tmp_path / "it.onnx")
        (actions,) = session.run(None, {"observation": seen})
    np.testing.assert_allclose(actions, expected, atol=1e-5)
    controller.policy.save(tmp_path / "it.npz")
    again = load_policy(str(tmp_path / "it.npz"), plain(1))
    np.testing.assert_array_equal(again.predict(seen)[0], controller.policy.predict(seen)[0])
    with pytest.raises(ValueError, match=r"normalization must not be given for .*it\.npz"):
        load_policy(str(tmp_path / "it.npz"), plain(1), normalization=env)


@needs_compiler
@pytest.mark.parametrize("kind", [np.float64, np.float32])
@pytest.mark.parametrize("clip", [np.inf, 3.0])
def test_normalization_in_c_has_the_bits_of_numpy(kind, clip, tmp_path):
    """A network that only copies shows the normalized numbers, here large means over small ones."""
    rng = np.random.default_rng(0)
    mean = rng.normal(0.0, 30.0, 28).astype(kind)
    normalization = Normalization(mean, 10.0 ** rng.uniform(-2.0, 2.0, 28).astype(kind), clip)
    copied = np.zeros((4, 28), np.float32)
    copied[range(4), (0, 9, 17, 27)] = 0.25
    policy = MlpPolicy([copied], [np.zeros(4, np.float32)], ["none"], {}, normalization)
    policy.save(tmp_path / "it.npz")
    controller = controller_of(str(tmp_path / "it.npz"), HOVER, KEYWORDS)
    seen = observations()
    expected = controller.act(seen)
    assert 0.05 < (np.abs(expected) < 0.7).mean() < 0.95
    np.testing.assert_array_equal(compiled(controller, tmp_path)(seen)[0], expected)
    x = seen.astype(np.float64)[:, [0, 9, 17, 27]]  # in double precision, by the definition
    at = [0, 9, 17, 27]
    wide = (x - mean[at]) / normalization.deviation[at]
    np.testing.assert_allclose(expected, (0.25 * wide.clip(-clip, clip)).clip(-1, 1), atol=1e-4)


@pytest.mark.parametrize("vector", [False, True])
def test_statistics_of_gymnasium_wrapper_are_used(vector, tmp_path):
    if vector:
        env = gymnasium.wrappers.vector.NormalizeObservation(plain(3))
    else:
        env = gymnasium.wrappers.NormalizeObservation(gymnasium.make(HOVER, **KEYWORDS))
    env.reset(seed=0)
    for _ in range(30):
        env.step(np.zeros((3, 4) if vector else 4, np.float32))
    env.update_running_mean = False
    seen = observations(300)
    found = Normalization.of(gymnasium.wrappers.TimeLimit(env, 9) if not vector else env)
    expected = (
        np.stack([env.observation(row) for row in seen]) if not vector else env.observations(seen)
    )
    np.testing.assert_array_equal(found(seen), expected)
    found.save(tmp_path / "statistics.npz")
    np.testing.assert_array_equal(Normalization.of(tmp_path / "statistics.npz")(seen), expected)


@pytest.mark.parametrize("name", ["pd", "pretrained", "file with statistics"])
def test_policy_for_original_observations_is_refused_behind_a_wrapper_that_changes_them(
    name, tmp_path
):
    if name == "file with statistics":
        normalization = Normalization(np.zeros(28), np.ones(28))
        name = tmp_path / "policy.npz"
        MlpPolicy([np.zeros((4, 28))], [np.zeros(4)], ["none"], {}, normalization).save(name)
    assert load_policy(name, plain(1)) is not None
    wrapped = gymnasium.wrappers.vector.NormalizeObservation(plain(1))
    with pytest.raises(ValueError, match=r"original observations.*NormalizeObservation changes"):
        load_policy(name, wrapped)


def test_policy_trained_behind_gymnasium_wrapper_needs_its_statistics(tmp_path):
    env = gymnasium.wrappers.NormalizeObservation(gymnasium.make(HOVER, **KEYWORDS))
    model = sb3.PPO("MlpPolicy", env, n_steps=16, batch_size=16, seed=0, device="cpu")
    model.learn(32)
    model.save(tmp_path / "policy.zip")
    name = str(tmp_path / "policy.zip")
    with pytest.raises(ValueError, match="give the statistics of NormalizeObservation"):
        load_policy(name, plain(1))
    policy = load_policy(name, plain(1), normalization=env)
    assert isinstance(policy, NormalizedPolicy)
    env.update_running_mean = False
    seen = observations(20)
    expected = [model.predict(env.observation(row), deterministic=True)[0] for row in seen]
    np.testing.assert_allclose(
        policy.predict(seen, deterministic=True)[0], expected, rtol=0.0, atol=1e-6
    )


@pytest.mark.parametrize("place", ["ppo_vecnormalize_256_steps.pkl", "policy/vecnormalize.pkl"])
def test_statistics_next_to_a_policy_are_not_forgotten(place, trained, tmp_path):
    """The names are those of `CheckpointCallback` and of rl-zoo3."""
    _, model, env = trained
    name = tmp_path / "policy.zip"
    model.save(name)
    (tmp_path / place).parent.mkdir(exist_ok=True)
    (tmp_path / "replay_buffer.pkl").write_bytes(b"\x80\x04something else")
    load_policy(str(name), plain(1))
    env.save(tmp_path / place)
    message = re.escape(f"give normalization {tmp_path / place}")
    with pytest.raises(ValueError, match=f"VecNormalize.*{message}"):
        load_policy(str(name), plain(1))
    with pytest.raises(ValueError, match=message):
        controller_of(str(name), HOVER, KEYWORDS)
    assert load_policy(str(name), plain(1), normalization="none") is not None


def test_message_names_the_statistics_that_were_saved_with_the_policy(trained, tmp_path):
    _, model, env = trained
    model.save(tmp_path / "mine.zip")
    for stem in ("another", "mine"):
        env.save(tmp_path / f"{stem}.pkl")
    with pytest.raises(ValueError, match=r"another\.pkl, mine\.pkl .* give .*/mine\.pkl, or"):
        load_policy(str(tmp_path / "mine.zip"), plain(1))
    env.save(tmp_path / "third.pkl")
    (tmp_path / "mine.pkl").unlink()
    with pytest.raises(ValueError, match="give normalization one of them, or 'none'"):
        load_policy(str(tmp_path / "mine.zip"), plain(1))


def test_commands_take_the_statistics(trained, tmp_path, capsys, monkeypatch):
    folder, _, _ = trained
    monkeypatch.chdir(tmp_path)
    zipped, statistics = str(folder / "policy.zip"), str(folder / "apart" / "vn.pkl")
    words = ["--normalization", statistics, "--output", "it.c", "--env", "observation=truth"]
    main(["export", "policy", zipped, HOVER, *words])
    assert "static const double mean[28]" in (tmp_path / "it.c").read_text()
    words = ["--observation", "truth", "--episodes", "2", "--output", "out", "--env", "start=hover"]
    main(["evaluate", HOVER, "--policy", "pd", zipped, "--normalization", statistics, *words])
    with pytest.raises(SystemExit):
        main(["evaluate", HOVER, "--policy", "pd", "--normalization", statistics, *words])
    assert "--normalization needs a --policy that is a file" in capsys.readouterr().err


def test_statistics_that_do_not_fit_are_refused(trained, tmp_path):
    folder, _, env = trained
    name, one = str(folder / "policy.zip"), np.ones(27)
    for given, message in (
        (Normalization(one, one), "normalization must be of the 28 numbers .* got 27"),
        (str(tmp_path / "none.pkl"), "there is no normalization"),
        ("vn.txt", r"must be a \.pkl or \.npz file"),
        (plain(1), "normalization must be a file, or a VecNormalize"),
    ):
        with pytest.raises(ValueError, match=message):
            load_policy(name, plain(1), normalization=given)
    (tmp_path / "bad.pkl").write_bytes(b"nothing")
    np.savez(tmp_path / "bad.npz", mean=one)
    for file in ("bad.pkl", "bad.npz"):
        with pytest.raises(ValueError, match="is not a"):
            Normalization.of(tmp_path / file)
    for mean, deviation, clip in ((one, 0.0 * one, 1.0), (np.nan * one, one, 1.0), (one, one, 0.0)):
        with pytest.raises(ValueError, match="mean of a normalization must be finite"):
            Normalization(mean, deviation, clip)
    with pytest.raises(ValueError, match=r"original observations.*VecNormalize changes them"):
        load_policy(name, env, normalization=env)  # they would be normalized twice
    with pytest.raises(ValueError, match="normalization must not be given for pd"):
        load_policy("pd", plain(1), normalization=env)
    twins = VecNormalize(quad_gym.make_sb3_vec_env(HOVER, n_envs=2, privileged=True, **KEYWORDS))
    with pytest.raises(ValueError, match="dictionary of policy, privileged"):
        Normalization.of(twins)
    assert Normalization.of(VecNormalize(twins.venv, norm_obs=False)) is None

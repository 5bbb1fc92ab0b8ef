"""Trainings with the compiled engine are repeatable, resume after a kill, and need no torch."""

import json
import pickle
import signal
import zipfile
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from baselines.compiled_ppo import CompiledPPO
from baselines.keeping import STATE, RunError
from baselines.mlp import MlpPolicy
from baselines.policies import PRETRAINED, load_policy
from baselines.recipes import Linear, Plan, recipe
from baselines.training import export, train
from tests import console_commands
from tests.builders import run_python

ROOT = Path(__file__).resolve().parents[2]
CIRCLE = "QuadGym/Circle-v0"


def small_plan(**changes):
    """Return the plan of a training that takes seconds."""
    shipped = recipe(CIRCLE)
    parameters = {**shipped.parameters, "n_steps": 16, "batch_size": 128, "n_epochs": 2}
    options = {
        "recipe": shipped.replace(steps=2560, n_envs=16, parameters=parameters),
        "environment": {"duration": 1.0},
        "engine": "compiled",
        "threads": 1,
        "evaluations": 5,
        "episodes": 8,
    }
    return Plan(**{**options, **changes})


def run(plan, folder, **options):
    return train(plan, folder, quiet=True, **options)


def assert_same_policy(first, second):
    first, second = (MlpPolicy.load(f / "last.npz") for f in (first, second))
    for a, b in zip(first.weights + first.biases, second.weights + second.biases, strict=True):
        np.testing.assert_array_equal(a, b)


def die_after(rollouts, plan, folder, monkeypatch):
    """Train until a rollout fails."""
    calls = iter(range(10_000))
    roll_out = CompiledPPO._roll_out

    def die(self):
        if next(calls) == rollouts:
            raise RuntimeError("died")
        roll_out(self)

    with monkeypatch.context() as patch:
        patch.setattr(CompiledPPO, "_roll_out", die)
        with pytest.raises(RuntimeError, match="died"):
            run(plan, folder)


@pytest.mark.parametrize("rollouts", [3, 8])
def test_resumed_run_equals_uninterrupted_run(tmp_path, monkeypatch, rollouts):
    plan = small_plan()
    run(plan, tmp_path / "whole")
    die_after(rollouts, plan, tmp_path / "cut", monkeypatch)
    assert run(plan, tmp_path / "cut", resume=True).finished
    assert_same_policy(tmp_path / "whole", tmp_path / "cut")
    assert evaluations(tmp_path / "whole") == evaluations(tmp_path / "cut")
    with zipfile.ZipFile(tmp_path / "cut" / "last.npz") as archive:
        kept = archive.read(STATE)  # survives a move of any module or class
    assert b"quad_gym" not in kept
    assert b"baselines" not in kept


def evaluations(folder):
    """Return rows of the evaluations, without their times."""
    lines = (folder / "evaluations.csv").read_text().split()
    return [line.split(",")[:1] + line.split(",")[2:] for line in lines]


def test_run_stopped_between_evaluations_has_no_further_evaluation(tmp_path, monkeypatch):
    plan = small_plan()  # an evaluation every two rollouts
    run(plan, tmp_path / "whole")
    roll_out = CompiledPPO._roll_out
    calls = iter(range(10_000))

    def stop(self):
        roll_out(self)
        if next(calls) == 2:
            signal.raise_signal(signal.SIGTERM)

    with monkeypatch.context() as patch:
        patch.setattr(CompiledPPO, "_roll_out", stop)
        stopped = run(plan, tmp_path / "cut")
    assert (stopped.finished, stopped.steps) == (False, 768)
    assert len(evaluations(tmp_path / "cut")) == 1 + 2  # a header, and steps 0 and 512
    assert run(plan, tmp_path / "cut", resume=True).finished
    assert_same_policy(tmp_path / "whole", tmp_path / "cut")
    assert evaluations(tmp_path / "whole") == evaluations(tmp_path / "cut")


def asymmetric_plan(critic_only=15, **changes):
    """Return the plan of a training whose critic observes the truth."""
    plan = small_plan()
    parameters = {**plan.recipe.parameters, "critic_only": critic_only}
    return small_plan(
        **{
            "env_id": "QuadGym/LookAround-v0",
            "environment": {"duration": 1.0, "task": "baselines.arm_tasks:WithStd"},
            "learning": {"task": "scripts.studies.arm_critics:WithStdCertaintyRewardForCritic"},
            "recipe": plan.recipe.replace(parameters=parameters),
            **changes,
        }
    )


def test_policy_trained_with_privileged_critic_needs_no_privileged_observation(tmp_path):
    plan = asymmetric_plan()
    done = run(plan, tmp_path / "whole")
    env = plan.make_judge()
    policy = load_policy(str(done.best_policy), env)
    assert policy.inputs == env.observation_space.shape[1]
    names = policy.record["interface"]["observation"]
    assert names[-1] == "log_sigma"
    assert not any("actual" in name for name in names)


@pytest.mark.parametrize(
    ("plan", "message"),
    [
        (asymmetric_plan(critic_only=14), "15 of 47, got 14"),
        (asymmetric_plan(learning={}), "0 of 32, got 15"),
        (asymmetric_plan(environment={"include_std": True}), "got 15"),
    ],
)
def test_wrong_number_of_critic_only_values_raises_value_error(tmp_path, plan, message):
    with pytest.raises(ValueError, match="critic_only must be the number of values .*" + message):
        run(plan, tmp_path)


def test_sb3_engine_refuses_critic_only_values(tmp_path):
    pytest.importorskip("stable_baselines3")
    with pytest.raises(ValueError, match=r"critic_only must be 0 with .*, got 15"):
        run(asymmetric_plan(engine="sb3"), tmp_path)


def test_best_policy_is_loaded_from_file_and_exported(tmp_path):
    done = run(small_plan(), tmp_path / "run")
    assert done.best_policy == tmp_path / "run" / "best.npz"
    env = gymnasium.make_vec(CIRCLE, num_envs=2, duration=1.0)
    policy = load_policy(str(done.best_policy), env)
    actions = policy.predict(env.reset(seed=0)[0])[0]
    assert actions.shape == (2, 4)
    with pytest.raises(ValueError, match="trained with action ctbr"):
        load_policy(str(done.best_policy), gymnasium.make_vec(CIRCLE, 2, action="motor"))
    export(done, tmp_path / "out" / "policy.npz")
    exported = MlpPolicy.load(tmp_path / "out" / "policy.npz")
    assert exported.record["finished"]
    np.testing.assert_array_equal(exported.weights[0], policy.weights[0])


class SameDraws:
    """Generator that draws the same numbers as Stable-Baselines3, in the same order."""

    def __init__(self, torch, flights, steps):
        self.torch, self.flights, self.steps = torch, flights, steps
        torch.manual_seed(1)
        np.random.seed(1)  # noqa: NPY002

    def standard_normal(self, shape, dtype):
        return self.torch.normal(self.torch.zeros(shape), self.torch.ones(shape)).numpy()

    def permutation(self, count):
        flight, step = divmod(np.random.permutation(count), self.steps)  # noqa: NPY002
        return step * self.flights + flight


@pytest.mark.parametrize(
    ("activation", "normalize"), [("relu", True), ("tanh", False), ("elu", True)]
)
def test_training_with_the_same_draws_equals_stable_baselines(activation, normalize):
    """The test covers terminated and truncated episodes, advantages, gradients and learning rate.

    One or two of eight million inputs of ReLU round to the other side of zero, where the gradient
    differs. These inputs depend on the processor.
    """
    torch = pytest.importorskip("torch")
    pytest.importorskip("stable_baselines3")
    from baselines.compiled_ppo.run import make_compiled
    from baselines.models import make_flights, make_model

    parameters = {**recipe(CIRCLE).parameters, "n_steps": 64, "batch_size": 256}
    parameters |= {"normalize_advantage": normalize, "ent_coef": 0.02, "vf_coef": 0.7}
    changes = {"activation": activation, "parameters": parameters, "n_envs": 16}
    steps = 3 * 16 * 64
    plan = small_plan(recipe=recipe(CIRCLE).replace(steps=steps, **changes))
    ours, theirs = make_compiled(plan), make_model(plan, make_flights(plan))
    nets, networks = theirs.policy.mlp_extractor, ours.networks
    pairs = [(theirs.policy.log_std, networks.log_std)]
    for table, layers in (
        (networks.actor, (*nets.policy_net, theirs.policy.action_net)),
        (networks.critic, (*nets.value_net, theirs.policy.value_net)),
    ):
        linear = [layer for layer in layers if isinstance(layer, torch.nn.Linear)]
        for layer, (W, b) in zip(linear, networks.layers(table), strict=True):
            pairs += [(layer.weight, W), (layer.bias, b)]
    for tensor, view in pairs:
        tensor.data[:] = torch.as_tensor(view)
    before = [view.copy() for _, view in pairs]
    ours._rng = SameDraws(torch, 16, 64)
    ours.learn(steps)
    SameDraws(torch, 16, 64)
    theirs.learn(steps)
    tolerance = 2e-2 if activation == "relu" else 1e-4
    for (tensor, found), first in zip(pairs, before, strict=True):
        want = tensor.detach().numpy()
        assert np.linalg.norm(found - want) < tolerance * np.linalg.norm(want - first)
    assert len(ours._finished) > 30
    episodes = [record["r"] for record in theirs.ep_info_buffer]
    assert ours.training_return == pytest.approx(np.mean(episodes), rel=1e-3)


def test_checkpoint_that_is_damaged_or_of_another_version_is_refused(tmp_path):
    run(small_plan(), tmp_path)
    record = json.loads((tmp_path / "training.json").read_text())
    (tmp_path / "training.json").write_text(json.dumps(record | {"finished": False}))
    with zipfile.ZipFile(tmp_path / "last.npz") as archive:
        kept, state = pickle.loads(archive.read(STATE))
    part, arrays, flown = pickle.loads(state)
    others = (
        (b"cquad_gym.kernels.moved\nStage\n.", "ModuleNotFoundError: .*moved"),
        (b"cquad_gym.envs.vector\nRenamed\n.", "AttributeError: .*Renamed"),
        (pickle.dumps((part, arrays)), "ValueError"),
        (pickle.dumps((part, arrays, {"env": None})), "KeyError: 'flights'"),
        (
            pickle.dumps((part, arrays, {"flights": flown["flights"][["r", "v"]]})),
            "ValueError: snapshot must be from a batch of 16 flights .* same version",
        ),
    )
    for other, reason in others:
        with zipfile.ZipFile(tmp_path / "last.npz", "w") as archive:
            archive.writestr(STATE, pickle.dumps((kept, other)))
        message = f"must be resumed with the version of quad_gym.*{reason}"
        with pytest.raises(RunError, match=message):
            run(small_plan(), tmp_path, resume=True)
    (tmp_path / "last.npz").write_bytes(b"PK nonsense")
    with pytest.raises(ValueError, match="damaged"):
        run(small_plan(), tmp_path, resume=True)
    with pytest.raises(ValueError, match=r"another plan \(different: engine\)"):
        run(small_plan(engine="sb3"), tmp_path, resume=True)


def command(tmp_path, *more):
    line = [CIRCLE, "--engine", "compiled", "--output", tmp_path / "run"]
    line += ["--no-progress", "--threads", "1", "--episodes", "4", "--env", "duration=1.0"]
    line += ["--n-envs", "16", "--steps", "1024", "--set", "n_steps=16", "batch_size=128"]
    return console_commands.run("train", *line, *more, where=tmp_path)


def test_the_command_trains_and_exports(tmp_path):
    done = command(tmp_path, "--export", "policy.npz")
    assert done.returncode == 0, done.stderr
    assert "best.npz" in done.stdout
    assert MlpPolicy.load(tmp_path / "policy.npz").record["plan"]["engine"] == "compiled"


def test_compiled_engine_is_imported_without_torch():
    code = (
        "import sys; sys.modules['torch'] = sys.modules['stable_baselines3'] = None\n"
        "import baselines.training, baselines.compiled_ppo.run"
    )
    assert run_python("-c", code).returncode == 0


@pytest.mark.parametrize("file", sorted(PRETRAINED.glob("*.npz")), ids=lambda f: f.stem)
def test_included_policy_has_the_record_of_its_training(file):
    record = MlpPolicy.load(file).record
    assert record["finished"]
    assert {"plan", "steps", "best", "versions"} <= set(record)


def test_the_compiled_engine_writes_files_for_tensorboard(tmp_path):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    from baselines.compiled_ppo.run import Events

    events = Events(tmp_path / "run")
    for step in (0, 100):
        events.add(step, {"evaluation/mean_error": 0.5 + step, "train/loss": 0.25})
    events.close()
    found = accumulator.EventAccumulator(str(tmp_path / "run"))
    found.Reload()
    assert sorted(found.Tags()["scalars"]) == ["evaluation/mean_error", "train/loss"]
    errors = found.Scalars("evaluation/mean_error")
    assert [(e.step, e.value) for e in errors] == [(0, 0.5), (100, 100.5)]


def test_learning_rate_stays_positive_in_a_rollout_longer_than_the_training():
    first, last = 1e-3, 1e-4
    rate = Linear(first, last)
    np.testing.assert_allclose([rate(share) for share in (1.0, 0.5, 0.0)], [first, 5.5e-4, last])
    # 2,000,000 steps in rollouts of 8,192 end after 2,007,040: the line goes on
    assert rate(1.0 - 2_007_040 / 2_000_000) == pytest.approx(last - 3.168e-6)
    assert rate(1.0 - 8_192 / 2_000) == 0.5 * last
    assert Linear(last, first)(1.0) == pytest.approx(last)  # a schedule may rise

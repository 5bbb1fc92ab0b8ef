"""Exported controllers compute the actions of their policies."""

import ctypes
import json
import shutil
import subprocess
import zipfile
from functools import partial
from itertools import pairwise
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import quad_gym
from baselines.exporting import c_source, controller_of, save_onnx
from baselines.exporting.controller import action_fields
from baselines.mlp import MlpPolicy
from quad_gym.packing import params_record

COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler here")
FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-pedantic", "-Werror")
CIRCLE = "QuadGym/Circle-v0"


def library_of(controller, folder):
    """Compile the exported C file."""
    (folder / "it.c").write_text(c_source(controller, "it"))
    library = folder / "it.so"
    line = [COMPILER, *FLAGS, "-shared", "-fPIC", str(folder / "it.c"), "-o", str(library), "-lm"]
    subprocess.run(line, check=True, capture_output=True)
    return ctypes.CDLL(str(library))


def compiled(controller, folder):
    """Return the exported C function, from rows of observations to actions and status."""
    function = library_of(controller, folder).it

    def act(observations):
        actions = np.full((len(observations), 4), np.nan, np.float32)
        status = [
            function(row.ctypes.data_as(ctypes.c_void_p), action.ctypes.data_as(ctypes.c_void_p))
            for row, action in zip(np.ascontiguousarray(observations), actions, strict=True)
        ]
        return actions, np.array(status)

    return act


def exact(controller, observations):
    """Evaluate the network in double precision."""
    x = observations.astype(float)
    rules = {"none": lambda x: x, "relu": lambda x: np.maximum(x, 0.0), "tanh": np.tanh}
    policy = controller.policy
    for W, b, rule in zip(policy.weights, policy.biases, policy.activations, strict=True):
        x = rules[rule](x @ W.T.astype(float) + b)
    return x.clip(-1.0, 1.0)


def observations_in_flight(controller, count):
    """Return observations (count, n) of a policy in flight, with some noise on its actions."""
    rng, seen = np.random.default_rng(0), []
    env = gymnasium.make_vec(controller.env_id, num_envs=count // 100, **controller.keywords)
    observation, _ = env.reset(seed=0)
    for _ in range(100):
        seen.append(observation.copy())
        action = controller.policy.predict(observation)[0]
        observation, *_ = env.step(action + 0.1 * rng.standard_normal(action.shape))
    env.close()
    return np.concatenate(seen)


def stable_baselines_file(folder, algorithm, keywords=None):
    """Save an untrained policy of Stable-Baselines3."""
    pytest.importorskip("stable_baselines3")
    from baselines.models import make_flights, make_model
    from baselines.recipes import Plan, recipe

    chosen = recipe(CIRCLE, algorithm).replace(n_envs=2)
    if algorithm == "ppo":
        chosen = chosen.replace(
            activation="tanh", parameters={**chosen.parameters, "batch_size": 64}
        )
    plan = Plan(recipe=chosen, environment=keywords or {}, threads=1)
    model = make_model(plan, make_flights(plan))
    let_act(model)
    model.save(folder / "policy.zip")
    return folder / "policy.zip"


def let_act(model):
    """Give an untrained policy weights that produce actions."""
    import torch

    for name, parameter in model.policy.named_parameters():
        if "bias" in name:
            torch.nn.init.uniform_(parameter, -0.5, 0.5)
        if name == "action_net.weight":
            parameter.data *= 50.0


def compiled_ppo_file(folder, algorithm="ppo"):
    """Save an untrained policy of the compiled PPO as training does."""
    from baselines.compiled_ppo.run import make_compiled
    from baselines.recipes import Plan, description, recipe

    chosen = recipe(CIRCLE).replace(n_envs=2)
    plan = Plan(recipe=chosen, threads=1, engine="compiled")
    model = make_compiled(plan)
    model.networks.layers(model.networks.actor)[-1][0][:] *= 50.0
    model.policy({"plan": description(plan)}).save(folder / "policy.npz")
    return folder / "policy.npz"


SOURCES = {
    **{
        kind: partial(lambda folder, env_id: controller_of("pretrained", env_id), env_id=env_id)
        for env_id, kind in quad_gym.IDS.items()
        if (Path(__file__).parents[2] / "baselines" / "pretrained" / f"{kind}.npz").exists()
    },
    "ppo": lambda folder: controller_of(str(stable_baselines_file(folder, "ppo")), CIRCLE),
    "sac": lambda folder: controller_of(str(stable_baselines_file(folder, "sac")), CIRCLE),
    "compiled_ppo": lambda folder: controller_of(str(compiled_ppo_file(folder))),
}


@needs_compiler
@pytest.mark.parametrize("source", SOURCES)
def test_c_acts_as_the_policy_in_flight(source, tmp_path):
    controller = SOURCES[source](tmp_path)
    seen = observations_in_flight(controller, 10_000)
    actions, status = compiled(controller, tmp_path)(seen)
    assert not status.any()
    assert actions.std(axis=0).min() > 1e-2
    np.testing.assert_allclose(actions, controller.policy.predict(seen)[0], rtol=0.0, atol=2e-6)
    np.testing.assert_allclose(actions, exact(controller, seen), rtol=0.0, atol=1e-6)


@needs_compiler
def test_c_holds_observations_within_their_bounds(tmp_path):
    controller = controller_of("pretrained", CIRCLE)
    act = compiled(controller, tmp_path)
    low, high = controller.bounds
    for beyond, within in ((1e4 * high, high), (1e4 * low, low)):
        np.testing.assert_array_equal(act(beyond[None])[0], act(within[None])[0])


@needs_compiler
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", [0, 27])
def test_c_returns_error_for_non_finite_observation(bad, place, tmp_path):
    observation = np.zeros((1, 28), np.float32)
    observation[0, place] = bad
    actions, status = compiled(controller_of("pretrained", CIRCLE), tmp_path)(observation)
    assert status[0] == 1
    np.testing.assert_array_equal(actions, 0.0)


@needs_compiler
@pytest.mark.parametrize("activation", ["relu", "tanh", "elu", "none"])
def test_c_has_every_activation_and_odd_sizes(activation, tmp_path):
    """Layers of 28, 5, 3 and 4 numbers leave different remainders of sums of four at a time."""
    rng = np.random.default_rng(0)
    sizes = (28, 5, 3, 4)
    shapes = [(outputs, inputs) for inputs, outputs in pairwise(sizes)]
    weights = [rng.normal(0, 0.4, shape).astype(np.float32) for shape in shapes]
    biases = [rng.normal(0, 0.4, o).astype(np.float32) for o in sizes[1:]]
    policy = MlpPolicy(weights, biases, [activation] * 3, {})
    policy.save(tmp_path / "policy.npz")
    controller = controller_of(tmp_path / "policy.npz", CIRCLE)
    seen = rng.standard_normal((200, 28)).astype(np.float32).clip(*controller.bounds)
    actions, _ = compiled(controller, tmp_path)(seen)
    np.testing.assert_allclose(actions, policy.predict(seen)[0], rtol=0.0, atol=2e-6)


@pytest.mark.parametrize("source", SOURCES)
def test_onnx_acts_as_the_policy_in_flight(source, tmp_path):
    pytest.importorskip("onnx")
    onnxruntime = pytest.importorskip("onnxruntime")
    controller = SOURCES[source](tmp_path)
    assert save_onnx(controller, tmp_path / "it.onnx") < 1e-4
    session = onnxruntime.InferenceSession(tmp_path / "it.onnx")
    seen = observations_in_flight(controller, 10_000)
    (actions,) = session.run(None, {"observation": seen})
    np.testing.assert_allclose(actions, controller.policy.predict(seen)[0], rtol=0.0, atol=1e-6)


def test_onnx_metadata_describes_observation_and_action(tmp_path):
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    save_onnx(controller_of("pretrained", CIRCLE), tmp_path / "it.onnx")
    model = onnx.load(tmp_path / "it.onnx")
    said = {p.key: json.loads(p.value) for p in model.metadata_props}
    assert said["env_id"] == CIRCLE
    assert said["control_rate_hz"] == 50.0
    layout = quad_gym.observation_layout()
    assert [f["name"] for f in said["observation"]] == [f.name for f in layout]
    second = ["velocity_error", 3, 3, "m/s", "B"]
    assert list(said["observation"][1].values()) == second
    assert said["action"][1] == "body rate x = 6 a[1] rad/s in B"


def test_onnx_that_acts_differently_is_not_written(tmp_path, monkeypatch):
    pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    controller = controller_of("pretrained", CIRCLE)
    other = controller_of("pretrained", "QuadGym/Hover-v0")
    monkeypatch.setattr(type(controller), "act", lambda self, seen: other.policy.predict(seen)[0])
    with pytest.raises(RuntimeError, match="differ"):
        save_onnx(controller, tmp_path / "it.onnx")
    assert not (tmp_path / "it.onnx").exists()


@pytest.mark.parametrize("action", ["ctbr", "motor", "wrench", "attitude", "velocity"])
def test_zeros_hover_in_every_action(action):
    """Zero actions carry the weight, m g = 0.78 kg 9.8 m/s^2, and command no rotation."""
    params = params_record(quad_gym.vehicle_params("lab"), quad_gym.sensor_suite("lab"))[0]
    offsets = [field.offset for field in action_fields(action, params)]
    if action == "motor":
        speed = np.sqrt(0.78 * 9.8 / 4 / float(params["thrust_coefficient"]))
        np.testing.assert_allclose(offsets, speed / float(params["motor_speed_per_volt"]))
    else:
        hovering = 0.0 if action == "velocity" else 0.78 * 9.8
        np.testing.assert_allclose(offsets, [hovering, 0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("policy", "env_id", "keywords", "message"),
    [
        ("pd:lab", CIRCLE, None, "must be a trained network"),
        ("pretrained", CIRCLE, {"action": "motor"}, "was trained with action ctbr"),
        ("nothing.zip", None, None, "policy file not found"),
        ("nothing.txt", CIRCLE, None, "policy file not found"),
    ],
)
def test_export_of_unsuitable_policy_raises_value_error(policy, env_id, keywords, message):
    with pytest.raises(ValueError, match=message):
        controller_of(policy, env_id, keywords)


def test_export_of_privileged_policy_raises_value_error(tmp_path):
    keywords = {"privileged": True}
    file = stable_baselines_file(tmp_path, "ppo", keywords)
    with pytest.raises(ValueError, match="observes the truth"):
        controller_of(str(file), CIRCLE, keywords)


@pytest.mark.parametrize(
    ("plan", "named"),
    [
        ({"env_id": CIRCLE, "environment": {"estimator": "evil:E"}}, "--env estimator=evil:E"),
        (  # keywords replace all of the record, so the message has all of them
            {"env_id": CIRCLE, "environment": {"include_std": True, "task": "evil:T"}},
            "--env include_std=True task=evil:T",
        ),
        ({"env_id": f"evil:{CIRCLE}"}, "ENV_ID"),
    ],
)
def test_module_that_a_policy_file_names_is_not_imported(plan, named, tmp_path, monkeypatch):
    (tmp_path / "evil.py").write_text("open('ran', 'w').close()")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    included = Path(quad_gym.__file__).parents[1] / "baselines" / "pretrained" / "circle.npz"
    policy = MlpPolicy.load(included)
    policy.record = {"plan": plan}
    policy.save(tmp_path / "policy.npz")
    with pytest.raises(ValueError, match=f"names a module, evil:.*specify {named} yourself"):
        controller_of("policy.npz")
    assert not Path("ran").exists()
    if named != "ENV_ID":
        with pytest.raises(ValueError, match="specify --env"):
            controller_of("policy.npz", CIRCLE)
        assert not Path("ran").exists()
    controller_of("policy.npz", CIRCLE, {})  # which the user names


def rewritten(file, **entries):
    """Copy the included policy of the circle, with other entries; None: without the entry."""
    included = Path(quad_gym.__file__).parents[1] / "baselines" / "pretrained" / "circle.npz"
    with np.load(included) as stored:
        arrays = {name: stored[name] for name in stored.files}
    arrays |= {name: value for name, value in entries.items() if not isinstance(value, bytes)}
    if "record" in arrays:
        about = json.loads(str(arrays["about"])) | {"record": arrays.pop("record")}
        arrays["about"] = np.array(json.dumps(about))
    np.savez_compressed(file, **arrays)
    for name, content in entries.items():
        if isinstance(content, bytes):
            with zipfile.ZipFile(file, "a") as archive:
                archive.writestr(f"{name}.npy", content)
    return file


def claiming(count):
    """Return an array in NumPy's format that claims so many numbers, and has none."""
    header = str({"descr": "<f4", "fortran_order": False, "shape": (count,)}).encode()
    header += b" " * (118 - len(header) - 1) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header


NANS = np.full((4, 64), np.nan, np.float32)


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"more": claiming(10**12)}, "is not a policy, or is damaged"),
        ({"more": claiming(10**7)}, "is not a policy, or is damaged"),
        ({"more": np.zeros(2**26 + 1, np.float32)}, "is not a policy, or is damaged"),
        ({"W0": np.float32(1.0)}, r"is not a valid policy: weights must be matrices.*\(\)"),
        ({"W0": np.zeros((0, 0), np.float32)}, "is not a valid policy"),
        ({"W2": NANS}, "is not a valid policy: weights and biases must be finite"),
        ({"record": []}, r"its training record must be a table, got \[\]"),
        ({"record": {"plan": "circle"}}, "plan of its training record must be a table"),
        ({"record": {"plan": {"environment": ["motor"]}}}, "environment of its training record"),
        ({"record": {"interface": [1]}}, "interface of its training record must be a table"),
        ({"record": {"interface": {"observation": 5}}}, "must be names, got 5"),
    ],
)
def test_damaged_or_hostile_policy_is_refused(entries, message, tmp_path):
    file = rewritten(tmp_path / "policy.npz", **entries)
    with pytest.raises(ValueError, match=rf"policy\.npz .*{message}"):
        controller_of(str(file), CIRCLE)


@pytest.mark.parametrize(
    "keywords",
    [{"trajectory": "/etc/passwd"}, {"trajectory": ["a", "b/c.csv"]}, {"world": "mine.toml"}],
)
def test_file_that_a_policy_file_names_is_not_opened(keywords, tmp_path):
    plan = {"env_id": CIRCLE, "environment": keywords}
    file = rewritten(tmp_path / "policy.npz", record={"plan": plan})
    (name,) = keywords
    with pytest.raises(ValueError, match=f"names a file, .*specify --env '?{name}="):
        controller_of(str(file))

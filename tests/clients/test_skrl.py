"""skrl trains on flights of torch tensors."""

import pytest

import quad_gym

skrl = pytest.importorskip("skrl")
torch = pytest.importorskip("torch")

from skrl.agents.torch.ppo import PPO  # noqa: E402
from skrl.memories.torch import RandomMemory  # noqa: E402
from skrl.trainers.torch import SequentialTrainer  # noqa: E402
from skrl.utils.model_instantiators.torch import deterministic_model, gaussian_model  # noqa: E402

from quad_gym.envs.skrl import SkrlWrapper  # noqa: E402

LAYERS = [
    {"name": "net", "input": "OBSERVATIONS", "layers": [64, 64], "activations": "tanh"},
]


def hovering(seed):
    flights = quad_gym.make_torch_vec_env(
        "QuadGym/Hover-v0", 64, autoreset_mode="SameStep", observation="truth"
    )
    return SkrlWrapper(flights, seed=seed)


def crashes(env, act):
    """Fly one episode; return the share of flights that crash."""
    crashed, (seen, _) = torch.zeros(64, dtype=torch.bool), env.reset()
    with torch.no_grad():
        for _ in range(env.flights.batch.max_steps):
            seen, _, terminated, _, _ = env.step(act(seen))
            crashed |= terminated[:, 0]
    return float(crashed.float().mean())


def test_ppo_learns_to_hover(tmp_path):
    torch.manual_seed(0)
    torch.set_num_threads(1)
    env = hovering(10**9)
    spaces = {
        "observation_space": env.observation_space,
        "action_space": env.action_space,
        "device": env.device,
    }
    models = {
        "policy": gaussian_model(**spaces, initial_log_std=-0.5, network=LAYERS, output="ACTIONS"),
        "value": deterministic_model(**spaces, network=LAYERS, output="ONE"),
    }
    agent = PPO(
        models=models,
        memory=RandomMemory(memory_size=32, num_envs=64, device=env.device),
        cfg={
            "rollouts": 32,
            "learning_epochs": 5,
            "mini_batches": 4,
            "discount_factor": 0.98,
            "experiment": {
                "directory": str(tmp_path),
                "write_interval": 0,
                "checkpoint_interval": 0,
            },
        },
        **spaces,
    )
    steps = 32 * 60
    trainer = {"timesteps": steps, "disable_progressbar": True, "close_environment_at_exit": False}
    SequentialTrainer(env=env, agents=agent, cfg=trainer).train()

    def act(seen):
        inputs = {"observations": seen}
        return models["policy"].act(inputs, role="policy")[1]["mean_actions"]

    assert crashes(hovering(0), lambda seen: 0.3 * torch.randn(64, 4)) > 0.5
    assert crashes(hovering(0), act) < 0.1


def test_dictionaries_are_refused():
    flights = quad_gym.make_torch_vec_env("QuadGym/Hover-v0", 2, privileged=True)
    with pytest.raises(ValueError, match="privileged=False"):
        SkrlWrapper(flights)

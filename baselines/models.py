"""Models of Stable-Baselines3 for a plan, and checkpoints from which a run resumes exactly."""

import inspect
import io
import math
import pickle
import zipfile
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

import quad_gym
from baselines.keeping import STATE, RunKeeper, best_file, reading_checkpoint, replace_file
from baselines.recipes import ALGORITHMS, Linear, Plan, Recipe, first_seed
from quad_gym.params import checks as check

# --------------------------------------------------------------------------------------------------
# The flights of a training with Stable-Baselines3.
# --------------------------------------------------------------------------------------------------


class ScaledReward(VecEnvWrapper):
    """Wrapper that multiplies the reward; returns in episode records are not scaled."""

    def __init__(self, venv: VecEnv, scale: float) -> None:
        super().__init__(venv)
        self.scale = np.float32(scale)

    def reset(self) -> Any:
        """Begin an episode in each flight."""
        return self.venv.reset()

    def step_wait(self) -> Any:
        """Return the results of the step, with scaled rewards."""
        observations, rewards, dones, infos = self.venv.step_wait()
        return observations, rewards * self.scale, dones, infos


def make_flights(plan: Plan) -> ScaledReward:
    """Make the environment to train in, seeded."""
    env = quad_gym.make_sb3_vec_env(
        plan.env_id,
        n_envs=plan.recipe.n_envs,
        seed=first_seed("training", plan.seed, plan.recipe.n_envs),
        threads=plan.threads,
        **plan.training_keywords,
    )
    return ScaledReward(env, plan.recipe.reward_scale)


# --------------------------------------------------------------------------------------------------
# Untrained models of Stable-Baselines3 for a plan.
# --------------------------------------------------------------------------------------------------

_OURS = {"self", "policy", "env", "learning_rate", "policy_kwargs", "action_noise"}
_OURS |= {"seed", "device", "tensorboard_log", "_init_setup_model"}
"""Arguments of algorithms that `make_model` sets, or that recipes must not set."""


def algorithm_class(name: str) -> type[BaseAlgorithm]:
    """Class of an algorithm, by its name in `recipes.ALGORITHMS`."""
    if name == "recurrent_ppo":
        from baselines.memory import SequencePPO

        return SequencePPO
    if name == "tqc":
        import sb3_contrib

        return sb3_contrib.TQC
    return {"ppo": PPO, "sac": SAC, "td3": TD3}[name]


def make_model(plan: Plan, env: VecEnv, tensorboard: Path | None = None) -> BaseAlgorithm:
    """Make the untrained model of a plan's recipe.

    Raises a ValueError if a parameter is unknown to the algorithm, or its value is invalid.
    """
    chosen = plan.recipe
    check.choice("algorithm of Stable-Baselines3", chosen.algorithm, ALGORITHMS)
    parameters: dict[str, Any] = {}
    if chosen.parameters.get("critic_only"):
        raise ValueError(
            "critic_only must be 0 with Stable-Baselines3, where actor and critic share inputs, "
            f'got {chosen.parameters["critic_only"]}: it needs engine="compiled"'
        )
    if chosen.algorithm == "td3":  # whose policy is deterministic
        mean = np.zeros(env.action_space.shape or ())
        noise = NormalActionNoise(mean, np.full_like(mean, chosen.action_noise))
        parameters = {"action_noise": noise}
    parameters |= _checked_parameters(chosen)
    first, last = chosen.learning_rate
    activations = {"relu": torch.nn.ReLU, "tanh": torch.nn.Tanh, "elu": torch.nn.ELU}
    policy = {
        "net_arch": {
            "pi": list(chosen.layers),
            "vf" if "ppo" in chosen.algorithm else "qf": list(chosen.critic_layers),
        },
        "activation_fn": activations[chosen.activation],
        **chosen.policy,
    }
    kind = "MultiInput" if isinstance(env.observation_space, gymnasium.spaces.Dict) else "Mlp"
    kind += "LstmPolicy" if chosen.algorithm == "recurrent_ppo" else "Policy"
    try:
        model = algorithm_class(chosen.algorithm)(
            kind,
            env,
            learning_rate=Linear(first, last),
            policy_kwargs=policy,
            seed=plan.seed,
            device="cpu",
            tensorboard_log=None if tensorboard is None else str(tensorboard),
            **parameters,
        )
    except (TypeError, AssertionError) as error:
        raise ValueError(f"recipe does not fit {chosen.algorithm}: {error}") from None
    # the algorithm has seeded the flights with its own seed, which are seeds of tests
    env.seed(first_seed("training", plan.seed, chosen.n_envs))
    return model


def _checked_parameters(chosen: Recipe) -> dict[str, Any]:
    """Check the parameters of a recipe against the types of the algorithm's defaults.

    Stable-Baselines3 checks few of them and would fail during training.
    """
    kind = algorithm_class(chosen.algorithm)
    known = {k: v for k, v in inspect.signature(kind).parameters.items() if k not in _OURS}
    check.keywords(chosen.parameters, tuple(known), kind.__name__)
    found = dict(chosen.parameters)
    for name, value in found.items():
        default = known[name].default
        if callable(value) or isinstance(value, tuple):  # a schedule; a frequency of training
            continue
        if isinstance(default, bool):
            check.flag(name, value)
        elif name in ("n_steps", "batch_size", "n_epochs", "buffer_size"):
            found[name] = check.whole(name, value)
        elif isinstance(default, int):
            found[name] = check.whole(name, value, least=-1)  # of gradient_steps: as many as steps
        elif isinstance(default, float):
            share = name in ("gamma", "gae_lambda", "tau")
            check.number(name, value, least=0.0 if share else -math.inf)
            if share and value > 1.0:
                raise ValueError(f"{name} must be at most 1, got {value!r}")
    return found


# --------------------------------------------------------------------------------------------------
# Checkpoints of models of Stable-Baselines3, from which a run resumes exactly.
# --------------------------------------------------------------------------------------------------

LAST = "last.zip"


class Keeper(RunKeeper, BaseCallback):
    """`RunKeeper` for Stable-Baselines3, as a callback."""

    def _on_training_start(self) -> None:
        self.begin(self.num_timesteps)

    def _on_rollout_start(self) -> None:
        """Evaluate and save between two rollouts, after the update by the last one."""
        self.watch(self.model, self.model.num_timesteps)

    def _on_step(self) -> bool:
        return not self.stopping

    def _training_return(self, model: BaseAlgorithm) -> float:
        records = model.ep_info_buffer or []
        return float(np.mean([r["r"] for r in records])) if records else float("nan")

    def _save(self, model: Any, *, best: bool) -> None:
        for name, value in self.rows[-1].items():
            model.logger.record(f"evaluation/{name}", value)
        if best:
            replace_file(best_file(self._plan, self._folder), _model_bytes(model))
        save_model(self._folder, model, self)


def _model_bytes(model: BaseAlgorithm) -> bytes:
    buffer = io.BytesIO()
    model.save(buffer)
    return buffer.getvalue()


def save_model(folder: Path, model: BaseAlgorithm, keeper: Keeper) -> None:
    """Write `last.zip`: the model, and the states of the flights and random number generators."""
    env = model.get_env()
    assert env is not None
    state = {
        "flights": env.unwrapped.flights.batch.snapshot(),  # type: ignore[attr-defined]
        "torch": torch.get_rng_state(),
        "numpy": np.random.get_state(),  # noqa: NPY002 - Stable-Baselines3 shuffles with it
        "actions": model.action_space.np_random.bit_generator.state,
        "keeper": keeper.state(),
        "replay": None,
    }
    if isinstance(model, OffPolicyAlgorithm):
        replay = folder / f"replay_{model.num_timesteps}.pickle"
        part = replay.with_name(replay.name + ".part")
        model.save_replay_buffer(part)
        part.replace(replay)
        state["replay"] = replay.name
    buffer = io.BytesIO(_model_bytes(model))
    with zipfile.ZipFile(buffer, "a") as archive:
        archive.writestr(STATE, pickle.dumps(state))
    replace_file(folder / LAST, buffer.getvalue())
    for old in folder.glob("replay_*.pickle"):
        if old.name != state["replay"]:
            old.unlink()


def load_model(folder: Path, model: BaseAlgorithm, env: VecEnv, keeper: Keeper) -> BaseAlgorithm:
    """Load the model of `last.zip` into an untrained one, and restore flights, keeper and draws."""
    with reading_checkpoint(folder):
        with zipfile.ZipFile(folder / LAST) as archive:
            state = pickle.loads(archive.read(STATE))
        found = type(model).load(
            folder / LAST,
            env=env,
            device="cpu",
            force_reset=False,
            custom_objects={"tensorboard_log": model.tensorboard_log},
        )
        if state["replay"]:
            found.load_replay_buffer(folder / state["replay"])  # type: ignore[attr-defined]
        env.reset()
        env.unwrapped.flights.batch.restore(state["flights"])  # type: ignore[attr-defined]
        torch.set_rng_state(state["torch"])
        np.random.set_state(state["numpy"])  # noqa: NPY002
        found.action_space.np_random.bit_generator.state = state["actions"]
        keeper.restore(state["keeper"], found.num_timesteps)
    return found


def run(
    plan: Plan,
    folder: Path,
    judge: gymnasium.vector.VectorEnv[Any, Any, Any],
    *,
    tensorboard: bool,
    quiet: bool,
) -> Keeper:
    """Train with Stable-Baselines3, or resume from the last checkpoint; see `training.train`."""
    torch.set_num_threads(1)  # networks of this size do not benefit from more
    env = make_flights(plan)
    model = make_model(plan, env, folder / "tensorboard" if tensorboard else None)
    keeper = Keeper(plan, folder, judge, quiet=quiet)
    resuming = (folder / LAST).exists()
    if resuming:
        model = load_model(folder, model, env, keeper)
    steps = plan.recipe.steps - model.num_timesteps
    with keeper.running():
        if steps > 0:
            model.learn(steps, callback=keeper, reset_num_timesteps=not resuming, tb_log_name="run")
        keeper.finish(model, model.num_timesteps)
    env.close()
    return keeper

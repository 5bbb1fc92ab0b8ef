"""Recipes: all hyperparameters of each algorithm on each task; plans and seeds of trainings.

A recipe is data. `quad-gym train` and `quad-gym compare` read it, and their options override it.
Policies are always evaluated on the task of the environment's id; `flights` defines differences of
the flights in training, such as a start that is easier to learn from.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import partial
from types import MappingProxyType
from typing import Annotated, Any

import gymnasium

import quad_gym
from quad_gym import IDS
from quad_gym.analysis.reports import as_json
from quad_gym.params import checks as check
from quad_gym.params.checks import Checked
from quad_gym.params.suites import contents_of_suite_files

# --------------------------------------------------------------------------------------------------
# Disjoint blocks of seeds for flights in training, validation and test.
#
# Flight i of an environment seeded with s has the seed s + i, as is Gymnasium's convention.
# Trainings with seeds 0 and 4 would therefore share most of their flights, and an evaluation with
# seed 0 would use flights of the first training. Here each purpose has its own seeds:
#
# | purpose | seeds of its flights |
# |---|---|
# | "test" | `seed + i`, with `seed` as given by the user, below 10^9 |
# | "training" | `10^9 + 10^6 seed + i`, up to 10^6 flights at a time |
# | "validation" | `10^12 + 10^6 seed + i`, up to 10^6 flights at a time |
#
# Flights for "training" are used to fit parameters, including the search of gains; flights for
# "validation" to select the best checkpoint of a training; flights for "test" for reported results.
# --------------------------------------------------------------------------------------------------

PURPOSES = ("training", "validation", "test")  #: purposes of flights

BLOCK = 10**6  #: number of flights in the block of one seed of a training, or of its validation

TEST_END = 10**9  #: upper limit of the seeds of tests

MAX_SEED = 99_999
"""Largest seed of a training, for which the blocks of training and validation do not overlap."""

_FIRST = {"training": TEST_END, "validation": 10**12}


def flight_seeds(purpose: str, seed: int, count: int) -> range:
    """Seeds (count,) of the flights of one training, validation or test.

    `seed` is the one of the training or, for a test, of its first flight. Raises a ValueError if
    the seeds are outside the block of the purpose.
    """
    check.choice("purpose", purpose, PURPOSES)
    testing = purpose == "test"  # from TEST_END on, seeds are for training
    check.whole("count", count, most=TEST_END if testing else BLOCK)
    check.whole("seed", seed, least=0, most=TEST_END - count if testing else MAX_SEED)
    first = seed if testing else _FIRST[purpose] + BLOCK * seed
    return range(first, first + count)


def first_seed(purpose: str, seed: int, count: int = 1) -> int:
    """Seed of the first of `count` flights, to which flight i adds i; see `flight_seeds`."""
    return flight_seeds(purpose, seed, count)[0]


# --------------------------------------------------------------------------------------------------
# Recipes: all hyperparameters of each algorithm on each task.
# --------------------------------------------------------------------------------------------------

ALGORITHMS = ("ppo", "recurrent_ppo", "sac", "td3", "tqc")
"""Algorithms of Stable-Baselines3 and SB3-Contrib that support continuous actions and vector
environments."""

IMITATION = "dagger"
"""Algorithm that imitates another controller (`baselines.compiled_ppo.imitation`)."""

ACTIVATIONS = ("relu", "tanh", "elu")  #: activations between the layers of a policy


_rates = partial(check.vector, length=2, least=0.0, open_end=True)


def _sizes(name: str, sizes: Any) -> tuple[int, ...]:
    if not sizes:
        raise ValueError(f"{name} must be positive whole numbers, got {sizes}")
    return tuple(check.whole(name, size) for size in sizes)


def _read_only(name: str, values: Any) -> Mapping[str, Any]:
    return MappingProxyType(dict(check.instance(name, values, Mapping)))


ReadOnly = Annotated[Mapping[str, Any], _read_only]
"""A mapping that is copied, and cannot be changed."""


class Recipe(Checked):
    """Hyperparameters of a training."""

    algorithm: Annotated[str, partial(check.choice, choices=(*ALGORITHMS, IMITATION))] = "ppo"
    """Algorithm, one of `ALGORITHMS`, or `IMITATION`"""
    steps: Annotated[int, check.whole] = 1_800_000
    """Environment steps, summed over all flights"""
    n_envs: Annotated[int, check.whole] = 256
    """Number of parallel flights"""
    learning_rate: Annotated[tuple[float, float], _rates] = (1e-3, 1e-4)
    """Learning rate at the beginning and at the end, with linear decay between"""
    layers: Annotated[tuple[int, ...], _sizes] = (64, 64)
    """Number of units in each hidden layer of the policy"""
    critic_layers: Annotated[tuple[int, ...], _sizes] = (64, 64)
    """Number of units in each hidden layer of the value function, or of each critic"""
    activation: Annotated[str, partial(check.choice, choices=ACTIVATIONS)] = "relu"
    """Activation of hidden layers, one of `ACTIVATIONS`"""
    reward_scale: check.Positive = 0.2
    """Factor on the rewards that the algorithm receives; a perfect circle then returns 160"""
    action_noise: check.Positive = 0.1
    """Standard deviation of the exploration noise on actions of TD3, and in imitation; the policies
    of the other algorithms are stochastic themselves"""
    flights: ReadOnly = field(default_factory=lambda: {"start": "mixed"})
    """Keywords of the environment for training only, unless they are given explicitly"""
    parameters: ReadOnly = field(default_factory=dict)
    """Further arguments of the algorithm's class"""
    policy: ReadOnly = field(default_factory=dict)
    """Further arguments of the policy's class"""

    def __reduce__(self) -> Any:
        """Support pickling, which read-only mappings do not."""
        return unfreeze(self)


def unfreeze(recipe: Any) -> tuple[Any, ...]:
    """Reduce a dataclass with read-only mappings, for pickle."""
    values = {f.name: getattr(recipe, f.name) for f in fields(recipe)}
    plain = {k: dict(v) if isinstance(v, Mapping) else v for k, v in values.items()}
    kind: Any = type(recipe)
    return partial(kind, **plain), ()


_PPO = Recipe(
    algorithm="ppo",
    parameters={
        "n_steps": 32,
        "batch_size": 1024,
        "n_epochs": 5,
        "gamma": 0.97,
        "gae_lambda": 0.95,
        "clip_range": 0.2,
        "ent_coef": 0.0,
    },
    policy={"log_std_init": -1.0},
    flights={"start": "mixed", "randomize_reference": True},
)
"""Result of a search over learning rates, reward scales, activations and batch sizes on Circle."""

_OFF_POLICY = {
    "batch_size": 1024,
    "buffer_size": 500_000,
    "learning_starts": 5_000,
    "train_freq": 1,
    "gradient_steps": 4,
    "gamma": 0.95,
    "tau": 0.01,
}
_SAC = Recipe(
    algorithm="sac",
    # flights cost next to nothing compared with gradient steps: many, each sample used 16 times
    n_envs=256,
    learning_rate=(1e-3, 1e-5),
    critic_layers=(128, 128),
    flights={"start": "mixed", "randomize_reference": True},
    # the reward of a step is about 0.3: an initial entropy coefficient of 1 would dominate it for
    # long, and the usual target entropy would mask the reward for the last centimeters
    parameters={**_OFF_POLICY, "ent_coef": "auto_0.02", "target_entropy": -8.0},
)

_DEFAULTS = {
    "ppo": _PPO,
    "sac": _SAC,
    "td3": _SAC.replace(algorithm="td3", parameters={**_OFF_POLICY, "policy_delay": 2}),
    "tqc": _SAC.replace(algorithm="tqc"),
    # found on OutageDash; each step is in 14 minibatches on average
    IMITATION: Recipe(
        algorithm=IMITATION,
        steps=300_000,
        n_envs=250,
        learning_rate=(1e-3, 1e-5),
        action_noise=0.25,
        flights={},
    ),
}
"""Default recipe of each algorithm; those of the other algorithms were found on Circle."""


def _changed(base: Recipe, parameters: Mapping[str, Any], **fields: Any) -> Recipe:
    """Recipe with other fields, and other values of some parameters."""
    found: Recipe = base.replace(parameters={**base.parameters, **parameters}, **fields)
    return found


_SPECIAL: dict[tuple[str, str], Recipe] = {
    # gates are seconds apart: with a shorter horizon, policies fly past them and out of bounds
    ("QuadGym/Waypoints-v0", "ppo"): _changed(_PPO, {"gamma": 0.99}, steps=3_000_000),
    ("QuadGym/StaleRace-v0", "ppo"): _changed(
        _PPO, {"gamma": 0.99}, steps=4_000_000, reward_scale=1.0
    ),
    # closer bounds than the task's: a flight that has lost its position teaches little
    ("QuadGym/LookAround-v0", "ppo"): _changed(
        _PPO, {"gamma": 0.99}, steps=8_000_000, flights={"out_of_bounds": 3.0}
    ),
    # During an outage, halving the speed prevents few crashes, and waiting for its end prevents
    # most: a policy has to discover pauses of seconds. Exploration noise drawn ten times a second
    # averages out, so training holds each action for 0.25 s. Rewards after 7 s of waiting are
    # discounted by 0.996^28 = 0.89.
    ("QuadGym/OutageDash-v0", "ppo"): _changed(
        _PPO,
        {"n_epochs": 10, "gamma": 0.996, "gae_lambda": 0.96, "batch_size": 2048},
        steps=1_200_000,
        reward_scale=0.02,
        flights={"control_rate": 4.0},
    ),
}
"""Recipes for tasks that need other hyperparameters, by id and algorithm."""


def recipe(env_id: str, algorithm: str = "ppo") -> Recipe:
    """Included recipe for a task, by its id, and one of `ALGORITHMS`, or `IMITATION`.

    Recurrent PPO has the recipe of PPO, and an LSTM of 64 units.
    """
    check.choice("env_id", env_id, tuple(IDS))
    check.choice("algorithm", algorithm, (*ALGORITHMS, IMITATION))
    if algorithm == "recurrent_ppo":
        base = recipe(env_id)
        memory = {**base.policy, "lstm_hidden_size": 64}
        return base.replace(algorithm=algorithm, policy=memory)
    return _SPECIAL.get((env_id, algorithm), _DEFAULTS[algorithm])


# --------------------------------------------------------------------------------------------------
# Plans of trainings, and the environments that they define.
# --------------------------------------------------------------------------------------------------

ENGINES = ("sb3", "compiled")  #: training engines: Stable-Baselines3, or `baselines.compiled_ppo`


class Plan(Checked):
    """Plan of a training and its evaluations."""

    env_id: Annotated[str, partial(check.choice, choices=tuple(quad_gym.IDS))] = "QuadGym/Circle-v0"
    """Id of the environment, from `quad_gym.IDS`"""
    environment: ReadOnly = field(default_factory=dict)
    """Keywords of the environment in training and evaluation; they override the recipe's"""
    learning: ReadOnly = field(default_factory=dict)
    """Keywords of the environment in training only; they override all others"""
    recipe: Recipe = field(default_factory=lambda: recipe("QuadGym/Circle-v0"))
    seed: Annotated[int, partial(check.whole, least=0, most=MAX_SEED)] = 0
    """Seed of the networks; it also determines the blocks of seeds of the flights in training and
    validation, see `baselines.recipes`"""
    threads: int | None = None
    """Number of threads of the flights; None: one per core. It does not affect results"""
    engine: Annotated[str, partial(check.choice, choices=ENGINES)] = "sb3"
    """Training engine, one of `ENGINES`"""
    evaluations: Annotated[int, check.whole] = 20
    """Number of evaluations, each with a checkpoint, during the training"""
    episodes: Annotated[int, check.whole] = 100
    """Number of episodes in each evaluation"""

    def __reduce__(self) -> Any:
        """Support pickling, to send plans to other processes."""
        return unfreeze(self)

    @property
    def training_keywords(self) -> dict[str, Any]:
        """Keywords of the environment in training."""
        return {**self.recipe.flights, **self.environment, **self.learning}

    def make_vector_flights(self) -> gymnasium.vector.VectorEnv[Any, Any, Any]:
        """Make the environment to train in with the compiled engine; it is not seeded."""
        return gymnasium.make_vec(
            self.env_id,
            num_envs=self.recipe.n_envs,
            threads=self.threads,
            autoreset_mode="SameStep",
            **self.training_keywords,
        )

    def make_judge(self) -> gymnasium.vector.VectorEnv[Any, Any, Any]:
        """Make the environment for evaluations, defined by the id and the keywords."""
        return gymnasium.make_vec(
            self.env_id, num_envs=self.episodes, threads=self.threads, **self.environment
        )


@dataclass(frozen=True)
class Linear:
    """Schedule that changes linearly from a first to a last value during training."""

    first: float
    last: float

    def __call__(self, remaining: float) -> float:
        """Return the value when a share `remaining` of the training remains.

        A training ends with a whole rollout, where the share is below zero, and far below if the
        rollout is longer than the training: the value stays above half of the smaller one.
        """
        value = self.last + (self.first - self.last) * remaining
        return max(value, 0.5 * min(self.first, self.last))


def description(plan: Plan) -> dict[str, Any]:
    """Convert a plan to JSON types."""
    found: dict[str, Any] = as_json(plan)
    del found["threads"]  # does not affect results
    if not plan.learning:
        del found["learning"]
    given = (plan.environment.get("sensors"), plan.learning.get("sensors"))
    found |= as_json(contents_of_suite_files(*given))
    found["first_flights"] = {
        "training": first_seed("training", plan.seed, plan.recipe.n_envs),
        "validation": first_seed("validation", plan.seed, plan.episodes),
    }
    return found

"""`Networks`, and `NetworkTraining`: the common part of their trainings."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any, Self

import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from tqdm.auto import tqdm

from baselines.compiled_ppo import kernels
from baselines.compiled_ppo.kernels import INPUTS, OUTPUTS, STORED, TILE
from baselines.mlp import MlpPolicy
from baselines.policies import interface_of
from baselines.recipes import ACTIVATIONS, Linear, Recipe
from quad_gym.envs.vector import QuadVectorEnv

# --------------------------------------------------------------------------------------------------
# Actor and critic as multilayer perceptrons in one vector of parameters.
# --------------------------------------------------------------------------------------------------

Floats = NDArray[np.float32]
Table = NDArray[np.int64]


class Networks:
    """Gaussian policy and value function of a recipe, for observations and actions of some lengths.

    `critic_only` inputs, at the end of an observation, are for the critic only. The vector of
    parameters contains the logarithms of the policy's standard deviations directly after the
    actor's layers. Initial values of layers are drawn as in Stable-Baselines3.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        recipe: Recipe,
        rng: np.random.Generator,
        critic_only: int = 0,
    ) -> None:
        self.actor, first = _table_of((inputs - critic_only, *recipe.layers, outputs), 0)
        self.critic, count = _table_of((inputs, *recipe.critic_layers, 1), first + outputs)
        self._activation, self.params = recipe.activation, np.zeros(count, np.float32)
        self.net = (self.params, np.zeros_like(self.params), ACTIVATIONS.index(recipe.activation))
        self.model = (self.net, self.actor, self.critic)
        self.log_std = self.params[first : first + outputs]
        self.log_std[:] = recipe.policy.get("log_std_init", 0.0)
        for table, last_gain in ((self.actor, 0.01), (self.critic, 1.0)):
            for W, _ in self.layers(table)[:-1]:
                W[:] = np.sqrt(2.0) * orthogonal(W.shape, rng)
            W, _ = self.layers(table)[-1]
            W[:] = last_gain * orthogonal(W.shape, rng)
        self._room = tuple(room[0] for room in self.rooms(1)[:2])

    def layers(self, table: Table, vector: Floats | None = None) -> list[tuple[Any, Any]]:
        """Weights (outputs, inputs) and biases (outputs,) of each layer, as views.

        They are views of the parameters, or of a vector like these, such as a gradient.
        """
        vector = self.params if vector is None else vector
        return [
            (vector[w : w + i * o].reshape(o, i), vector[b : b + o])
            for i, o, w, b, _ in table.tolist()
        ]

    def flip(self) -> None:
        """Update the flipped weights from the parameters."""
        for table in (self.actor, self.critic):
            kernels.flip(self.net, table)

    def rooms(self, parts: int) -> tuple[Floats, ...]:
        """Work memory of `kernels.differentiate`: inputs, outputs, deltas, and a matrix product."""
        tables = (self.actor, self.critic)
        sizes = (
            (2, TILE, int(self.critic[0, INPUTS])),
            (TILE * max(int(t[-1, STORED] + t[-1, OUTPUTS]) for t in tables),),
            (2, TILE * max(int(t[:, OUTPUTS].max()) for t in tables)),
            (max(int((t[:, INPUTS] * t[:, OUTPUTS]).max()) for t in tables),),
        )
        return tuple(np.zeros((parts, *size), np.float32) for size in sizes)

    def evaluate(self, x: Floats) -> tuple[Floats, Floats]:
        """Means of actions (n, a) and values (n,) for observations x (n, o)."""
        means = np.empty((len(x), len(self.log_std)), np.float32)
        values = np.empty(len(x), np.float32)
        kernels.evaluate(x, self.model, *self._room, means, values)
        return means, values

    def policy(self, record: Mapping[str, Any]) -> MlpPolicy:
        """Copy the actor to a policy that requires only NumPy."""
        layers = self.layers(self.actor)
        activations = [self._activation] * (len(layers) - 1) + ["none"]
        return MlpPolicy(
            [W.copy() for W, _ in layers], [b.copy() for _, b in layers], activations, record
        )


def _table_of(sizes: Sequence[int], first: int) -> tuple[Table, int]:
    """Table of a network whose parameters begin at `first`, and the end of its parameters."""
    rows, stored = [], 0
    for inputs, outputs in pairwise(sizes):
        rows.append((inputs, outputs, first, first + inputs * outputs, stored))
        first += (inputs + 1) * outputs
        stored += outputs
    return np.array(rows, np.int64), first


def orthogonal(shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[Any]:
    """Draw a matrix with orthonormal rows or columns, whichever are fewer (Saxe et al. 2014)."""
    Q, R = np.linalg.qr(rng.standard_normal((max(shape), min(shape))))
    Q *= np.sign(np.diag(R))
    return Q if shape[0] >= shape[1] else Q.T


# --------------------------------------------------------------------------------------------------
# Training of networks.
# --------------------------------------------------------------------------------------------------

_EPISODES = 100  #: number of latest episodes whose mean return is `training_return`

STATE = ("num_timesteps", "losses", "_rng", "_seen", "_returns", "_finished")
"""Attributes of the state of every training, in addition to networks and environment."""


class NetworkTraining(ABC):
    """Training of networks in the flights of a vector environment, in rounds.

    In a round, all flights continue for some steps, and then the networks are fitted to what they
    have shown.

    Args:
        env: Vector environment with vectors as observations, vectors in [-1, 1] as actions, and
            same-step autoreset (`autoreset_mode="SameStep"`).
        recipe: All hyperparameters.
        parameters: The parameters of the recipe, checked and with defaults.
        seed: Seed of all random numbers of the training.
        env_seed: Seed of the environment; None: `seed`.
    """

    _observed: Any = slice(None)
    """Index of the values in an observation that the actor observes"""

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        recipe: Recipe,
        parameters: dict[str, Any],
        seed: int,
        env_seed: int | None,
    ) -> None:
        self.env, self.recipe, self.parameters = env, recipe, parameters
        self.num_timesteps = 0
        self.networks: Networks  # which the subclass makes, from the random numbers
        self.losses: dict[str, float] = {}
        self._env_seed = seed if env_seed is None else env_seed
        self._rng = np.random.default_rng(seed)
        self._seen: NDArray[np.float32] | None = None
        self._returns, self._finished = np.zeros(env.num_envs), deque[float](maxlen=_EPISODES)

    # ---- specific to the algorithm --------------------------------------------------------------

    @abstractmethod
    def _compile(self, seen: NDArray[np.float32]) -> None:
        """Compile all kernels, with the observations (n, o) of all flights."""

    @abstractmethod
    def _round(self, steps: int) -> None:
        """Complete a round of a training of so many steps: fly, then fit, and set `losses`."""

    @abstractmethod
    def _progress(self) -> str:
        """Text for the progress bar."""

    # ---- the training ---------------------------------------------------------------------------

    def learn(
        self, steps: int, watch: Callable[[Self], bool] | None = None, *, quiet: bool = False
    ) -> None:
        """Train until a total number of environment steps, summed over all flights, is reached.

        The last round is completed. `watch` is called between rounds; the training stops if it
        returns False. `quiet` hides the progress bar.
        """
        self.prepare()
        begun = min(self.num_timesteps, steps)
        look: dict[str, Any] = {"unit": " steps", "unit_scale": True, "disable": quiet}
        with tqdm(total=steps, initial=begun, **look) as bar:
            while self.num_timesteps < steps and (watch is None or watch(self)):
                self._round(steps)
                bar.set_postfix_str(self._progress(), refresh=False)
                bar.update(min(self.num_timesteps, steps) - bar.n)

    def prepare(self) -> None:
        """Begin the first episodes, and compile all kernels."""
        if self._seen is None:
            self._seen = as_floats(self.env.reset(seed=self._env_seed)[0])
        self._compile(self._seen)

    def _rate(self, remaining: float) -> float:
        """Learning rate when a share `remaining` of the training remains."""
        return Linear(*self.recipe.learning_rate)(remaining)

    def _step(self, actions: NDArray[np.float32]) -> tuple[Any, Any, Any, Any]:
        """Step all flights: reward, terminated, truncated and info; counts steps and returns."""
        seen, reward, terminated, truncated, info = self.env.step(actions)
        self._seen, ended = as_floats(seen), terminated | truncated
        self._returns += reward
        self._finished += self._returns[ended].tolist()
        self._returns[ended] = 0.0
        self.num_timesteps += len(ended)
        return reward, terminated, truncated, info

    @property
    def training_return(self) -> float:
        """Mean return of the latest episodes, not scaled; NaN before the first."""
        return float(np.mean(self._finished)) if self._finished else float("nan")

    # ---- the policy -----------------------------------------------------------------------------

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], None]:
        """Return deterministic actions for observations (..., n) of the actor, or the whole ones.

        Whole observations (..., m) are those of the environment of the training.
        """
        policy, x = self.networks.policy({}), np.asarray(observation, np.float32)
        whole = self.env.single_observation_space.shape
        if x.shape[-1:] == whole != (policy.inputs,):
            x = x[..., self._observed]
        return policy.predict(x, state, episode_start)

    def policy(self, record: dict[str, Any] | None = None) -> MlpPolicy:
        """Copy the present policy to one that requires only NumPy.

        Its record defaults to the observations, actions and control rate of the training, so that
        `load_policy` refuses environments with others.
        """
        return self.networks.policy(self._record() if record is None else record)

    def _record(self) -> dict[str, Any]:
        """Record of a policy with the observations, actions and control rate of its training."""
        ours = isinstance(self.env.unwrapped, QuadVectorEnv)
        return {"interface": interface_of(self.env) if ours else {}}

    # ---- checkpoints ----------------------------------------------------------------------------

    @abstractmethod
    def state(self) -> bytes:
        """Serialize the state of the training and the environment, to resume exactly."""

    @abstractmethod
    def restore(self, state: bytes) -> None:
        """Restore a `state` with the same recipe; unpickling can run code, so trust its source.

        Raises:
            ValueError: If the state is from another configuration or version.
        """


def as_floats(observations: Any) -> NDArray[np.float32]:
    """Convert observations or actions to contiguous float32."""
    return np.ascontiguousarray(observations, np.float32)


def sizes_of(env: VectorEnv[Any, Any, Any]) -> tuple[int, int]:
    """Check the spaces and the autoreset mode; return lengths of observation and action."""
    sizes = []
    for name, space in (
        ("observations", env.single_observation_space),
        ("actions", env.single_action_space),
    ):
        if not isinstance(space, Box) or len(space.shape) != 1:
            raise ValueError(f"env must have vectors as {name} for compiled PPO, got {space}")
        sizes.append(space.shape[0])
    if space != Box(-1.0, 1.0, space.shape, space.dtype):  # type: ignore[arg-type]
        raise ValueError(f"env must have actions in [-1, 1] (see RescaleAction), got {space}")
    mode = env.metadata.get("autoreset_mode")
    if mode is None or AutoresetMode(mode) != AutoresetMode.SAME_STEP:
        raise ValueError(f"env must have the autoreset mode SameStep, got {mode}")
    return sizes[0], sizes[1]

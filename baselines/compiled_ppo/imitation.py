"""Imitation: a network learns the actions of another controller from its own observation.

It shows whether an observation suffices for a way to fly, independently of whether an algorithm
finds this way by its rewards. The method is DAgger (S. Ross, G. Gordon, D. Bagnell, AISTATS 2011):
the network flies, its teacher says what it would do in the states that are reached, and the network
is fitted to all answers so far.
"""

import importlib
import pickle
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from baselines.compiled_ppo.training import STATE, Networks, NetworkTraining, as_floats, sizes_of
from baselines.mlp import FUNCTIONS
from baselines.policies import NAMES, load_policy
from baselines.recipes import IMITATION, Recipe
from quad_gym.evaluation import Policy
from quad_gym.params import checks as check

PARAMETERS = {"teacher": "pd", "n_steps": 60, "batch_size": 1024, "n_batches": 200}
"""Parameters of a recipe, and their defaults: name of the teacher (`teacher_of`), steps of each
flight in a round, size of a minibatch, and number of minibatches after each round."""

BETAS, EPSILON = (0.9, 0.999), 1e-8  #: parameters of Adam

_SLOPES: dict[str, Any] = {
    "relu": lambda y: y > 0.0,
    "tanh": lambda y: 1.0 - y * y,
    "elu": lambda y: np.where(y > 0.0, 1.0, y + 1.0),
}
"""Derivatives of activations, as functions of their results."""


class Imitation(NetworkTraining):
    """Training of a network by a teacher that knows what to do in every state (DAgger).

    In each round all flights continue for some steps. At first the teacher flies all of them; the
    share of those that it flies falls to zero until half of the steps are done, and the network
    flies the others. Noise is added to the actions of every second flight, so that the teacher also
    answers in states that it would avoid itself. After a round, the network is fitted to all
    answers so far: the mean squared error of actions is reduced in minibatches, by Adam.

    The same seed gives the same policy, bitwise on the same machine.

    Args:
        env: Vector environment with vectors as observations, vectors in [-1, 1] as actions, and
            same-step autoreset (`autoreset_mode="SameStep"`).
        recipe: All hyperparameters. `action_noise` is the standard deviation of the noise.
        teacher: Controller of `env`; None: the one named in the recipe's parameters.
        columns: Indices of the values in an observation that the network observes; None: all. The
            teacher observes all.
        seed: Seed of the network, the noise and the minibatches.
        env_seed: Seed of the environment; None: `seed`.

    Raises:
        ValueError: If the environment does not fit, or the recipe is not supported.
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        recipe: Recipe,
        *,
        teacher: Policy | None = None,
        columns: Sequence[int] | None = None,
        seed: int = 0,
        env_seed: int | None = None,
    ) -> None:
        inputs, outputs = sizes_of(env)
        super().__init__(env, recipe, _checked(recipe), seed, env_seed)
        self._teacher = teacher or teacher_of(self.parameters["teacher"], env)
        self._observed = _checked_columns(range(inputs) if columns is None else columns, inputs)
        count = len(self._observed)
        self._sees_all = count == inputs
        self.networks = Networks(count, outputs, recipe, self._rng)
        size = self.networks.params.size
        self._gradient, self._moments = np.zeros(size, np.float32), np.zeros((2, size), np.float32)
        self._descents = 0
        self._observations = np.zeros((0, count), np.float32)
        self._answers = np.zeros((0, outputs), np.float32)
        self._memory: Any = None
        self._starts = np.ones(env.num_envs, bool)

    def _round(self, steps: int) -> None:
        self._roll_out(max(0.0, 1.0 - 2.0 * self.num_timesteps / steps))
        self._fit(self._rate(max(0.0, 1.0 - self.num_timesteps / steps)))

    def _progress(self) -> str:
        return f"error {self.losses['squared_error']:.4f}"

    def _compile(self, seen: NDArray[np.float32]) -> None:
        self.networks.flip()
        self.networks.evaluate(seen[:1, self._observed])

    def _record(self) -> dict[str, Any]:
        """Record of the training, if the network observes everything; otherwise none."""
        return super()._record() if self._sees_all else {}

    def state(self) -> bytes:
        """Serialize the state of the training and an environment of quad_gym, to resume exactly."""
        kept = {name: getattr(self, name) for name in _STATE}
        flights: Any = self.env
        return pickle.dumps((kept, self.networks.params, flights.flights.batch.snapshot()))

    def restore(self, state: bytes) -> None:
        """Restore a `state` with the same recipe; unpickling can run code, so trust its source.

        Raises:
            ValueError: If the state is from another configuration or version.
        """
        kept, params, flown = pickle.loads(state)
        flights: Any = self.env
        flights.reset(seed=self._env_seed)
        flights.flights.batch.restore(flown)
        self.networks.params[:] = params
        self.__dict__.update({name: kept[name] for name in _STATE})

    # ---- a round --------------------------------------------------------------------------------

    def _roll_out(self, share: float) -> None:
        """Fly `n_steps` steps, a share of the flights by the teacher, and keep its answers."""
        assert self._seen is not None
        count = self.env.num_envs
        taught = (self._rng.random(count) < share)[:, np.newaxis]
        spread = np.float32(self.recipe.action_noise) * (np.arange(count) % 2)[:, np.newaxis]
        observations, answers = [self._observations], [self._answers]
        for _ in range(self.parameters["n_steps"]):
            wanted, self._memory = self._teacher.predict(
                self._seen, state=self._memory, episode_start=self._starts, deterministic=True
            )
            x = np.ascontiguousarray(self._seen[:, self._observed])
            observations.append(x)
            answers.append(as_floats(wanted))
            action = np.where(taught, wanted, self.networks.evaluate(x)[0])
            action = action + spread * self._rng.standard_normal(action.shape, np.float32)
            _, terminated, truncated, _ = self._step(action.clip(-1.0, 1.0).astype(np.float32))
            self._starts = terminated | truncated
        self._observations = np.concatenate(observations)
        self._answers = np.concatenate(answers)

    def _fit(self, rate: float) -> None:
        """Fit the network to minibatches of all answers so far."""
        size, number = self.parameters["batch_size"], self.parameters["n_batches"]
        error = 0.0
        for _ in range(number):
            drawn = self._rng.integers(len(self._answers), size=size)
            error += self._differentiate(self._observations[drawn], self._answers[drawn])
            self._descend(rate)
        self.networks.flip()
        self.losses = {"squared_error": error / number}

    def _differentiate(self, x: Any, wanted: Any) -> float:
        """Compute the gradient of the mean squared error of actions; returns this error."""
        layers = self.networks.layers(self.networks.actor)
        own = self.networks.layers(self.networks.actor, self._gradient)
        activate, slope = FUNCTIONS[self.recipe.activation], _SLOPES[self.recipe.activation]
        below = [x]
        for W, b in layers[:-1]:
            below.append(activate(below[-1] @ W.T + b))
        W, b = layers[-1]
        error = below[-1] @ W.T + b - wanted
        delta = np.float32(2.0 / error.size) * error
        for (W, _), (dW, db), y in zip(layers[::-1], own[::-1], below[::-1], strict=True):
            dW[:], db[:] = delta.T @ y, delta.sum(axis=0)
            delta = (delta @ W) * slope(y)
        return float((error * error).mean())

    def _descend(self, rate: float) -> None:
        """Take a step of Adam along the gradient."""
        self._descents += 1
        mean, square = self._moments
        for moment, beta, latest in zip(
            self._moments, BETAS, (self._gradient, self._gradient**2), strict=True
        ):
            moment += np.float32(1.0 - beta) * (latest - moment)
        first, second = (1.0 - beta**self._descents for beta in BETAS)
        spread = np.sqrt(square / np.float32(second)) + np.float32(EPSILON)
        self.networks.params -= np.float32(rate / first) * mean / spread


_STATE = (*STATE, "_moments", "_descents", "_observations", "_answers", "_memory", "_starts")
"""Attributes of the state of a training, in addition to the network and the environment."""


def teacher_of(name: str, env: Any) -> Policy:
    """Make the teacher of a name for an environment.

    Args:
        name: Name or file of a policy (`baselines.policies.load_policy`), or "module:Class" of a
            controller that is made with the environment as its argument.
        env: Environment that the teacher observes.

    Raises:
        ValueError: If there is no such controller, or it does not fit the environment.
    """
    module, _, attribute = name.partition(":")
    if name in NAMES or not attribute.isidentifier():
        return load_policy(name, env)
    try:
        kind = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ValueError(
            f'teacher must be a policy or "module:Class", got {name!r}: {error}'
        ) from None
    made: Policy = kind(env)
    return made


def columns_of(names: Sequence[str], env: Any) -> list[int]:
    """Indices of the parts with these names in an observation of an environment, in their order.

    Raises a ValueError if a part is missing.
    """
    where = {field.name: field.slice for field in env.unwrapped.flights.table}
    missing = [name for name in names if name not in where]
    if missing:
        raise ValueError(
            f"the environment of the training must observe {missing[0]}, as the policy does"
        )
    return [k for name in names for k in range(where[name].start, where[name].stop)]


def _checked(recipe: Recipe) -> dict[str, Any]:
    """Check a recipe; return its parameters with defaults."""
    check.choice("algorithm of imitation", recipe.algorithm, (IMITATION,))
    check.keywords(recipe.parameters, tuple(PARAMETERS), "imitation")
    check.keywords(recipe.policy, (), "the policy of imitation")
    found: dict[str, Any] = {**PARAMETERS, **recipe.parameters}
    check.instance("teacher", found["teacher"], str)
    for name in ("n_steps", "batch_size", "n_batches"):
        found[name] = check.whole(name, found[name])
    return found


def _checked_columns(columns: Sequence[int], inputs: int) -> NDArray[np.int64]:
    found = np.asarray(columns)
    sound = found.ndim == 1 and found.size > 0 and np.issubdtype(found.dtype, np.integer)
    if not (sound and found.min() >= 0 and found.max() < inputs):
        raise ValueError(f"columns must be indices of {inputs} observed values, got {columns}")
    return found

"""`CompiledPPO`: proximal policy optimization without torch, for vector environments."""

import pickle
from typing import Any

import numpy as np
from gymnasium.vector import VectorEnv
from numpy.typing import NDArray

from baselines.compiled_ppo import kernels
from baselines.compiled_ppo.training import STATE, Networks, NetworkTraining, as_floats, sizes_of
from baselines.recipes import Recipe
from quad_gym.batch.threads import (
    MIN_BLOCKS_PER_THREAD,
    POSTED_BEFORE,
    Crew,
    board_of,
    resolve_threads,
)
from quad_gym.envs.vector import QuadVectorEnv
from quad_gym.params import checks as check

# --------------------------------------------------------------------------------------------------
# Update step of PPO: epochs of minibatches, on as many threads as are worthwhile.
# --------------------------------------------------------------------------------------------------

PARTS = 2 * MIN_BLOCKS_PER_THREAD
"""Number of parts of a minibatch, enough for two threads: adding more parts would take longer. They
are added in order, so that the sum does not depend on the number of threads."""

Samples = tuple[NDArray[Any], ...]
"""Observations (n, o), actions (n, a), their log probabilities (n,) in the rollout, returns (n,)
as targets of the critic."""


class Learner:
    """Training on samples with advantages (n,), as in `stable_baselines3.PPO.train`.

    Each `learn` reads samples and advantages again; `parameters` are a recipe's complete ones.
    """

    def __init__(
        self,
        networks: Networks,
        samples: Samples,
        advantages: NDArray[np.float32],
        parameters: dict[str, Any],
        threads: int,
    ) -> None:
        self.networks, self.parameters, self._advantages = networks, parameters, advantages
        self.moments, self.steps = np.zeros((2, networks.params.size), np.float32), 0
        self.span, self.order = np.zeros(2, np.int64), np.arange(len(advantages))
        self.normalized = np.zeros(len(advantages), np.float32)
        self.gradients = np.zeros((PARTS, networks.params.size), np.float32)
        self.sums = np.zeros((PARTS, len(kernels.SUMS)))
        minibatch, rooms = (self.span, self.order, self.normalized), networks.rooms(PARTS)
        recipe = np.array([parameters[name] for name in ("clip_range", "ent_coef", "vf_coef")])
        fixed = (minibatch, networks.model, samples, recipe, rooms, (self.gradients, self.sums))

        def differentiate(
            board: NDArray[np.int64], number: int, command: int, serving: bool
        ) -> bool:
            return bool(kernels.differentiate(board, number, command, serving, *fixed))

        self._differentiate = differentiate
        self._crew = Crew(differentiate, PARTS, threads)

    def prepare(self) -> None:
        """Call every kernel once to compile it, without changing the networks."""
        self.networks.flip()
        self._differentiate(board_of(0, 1), 0, POSTED_BEFORE, False)
        copies = self.networks.params.copy(), self.moments.copy()
        kernels.descend(self.gradients, *copies, 0.0, 1.0, np.ones(2))

    def learn(self, rate: float, rng: np.random.Generator) -> dict[str, float]:
        """Train on all samples for `n_epochs` epochs; returns means of `SUMS` over the last one.

        Raises a FloatingPointError if a gradient is not finite because the training has diverged.
        """
        count, size = len(self.order), self.parameters["batch_size"]
        for _ in range(self.parameters["n_epochs"]):
            sums = np.zeros(len(kernels.SUMS))
            self.order[:] = rng.permutation(count)
            self.normalized[:] = self._advantages[self.order]
            for first in range(0, count, size):
                if self.parameters["normalize_advantage"]:
                    _normalize(self.normalized[first : first + size])
                sums += self.differentiate(first, min(first + size, count))
                self.descend(rate)
        return dict(zip(kernels.SUMS, (sums / count).tolist(), strict=True))

    def differentiate(self, first: int, last: int) -> NDArray[np.float64]:
        """Compute the gradient of a minibatch of this epoch, in parts; returns its `SUMS`."""
        self.span[:] = first, last
        self._crew.gather()
        self._crew.run(0)
        return self.sums.sum(axis=0)

    def descend(self, rate: float) -> None:
        """Take a step along the gradient."""
        self.steps += 1
        norm = kernels.descend(
            self.gradients,
            self.networks.params,
            self.moments,
            rate,
            self.parameters["max_grad_norm"],
            1.0 - np.power(kernels.BETAS, self.steps),
        )
        if not np.isfinite(norm):
            raise FloatingPointError("the training has diverged: a gradient is not finite")
        self.networks.flip()


def _normalize(advantages: NDArray[np.float32]) -> None:
    """Normalize advantages to zero mean and unit variance, in place; a single one is unchanged."""
    if len(advantages) > 1:
        advantages -= advantages.mean()
        advantages /= np.sqrt(advantages @ advantages / (len(advantages) - 1)) + 1e-8


# --------------------------------------------------------------------------------------------------
# `CompiledPPO`: proximal policy optimization without torch, for vector environments.
# --------------------------------------------------------------------------------------------------

PARAMETERS = {
    "n_steps": 2048,
    "batch_size": 64,
    "n_epochs": 10,
    "gamma": 0.99,
    "gae_lambda": 0.95,
    "clip_range": 0.2,
    "normalize_advantage": True,
    "ent_coef": 0.0,
    "vf_coef": 0.5,
    "max_grad_norm": 0.5,
    "critic_only": 0,
}
"""Parameters of a recipe, with the defaults of Stable-Baselines3, which lacks `critic_only`: the
number of values at the end of an observation for the critic only, such as the true state."""


class CompiledPPO(NetworkTraining):
    """PPO (Schulman et al. 2017) as in `stable_baselines3.PPO`, except for the random numbers.

    The same seed gives bitwise the same policy, with any number of threads. With `critic_only`
    among the recipe's parameters, the policy takes observations without this part.

    Args:
        env: Vector environment with vectors as observations, vectors in [-1, 1] as actions, and
            same-step autoreset (`autoreset_mode="SameStep"`).
        recipe: All hyperparameters.
        seed: Seed of the networks, the actions and the order of samples.
        env_seed: Seed of the environment; None: `seed`.
        threads: Number of threads for learning; None: one per core.

    Raises:
        ValueError: If the environment does not fit, or the recipe is not supported.
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        recipe: Recipe,
        *,
        seed: int = 0,
        env_seed: int | None = None,
        threads: int | None = None,
    ) -> None:
        inputs, outputs = sizes_of(env)
        super().__init__(env, recipe, _checked(recipe, inputs), seed, env_seed)
        critic_only = self.parameters["critic_only"]
        self.networks = Networks(inputs, outputs, recipe, self._rng, critic_only)
        self._observed = slice(inputs - critic_only)
        shape = (self.parameters["n_steps"], env.num_envs)
        self._observations = np.zeros((*shape, inputs), np.float32)
        self._actions = np.zeros((*shape, outputs), np.float32)
        self._log_probs, self._rewards, self._values, self._advantages, self._targets = (
            np.zeros(shape, np.float32) for _ in range(5)
        )
        self._ended = np.zeros(shape, bool)
        samples = (self._observations, self._actions, self._log_probs, self._targets)
        self.learner = Learner(
            self.networks,
            tuple(a.reshape(-1, *a.shape[2:]) for a in samples),
            self._advantages.reshape(-1),
            self.parameters,
            resolve_threads(threads),
        )

    def _round(self, steps: int) -> None:
        self._roll_out()
        rate = self._rate(1.0 - self.num_timesteps / steps)
        self.losses = self.learner.learn(rate, self._rng)

    def _progress(self) -> str:
        return f"return {self.training_return:.1f}"

    def _compile(self, seen: NDArray[np.float32]) -> None:
        self.networks.evaluate(seen[:1])
        self.learner.prepare()

    def state(self) -> bytes:
        """Serialize the state of the training and the environment, to resume exactly.

        The flights of an environment of quad_gym are kept as a snapshot, which contains no names of
        classes and modules; another environment is pickled.
        """
        kept = {name: getattr(self, name) for name in STATE}
        arrays = (self.networks.params, self.learner.moments, self.learner.steps)
        if isinstance(self.env, QuadVectorEnv):
            return pickle.dumps((kept, arrays, {"flights": self.env.flights.batch.snapshot()}))
        return pickle.dumps((kept, arrays, {"env": self.env}))

    def restore(self, state: bytes) -> None:
        """Restore a `state` with the same recipe; unpickling can run code, so trust its source.

        Raises:
            ValueError: If the state is from another configuration or version; nothing has changed
                then, except for the environment's reset.
        """
        kept, (params, moments, steps), flown = pickle.loads(state)
        if isinstance(self.env, QuadVectorEnv):
            self.env.reset(seed=self._env_seed)
            self.env.flights.batch.restore(flown["flights"])
        else:
            self.env = flown["env"]
        self.networks.params[:], self.learner.moments[:] = params, moments
        self.learner.steps = steps
        self.__dict__.update({name: kept[name] for name in STATE})

    # ---- a rollout ------------------------------------------------------------------------------

    def _roll_out(self) -> None:
        """Run `n_steps` steps, and estimate advantages."""
        actions = self._actions.shape[-1]
        log_std = self.networks.log_std
        spread, peak = np.exp(log_std), log_std.sum() + 0.5 * actions * np.log(2.0 * np.pi)
        evaluate = self.networks.evaluate
        assert self._seen is not None
        for t in range(len(self._actions)):
            self._observations[t] = self._seen
            means, self._values[t] = evaluate(self._seen)
            noise = self._rng.standard_normal(means.shape, np.float32)
            self._actions[t] = means + spread * noise
            self._log_probs[t] = -0.5 * (noise * noise).sum(axis=1) - peak
            reward, terminated, truncated, info = self._step(self._actions[t].clip(-1.0, 1.0))
            self._rewards[t] = np.float32(self.recipe.reward_scale) * reward.astype(np.float32)
            self._ended[t] = terminated | truncated
            cut = np.flatnonzero(truncated & ~terminated)
            if cut.size:  # bootstrap truncated episodes with the critic's value
                last = as_floats(np.stack(info["final_obs"][cut]))
                value = evaluate(last)[1]
                self._rewards[t, cut] += self.parameters["gamma"] * value
        discounts = (self.parameters["gamma"], self.parameters["gae_lambda"])
        ahead = evaluate(self._seen)[1]
        rollout = (self._rewards, self._values, self._ended, ahead)
        self._advantages[:] = advantages(*rollout, *discounts)
        self._targets[:] = self._advantages + self._values


def advantages(
    rewards: NDArray[np.float32],
    values: NDArray[np.float32],
    ended: NDArray[np.bool_],
    next_values: NDArray[np.float32],
    gamma: float,
    gae_lambda: float,
) -> NDArray[np.float32]:
    """Generalized advantage estimation (Schulman et al. 2016, eq. 16): advantages (T, n).

    A_t = d_t + gamma lambda A_{t+1}, d_t = r_t + gamma V(s_{t+1}) - V(s_t); both recursions stop at
    the end of an episode.

    Rewards (T, n) include the bootstrapped value at a truncation. Values (T, n) are of observations
    before the steps, and `next_values` (n,) of those after the last one. `ended` (T, n) is True if
    an episode ended with the step.
    """
    found = np.empty_like(values)
    ahead = np.zeros_like(next_values)
    for t in range(len(rewards) - 1, -1, -1):
        goes_on = np.float32(gamma) * ~ended[t]
        ahead = rewards[t] + goes_on * (next_values + np.float32(gae_lambda) * ahead) - values[t]
        found[t], next_values = ahead, values[t]
    return found


def _checked(recipe: Recipe, inputs: int) -> dict[str, Any]:
    """Check a recipe for a number of inputs; return its parameters with defaults."""
    check.choice("algorithm of the compiled engine", recipe.algorithm, ("ppo",))
    for name in recipe.parameters:
        if name in Recipe.__dataclass_fields__:
            raise ValueError(
                f"{name} belongs to the recipe, not to the parameters of the algorithm: "
                f"quad-gym sweep has --recipe {name}=..."
            )
    check.keywords(recipe.parameters, tuple(PARAMETERS), "the compiled PPO")
    check.keywords(recipe.policy, ("log_std_init",), "the policy of the compiled PPO")
    found: dict[str, Any] = {**PARAMETERS, **recipe.parameters}
    for name in ("n_steps", "batch_size", "n_epochs"):
        found[name] = check.whole(name, found[name])
    for name in ("gamma", "gae_lambda"):
        check.number(name, found[name], least=0.0, most=1.0)
    for name in ("clip_range", "max_grad_norm"):
        check.positive(name, found[name])
    for name in ("ent_coef", "vf_coef"):
        check.number(name, found[name], least=0.0)
    check.flag("normalize_advantage", found["normalize_advantage"])
    check.number("log_std_init", recipe.policy.get("log_std_init", 0.0))
    found["critic_only"] = check.whole("critic_only", found["critic_only"], least=0)
    if found["critic_only"] >= inputs:
        raise ValueError(
            f"critic_only must leave the actor at least one of {inputs} observed values, "
            f"got {found['critic_only']}"
        )
    return found

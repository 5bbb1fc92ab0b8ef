"""Update step of PPO: epochs of minibatches, on as many threads as are worthwhile."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from baselines.compiled_ppo import kernels
from baselines.compiled_ppo.networks import Networks
from quad_gym.batch.threads import MIN_BLOCKS_PER_THREAD, POSTED_BEFORE, Crew, board_of

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

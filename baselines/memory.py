"""Recurrent PPO whose training passes each sequence through the LSTM at once.

`RecurrentPPO` of SB3-Contrib cuts its rollouts where episodes begin, so that only the first step of
a sequence can be the first of an episode. It passes sequences with such a step through the LSTM
step by step, which takes twice the processor time of a training.
"""

from collections.abc import Callable

import torch
from sb3_contrib import RecurrentPPO
from torch import Tensor, nn

Process = Callable[[Tensor, tuple[Tensor, Tensor], Tensor, nn.LSTM], tuple[Tensor, ...]]


class SequencePPO(RecurrentPPO):
    """`RecurrentPPO` with faster training, and equal files and results up to rounding."""

    def _setup_model(self) -> None:
        super()._setup_model()
        # the class of the policy stays SB3-Contrib's, so that its files load without this package
        self.policy._process_sequence = at_once(self.policy._process_sequence)


def at_once(process: Process) -> Process:
    """Make a function that resets states before a sequence, and passes it through an LSTM.

    Args:
        process: `RecurrentActorCriticPolicy._process_sequence` of SB3-Contrib. Its arguments are
            features (n * length, inputs), states (layers, n, units) of the LSTM before the first
            step, whether an episode starts at each step (n * length), and the LSTM.
    """

    def pass_sequences(
        features: Tensor, states: tuple[Tensor, Tensor], starts: Tensor, lstm: nn.LSTM
    ) -> tuple[Tensor, ...]:
        n = states[0].shape[1]
        starting = starts.reshape((n, -1))
        if torch.any(starting[:, 1:] != 0.0):
            return process(features, states, starts, lstm)
        kept = (1.0 - starting[:, 0]).view(1, n, 1)
        hidden, cell = states
        return process(features, (kept * hidden, kept * cell), torch.zeros_like(starts), lstm)

    return pass_sequences

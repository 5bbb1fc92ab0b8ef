"""PPO without torch: rollouts, losses, gradients and Adam as compiled, multithreaded code.

`Imitation` trains the same networks by the answers of another controller instead of rewards.
"""

from baselines.compiled_ppo.imitation import Imitation
from baselines.compiled_ppo.ppo import CompiledPPO

__all__ = ["CompiledPPO", "Imitation"]

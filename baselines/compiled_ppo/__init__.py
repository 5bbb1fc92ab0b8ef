"""PPO without torch: rollouts, losses, gradients and Adam as compiled, multithreaded code."""

from baselines.compiled_ppo.ppo import CompiledPPO

__all__ = ["CompiledPPO"]

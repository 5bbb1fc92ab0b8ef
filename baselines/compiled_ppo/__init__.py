"""PPO without torch: rollouts, losses, gradients and Adam, compiled and on several cores."""

from baselines.compiled_ppo.ppo import CompiledPPO

__all__ = ["CompiledPPO"]

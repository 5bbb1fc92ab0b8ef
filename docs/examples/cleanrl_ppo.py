"""PPO in one file, with the settings and wrappers of CleanRL's `ppo_continuous_action.py`.

    python docs/examples/cleanrl_ppo.py --env-id quad_gym:QuadGym/Circle-v0

CleanRL is not a package: its scripts are to be copied, and need Gymnasium 0.29. This script is the
same algorithm for Gymnasium 1, with CleanRL's options, defaults and order of the wrappers.
"""

from collections import deque
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
import tyro
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from torch import nn
from torch.distributions import Normal


@dataclass
class Args:
    """Options, by the names that CleanRL gives them."""

    env_id: str = "quad_gym:QuadGym/Circle-v0"
    seed: int = 1
    total_timesteps: int = 1_000_000
    learning_rate: float = 3e-4
    num_envs: int = 1
    num_steps: int = 2048
    gamma: float = 0.99
    gae_lambda: float = 0.95
    num_minibatches: int = 32
    update_epochs: int = 10
    clip_coef: float = 0.2
    vf_coef: float = 0.5
    max_grad_norm: float = 0.5
    evaluate: int = 100
    """episodes of the evaluation, without exploration"""
    save: Path | None = None
    """file for the weights"""


def make_env(env_id, gamma):
    """One environment with CleanRL's wrappers, in its order."""
    env = gym.make(env_id)
    env = gym.wrappers.FlattenObservation(env)
    env = gym.wrappers.RecordEpisodeStatistics(env)
    env = gym.wrappers.ClipAction(env)
    env = gym.wrappers.NormalizeObservation(env)
    env = gym.wrappers.TransformObservation(
        env, lambda observation: np.clip(observation, -10, 10), env.observation_space
    )
    env = gym.wrappers.NormalizeReward(env, gamma=gamma)
    return gym.wrappers.TransformReward(env, lambda reward: float(np.clip(reward, -10, 10)))


def network(inputs, outputs, last):
    """Two tanh layers of 64 units with orthogonal weights; `last` is the output layer's gain."""
    sizes = [(inputs, 64, np.sqrt(2.0)), (64, 64, np.sqrt(2.0)), (64, outputs, last)]
    layers = []
    for before, after, gain in sizes:
        layer = nn.Linear(before, after)
        nn.init.orthogonal_(layer.weight, gain)
        nn.init.zeros_(layer.bias)
        layers += [layer, nn.Tanh()]
    return nn.Sequential(*layers[:-1])


class Agent(nn.Module):
    """Actor and critic, and the statistics by which observations were normalized."""

    def __init__(self, inputs, outputs):
        super().__init__()
        self.critic = network(inputs, 1, 1.0)
        self.actor = network(inputs, outputs, 0.01)
        self.log_std = nn.Parameter(torch.zeros(1, outputs))
        self.register_buffer("mean", torch.zeros(inputs, dtype=torch.float64))
        self.register_buffer("variance", torch.ones(inputs, dtype=torch.float64))

    def policy(self, observations):
        """The distribution of actions."""
        mean = self.actor(observations)
        return Normal(mean, self.log_std.exp().expand_as(mean))

    @torch.no_grad()
    def predict(self, observations, **_):
        """Actions without exploration, as Stable-Baselines3 returns them."""
        shifted = torch.as_tensor(observations, dtype=torch.float64) - self.mean
        normal = (shifted / (self.variance + 1e-8).sqrt()).clamp(-10, 10).float()
        return self.actor(normal).clamp(-1, 1).numpy(), None


def advantages_of(rewards, dones, values, last_done, last_value, args):
    """Generalized advantage estimates; as in CleanRL, a truncation counts as a termination."""
    advantages = torch.zeros_like(rewards)
    following, advantage = last_value, torch.zeros_like(last_value)
    goes_on = 1.0 - last_done
    for t in reversed(range(args.num_steps)):
        delta = rewards[t] + args.gamma * following * goes_on - values[t]
        advantage = delta + args.gamma * args.gae_lambda * goes_on * advantage
        advantages[t] = advantage
        following, goes_on = values[t], 1.0 - dones[t]
    return advantages


def loss_of(agent, batch, args):
    """PPO's loss of a minibatch: clipped policy, clipped value."""
    observations, actions, log_probs, advantages, returns, values = batch
    ratio = (agent.policy(observations).log_prob(actions).sum(1) - log_probs).exp()
    advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    clipped = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
    policy_loss = torch.max(-advantages * ratio, -advantages * clipped).mean()
    now = agent.critic(observations).squeeze(1)
    near = values + (now - values).clamp(-args.clip_coef, args.clip_coef)
    value_loss = 0.5 * torch.max((now - returns) ** 2, (near - returns) ** 2).mean()
    return policy_loss + args.vf_coef * value_loss


def train(args):
    """Train and return the agent."""
    rng = np.random.default_rng(args.seed)
    torch.manual_seed(args.seed)
    makers = [lambda: make_env(args.env_id, args.gamma)] * args.num_envs
    envs = SyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP)  # as CleanRL assumes
    inputs, outputs = envs.single_observation_space.shape[0], envs.single_action_space.shape[0]
    agent = Agent(inputs, outputs)
    optimizer = torch.optim.Adam(agent.parameters(), lr=args.learning_rate, eps=1e-5)
    shape = (args.num_steps, args.num_envs)
    observations, actions = torch.zeros(*shape, inputs), torch.zeros(*shape, outputs)
    log_probs, rewards, dones, values = (torch.zeros(shape) for _ in range(4))
    size = args.num_steps * args.num_envs
    observation = torch.as_tensor(envs.reset(seed=args.seed)[0], dtype=torch.float32)
    done = torch.zeros(args.num_envs)
    count, returns = args.total_timesteps // size, deque(maxlen=100)
    for iteration in range(count):
        optimizer.param_groups[0]["lr"] = args.learning_rate * (1.0 - iteration / count)
        for t in range(args.num_steps):
            observations[t], dones[t] = observation, done
            with torch.no_grad():
                policy = agent.policy(observation)
                actions[t] = policy.sample()
                log_probs[t] = policy.log_prob(actions[t]).sum(1)
                values[t] = agent.critic(observation).squeeze(1)
            result, reward, terminated, truncated, info = envs.step(actions[t].numpy())
            if "final_info" in info:
                returns.extend(info["final_info"]["episode"]["r"][info["_final_info"]])
            observation = torch.as_tensor(result, dtype=torch.float32)
            rewards[t] = torch.as_tensor(reward)
            done = torch.as_tensor(terminated | truncated, dtype=torch.float32)
        with torch.no_grad():
            last = agent.critic(observation).squeeze(1)
            advantages = advantages_of(rewards, dones, values, done, last, args)
        columns = (observations, actions, log_probs, advantages, advantages + values, values)
        data = [column.reshape(size, *column.shape[2:]) for column in columns]
        for _ in range(args.update_epochs):
            for rows in rng.permutation(size).reshape(args.num_minibatches, -1):
                loss = loss_of(agent, [column[rows] for column in data], args)
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
                optimizer.step()
        if returns:
            print(f"{(iteration + 1) * size:,} steps: return {np.mean(returns):.1f}", flush=True)
    statistics = [env.get_wrapper_attr("obs_rms") for env in envs.envs]
    agent.mean[:] = torch.as_tensor(np.mean([s.mean for s in statistics], axis=0))
    agent.variance[:] = torch.as_tensor(np.mean([s.var for s in statistics], axis=0))
    envs.close()
    return agent


def main(args):
    """Train, save and evaluate."""
    from quad_gym.evaluation import roll_out

    torch.set_num_threads(1)  # the networks are small
    agent = train(args)
    if args.save is not None:
        torch.save(agent.state_dict(), args.save)
    test = gym.make_vec(args.env_id, num_envs=args.evaluate)
    print(roll_out(agent, test, seed=0).summary())


if __name__ == "__main__":
    main(tyro.cli(Args))

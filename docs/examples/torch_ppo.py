"""PPO in one file of torch: flights, rollouts and networks are tensors of one device.

    python docs/examples/torch_ppo.py
    python docs/examples/torch_ppo.py --memory --env-id QuadGym/LookAround-v0 --gamma 0.99
    python docs/examples/torch_ppo.py --device cuda --num-envs 16384

With `--memory`, a GRU precedes the policy and the value, and learns through whole rollouts. On a
GPU nothing waits for the host within an iteration, and updates are replayed as a CUDA graph.
"""

import copy
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.distributions import Normal


@dataclass
class Args:
    """Options, with the defaults of `quad-gym train circle`."""

    env_id: str = "QuadGym/Circle-v0"
    observation: str = "estimate"
    """"estimate" or "truth", the observation in training"""
    device: str = "cpu"
    """device of flights and networks, "cpu" or "cuda\""""
    seed: int = 1
    total_timesteps: int = 1_800_000
    num_envs: int = 256
    num_steps: int = 32
    """steps of each flight in a rollout"""
    num_minibatches: int = 8
    """groups of flights, each of which makes one update"""
    update_epochs: int = 5
    memory: bool = False
    """observe the past, too, through a GRU"""
    units: int = 64
    learning_rate: float = 1e-3
    last_learning_rate: float = 1e-4
    reward_scale: float = 0.2
    gamma: float = 0.97
    gae_lambda: float = 0.95
    clip_coef: float = 0.2
    vf_coef: float = 0.5
    max_grad_norm: float = 0.5
    evaluate: int = 100
    """episodes of the evaluation on the estimate, without exploration"""
    save: Path | None = None
    """file for the weights"""


class Agent(nn.Module):
    """Policy and value, behind a GRU if they have a memory."""

    def __init__(self, inputs: int, outputs: int, units: int, memory: bool) -> None:
        super().__init__()
        self.cell = nn.GRUCell(inputs, units) if memory else None
        self.units = units if memory else 0
        seen = units if memory else inputs
        self.actor = network(seen, units, outputs)
        self.critic = network(seen, units, 1)
        self.log_std = nn.Parameter(torch.full((outputs,), -1.0))

    def begin(self, flights: int) -> torch.Tensor:
        """Return the memory of flights that begin, (n, units)."""
        return torch.zeros(flights, self.units, device=self.log_std.device)

    def features(
        self, observations: torch.Tensor, begins: torch.Tensor, state: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return inputs of policy and value, (T, n, k), and the memory after them, (n, units).

        Args:
            observations: (T, n, inputs).
            begins: (T, n) bool, where an episode begins with the observation.
            state: (n, units), the memory before.
        """
        if self.cell is None:
            return observations, state
        found = []
        for seen, fresh in zip(observations, begins, strict=True):
            state = self.cell(seen, state.masked_fill(fresh[:, None], 0.0))
            found.append(state)
        return torch.stack(found), state

    def policy(self, features: torch.Tensor) -> Normal:
        """Return the distribution of actions."""
        return Normal(self.actor(features), self.log_std.exp(), validate_args=False)

    def value(self, features: torch.Tensor) -> torch.Tensor:
        """Return the expected sum of discounted rewards."""
        return self.critic(features).squeeze(-1)

    @torch.no_grad()
    def predict(self, observations, state=None, episode_start=None, **_):
        """Return actions without exploration and the memory, as Stable-Baselines3 does."""
        seen = torch.as_tensor(observations, dtype=torch.float32)
        begins = torch.as_tensor(episode_start, dtype=torch.bool)
        state = self.begin(len(seen)) if state is None else state
        features, state = self.features(seen[None], begins[None], state)
        return self.actor(features[0]).clamp(-1, 1).numpy(), state


def network(inputs: int, units: int, outputs: int) -> nn.Module:
    """Return two layers of units and a linear one, whose weights are small for actions."""
    layers = [nn.Linear(inputs, units), nn.Linear(units, units), nn.Linear(units, outputs)]
    gains = (2.0**0.5, 2.0**0.5, 1.0 if outputs == 1 else 0.01)
    for layer, gain in zip(layers, gains, strict=True):
        nn.init.orthogonal_(layer.weight, gain)
        nn.init.zeros_(layer.bias)
    return nn.Sequential(layers[0], nn.ReLU(), layers[1], nn.ReLU(), layers[2])


def advantages_of(rewards, over, values, last_value, args):
    """Return generalized advantage estimates, (T, n); `over`: an episode ended with the step."""
    advantages, advantage = torch.zeros_like(rewards), torch.zeros_like(last_value)
    following = last_value
    for t in reversed(range(len(rewards))):
        goes_on = (~over[t]).float()
        delta = rewards[t] + args.gamma * following * goes_on - values[t]
        advantage = delta + args.gamma * args.gae_lambda * goes_on * advantage
        advantages[t], following = advantage, values[t]
    return advantages


def loss_of(agent, batch, args):
    """Return PPO's loss of some flights' rollouts, whose tensors are (T, n, ...)."""
    observations, begins, actions, log_probs, advantages, returns, state = batch
    features, _ = agent.features(observations, begins, state[0])
    ratio = (agent.policy(features).log_prob(actions).sum(-1) - log_probs).exp()
    advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    clipped = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
    policy_loss = torch.max(-advantages * ratio, -advantages * clipped).mean()
    return policy_loss + args.vf_coef * (agent.value(features) - returns).square().mean()


def updater(agent, optimizer, args) -> Callable[[list[torch.Tensor]], None]:
    """Return a function that makes one update; on a GPU it replays a CUDA graph."""

    def update(batch):
        optimizer.zero_grad(set_to_none=False)
        loss_of(agent, batch, args).backward()
        nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
        optimizer.step()

    if args.device == "cpu":
        return update
    graph, inputs = torch.cuda.CUDAGraph(), list[torch.Tensor]()

    def replay(batch):
        if not inputs:  # warm up beside the current stream, begin again from there, then capture
            inputs.extend(part.clone() for part in batch)
            before = copy.deepcopy(agent.state_dict())
            stream = torch.cuda.Stream()
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                for _ in range(3):
                    update(inputs)
            torch.cuda.current_stream().wait_stream(stream)
            with torch.cuda.graph(graph):
                update(inputs)
            agent.load_state_dict(before)
            for moments in optimizer.state.values():
                for moment in moments.values():
                    moment.zero_()
        for kept, part in zip(inputs, batch, strict=True):
            kept.copy_(part)
        graph.replay()

    return replay


@torch.no_grad()
def rollout(env, agent, seen, begins, state, args):
    """Fly `num_steps` steps; return their tensors, the last values, and the next start."""
    parts: list[list[torch.Tensor]] = [[] for _ in range(7)]
    for _ in range(args.num_steps):
        features, after = agent.features(seen[None], begins[None], state)
        policy = agent.policy(features[0])
        action = policy.sample()
        following, reward, terminated, truncated, infos = env.step(action)
        over, scored = terminated | truncated, args.reward_scale * reward
        if "final_obs" in infos:  # a truncated episode would have gone on
            final, _ = agent.features(infos["final_obs"][None], torch.zeros_like(over)[None], after)
            rest = args.gamma * agent.value(final[0])
            scored = scored + torch.where(truncated & ~terminated, rest, 0.0)
        log_prob, value = policy.log_prob(action).sum(-1), agent.value(features[0])
        row = (seen, begins, action, log_prob, scored, over, value)
        for part, tensor in zip(parts, row, strict=True):
            part.append(tensor.clone())
        seen, begins, state = following, over, after
    features, _ = agent.features(seen[None], begins[None], state)
    return [torch.stack(part) for part in parts], agent.value(features[0]), (seen, begins, state)


def train(env: Any, inputs: int, outputs: int, args: Args) -> Agent:
    """Train an agent in a vector environment of tensors with autoreset in the same step."""
    torch.manual_seed(args.seed)
    agent = Agent(inputs, outputs, args.units, args.memory).to(args.device)
    on_gpu = args.device != "cpu"
    rate = torch.tensor(args.learning_rate, device=args.device)
    optimizer = torch.optim.Adam(agent.parameters(), lr=rate, eps=1e-5, capturable=on_gpu)
    update = updater(agent, optimizer, args)
    seen, _ = env.reset(seed=10**9 + args.seed)  # not the seeds of the evaluation
    begins = torch.ones(args.num_envs, dtype=torch.bool, device=args.device)
    now = (seen, begins, agent.begin(args.num_envs))
    count = args.total_timesteps // (args.num_steps * args.num_envs)
    started, size = time.monotonic(), args.num_envs // args.num_minibatches
    for iteration in range(count):
        rate.fill_(
            args.learning_rate
            + (args.last_learning_rate - args.learning_rate) * iteration / max(count - 1, 1)
        )
        state = now[2]
        parts, last_value, now = rollout(env, agent, *now, args)
        observations, begins, actions, log_probs, rewards, over, values = parts
        advantages = advantages_of(rewards, over, values, last_value, args)
        data = (observations, begins, actions, log_probs, advantages, advantages + values)
        data = (*data, state[None])
        for _ in range(args.update_epochs):
            flights = torch.randperm(args.num_envs, device=args.device)
            for group in flights[: size * args.num_minibatches].split(size):
                update([part[:, group] for part in data])
        if (iteration + 1) % 20 == 0 or iteration + 1 == count:
            steps = (iteration + 1) * args.num_steps * args.num_envs
            reward = float(rewards.mean()) / args.reward_scale
            ends = float(over.float().mean())
            speed = steps / (time.monotonic() - started)
            print(
                f"{steps:,} steps, {speed:,.0f} a second: reward of a step {reward:.3f}, "
                f"{ends:.2%} of the steps end an episode",
                flush=True,
            )
    return agent


def main(args: Args) -> None:
    """Train, save and evaluate."""
    import quad_gym
    from quad_gym.evaluation import evaluate

    if args.device == "cpu":
        torch.set_num_threads(1)  # the networks are small
    env = quad_gym.make_torch_vec_env(
        args.env_id,
        args.num_envs,
        args.device,
        autoreset_mode="SameStep",
        observation=args.observation,
        start="mixed",
    )
    inputs, outputs = env.single_observation_space.shape[0], env.single_action_space.shape[0]
    agent = train(env, inputs, outputs, args).cpu()
    env.close()
    if args.save is not None:
        torch.save(agent.state_dict(), args.save)
    results = evaluate(agent, args.env_id, episodes=args.evaluate, observation="estimate")
    print({name: float(np.round(value, 4)) for name, value in results.summary().items()})


if __name__ == "__main__":
    import tyro

    main(tyro.cli(Args))

"""Recurrent PPO after `ppo_atari_lstm.py` of CleanRL.

A script of CleanRL is copied and changed, not imported: this loop is ours after its own. An LSTM
begins anew where an episode begins; a minibatch has the whole sequences of some envs, from the
states that they began with. As there, an episode that is truncated counts as ended.

    python studies/recurrent_ppo.py [--num-envs 64] [--updates 100] [--seed 1]

prints the mean reward of a step in rotorgram/Forest-v0, of each tenth of the updates.
"""

from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import torch
from measuring import options
from torch import Tensor, nn
from torch.distributions import Normal

FOREST = "rotorgram/Forest-v0"
SIZE = 64
GAMMA, GAE_LAMBDA = 0.98, 0.95
EPOCHS, MINIBATCHES = 4, 4
CLIP, VALUE_SHARE, MAX_NORM = 0.2, 0.5, 0.5

State = tuple[Tensor, Tensor]
"""Of the LSTM: what it says and what it keeps, (1, N, 64) each."""


class Agent(nn.Module):
    """Actor and critic above one LSTM."""

    def __init__(self, inputs: int, actions: int) -> None:
        super().__init__()
        self.encoder = nn.Sequential(nn.Linear(inputs, SIZE), nn.Tanh())
        self.memory = nn.LSTM(SIZE, SIZE)
        self.actor = nn.Linear(SIZE, actions)
        self.critic = nn.Linear(SIZE, 1)
        self.log_std = nn.Parameter(torch.full((actions,), -0.7))
        nn.init.orthogonal_(self.actor.weight, 0.01)
        nn.init.zeros_(self.actor.bias)

    def forward(self, seen: Tensor, begins: Tensor, state: State) -> tuple[Normal, Tensor, State]:
        """Of sequences, (T, N, inputs), and where episodes begin, (T, N): the distributions of
        actions, values (T, N), and the last state.
        """
        said = []
        for encoded, new in zip(self.encoder(seen), begins, strict=True):
            kept = (1.0 - new)[None, :, None]
            output, state = self.memory(encoded[None], (kept * state[0], kept * state[1]))
            said.append(output)
        hidden = torch.cat(said)
        return Normal(self.actor(hidden), self.log_std.exp()), self.critic(hidden)[..., 0], state


@dataclass
class Rollout:
    """T steps of N envs: (T, N), observations and actions (T, N, size)."""

    seen: Tensor
    begins: Tensor
    actions: Tensor
    scores: Tensor
    """Log-probabilities of the actions."""
    rewards: Tensor
    values: Tensor
    state: State
    """Before the first step."""
    next_value: Tensor
    """After the last step, (N,)."""
    next_begins: Tensor

    def advantages(self) -> Tensor:
        """Generalised advantage estimates, (T, N)."""
        found = torch.zeros_like(self.rewards)
        last = torch.zeros_like(self.next_value)
        value, ended = self.next_value, self.next_begins
        for step in reversed(range(len(found))):
            goes_on = 1.0 - ended
            delta = self.rewards[step] + GAMMA * goes_on * value - self.values[step]
            last = delta + GAMMA * GAE_LAMBDA * goes_on * last
            found[step] = last
            value, ended = self.values[step], self.begins[step]
        return found


class Collector:
    """Flies a vector env of SAME_STEP, whose observation is a mapping of arrays."""

    def __init__(self, env: gym.vector.VectorEnv, seed: int) -> None:
        self.env = env
        observations, _ = env.reset(seed=seed)
        self.seen = joined(observations)
        self.begins = torch.zeros(env.num_envs)
        nothing = torch.zeros(1, env.num_envs, SIZE)
        self.state: State = (nothing, nothing)

    @torch.no_grad()
    def rollout(self, agent: Agent, steps: int) -> Rollout:
        before = self.state
        space = self.env.single_action_space
        rows = []
        for _ in range(steps):
            chosen, value, self.state = agent(self.seen[None], self.begins[None], self.state)
            action = chosen.sample()[0]
            score = chosen.log_prob(action).sum(-1)[0]
            bounded = np.clip(action.numpy(), space.low, space.high)
            observations, rewards, terminated, truncated, _ = self.env.step(bounded)
            reward = torch.as_tensor(rewards, dtype=torch.float32)
            rows.append((self.seen, self.begins, action, score, reward, value[0]))
            self.seen = joined(observations)
            self.begins = torch.as_tensor(terminated | truncated, dtype=torch.float32)
        _, value, _ = agent(self.seen[None], self.begins[None], self.state)
        arrays = [torch.stack(column) for column in zip(*rows, strict=True)]
        return Rollout(*arrays, before, value[0], self.begins)


def joined(observations: dict[str, np.ndarray]) -> Tensor:
    """All arrays of N observations, (N, inputs)."""
    count = len(next(iter(observations.values())))
    rows = [array.reshape(count, -1) for array in observations.values()]
    return torch.as_tensor(np.concatenate(rows, axis=1), dtype=torch.float32)


def update(agent: Agent, optimizer: torch.optim.Optimizer, rollout: Rollout) -> float:
    """Learn from a rollout; by how much ratios differ from 1 before the first change."""
    advantages = rollout.advantages()
    returns = advantages + rollout.values
    differs = []
    for _ in range(EPOCHS):
        for envs in torch.randperm(advantages.shape[1]).chunk(MINIBATCHES):
            state = rollout.state[0][:, envs], rollout.state[1][:, envs]
            chosen, values, _ = agent(rollout.seen[:, envs], rollout.begins[:, envs], state)
            scores = chosen.log_prob(rollout.actions[:, envs]).sum(-1)
            ratio = (scores - rollout.scores[:, envs]).exp()
            differs.append(float((ratio.detach() - 1.0).abs().max()))
            own = advantages[:, envs]
            own = (own - own.mean()) / (own.std() + 1e-8)
            gain = torch.min(ratio * own, ratio.clamp(1.0 - CLIP, 1.0 + CLIP) * own).mean()
            error = 0.5 * (values - returns[:, envs]).square().mean()
            optimizer.zero_grad()
            (VALUE_SHARE * error - gain).backward()
            nn.utils.clip_grad_norm_(agent.parameters(), MAX_NORM)
            optimizer.step()
    return differs[0]


def learn(env: gym.vector.VectorEnv, steps: int, updates: int, seed: int = 1) -> list[float]:
    """Mean rewards of the steps of each update.

    Raises `AssertionError` where sequences are not flown again as they were.
    """
    torch.manual_seed(seed)
    collector = Collector(env, seed)
    agent = Agent(collector.seen.shape[1], env.single_action_space.shape[0])
    optimizer = torch.optim.Adam(agent.parameters(), lr=1e-3, eps=1e-5)
    rewards = []
    for _ in range(updates):
        rollout = collector.rollout(agent, steps)
        differs = update(agent, optimizer, rollout)
        assert differs < 1e-3, f"ratios: expected 1 before the first change, got {differs:g} off"
        rewards.append(float(rollout.rewards.mean()))
    return rewards


def main() -> None:
    args = options(__doc__, num_envs=64, updates=100, seed=1).parse_args()
    import rotorgram.envs  # noqa: F401  registers the envs

    env = gym.make_vec(FOREST, num_envs=args.num_envs, autoreset_mode="SameStep")
    rewards = np.array(learn(env, 64, args.updates, args.seed))
    for part in np.array_split(rewards, 10):
        print(f"{part.mean():+.4f}")


if __name__ == "__main__":
    main()

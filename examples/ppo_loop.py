"""PPO in one file on the vector env: collect, advantages, update, and nothing hidden.

    python examples/ppo_loop.py [--updates 50]

The env resets a drone in the step after its episode's end (Gymnasium's NEXT_STEP). That step is no
transition: its action is ignored and its reward is 0, so it is masked out of everything.
"""

import argparse

import gymnasium as gym
import numpy as np
import rotorgram.envs
import torch
from torch import nn

assert rotorgram.envs  # importing it registers the env
parser = argparse.ArgumentParser()
parser.add_argument("--updates", type=int, default=50)
parser.add_argument("--seed", type=int, default=0)
args = parser.parse_args()

DRONES = 16
STEPS = 128
GAMMA = 0.98
LAMBDA = 0.95
CLIP = 0.2
torch.manual_seed(args.seed)
torch.set_num_threads(1)
envs = gym.make_vec("rotorgram/Elevation-v0", num_envs=DRONES)


def network(outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(3, 64), nn.Tanh(), nn.Linear(64, outputs))


actor = network(1)
critic = network(1)
log_std = nn.Parameter(torch.tensor(-0.5))
with torch.no_grad():
    actor[2].weight *= 0.01  # the first policy holds the thrust
optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters(), log_std], lr=3e-3)
observation, _ = envs.reset(seed=args.seed)
fresh = np.zeros(DRONES, bool)  # whose next step is a reset, no transition
total = np.zeros(DRONES)
returns = []

for update in range(args.updates):
    rows = []
    for _ in range(STEPS):
        seen = torch.as_tensor(observation)
        with torch.no_grad():
            policy = torch.distributions.Normal(actor(seen), log_std.exp())
            action = policy.sample()
            value = critic(seen).squeeze(1)
            log_prob = policy.log_prob(action).sum(1)
        following, reward, terminated, truncated, _ = envs.step(action.clamp(-1, 1).numpy())
        with torch.no_grad():  # a truncated flight would have gone on; a terminated one would not
            after = critic(torch.as_tensor(following)).squeeze(1) * torch.as_tensor(~terminated)
        rows.append((seen, action, log_prob, value, after, torch.as_tensor(reward).float(),
                     torch.as_tensor(terminated | truncated), torch.as_tensor(~fresh)))  # fmt: skip
        total += reward
        fresh = terminated | truncated
        returns += total[fresh].tolist()
        total[fresh] = 0
        observation = following
    seen, action, log_prob, value, after, reward, ended, flown = map(
        torch.stack, zip(*rows, strict=True)
    )

    advantage = torch.zeros_like(reward)
    ahead = torch.zeros(DRONES)
    for t in reversed(range(STEPS)):
        delta = reward[t] + GAMMA * after[t] - value[t]
        ahead = delta + GAMMA * LAMBDA * ahead * ~ended[t] * flown[t]
        advantage[t] = ahead
    target = (advantage + value)[flown]
    old = log_prob[flown]
    seen = seen[flown]
    action = action[flown]
    advantage = advantage[flown]
    advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)

    for _ in range(10):
        for batch in torch.randperm(len(seen)).split(512):
            policy = torch.distributions.Normal(actor(seen[batch]), log_std.exp())
            ratio = (policy.log_prob(action[batch]).sum(1) - old[batch]).exp()
            clipped = ratio.clamp(1 - CLIP, 1 + CLIP)
            gain = torch.min(ratio * advantage[batch], clipped * advantage[batch]).mean()
            miss = (critic(seen[batch]).squeeze(1) - target[batch]).pow(2).mean()
            optimizer.zero_grad()
            (0.5 * miss - gain).backward()
            optimizer.step()
    recent = f"{np.mean(returns[-2 * DRONES :]):.1f}" if returns else "none yet"
    print(f"update {update + 1}: {(update + 1) * DRONES * STEPS:,} steps, return {recent}")
envs.close()

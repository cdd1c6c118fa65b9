"""Model predictive control by random shooting: a second env is the model of the first.

python examples/mpc.py

In each control step the model takes the state of the env by `snapshot` and `restore` and flies
random plans; the env flies the first action of the best. No gradient and no training.
"""

import argparse

import gymnasium as gym
import numpy as np
import rotorgram.envs  # noqa: F401  # registers the envs

PLANS = 20  # in each control step
HORIZON = 40  # control steps of a plan
SPREAD = 0.5  # of random changes of a plan, at first
SHRINK = 0.5  # of the spread, after every fifth plan

parser = argparse.ArgumentParser()
parser.add_argument("--steps", type=int, default=150, help="control steps of 20 ms")
STEPS = parser.parse_args().steps

env = gym.make("rotorgram/Hover-v0", action="velocity")
model = gym.make("rotorgram/Hover-v0", action="velocity").unwrapped
model.reset()
rng = np.random.default_rng(1)


def total_reward(snapshot, action):
    """Reward of a plan that holds an action, from the state of a snapshot on."""
    model.restore(snapshot)
    total = 0.0
    for _ in range(HORIZON):
        _, reward, terminated, truncated, _ = model.step(action)
        total += reward
        if terminated or truncated:
            break
    return total


def best_action(last):
    """The best of random changes of the last action."""
    snapshot = env.unwrapped.snapshot()
    best = last
    most = total_reward(snapshot, last)
    for number in range(PLANS):
        spread = SPREAD * SHRINK ** (number // 5)
        action = best + spread * rng.normal(size=last.shape)
        action = action.clip(-1.0, 1.0).astype(np.float32)
        total = total_reward(snapshot, action)
        if total > most:
            best = action
            most = total
    return best


action = np.zeros(env.action_space.shape, np.float32)
_, info = env.reset(seed=1)
for step in range(1, STEPS + 1):
    action = best_action(action)
    _, _, terminated, truncated, info = env.step(action)
    if step % 25 == 0 or step == STEPS:
        print(f"step {step}: {info['position_error']:.3f} m from the goal")
    if terminated or truncated:
        break
env.close()
model.close()

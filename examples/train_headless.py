"""Train A2C over UDP without a display, keep the policy, and measure it.

    python examples/train_headless.py [--env-steps 100000] [--num-envs 16] [--out FILE]

The same from the command line, with checkpoints on the way and curves for TensorBoard:

    rotorgram train a2c --env-steps 100000 --num-envs 16 --env.target 4 8 \\
        --set steps_per_update=1024 learning_rate=0.02
"""

import argparse
from pathlib import Path

import numpy as np
from rotorgram.agents import preset
from rotorgram.agents.policies import NetworkPolicy
from rotorgram.envs import ElevationConfig
from rotorgram.experiments.evaluate import evaluation_row, fly_episodes
from rotorgram.experiments.pairs import socket_pair
from rotorgram.experiments.training import Run, Training

parser = argparse.ArgumentParser()
parser.add_argument("--env-steps", type=int, default=100_000)
parser.add_argument("--num-envs", type=int, default=16)
parser.add_argument("--out", type=Path, default=Path("policy.safetensors"))
args = parser.parse_args()

task = ElevationConfig(target=(4.0, 8.0))  # a target of its own for every episode
run = Run(
    algorithm="a2c",
    config=preset("a2c", "tuned", steps_per_update=1024, learning_rate=0.02),
    env=task,
    seed=0,
    env_steps=args.env_steps,
    num_envs=args.num_envs,
)
with socket_pair(task, num_envs=run.num_envs) as drones:  # an agent here, a simulator beside it
    training = Training(run, drones)
    training.train()
training.store(args.out)
print(f"{training.log.env_steps:,} env steps in {training.log.seconds:.1f} s: {args.out}")

with socket_pair(task) as drone:
    flights = fly_episodes(drone, NetworkPolicy(training.agent.actor()), episodes=5)
rows = [evaluation_row(flight, i, task.control_period) for i, flight in enumerate(flights)]
print(f"steady-state |E|: {np.mean([row['steady_error'] for row in rows]):.3f} m")

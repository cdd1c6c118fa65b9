"""Train A2C over UDP without a display, keep the policy, and measure it.

    python examples/train_headless.py [--env-steps 100000] [--num-envs 16] [--out FILE]

The same from the command line, with checkpoints on the way and curves for TensorBoard:

    rotorgram train a2c --env-steps 100000 --num-envs 16 --env.target 4 8 \\
        --set steps_per_update=1024 learning_rate=0.02
"""

import argparse
from pathlib import Path

import numpy as np
from rotorgram.agents import preset, store
from rotorgram.envs import EnvConfig
from rotorgram.flights.trajectories import fly_episodes
from rotorgram.training.metrics import steady_state
from rotorgram.training.settings import Run
from rotorgram.training.training import Training
from rotorgram.udp.spawn import spawn_simulator

parser = argparse.ArgumentParser()
parser.add_argument("--env-steps", type=int, default=100_000)
parser.add_argument("--num-envs", type=int, default=16)
parser.add_argument("--out", type=Path, default=Path("policy.safetensors"))
args = parser.parse_args()

run = Run(
    algorithm="a2c",
    config=preset("a2c", "tuned", steps_per_update=1024, learning_rate=0.02),
    env=EnvConfig(task={"target": (4.0, 8.0)}),  # a target of its own for every episode
    seed=0,
    env_steps=args.env_steps,
    num_envs=args.num_envs,
)
with spawn_simulator(run.env, num_envs=run.num_envs) as drones:  # agent here, simulator beside it
    training = Training(run, drones)
    training.train()
store(training.checkpoint(), args.out)
print(f"{training.log.env_steps:,} env steps in {training.log.seconds:.1f} s: {args.out}")

with spawn_simulator(run.env, num_envs=5) as drones:
    policy = training.agent.policy()
    trajectories = fly_episodes(drones, policy, episodes=5)
errors = [abs(one.headline[1:]) for one in trajectories]
print(f"steady-state |E|: {np.mean([steady_state(error) for error in errors]):.3f} m")

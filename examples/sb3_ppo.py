"""Stable-Baselines3's PPO, with 16 drones through one socket.

python examples/sb3_ppo.py [--env-steps 100000]
"""

import argparse
import subprocess
import sys

from rotorgram.agents.sb3 import SB3VecEnv
from rotorgram.udp import RemoteVectorEnv
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecMonitor

parser = argparse.ArgumentParser()
parser.add_argument("--env-steps", type=int, default=100_000)
args = parser.parse_args()

drones = RemoteVectorEnv(
    ("127.0.0.1", 0), num_envs=16, autoreset_mode="SameStep", connect=False, connect_timeout=60
)
host, port = drones.address
simulator = subprocess.Popen(
    [sys.executable, "-m", "rotorgram.cli", "sim", "--num-envs", "16",
     "--server", f"{host}:{port}", "--bind", "127.0.0.1:0"]
)  # fmt: skip
drones.connect()

envs = VecMonitor(SB3VecEnv(drones))
model = PPO("MlpPolicy", envs, n_steps=128, batch_size=512, gamma=0.98, device="cpu", seed=0)
model.learn(args.env_steps)
mean, deviation = evaluate_policy(model, envs, n_eval_episodes=16)
print(f"return {mean:.1f} ± {deviation:.1f} of at most 250")
envs.close()
simulator.wait()

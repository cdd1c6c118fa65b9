"""Environment steps that `examples/ppo_loop.py` needs, beside SB3's PPO with the same settings.

    python studies/ppo_example.py [--seeds 3] [--out FILE.json]

For each seed: after how many steps the mean return of the last 32 episodes is 150 and 200 of at
most 250. Both train with 16 drones in process and look after each update of 2,048 steps.

It takes about six minutes on two cores.
"""

import json
import re
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import rotorgram.envs
import torch
from measuring import options
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

ENV = "rotorgram/Elevation-v0"
DRONES = 16
UPDATES = 50
RETURNS = (150, 200)
EXAMPLE = Path(__file__).parents[1] / "examples" / "ppo_loop.py"
assert rotorgram.envs  # importing it registers the env


class Curve(BaseCallback):
    """Mean return of the last episodes after each update."""

    def __init__(self) -> None:
        super().__init__()
        self.returns: list[float] = []
        self.points: list[tuple[int, float]] = []

    def _on_step(self) -> bool:
        self.returns += [i["episode"]["r"] for i in self.locals["infos"] if "episode" in i]
        return True

    def _on_rollout_end(self) -> None:
        if self.returns:
            self.points.append((self.num_timesteps, float(np.mean(self.returns[-2 * DRONES :]))))


def sb3(seed: int) -> list[tuple[int, float]]:
    """Env steps and mean returns of SB3's PPO with the example's settings."""
    envs = VecMonitor(DummyVecEnv([lambda: gym.make(ENV)] * DRONES))
    policy = {"net_arch": [64], "log_std_init": -0.5}
    model = PPO("MlpPolicy", envs, n_steps=128, batch_size=512, gamma=0.98, learning_rate=3e-3,
                seed=seed, policy_kwargs=policy, device="cpu")  # fmt: skip
    curve = Curve()
    model.learn(UPDATES * 128 * DRONES, curve)
    return curve.points


def example(seed: int) -> list[tuple[int, float]]:
    """The same of the example."""
    command = [sys.executable, str(EXAMPLE), "--seed", str(seed), "--updates", str(UPDATES)]
    told = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    points = re.findall(r": ([\d,]+) steps, return (-?[\d.]+)", told)
    return [(int(steps.replace(",", "")), float(mean)) for steps, mean in points]


def main() -> None:
    """Train both with each seed, and write after how many steps they were there."""
    args = options(__doc__, seeds=3, out=Path).parse_args()
    torch.set_num_threads(1)
    found: dict[str, list[dict[str, object]]] = {"ppo_loop.py": [], "SB3's PPO": []}
    for seed in range(args.seeds):
        for (name, rows), curve in zip(found.items(), (example(seed), sb3(seed)), strict=True):
            row = {"seed": seed}
            for least in RETURNS:
                there = (steps for steps, mean in curve if mean >= least)
                row[f"return_{least}"] = next(there, None)  # null: not within the steps
            rows.append(row)
            print(name, row, flush=True)
    if args.out:
        args.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()

"""When VPG begins to hold the target, seed by seed, and what its policy has learnt by then.

    python benchmarks/vpg_seeds.py [--first-seed 200] [--seeds 20]

Every 10,000 env steps the policy flies six episodes without exploration. It holds from the first
such time on from which none of them crashes and the mean size of the error over their last 60
steps stays below 0.1 m. The gains are the slopes of the action at the target: over the error, over
its rate (damping) and over the thrust.
"""

import argparse

import gymnasium as gym
import numpy as np
import rotorgram.envs
import torch
from rotorgram.agents import EpisodeLog, NetworkPolicy, make_agent, preset

ENV = "rotorgram/Elevation-v0"
assert rotorgram.envs  # importing it registers the env


def flown(policy: NetworkPolicy) -> tuple[int, float]:
    """Crashes of six episodes, and the mean size of their late errors, m."""
    env, crashes, late = gym.make(ENV), 0, []
    for seed in range(6):
        observation, ended, errors = env.reset(seed=seed)[0], False, []
        while not ended:
            observation, _, crashed, cut, info = env.step(policy.act(observation))
            errors.append(abs(info["elevation_error"]))
            ended, crashes = crashed or cut, crashes + crashed
        late.append(np.mean(errors[-60:]))
    return crashes, float(np.mean(late))


def gains(policy: NetworkPolicy) -> list[float]:
    """Slopes of the action over what is observed, at the target."""
    step = np.diag((0.3, 0.3, 0.1)).astype(np.float32)
    change = policy.output(step) - policy.output(-step)
    return [round(float(x), 2) for x in change[:, 0] / (2 * np.diag(step))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first-seed", type=int, default=200)
    parser.add_argument("--seeds", type=int, default=20)
    args = parser.parse_args()
    torch.set_num_threads(1)
    for seed in range(args.first_seed, args.first_seed + args.seeds):
        log = EpisodeLog(gym.make(ENV, disable_env_checker=True), seed)
        agent = make_agent("vpg", log, preset("vpg", "tuned"), seed)
        rows: list[tuple[int, int, float]] = []

        def look(log=log, agent=agent, rows=rows, seed=seed) -> bool:
            if log.env_steps >= 10_000 * (len(rows) + 1):
                policy = NetworkPolicy(agent.actor(), log.spec)
                rows.append((log.env_steps, *flown(policy)))
                if len(rows) in (3, 6):
                    print(f"  seed {seed}, {rows[-1][0]:,} steps: gains {gains(policy)}")
            return True

        agent.train(log, 200_000, look)
        bad = [number for number, (_, crashes, error) in enumerate(rows) if crashes or error >= 0.1]
        first = bad[-1] + 1 if bad else 0
        since = f"holds from {rows[first][0]:,} steps on" if first < len(rows) else "does not hold"
        print(f"seed {seed}: {since}, late error {rows[-1][2]:.4f} m", flush=True)


if __name__ == "__main__":
    main()
